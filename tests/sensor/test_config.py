"""GalSim's configuration: the types are there, and the example files run."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from pathlib import Path

import galsim
import numpy as np
import pytest

import bfsensor

EXAMPLES = Path(__file__).parents[2] / "validation" / "sensor"


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


# -- the example files ---------------------------------------------------------------------


@pytest.mark.slow
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


def test_star_field_runs_by_its_command(tmp_path):
    """``modules: [bfsensor]`` is all that GalSim's command needs; stamps may be spread too."""
    command = [
        sys.executable, "-c", "from galsim.__main__ import run_main; run_main()",
        str(EXAMPLES / "star_field.yaml"), f"output.dir={tmp_path}", "output.nfiles=1",
        "image.nproc=2",
    ]  # fmt: skip
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    (file,) = tmp_path.iterdir()
    written = galsim.fits.read(str(file)).array
    assert written.max() > 1e4
    here = galsim.config.BuildImage(read("star_field.yaml", tmp_path))
    np.testing.assert_array_equal(written, here.array)


def test_star_field_shows_the_effect(tmp_path):
    """Peaks are lower than with the sensor's boundaries at rest."""
    peaks = []
    for strength in (1.0, 0.0):
        config = read("star_field.yaml", tmp_path)
        # The brightest star alone, so that the peak is the same in both.
        config["gal"]["flux"] = 6.0e5
        config["image"].update(nobjects=1, size=64)
        config["image"]["sensor"]["strength"] = strength
        peaks.append(galsim.config.BuildImage(config).array.max())
    # Photons are the same; the peak of about 3e4 e- loses some per cent, 5 sigma are 3 %
    # if no electron were shared between the two images, and nearly all are.
    assert peaks[0] < 0.99 * peaks[1]


SWAP = f"""
import copy, galsim, galsim.config as c
(d,) = c.ReadConfig({str(EXAMPLES / "silicon_swap.yaml")!r})
d["output"]["dir"] = FOLDER
"""


def test_silicon_swap_runs_on_ours_only_with_its_module(tmp_path):
    text = (EXAMPLES / "silicon_swap.yaml").read_text()
    assert text.count("bfsensor") == 1
    images = {}
    for package, change in (("bfsensor", ""), ("galsim", "d.pop('modules')")):
        code = SWAP.replace("FOLDER", repr(str(tmp_path / package))) + (
            f"{change}\nc.Process(d)\n"
            "print(type(c.sensor.valid_sensor_types['Silicon']).__module__.split('.')[0])"
        )
        assert python(code) == package
        file = tmp_path / package / "silicon_swap.fits"
        images[package] = galsim.fits.read(str(file)).array.astype(float)
    ours, theirs = images["bfsensor"], images["galsim"]
    # Each sum is of Poisson numbers, independent as the sensors take other random numbers.
    assert ours.sum() == pytest.approx(theirs.sum(), abs=5 * np.sqrt(2 * theirs.sum()))
    assert not np.array_equal(ours, theirs)


def swap_sky(kind, use_flux, tmp_path):
    """Sky of the file on a sensor, without stars and noise."""
    config = read("silicon_swap.yaml", tmp_path)
    config.pop("modules")
    config["image"].pop("noise")
    config["gal"]["flux"] = 0.0
    config["image"]["use_flux_sky_areas"] = use_flux
    options = {k: v for k, v in config["image"]["sensor"].items() if k != "treering_center"}
    options["treering_func"] = galsim.SiliconSensor.simple_treerings(0.05, 80.0)
    options.pop("type")
    config["image"]["sensor"] = kind(
        rng=galsim.BaseDeviate(77), treering_center=galsim.PositionD(-400, 60), **options
    )
    return galsim.config.BuildImage(config).array.astype(float)


def test_sky_of_silicon_swap_goes_through_areas(tmp_path):
    """The sky has rings, and by use_flux_sky_areas its own charge acts, as in GalSim."""
    ours, theirs = (
        [swap_sky(kind, use_flux, tmp_path) for use_flux in (True, False)]
        for kind in (bfsensor.SiliconSensor, galsim.SiliconSensor)
    )
    inside = np.s_[5:-5, 5:-5]  # GalSim's edges at the top and the right do not move
    j, i = np.indices(ours[0].shape) + 1
    r = np.hypot(i + 400, j - 60)
    phase = 2 * np.pi * r / 80.0
    # The divergence of a radial shift f(r) is f' + f / r.
    divergence = 0.05 * (np.cos(phase) / r - 2 * np.pi / 80.0 * np.sin(phase))
    sky = 9000 * 0.3**2 * (1 + divergence)
    for our, their in zip(ours, theirs, strict=True):
        # A difference over a pixel is not the slope: (2 pi / 80)^2 / 24 of 4e-3, 1e-6; the
        # strings that bound a pixel and single precision are of the same order.
        np.testing.assert_allclose(our[inside], sky[inside], rtol=5e-6)
        # GalSim's rings lie half a pixel away in x and y, 0.5 * sqrt(2) pixels at most
        # along the radius, and their areas change by 3.1e-4 a pixel.
        np.testing.assert_allclose(our[inside], their[inside], rtol=2.2e-4)
    # Beside the image there is no sky that would push back: 1.1e-3 of the area here.
    use_flux, rings_only = ours
    assert np.abs(use_flux / rings_only - 1)[0].min() > 5e-4


