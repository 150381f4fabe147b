"""Tables as the corrections of LSST's pipelines, from the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.recording.tables.lsst_datasets import (
    BrighterFatterKernel,
    DistortionMatrix,
    PhotonTransferDataset,
)
from bfsensor.sensor.options import find_table, load_table
from bfsensor.table.lsst_format import make_distortion_matrix, make_kernel
from bfsensor.table.quadrant_shifts import quadrant_shifts
from tests.recording.tables.test_lsst_datasets import photon_transfer_table, write_as_lsst

NAME = "itl_sta3800c"


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *args: CliRunner().invoke(main, ["export", *map(str, args)])


@pytest.fixture(scope="module")
def table():
    return load_table(*find_table(NAME))


def test_bfk_is_the_kernel_of_the_table(run, table):
    result = run(
        "bfk", NAME, "--detector", 94, "--instrument", "LSSTCam", "--gain", 1.6, "--gain",
        "C07=1.7", "--wavelength", 950, "--level", 2e4, "-o", "bfk.fits", "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    found = BrighterFatterKernel.read("bfk.fits")
    shifts = quadrant_shifts(table, background=2e4, wavelengths=[950.0])
    gains = dict(zip(found.columns["AMPLIFIER"], found.columns["GAIN"], strict=True))
    assert len(gains) == 16 and gains.pop("C07") == 1.7 and set(gains.values()) == {1.6}
    kernel = make_kernel(shifts, {"C00": 1.6}).columns["KERNEL"][0]
    np.testing.assert_array_equal(found.columns["KERNEL"], np.repeat([kernel], 16, axis=0))
    assert (found.meta["DETECTOR"], found.meta["INSTRUME"]) == (94, "LSSTCam")
    assert summary["a_00 [1/e-]"] == shifts.areas[0, 0] < 0 < summary["a_01 [1/e-]"]
    # Level and wavelength are not without effect.
    assert shifts.areas[0, 0] != quadrant_shifts(table, wavelengths=[950.0]).areas[0, 0]
    assert shifts.areas[0, 0] != quadrant_shifts(table, background=2e4).areas[0, 0]
    result = run("bfk", NAME, "--detector", 94, "--gain", 1.6, "-o", "bfk.fits")
    assert result.exit_code == 1
    assert "bfk.fits" in result.stderr and "--overwrite" in result.stderr


def test_edm_has_filters_and_the_gains_of_a_ptc(run, tmp_path, table):
    write_as_lsst(tmp_path / "ptc.fits", photon_transfer_table())
    ptc = PhotonTransferDataset.read("ptc.fits")
    result = run(
        "edm", NAME, "--detector", 94, "--ptc", "ptc.fits", "--filter", "g_6=480",
        "--filter", "y_10=950,1050", "--no-tail", "-o", "edm.fits",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    gains = dict(zip(ptc.amplifiers, ptc.columns["GAIN"].tolist(), strict=True))
    bands = {
        name: quadrant_shifts(table, wavelengths=waves, tail_slope=None)
        for name, waves in (("g_6", [480.0]), ("y_10", [950.0, 1050.0]))
    }
    expected = make_distortion_matrix(
        quadrant_shifts(table, tail_slope=None), gains, filters=bands, thickness=100.0,
        pitch=10.0, meta={"DETECTOR": 94},
    )  # fmt: skip
    assert DistortionMatrix.read("edm.fits") == expected


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (("bfk", NAME), 2, "--gain or --ptc"),
        (("bfk", NAME, "--gain", "C00=x"), 2, "'C00=x'"),
        (("bfk", NAME, "--gain", 1, "--level", 1e9), 1, "background = 1e+09"),
        (("bfk", "itl", "--gain", 1), 1, "'itl'"),
        (("edm", NAME, "--gain", 1, "--filter", "y"), 2, "--filter y: "),
    ],
)
def test_what_export_refuses(run, tmp_path, args, code, message):
    result = run(*args, "--detector", 94, "-o", "out.fits")
    assert result.exit_code == code
    assert message in result.stderr
    assert list(tmp_path.iterdir()) == []
