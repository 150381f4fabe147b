"""GalSim's format: the same areas as GalSim finds, in and out, wrong files refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import galsim
import numpy as np
import pytest

from bfsensor.device.device import Device
from bfsensor.device.shipped import tables_dir
from bfsensor.errors import TableError
from bfsensor.table.galsim_format import read_galsim, write_galsim
from tests.table.smooth_tables import PITCH, SINGLE, make_table, parts, polygon_area

SENSORS = Path(galsim.meta_data.share_dir) / "sensors"
STEMS = sorted(path.stem for path in SENSORS.glob("lsst_*.cfg"))
DIFFUSION_KEYS = [
    "NumPhases", "CollectingPhases", "ChannelStopWidth", "FieldOxideTaper", "Vbb",
    "Vparallel_lo", "Vparallel_hi", "qfh", "CCDTemperature", "SensorThickness",
    "PixelSizeX", "CollectedCharge_0_0",
]  # fmt: skip


def galsim_areas(name, charge):
    """Areas [um^2] of the 9 x 9 pixels about one charge, by GalSim itself."""
    image = galsim.ImageD(17, 17)
    image.setCenter(0, 0)
    image[0, 0] = charge
    sensor = galsim.SiliconSensor(name=str(name), qdist=4)
    pixel = sensor.config["PixelSizeX"] ** 2
    return sensor.calculate_pixel_areas(image).array[4:13, 4:13] * pixel


def file_polygons(stem, n, vertices):
    """Polygons of a .dat file, by pixel in y and x."""
    rows = np.loadtxt(stem.with_name(stem.name + ".dat"), skiprows=1)
    return rows[:, 3:].reshape(n, n, 4 * vertices + 4, 2).transpose(1, 0, 2, 3)


@pytest.fixture(scope="module")
def itl_50_8():
    return read_galsim(SENSORS / "lsst_itl_50_8")


@pytest.fixture
def exportable():
    """A table GalSim's format can hold, with the built-in device."""
    text = (tables_dir() / "itl_sta3800c" / "device.toml").read_text()
    return make_table(device_text=text, reach=4, symmetric=True)