# -- registration --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "first", ["import bfsensor; import galsim", "import galsim; import bfsensor"]
)
def test_the_type_works_whichever_comes_first(first):
    code = (
        f"{first}; import galsim.config; "
        "types = galsim.config.sensor.valid_sensor_types; "
        "print('BrighterFatter' in types and 'BfsensorSilicon' in types); "
        "d = {'sensor': {'type': 'BrighterFatter', 'name': 'e2v_ccd250'}}; "
        "print(galsim.config.BuildSensor(d, 'sensor', {'rng': galsim.BaseDeviate(77)}));"
        "print(galsim.config.sensor.valid_sensor_types['Silicon'].init_func)"
    )
    found, sensor, silicon = python(code).splitlines()
    assert found == "True"
    assert sensor == "bfsensor.BrighterFatterSensor('e2v_ccd250')"
    assert silicon == "<class 'galsim.sensor.SiliconSensor'>"


@pytest.mark.parametrize("first", ["", "import bfsensor; ", "import galsim; "])
def test_silicon_is_ours_once_as_silicon_is_imported(first):
    code = (
        f"{first}import bfsensor.as_silicon; import galsim; "
        "d = {'sensor': {'type': 'Silicon', 'name': 'lsst_e2v_50_8'}}; "
        "print(galsim.config.BuildSensor(d, 'sensor', {'rng': galsim.BaseDeviate(77)}))"
    )
    assert python(code) == "bfsensor.SiliconSensor('lsst_e2v_50_8')"


def test_importing_bfsensor_is_cheap():
    code = "import sys, bfsensor; print(any(m in sys.modules for m in ('galsim', 'numba')))"
    assert python(code) == "False"


# -- building sensors ----------------------------------------------------------------------


def build(sensor, **others):
    base = {"image": {"sensor": sensor, **others}, "rng": galsim.BaseDeviate(77)}
    return galsim.config.BuildSensor(base["image"], "sensor", base)


def test_our_silicon_sensor_has_a_type_of_its_own():
    """Beside GalSim's, which stays what it is (the test above)."""
    options = {"name": "lsst_e2v_50_8", "strength": 1.5, "nrecalc": 2000, "threads": 2}
    sensor = build({"type": "BfsensorSilicon", **options})
    assert type(sensor) is bfsensor.SiliconSensor
    assert sensor == bfsensor.SiliconSensor(rng=galsim.BaseDeviate(77), **options)
    assert build({"type": "BfsensorSilicon"}).threads is None
    assert build({"type": "BfsensorSilicon", "threads": None}).threads is None
    with pytest.raises(
        galsim.GalSimConfigError, match="Could not parse all as a <class 'int'>"
    ):
        build({"type": "BfsensorSilicon", "threads": "all"})
    known = set(bfsensor.SiliconSensor._opt_params)
    assert known == set(galsim.SiliconSensor._opt_params) | {"surroundings", "threads"}


def used_threads(kind, nproc, monkeypatch, tmp_path):
    """Threads that kernels use while a configuration draws, by process."""
    from bfsensor.sensor.image_exposure import ImageExposure

    inner = ImageExposure._busy_threads
    folder = tmp_path / f"{kind}{nproc}"
    folder.mkdir()

    def noted(exposure, photons):
        threads = inner(exposure, photons)
        (folder / f"{os.getpid()}-{threads}").touch()
        return threads

    monkeypatch.setattr(ImageExposure, "_busy_threads", noted)
    config = {
        "modules": ["bfsensor"],
        "gal": {"type": "Gaussian", "sigma": 0.3, "flux": 4e4},
        "stamp": {"draw_method": "phot"},
        "image": {"type": "Tiled", "nx_tiles": 4, "ny_tiles": 1, "stamp_size": 15,
                  "nproc": nproc, "random_seed": 977, "pixel_scale": 0.2,
                  "sensor": {"type": kind}},
    }  # fmt: skip
    pixels = galsim.config.BuildImage(config).array.copy()
    monkeypatch.setattr(ImageExposure, "_busy_threads", inner)
    found = [path.name.split("-") for path in folder.iterdir()]
    return pixels, {int(p) for p, _ in found}, {int(t) for _, t in found}


