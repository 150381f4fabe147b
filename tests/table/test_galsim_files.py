"""GalSim's files: its tables read, ours read by it, what it cannot hold refused."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import galsim
import numpy as np
import pytest

from bfsensor.device.device import Device
from bfsensor.table.galsim_format import read_galsim, write_galsim
from tests.table.rough_tables import ARRAYS, make_table, refusal, shoelace

SENSORS = Path(galsim.meta_data.share_dir) / "sensors"


@pytest.mark.parametrize(
    ("stem", "centre"), [("lsst_itl_50_32", -10.371), ("lsst_e2v_50_32", -20.805)]
)
def test_reading_galsims_tables(stem, centre):
    """The numbers are the shoelace area of the central polygon of GalSim's own file.

    GalSim keeps two copies of each corner, one per pixel and not the same: its polygons
    overlap a little.  One common corner can keep the lines of the sides, not both copies,
    which moves the area by what lies between them: below 0.02 um^2 of 100 um^2.
    """
    table = read_galsim(SENSORS / stem)
    rows = np.loadtxt(SENSORS / f"{stem}.dat", skiprows=1)[:, 3:].reshape(9, 9, -1, 2)
    own = np.array([[shoelace(rows[i, j]) - 100 for i in range(9)] for j in range(9)])
    assert own[4, 4] == pytest.approx(centre, abs=5e-4)
    found = table.area_changes(charge=100e3, depth=95.0)
    assert found[4, 4] == pytest.approx(own[4, 4], abs=0.02)
    # The neighbours take over the nearer pixel's copy of a line.  In the files mirror
    # images differ by up to 0.07 um^2 (e2v, diagonal): the copies are no better than that.
    np.testing.assert_allclose(found[3:6, 3:6], own[3:6, 3:6], rtol=0, atol=0.1)
    assert table.charges.tolist() == [100e3]
    assert table.depths.tolist() == [95.0]
    assert table.vertices == 32
    assert Device.from_toml(table.device_text).name == stem


@pytest.fixture
def exported():
    """A table for GalSim: square pixels, even vertices, a device."""
    return make_table(
        9, reach=4, vertices=6, pitch=(10.0, 10.0), size=0.05,
        device_text=Device.load("itl_sta3800c").to_toml(),
    )  # fmt: skip


def test_galsim_reads_what_is_written(exported, tmp_path):
    charge, depth = 70e3, 60.0
    paths = write_galsim(exported, tmp_path / "ours", charge=charge, depth=depth)
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    sensor = galsim.SiliconSensor(name=str(tmp_path / "ours"), qdist=4)
    image = galsim.ImageD(15, 15)
    image[8, 8] = charge
    found = sensor.calculate_pixel_areas(image, use_flux=True).array[3:12, 3:12] * 100
    expected = exported.areas(charge=charge, depth=depth)
    assert np.abs(expected - 100).max() > 0.1
    # Vertices are written to 5e-8 um: 28 of them, 1.4 um apart, change an area by about
    # 5e-8 / sqrt(3) x 1.4 sqrt(28) = 2e-7 um^2.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_reading_back_what_was_written_for_galsim(tmp_path):
    def shift(at):
        x, y = at[..., 0], at[..., 1]
        return np.stack([-x, -1.3 * y], -1) / (20 + (x**2 + y**2)[..., None] / 10)

    bare = make_table(reach=4, vertices=6, pitch=(10.0, 10.0), size=0.0,
                      charges=np.array([70e3]), backgrounds=np.zeros(1))  # fmt: skip
    nominal = bare.nominal()
    table = dataclasses.replace(
        bare,
        device_text=Device.load("itl_sta3800c").to_toml(),
        **{
            name: np.broadcast_to(shift(getattr(nominal, name)), getattr(bare, name).shape)
            for name in ARRAYS
        },
    )
    write_galsim(table, tmp_path / "ours", charge=70e3, depth=60.0)
    again = read_galsim(tmp_path / "ours")
    expected = table.area_changes(charge=70e3, depth=60.0)
    assert expected[4, 4] < -3
    # Reading fits polygons to lines: it keeps areas up to the curvature of a line within a step
    # of the vertices, about (1.7 um)^2 / 12 x 0.02 / um x 10 um a side at most.
    np.testing.assert_allclose(
        again.area_changes(charge=70e3, depth=60.0), expected, rtol=0, atol=0.05
    )


def test_what_galsim_cannot_hold_is_refused(exported, tmp_path):
    stem = tmp_path / "ours"
    where = {"charge": 70e3, "depth": 60.0}
    text = exported.device_text
    odd = make_table(vertices=5, pitch=(10.0, 10.0), device_text=text)
    assert refusal(write_galsim, odd, stem, **where) == (
        "GalSim's order of vertices needs an even number a side, not 5"
    )
    oblong = make_table(device_text=text)
    assert refusal(write_galsim, oblong, stem, **where) == (
        "GalSim assumes square pixels, not 10 x 12 um"
    )
    bare = dataclasses.replace(exported, device_text="")
    assert "device" in refusal(write_galsim, bare, stem, **where)
    assert refusal(write_galsim, exported, stem, charge=70e3, depth=101.0) == (
        "depth = 101 is outside the table, which holds from 1 to 100 um"
    )
    assert list(tmp_path.iterdir()) == []
    write_galsim(exported, stem, **where)
    before = stem.with_suffix(".dat").read_bytes()
    stem.with_suffix(".cfg").unlink()
    assert refusal(write_galsim, exported, stem, charge=60e3, depth=60.0) == (
        f"{stem}.dat exists; say overwrite to replace it"
    )
    write_galsim(exported, stem, charge=60e3, depth=60.0, overwrite=True)
    assert stem.with_suffix(".dat").read_bytes() != before


def test_damaged_galsim_files_are_refused(exported, tmp_path):
    stem = tmp_path / "ours"
    cfg, dat = stem.with_suffix(".cfg"), stem.with_suffix(".dat")
    assert refusal(read_galsim, stem).startswith(f"{cfg}: cannot be read: ")
    write_galsim(exported, stem, charge=70e3, depth=60.0)
    lines = dat.read_text().splitlines(keepends=True)
    for count in (0, 1, 2, len(lines) // 2, len(lines) - 1):
        dat.write_text("".join(lines[:count]))
        assert refusal(read_galsim, stem) == (
            f"{dat}: {max(count - 1, 0)} rows are not the 2268 of 9 x 9 pixels with 6 "
            "vertices a side (truncated, or another table's)"
        )
    dat.write_text("".join(lines)[:-30])  # in the middle of a row
    assert refusal(read_galsim, stem).startswith(f"{dat}: not a vertex file: ")
    dat.unlink()
    assert refusal(read_galsim, stem).startswith(f"{dat}: not a vertex file: ")
    text = cfg.read_text()
    for key, value, message in (
        ("NumVertices", "nan", "NumVertices = 'nan' must be a finite number"),
        ("PixelBoundaryNx", "0", "PixelBoundaryNx = '0' is not a whole number above 0"),
        ("PixelBoundaryNx", "7", "7 x 9 pixels must be square and odd"),
        ("NumVertices", "six", "NumVertices = 'six' is not a number"),
    ):
        cfg.write_text(re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text))
        assert refusal(read_galsim, stem) == f"{cfg}: {message}"
    cfg.write_text(re.sub(r"(?m)^NumVertices.*\n", "", text))
    assert refusal(read_galsim, stem) == f"{cfg}: NumVertices is missing"