@pytest.mark.parametrize("stem", STEMS)
def test_areas_of_galsims_own_tables_are_those_that_galsim_finds(stem):
    table = read_galsim(SENSORS / stem)
    charge = table.charges[0]
    areas = table.areas(charge=charge, depth=table.depths[0])
    # GalSim keeps vertices in pixels of 10 um and we displacements of 1 um in single
    # precision: 2^-24 x 10 um x half a neighbour's distance (1.5 um), 40 of them at random.
    assert np.abs(areas - galsim_areas(stem, charge)).max() < 6e-6
    polygons = file_polygons(SENSORS / stem, 9, table.vertices)
    assert areas[4, 4] == pytest.approx(polygon_area(polygons[4, 4]), abs=6e-6)
    # All vertices of sides around the source, from the nearest pixel, are the file's own.
    own = table.polygon(0, 0, charge=charge, depth=table.depths[0]) + 55.0
    at_corner = (table.vertices // 2) + np.arange(4) * (table.vertices + 1)
    inside = np.delete(np.arange(len(own)), at_corner)
    assert np.abs(own - polygons[4, 4])[inside].max() < 10 * SINGLE
    # Corners move less than the copies in the file differ (0.4 um in lsst_e2v_50).
    assert np.abs(own - polygons[4, 4])[at_corner].max() < 0.1


def test_conditions_are_taken_from_the_configuration(itl_50_8):
    # lsst_itl_50_8.cfg: CollectedCharge_0_0, ElectronZ0Area, SensorThickness, PixelSizeX.
    assert itl_50_8.charges.tolist() == [1e5]
    assert itl_50_8.backgrounds.tolist() == [0.0]
    assert itl_50_8.depths.tolist() == [95.0]
    assert (itl_50_8.thickness, itl_50_8.pitch) == (100.0, PITCH)
    assert (itl_50_8.vertices, itl_50_8.reach, itl_50_8.symmetric) == (8, 4, False)
    assert Device.from_toml(itl_50_8.device_text).operating_point.back_bias == -50.0


@pytest.mark.parametrize("stem", ["lsst_itl_50_8", "lsst_e2v_50_32"])
def test_galsim_does_the_same_with_its_table_written_by_us(tmp_path, stem):
    table = read_galsim(SENSORS / stem)
    charge = table.charges[0]
    write_galsim(table, tmp_path / "ours", charge=charge, depth=95.0)
    # Single precision of the same vertices, see above.
    assert np.allclose(
        galsim_areas(tmp_path / "ours", charge), galsim_areas(stem, charge), rtol=6e-8
    )
    # A fraction s of the charge: the common corners keep the area as a whole, not its parts
    # linear and quadratic in s.  What is left is s (1 - s) times the linear part that was
    # missing, a corner shift (0.1 um) along the nearest vertex spacing (1.5 um at most).
    assert np.allclose(
        galsim_areas(tmp_path / "ours", 0.7 * charge), galsim_areas(stem, 0.7 * charge),
        rtol=0, atol=0.7 * 0.3 * 0.1 * 1.5,
    )  # fmt: skip
    ours = galsim.SiliconSensor(name=str(tmp_path / "ours"))
    theirs = galsim.SiliconSensor(name=stem)
    for key in DIFFUSION_KEYS:
        assert ours.config[key] == theirs.config[key], key
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("background", [0.0, 40_000.0])
def test_galsim_finds_the_areas_of_a_table_of_ours(tmp_path, exportable, background):
    where = {"charge": 120_000.0, "background": background, "depth": 60.0}
    write_galsim(exportable, tmp_path / "ours", **where)
    # Seven decimals of um, and GalSim's single precision, see above.
    found = galsim_areas(tmp_path / "ours", 120_000.0 - background)
    assert np.abs(found - exportable.areas(**where)).max() < 8e-6
    assert np.abs(exportable.area_changes(**where)).max() > 0.5


def test_written_stems_read_back_to_their_decimals(tmp_path, exportable):
    write_galsim(exportable, tmp_path / "ours", charge=120_000.0, depth=60.0)
    back = read_galsim(tmp_path / "ours")
    kept = exportable.displacements(charge=120_000.0, depth=60.0)
    again = back.displacements(charge=120_000.0, depth=60.0)
    for ours, theirs in zip(parts(kept), parts(again), strict=True):
        # Half of the seventh decimal, twice where the corners of copies are joined.
        assert np.abs(ours - theirs).max() < 1e-7 + SINGLE
    assert (back.vertices, back.reach) == (exportable.vertices, exportable.reach)


def test_another_device_may_give_the_voltages(tmp_path, exportable):
    text = (tables_dir() / "e2v_ccd250" / "device.toml").read_text()
    device = Device.from_toml(text)
    bare = replace(exportable, device_text="")
    write_galsim(bare, tmp_path / "ours", charge=1e5, depth=60.0, device=device)
    config = galsim.SiliconSensor(name=str(tmp_path / "ours")).config
    assert config["Vparallel_lo"] == device.operating_point.gate_low
    assert config["NumPhases"] == device.gates.phases


@pytest.mark.parametrize(
    ("change", "question", "message"),
    [
        ({"device_text": ""}, {}, "needs the device"),
        ({}, {"charge": 0.0}, "charge = 0 e- must be above the background, 0 e-"),
        ({}, {"charge": 3e4, "background": 3e4}, "above the background, 30000 e-"),
        ({}, {"charge": 2e5}, "charge = 200000 is outside"),
        ({}, {"depth": 1.0}, "depth = 1 is outside"),
        ({"pitch": (10.0, 9.0)}, {}, "square pixels, not 10 x 9 um"),
    ],
)
def test_what_galsims_format_cannot_hold_is_refused(
    tmp_path, exportable, change, question, message
):
    with pytest.raises(TableError, match=message):
        write_galsim(
            replace(exportable, **change), tmp_path / "ours",
            **{"charge": 1e5, "depth": 60.0, **question},
        )  # fmt: skip
    assert not list(tmp_path.iterdir())


def test_odd_numbers_of_vertices_are_refused(tmp_path, exportable):
    odd = make_table(vertices=5, device_text=exportable.device_text)
    with pytest.raises(TableError, match="even number a side, not 5"):
        write_galsim(odd, tmp_path / "ours", charge=1e5, depth=60.0)


def test_stems_are_written_as_a_pair_or_not_at_all(tmp_path, exportable, monkeypatch):
    stem = tmp_path / "ours"
    paths = write_galsim(exportable, stem, charge=1e5, depth=60.0)
    before = [path.read_bytes() for path in paths]
    with pytest.raises(TableError, match=r"ours.cfg exists"):
        write_galsim(exportable, stem, charge=9e4, depth=60.0)
    real = Path.write_text

    def fail_on_the_second(path, *args, **keywords):
        if ".dat." in path.name:
            raise OSError("disk full")
        return real(path, *args, **keywords)

    monkeypatch.setattr(Path, "write_text", fail_on_the_second)
    with pytest.raises(TableError, match=r"ours.dat: cannot be written: disk full"):
        write_galsim(exportable, stem, charge=9e4, depth=60.0, overwrite=True)
    assert [path.read_bytes() for path in paths] == before
    assert len(list(tmp_path.iterdir())) == 2


@pytest.fixture
def stem(tmp_path):
    """A copy of GalSim's smallest table, to damage."""
    for ending in (".cfg", ".dat"):
        (tmp_path / f"copy{ending}").write_text(
            (SENSORS / f"lsst_itl_50_8{ending}").read_text()
        )
    return tmp_path / "copy"


def edit(stem, key, value):
    cfg = stem.with_name(stem.name + ".cfg")
    lines = cfg.read_text().splitlines()
    kept = [line for line in lines if line.split("=")[0].strip() != key]
    assert len(kept) == len(lines) - 1
    cfg.write_text("\n".join(kept + ([f"{key} = {value}"] if value else [])) + "\n")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("CollectedCharge_0_0", None, "CollectedCharge_0_0 is missing"),
        ("CollectedCharge_0_0", "0", "CollectedCharge_0_0 = 0 must be above 0 e-"),
        ("NumVertices", "8.5", "NumVertices = '8.5' is not a whole number"),
        ("NumVertices", "32", "is not|are not the 10692"),
        ("PixelBoundaryNx", "7", "7 x 9 pixels must be square and odd"),
        ("PixelSizeX", "ten", "PixelSizeX = 'ten' is not a number"),
        ("PixelSizeX", "9.5", "not listed column by column, 9.5 x"),
        ("SensorThickness", "50", "not be above the thickness, 50 um"),
    ],
)
def test_wrong_configurations_are_refused(stem, key, value, message):
    edit(stem, key, value)
    with pytest.raises(TableError, match=rf"copy\.(cfg|dat): .*({message})"):
        read_galsim(stem)


