"""GalSim's configuration: the types are there, and the example files run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import galsim
import numpy as np
import pytest

import bfsensor

EXAMPLES = Path(__file__).parents[2] / "validation"


def read(name, folder, **changes):
    (config,) = galsim.config.ReadConfig(str(EXAMPLES / name))
    config["output"]["dir"] = str(folder)
    config["output"].update(changes)
    return config


def python(code):
    """Run code in a fresh interpreter."""
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_star_field_is_the_same_on_one_process_and_on_two(tmp_path):
    images = {}
    for nproc in (1, 2):
        folder = tmp_path / str(nproc)
        galsim.config.Process(read("star_field.yaml", folder, nproc=nproc, nfiles=2))
        images[nproc] = [galsim.fits.read(str(p)).array for p in sorted(folder.iterdir())]
    assert len(images[1]) == 2
    for one, two in zip(images[1], images[2], strict=True):
        np.testing.assert_array_equal(one, two)
        assert one.max() > 1e4
    assert not np.array_equal(*images[1])


def test_silicon_swap_runs_on_ours_only_with_its_module(tmp_path):
    text = (EXAMPLES / "silicon_swap.yaml").read_text()
    assert text.count("bfsensor") == 1
    code = (
        "import galsim, galsim.config as c; "
        f"(d,) = c.ReadConfig({str(EXAMPLES / 'silicon_swap.yaml')!r}); "
        f"d['output']['dir'] = {str(tmp_path)!r}; {{}}c.Process(d); "
        "print(type(c.sensor.valid_sensor_types['Silicon']).__module__.split('.')[0])"
    )
    assert python(code.format("")) == "bfsensor"
    ours = galsim.fits.read(str(tmp_path / "silicon_swap.fits")).array
    assert python(code.format("d.pop('modules'); ")) == "galsim"
    theirs = galsim.fits.read(str(tmp_path / "silicon_swap.fits")).array
    assert ours.sum() == pytest.approx(theirs.sum(), rel=0.003)
    assert not np.array_equal(ours, theirs)


@pytest.mark.parametrize(
    "first", ["import bfsensor; import galsim", "import galsim; import bfsensor"]
)
def test_the_type_is_registered_whichever_comes_first(first):
    code = (
        f"{first}; import galsim.config; "
        "print('BrighterFatter' in galsim.config.sensor.valid_sensor_types)"
    )
    assert python(code) == "True"


def test_importing_bfsensor_is_cheap():
    code = "import sys, bfsensor; print(any(m in sys.modules for m in ('galsim', 'numba')))"
    assert python(code) == "False"


def build(sensor):
    base = {"image": {"sensor": sensor}, "rng": galsim.BaseDeviate(77)}
    return galsim.config.BuildSensor(base["image"], "sensor", base)


def test_options_reach_the_sensor():
    sensor = build({
        "type": "BrighterFatter", "name": "e2v_ccd250", "strength": 1.5, "red": "kept",
        "nrecalc": 2000, "full_well": 1.2e5, "depth": False, "transpose": True,
        "treering_center": {"type": "XY", "x": 1, "y": 2},
    })  # fmt: skip
    assert isinstance(sensor, bfsensor.BrighterFatterSensor)
    assert isinstance(sensor, galsim.SiliconSensor)
    assert (sensor.strength, sensor.red, sensor.nrecalc) == (1.5, "kept", 2000.0)
    assert (sensor.full_well, sensor.depth, sensor.transpose) == (1.2e5, False, True)
    assert sensor.treering_center == galsim.PositionD(1, 2)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"colour": "red"}, galsim.GalSimConfigError),
        ({"strength": "strong"}, galsim.GalSimConfigError),
        ({"red": "blue"}, bfsensor.SensorError),
    ],
)
def test_wrong_options_are_refused(options, error):
    with pytest.raises(error):
        build({"type": "BrighterFatter", **options})