@pytest.mark.parametrize("kind", ["BfsensorSilicon", "BrighterFatter"])
def test_processes_of_a_configuration_use_one_thread_each(kind, monkeypatch, tmp_path):
    """By default sensors follow GalSim, which turns threads off where it starts processes."""
    before = galsim.get_omp_threads()
    if galsim.set_omp_threads(2) != 2:
        pytest.skip("GalSim was built without OpenMP")
    # So that these photons are many enough for the default to be more than one thread.
    monkeypatch.setattr("bfsensor.sensor.threads.MANY", 1000)
    try:
        alone, processes, threads = used_threads(kind, 1, monkeypatch, tmp_path)
        assert (processes, threads) == ({os.getpid()}, {2})
        shared, processes, threads = used_threads(kind, 2, monkeypatch, tmp_path)
        assert os.getpid() not in processes
        assert threads == {1}
        assert galsim.get_omp_threads() == 2
    finally:
        galsim.set_omp_threads(before)
    np.testing.assert_array_equal(alone, shared)


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
    # The generator is that of the configuration, as for GalSim's sensors.
    assert sensor.rng == galsim.UniformDeviate(77)


CHANGED = {
    "name": "e2v_ccd250", "strength": 0.5, "diffusion_factor": 0.25, "qdist": 2,
    "nrecalc": 1234.0, "transpose": True, "charge_response": False, "background": False,
    "depth": False, "red": "kept", "absorption": "galsim", "temperature": 190.0,
    "diffusion": 1.5, "full_well": 7e4, "beyond": "error", "predict": False,
    "conversion_depth": 3.0, "threads": 2, "surroundings": 2e4,
}  # fmt: skip


@pytest.mark.parametrize("key", CHANGED)
def test_every_option_is_known_and_tells_sensors_apart(key):
    value = CHANGED[key]
    sensor = build({"type": "BrighterFatter", key: value})
    assert getattr(sensor, key) == value
    assert sensor != build({"type": "BrighterFatter"})
    direct = bfsensor.BrighterFatterSensor(rng=galsim.BaseDeviate(77), **{key: value})
    assert sensor == direct


def test_no_option_is_missing_from_the_configuration():
    import inspect

    accepted = set(inspect.signature(bfsensor.BrighterFatterSensor).parameters)
    known = set(bfsensor.BrighterFatterSensor._opt_params)
    # A generator comes from the configuration; a table in memory cannot.
    assert accepted - known == {"rng", "table"}
    assert known - set(CHANGED) == {
        "treering_func", "treering_center", "shift_map", "effects", "conditions", "layout",
    }  # fmt: skip


def test_rings_come_from_a_file_or_an_expression(tmp_path):
    radius = np.linspace(0.0, 900.0, 1801)
    shift = 0.02 * np.cos(2 * np.pi * radius / 60.0)
    file = tmp_path / "rings.txt"
    np.savetxt(file, np.transpose([radius, shift]), fmt="%.17g")
    table = galsim.LookupTable(radius, shift)
    center = {"type": "XY", "x": "$-10 * 30", "y": 128}
    for function in (
        {"type": "File", "file_name": str(file)}, "@image.table", "$@image.table", table,
    ):  # fmt: skip
        sensor = build(
            {
                "type": "BrighterFatter",
                "treering_func": function,
                "treering_center": center,
            },
            table=table,
        )
        np.testing.assert_array_equal(sensor.treering_func(radius), shift)
        assert sensor.treering_center == galsim.PositionD(-300, 128)
        areas = sensor.calculate_pixel_areas(galsim.ImageD(60, 3), use_flux=False).array
        # d(shift)/dr at most 0.02 * 2 pi / 60 = 0.0021, and 60 pixels hold a period.
        assert 0.0019 < np.ptp(areas) / 2 < 0.0022


def test_a_shift_map_comes_from_its_file(tmp_path):
    bend = 1e-3 * np.repeat(np.arange(12.0)[None], 12, 0)
    shift_map = bfsensor.ShiftMap(bend, 0 * bend)
    shift_map.write(tmp_path / "map.fits")
    sensor = build({"type": "BrighterFatter", "shift_map": str(tmp_path / "map.fits")})
    assert sensor.shift_map == shift_map