def test_values_are_never_evaluated(stem, tmp_path):
    edit(stem, "SensorThickness", f"__import__('os').mkdir('{tmp_path}/evaluated')")
    with pytest.raises(TableError, match=r"SensorThickness = .* is not a number"):
        read_galsim(stem)
    assert not (tmp_path / "evaluated").exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda lines: lines[:-100], "2816 rows are not the 2916"),
        (lambda lines: lines[:1], "0 rows are not the 2916"),
        (lambda lines: [*lines[:9], "a b c d e", *lines[10:]], "not a vertex file"),
        (lambda lines: [*lines[:9], "15 15 1 nan 15", *lines[10:]], "not finite"),
        (lambda lines: [lines[0], *lines[:0:-1]], "not listed column by column"),
    ],
)
def test_wrong_vertex_files_are_refused(stem, damage, message):
    dat = stem.with_name("copy.dat")
    dat.write_text("\n".join(damage(dat.read_text().splitlines())) + "\n")
    with pytest.raises(TableError, match=rf"copy\.dat: .*{message}"):
        read_galsim(stem)


@pytest.mark.parametrize("ending", [".cfg", ".dat"])
def test_missing_files_are_refused(stem, ending):
    stem.with_name("copy" + ending).unlink()
    with pytest.raises(TableError, match=rf"copy\{ending}"):
        read_galsim(stem)