def test_forms_of_a_sensor():
    """GalSim's documentation allows other forms than a dict with the type."""
    rng = galsim.BaseDeviate(77)
    direct = bfsensor.BrighterFatterSensor("e2v_ccd250", rng=rng, nrecalc=500)
    first = {"type": "BrighterFatter", "name": "e2v_ccd250", "nrecalc": 500}
    second = {"type": "BrighterFatter", "strength": 2.0}
    base = {
        "image": {
            "itself": direct,
            "dict": first,
            "at": "@image.dict",
            "current": {"type": "Current", "key": "image.dict"},
            "short": "$sensor",
            "eval": {"type": "Eval", "str": "bfsensor.BrighterFatterSensor('e2v_ccd250', "
                     "rng=galsim.BaseDeviate(77), nrecalc=500)"},
            "first": {"type": "List", "items": [first, second], "index": 0},
            "second": {"type": "List", "items": ["@image.dict", second], "index": -1 + 2},
            "cycle": {"type": "List", "items": [first, second]},
        },
        "eval_variables": {"xsensor": direct}, "rng": rng, "obj_num": 3,
        "modules": ["bfsensor"],
    }  # fmt: skip
    base["image"]["short"] = "$@image.itself"
    galsim.config.ImportModules(base)

    def one(key):
        return galsim.config.BuildSensor(base["image"], key, base)

    for key in ("itself", "dict", "at", "current", "short", "eval", "first"):
        assert one(key) == direct, key
    assert one("itself") is direct
    assert one("at") is one("dict") is one("current")
    for key in ("second", "cycle"):
        assert (one(key).name, one(key).strength) == ("itl_sta3800c", 2.0)


@pytest.mark.parametrize(("by", "fresh"), [("image_num", False), ("obj_num", True)])
def test_a_sensor_is_kept_by_index_key(by, fresh):
    """imSim keeps one sensor an image; a sensor of each object is built for it."""
    sensor = {"type": "BrighterFatter", "index_key": by, "strength": "$1.0 + obj_num"}
    base = {"image": {"sensor": sensor}, "image_num": 0, "obj_num": 0, "file_num": 0,
            "rng": galsim.BaseDeviate(77), "image_num_rng": galsim.BaseDeviate(78),
            "obj_num_rng": galsim.BaseDeviate(79)}  # fmt: skip
    first = galsim.config.BuildSensor(base["image"], "sensor", base)
    assert galsim.config.BuildSensor(base["image"], "sensor", base) is first
    base["obj_num"] = 1
    second = galsim.config.BuildSensor(base["image"], "sensor", base)
    assert (second is not first) == fresh
    assert second.strength == (2.0 if fresh else 1.0)
    base["image_num"] = 1
    third = galsim.config.BuildSensor(base["image"], "sensor", base)
    assert (third is second) == fresh


BAD_VALUES = [
    {"strength": "strong"}, {"nrecalc": "often"}, {"transpose": "perhaps"}, {"qdist": "far"},
    {"treering_center": "here"}, {"treering_func": 0.3}, {"threads": "all"},
]  # fmt: skip


@pytest.mark.parametrize("options", [{"colour": "red"}, {"rng": 5}, {"table": "x"}])
def test_unknown_keys_are_refused(options):
    with pytest.raises(galsim.GalSimConfigError, match=next(iter(options))):
        build({"type": "BrighterFatter", **options})


@pytest.mark.parametrize("options", BAD_VALUES)
def test_values_of_another_type_are_refused(options):
    with pytest.raises(galsim.GalSimConfigError):
        build({"type": "BrighterFatter", **options})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"red": "blue"}, "red = 'blue' must be one of lost, kept"),
        ({"name": "nowhere"}, "name = 'nowhere' is neither"),
        ({"qdist": 9}, "qdist = 9 must be from 0 to 4"),
    ],
)
def test_values_the_sensor_does_not_take_are_refused_by_it(options, message):
    """GalSim, too, lets the error of a constructor through."""
    with pytest.raises(bfsensor.SensorError, match=message):
        build({"type": "BrighterFatter", **options})


def test_other_faults_of_a_configuration():
    with pytest.raises(galsim.GalSimConfigError, match="Invalid sensor type"):
        build({"type": "brighterfatter"})
    with pytest.raises(galsim.GalSimConfigError, match="out of bounds"):
        build({"type": "List", "items": [{"type": "BrighterFatter"}], "index": 1})


def test_a_configuration_is_not_changed_for_another_image():
    """The same dict serves again: what is kept in it does not leak into the pixels."""
    config = {
        "modules": ["bfsensor"],
        "gal": {"type": "Gaussian", "sigma": 0.3, "flux": 4e5},
        "stamp": {"draw_method": "phot"},
        "image": {"type": "Tiled", "nx_tiles": 2, "ny_tiles": 1, "stamp_size": 15,
                  "random_seed": 977, "pixel_scale": 0.2, "sensor": {"type": "BrighterFatter"}},
    }  # fmt: skip
    clean = copy.deepcopy(config)
    first = galsim.config.BuildImage(config).array.copy()
    galsim.config.BuildImage(config, image_num=1, obj_num=2)
    np.testing.assert_array_equal(galsim.config.BuildImage(clean).array, first)
    np.testing.assert_array_equal(galsim.config.BuildImage(config).array, first)
