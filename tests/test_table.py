"""Tables: files give back the bits, polygons tile the plane, the outside is refused."""

from __future__ import annotations

import dataclasses
import pickle
import re
from pathlib import Path

import galsim
import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

from bfsensor.device import Device
from bfsensor.errors import TableError
from bfsensor.galsim_format import read_galsim, write_galsim
from bfsensor.simulate.boundaries import mirror_quadrant
from bfsensor.table import DistortionTable, vertex_fractions

SENSORS = Path(galsim.meta_data.share_dir) / "sensors"
CHARGES = np.array([0.0, 20e3, 50e3, 90e3, 150e3])
BACKGROUNDS = np.array([0.0, 20e3, 40e3, 60e3])
DEPTHS = np.array([1.0, 10.0, 40.0, 100.0])
ARRAYS = ("corners", "horizontal", "vertical")


def shapes(reach, vertices):
    n = 2 * reach + 1
    return {
        "corners": (n + 1, n + 1, 2),
        "horizontal": (n + 1, n, vertices, 2),
        "vertical": (n, n + 1, vertices, 2),
    }


def make_table(
    seed=20, *, symmetric=True, charges=CHARGES, backgrounds=BACKGROUNDS, depths=DEPTHS,
    reach=2, vertices=4, pitch=(10.0, 12.0), size=0.2, **more,
):  # fmt: skip
    """A table of random shifts of ``size`` um at most, zero where charge = background."""
    rng = np.random.default_rng(seed)
    levels = (len(charges), len(backgrounds), len(depths))
    arrays = {
        name: rng.uniform(-size, size, (np.prod(levels), *shape))
        for name, shape in shapes(reach, vertices).items()
    }
    if symmetric:
        mirror_quadrant(*(arrays[name] for name in ARRAYS))
    arrays = {name: a.reshape(*levels, *a.shape[1:]) for name, a in arrays.items()}
    for a in arrays.values():
        a[charges[:, None] == backgrounds] = 0.0
    return DistortionTable(
        charges=charges, backgrounds=backgrounds, depths=depths, pitch=pitch,
        thickness=100.0, vertices=vertices, reach=reach, symmetric=symmetric, **arrays,
        **more,
    )  # fmt: skip


def refusal(call, *args, **kwargs):
    """Message of the TableError that a call raises."""
    with pytest.raises(TableError) as caught:
        call(*args, **kwargs)
    return str(caught.value)


# -- files -------------------------------------------------------------------------------


def is_quadrant(path):
    with fits.open(path) as hdus:
        return hdus[0].header["QUADRANT"]


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("vertices", [2, 3, 4])
@pytest.mark.parametrize("reach", [1, 2])
def test_reading_gives_the_bits_that_were_written(symmetric, vertices, reach, tmp_path):
    table = make_table(
        77 + vertices, symmetric=symmetric, vertices=vertices, reach=reach,
        full_well=173_999.5, errors={"tracing [um]": 1 / 3}, provenance={"µ": "ü \\ \n"},
        device_text="\n" + Device.load("e2v_ccd250").to_toml(),
    )  # fmt: skip
    path = tmp_path / "table.fits"
    table.write(path)
    again = DistortionTable.read(path)
    assert again == table
    for name in ARRAYS:
        assert (getattr(again, name) + 0.0).tobytes() == (
            getattr(table, name) + 0.0
        ).tobytes()
    assert again.device_text == table.device_text
    assert dict(again.errors) == dict(table.errors)
    assert dict(again.provenance) == dict(table.provenance)
    assert is_quadrant(path) is symmetric
    assert [p.name for p in tmp_path.iterdir()] == ["table.fits"]


def test_a_table_without_well_and_device(tmp_path):
    table = make_table()
    table.write(tmp_path / "table.fits")
    again = DistortionTable.read(tmp_path / "table.fits")
    assert again == table
    assert np.isnan(again.full_well)
    assert again.device_text == ""


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("place", [0, -1])
def test_only_bitwise_symmetry_is_stored_as_a_quadrant(name, place, tmp_path):
    table = make_table()
    array = getattr(table, name).copy()
    flat = array[1, 0, 2].reshape(-1)
    # The smallest step of single precision, in one number.
    flat[place] = np.nextafter(np.float32(flat[place]), np.float32(1))
    other = dataclasses.replace(table, **{name: array})
    assert other.symmetric
    assert other != table
    table.write(tmp_path / "exact.fits")
    other.write(tmp_path / "nearly.fits")
    assert is_quadrant(tmp_path / "exact.fits")
    assert not is_quadrant(tmp_path / "nearly.fits")
    assert DistortionTable.read(tmp_path / "nearly.fits") == other
    sizes = [(tmp_path / f"{n}.fits").stat().st_size for n in ("exact", "nearly")]
    assert sizes[0] < sizes[1]


def test_units_and_checksums_are_in_the_file(tmp_path):
    make_table(full_well=1e5).write(tmp_path / "table.fits")
    with fits.open(tmp_path / "table.fits") as hdus:
        units = {hdu.name: hdu.header.get("BUNIT") for hdu in hdus[1:]}
        assert all("CHECKSUM" in hdu.header for hdu in hdus)
        assert all("DATASUM" in hdu.header for hdu in hdus)
    assert units == {
        "CORNERS": "um", "HORIZONTAL": "um", "VERTICAL": "um", "CHARGES": "electron",
        "BACKGROUNDS": "electron", "DEPTHS": "um", "META": None, "DEVICE": None,
    }  # fmt: skip


def test_pickling():
    table = make_table(errors={"a": 1.0}, provenance={"b": "c"})
    assert pickle.loads(pickle.dumps(table)) == table


def test_arrays_cannot_be_changed_behind_the_table():
    table = make_table()
    with pytest.raises(ValueError, match="read-only"):
        table.corners[...] = 0


def test_existing_files_are_kept(tmp_path):
    path = tmp_path / "table.fits"
    make_table(3).write(path)
    before = path.read_bytes()
    assert refusal(make_table(4).write, path) == (
        f"{path} exists; say overwrite to replace it"
    )
    assert path.read_bytes() == before
    make_table(4).write(path, overwrite=True)
    assert DistortionTable.read(path) == make_table(4)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A table, the bytes of its file, and a place to damage them."""
    folder = tmp_path_factory.mktemp("damage")
    table = make_table(device_text="name = 'x'\n", charges=CHARGES[:2], depths=DEPTHS[:1])
    table.write(folder / "table.fits")
    return table, (folder / "table.fits").read_bytes(), folder / "damaged.fits"


@settings(max_examples=60, deadline=None)
@given(part=st.floats(0, 1, exclude_max=True), block=st.booleans())
def test_truncated_files_are_refused(written, part, block):
    _, content, path = written
    length = int(part * len(content))
    path.write_bytes(content[: length // 2880 * 2880 if block else length])
    assert refusal(DistortionTable.read, path).startswith(f"{path}: ")


@settings(max_examples=100, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_damage_is_refused_or_harmless(written, place, flip):
    table, content, path = written
    damaged = bytearray(content)
    damaged[int(place * len(content))] ^= flip
    path.write_bytes(damaged)
    try:
        again = DistortionTable.read(path)
    except TableError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017
    else:
        assert again == table  # in the padding or a comment


def test_a_flipped_bit_in_a_shift_is_found(written):
    table, content, path = written
    number = np.array(table.corners[1, 0, 0, -1, -1, 0], ">f4").tobytes()
    assert content.count(number) == 1
    path.write_bytes(
        content.replace(number, bytes([number[0], number[1] ^ 1, *number[2:]]))
    )
    message = refusal(DistortionTable.read, path)
    assert message.startswith(f"{path}: not a FITS file, or damaged: ")
    assert "Checksum verification failed for HDU ('CORNERS'" in message


def test_other_files_are_refused(tmp_path, written):
    path = tmp_path / "other.fits"
    assert refusal(DistortionTable.read, path) == f"{path}: no such file"
    for content in (b"", b"a,b\n1,2\n", bytes(range(256)) * 30):
        path.write_bytes(content)
        assert refusal(DistortionTable.read, path).startswith(
            f"{path}: not a FITS file, or damaged: "
        )
    fits.PrimaryHDU(np.ones((3, 3))).writeto(path, overwrite=True)
    assert refusal(DistortionTable.read, path) == (
        f"{path}: not a distortion table (no SCHEMA = 'bfsensor distortion table')"
    )
    path.write_bytes(written[1])
    with fits.open(path) as hdus:
        hdus[0].header["SCHEMAV"] = 2
        hdus.writeto(path, overwrite=True, checksum=True)
    assert refusal(DistortionTable.read, path) == (
        f"{path}: schema version 2 is not 1, the one this version of bfsensor reads"
    )


@pytest.mark.parametrize("key", ["REACH", "VERTICES", "PITCHX", "QUADRANT", "THICKNSS"])
def test_a_missing_entry_is_refused_by_name(key, tmp_path, written):
    path = tmp_path / "table.fits"
    path.write_bytes(written[1])
    with fits.open(path) as hdus:
        del hdus[0].header[key]
        hdus.writeto(path, overwrite=True, checksum=True)
    message = refusal(DistortionTable.read, path)
    assert message.startswith(f"{path}: not a FITS file, or damaged: ")
    assert key in message


# -- what a table may hold ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"charges": CHARGES[::-1]},
            f"charges = {CHARGES[::-1].tolist()} must be finite and ascend",
        ),
        (
            {"depths": np.array([1.0, 1.0, 2.0, 3.0])},
            "depths = [1.0, 1.0, 2.0, 3.0] must be finite and ascend",
        ),
        (
            {"backgrounds": np.array([0.0, np.nan])},
            "backgrounds = [0.0, nan] must be finite and ascend",
        ),
        ({"charges": np.zeros(0)}, "charges = [] must be finite and ascend"),
        ({"charges": CHARGES - 1}, "charges and backgrounds must not be negative"),
        (
            {"depths": DEPTHS - 1},
            "depths = [0.0, 9.0, 39.0, 99.0] must be above the gates, 0 um",
        ),
        (
            {"reach": 1},
            "corners has the shape (5, 4, 4, 6, 6, 2), not (5, 4, 4, 4, 4, 2)",
        ),
        (
            {"vertices": 5},
            "horizontal has the shape (5, 4, 4, 6, 5, 4, 2), not (5, 4, 4, 6, 5, 5, 2)",
        ),
        (
            {"corners": np.full((5, 4, 4, 6, 6, 2), np.inf)},
            "corners holds values that are not finite",
        ),
        (
            {"corners": np.ones((5, 4, 4, 6, 6, 2))},
            "corners holds shifts where the charge equals the background and nothing moves",
        ),
    ],
)
def test_what_is_no_table_is_refused(changes, message):
    assert refusal(dataclasses.replace, make_table(), **changes) == message


# -- questions ---------------------------------------------------------------------------


def shoelace(points):
    x, y = np.moveaxis(points, -1, 0)
    return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(2, 10**6),
    symmetric=st.booleans(),
    charge=st.floats(0, 150e3),
    background=st.floats(0, 60e3),
    depth=st.floats(1, 100),
    reach=st.integers(1, 3),
    vertices=st.integers(1, 5),
)
def test_pixels_tile_the_plane(seed, symmetric, charge, background, depth, reach, vertices):
    """Whatever the shifts, the areas add up to the area inside the outer outline."""
    table = make_table(seed, symmetric=symmetric, reach=reach, vertices=vertices, size=1.0)
    where = {"charge": charge, "background": background, "depth": depth}
    moved, nominal = table.displacements(**where), table.nominal()
    c, h, v = (getattr(nominal, n) + getattr(moved, n) for n in ARRAYS)
    n = 2 * reach + 1
    outline = [c[0, 0][None]]
    for i in range(n):
        outline += [h[0, i], c[0, i + 1][None]]
    for j in range(n):
        outline += [v[j, n], c[j + 1, n][None]]
    for i in reversed(range(n)):
        outline += [h[n, i, ::-1], c[n, i][None]]
    for j in reversed(range(n)):
        outline += [v[j, 0, ::-1], c[j, 0][None]]
    areas = table.areas(**where)
    # Round-off: some 1e3 terms of 1e2 um^2 at 1e-16 each, far below 1e-9 of the sum.
    assert areas.sum() == pytest.approx(shoelace(np.concatenate(outline)), rel=1e-9)
    # One subtraction of 10 um x 12 um.
    np.testing.assert_allclose(table.area_changes(**where), areas - 120.0, atol=1e-13)
    for i, j in ((0, 0), (reach, -reach), (-1, 1)):
        polygon = table.polygon(i, j, **where)
        assert polygon.shape == (4 * vertices + 4, 2)
        assert shoelace(polygon) == pytest.approx(areas[j + reach, i + reach], rel=1e-12)


def test_polygons_start_at_the_middle_of_the_left_side():
    table = make_table(size=0.0, vertices=4)
    polygon = table.polygon(1, -1, charge=0.0, background=40e3, depth=10.0)
    f = vertex_fractions(4)
    # Pixel (1, -1): x from 5 to 15, y from -18 to -6; the first vertex below the middle.
    np.testing.assert_allclose(polygon[0], [5.0, -18 + 12 * f[1]], rtol=1e-15)
    np.testing.assert_allclose(polygon[2], [5.0, -18.0], rtol=1e-15)  # lower left corner
    np.testing.assert_allclose(polygon[3], [5 + 10 * f[0], -18.0], rtol=1e-15)


def test_vertex_fractions_are_equal_angles():
    angle = np.arctan(2 * vertex_fractions(6) - 1)
    np.testing.assert_allclose(np.diff(angle), np.pi / 14, rtol=1e-14)


def test_nodes_are_given_back():
    table = make_table(symmetric=False)
    for q, charge in enumerate(CHARGES):
        for b, background in enumerate(BACKGROUNDS):
            for d, depth in enumerate(DEPTHS):
                moved = table.displacements(
                    charge=charge, background=background, depth=depth
                )
                for name in ARRAYS:
                    # A response is divided and multiplied by Q - B and weighted with
                    # splines of up to 10: 1e-13 of a shift of 0.2 um.
                    np.testing.assert_allclose(
                        getattr(moved, name), getattr(table, name)[q, b, d], atol=2e-14
                    )


@settings(max_examples=40, deadline=None)
@given(charge=st.floats(0, 60e3), depth=st.floats(1, 100))
def test_nothing_moves_where_charge_equals_background(charge, depth):
    table = make_table(symmetric=False)
    moved = table.displacements(charge=charge, background=charge, depth=depth)
    assert all(np.all(getattr(moved, name) == 0) for name in ARRAYS)
    # An electron more moves something: the test above is not one of an empty table.
    more = table.displacements(charge=charge + 1, background=charge, depth=depth)
    assert all(np.any(getattr(more, name) != 0) for name in ARRAYS)


def smooth_table(response, charges, backgrounds, depths):
    """A table whose shifts are (Q - B) response(Q, B, z) times fixed random shifts."""
    rng = np.random.default_rng(606)
    q, b, z = np.meshgrid(charges, backgrounds, depths, indexing="ij")
    size = (q - b) * response(q, b, z)
    pattern = {n: rng.uniform(0.5, 1, s) for n, s in shapes(1, 2).items()}
    arrays = {n: np.multiply.outer(size, p) for n, p in pattern.items()}
    return pattern, DistortionTable(
        charges=charges, backgrounds=backgrounds, depths=depths, pitch=(10.0, 10.0),
        thickness=100.0, vertices=2, reach=1, symmetric=False, **arrays,
    )  # fmt: skip


def worst(response, charges, backgrounds, depths):
    """Largest relative error of a response at points between the levels."""
    pattern, table = smooth_table(response, charges, backgrounds, depths)
    rng = np.random.default_rng(919)
    error = 0.0
    for _ in range(60):
        q, b = rng.uniform(80e3, charges[-1]), rng.uniform(0, backgrounds[-1])
        z = np.exp(rng.uniform(*np.log(depths[[0, -1]])))
        moved = table.displacements(charge=q, background=b, depth=z)
        for name in ARRAYS:
            ratio = getattr(moved, name) / pattern[name] / ((q - b) * response(q, b, z))
            error = max(error, np.abs(ratio - 1).max())
    return error


def test_a_polynomial_response_is_exact():
    def response(q, b, z):
        return (
            1e-6 * (1 - q / 4e5 + (q / 4e5) ** 2) * (1 + (b / 2e5) ** 3) * (2 + np.log(z))
        )

    # Squares in charge, also across Q = B where it comes from three neighbours; cubes in
    # background; linear in log z.  Left is single precision, 6e-8, of shifts that Q - B
    # = 20000 e- of 150000 e- divides: weights of the splines below 10.
    assert worst(response, CHARGES, BACKGROUNDS, DEPTHS) < 6e-7


def test_interpolation_converges_as_cubics_do():
    def response(q, b, z):
        return 1e-6 * np.exp(-q / 1e5) * (1 + 0.3 * np.sin(b / 3e4)) * (2 + np.log(z))

    errors = [
        worst(
            response,
            np.linspace(0, 15e4, 4 * k + 1),
            np.linspace(0, 6e4, 3 * k + 1),
            DEPTHS,
        )
        for k in (1, 2, 4)
    ]
    # A cubic spline has order 4 (the Q = B nodes 3): halving the step divides the error by
    # 16 or 8, asymptotically; 5 leaves room for the coarsest.  The first spline is within
    # h^4 max|f''''| of either factor: (37500 / 1e5)^4 = 2 % and (2e4 / 3e4)^4 x 0.3 = 6 %.
    assert errors[0] < 0.08
    assert errors[1] < errors[0] / 5
    assert errors[2] < errors[1] / 5


def test_depths_never_overshoot():
    """Monotone in depth at the levels, monotone between (a cubic spline would ring)."""
    depths = np.array([1.0, 5.0, 6.0, 50.0, 100.0])
    steps = np.array([0.0, 0.01, 1.0, 1.0, 1.01])
    pattern, table = smooth_table(
        lambda q, b, z: 1e-6 * np.interp(z, depths, steps), CHARGES, BACKGROUNDS, depths
    )
    at = np.geomspace(1, 100, 200)
    shifts = [table.displacements(charge=9e4, depth=z).corners[0, 0, 0] for z in at]
    # Up to single precision, 6e-8 of 0.1 um.
    assert np.diff(shifts).min() > -1e-8
    assert max(shifts) == pytest.approx(0.0909 * pattern["corners"][0, 0, 0], rel=1e-6)


def test_one_charge_scales_linearly():
    table = make_table(charges=np.array([80e3]), backgrounds=np.zeros(1))
    full = table.displacements(charge=80e3, depth=33.0).horizontal
    half = table.displacements(charge=40e3, depth=33.0).horizontal
    assert np.abs(full).max() > 0
    np.testing.assert_allclose(half, full / 2, rtol=1e-14)


@pytest.mark.parametrize(
    ("where", "message"),
    [
        (
            {"charge": 150_001.0, "depth": 10.0},
            "charge = 150001 is outside the table, which holds from 0 to 150000 e- "
            "(full well 174,017 e-)",
        ),
        (
            {"charge": -1.0, "depth": 10.0},
            "charge = -1 is outside the table, which holds from 0 to 150000 e- "
            "(full well 174,017 e-)",
        ),
        (
            {"charge": float("nan"), "depth": 10.0},
            "charge = nan is outside the table, which holds from 0 to 150000 e- "
            "(full well 174,017 e-)",
        ),
        (
            {"charge": 1e4, "background": 60_001.0, "depth": 10.0},
            "background = 60001 is outside the table, which holds from 0 to 60000 e-",
        ),
        (
            {"charge": 1e4, "depth": 0.9},
            "depth = 0.9 is outside the table, which holds from 1 to 100 um",
        ),
        (
            {"charge": 1e4, "depth": 100.1},
            "depth = 100.1 is outside the table, which holds from 1 to 100 um",
        ),
    ],
)
@pytest.mark.parametrize("question", ["displacements", "areas", "area_changes"])
def test_questions_outside_are_refused(question, where, message):
    table = make_table(full_well=174_017.0)
    assert refusal(getattr(table, question), **where) == message


def test_refusals_of_small_tables_and_far_pixels():
    table = make_table(charges=CHARGES[2:3], backgrounds=np.zeros(1), depths=DEPTHS[1:2])
    assert refusal(table.areas, charge=1.0, depth=11.0) == (
        "depth = 11 is outside the table, which holds 10 um"
    )
    assert refusal(table.areas, charge=1.0, background=2.0, depth=10.0) == (
        "background = 2 is outside the table, which holds 0 e-"
    )
    assert refusal(table.polygon, 0, -3, charge=1.0, depth=10.0) == (
        "offset (0, -3) is outside the table, which reaches 2 pixels"
    )


# -- GalSim's files ----------------------------------------------------------------------


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
    # Reading fits polygons to lines: it keeps areas up to the bend of a line within a step
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
    assert refusal(write_galsim, bare, stem, **where) == (
        "GalSim needs the device for its diffusion, and this table has none"
    )
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
        ("NumVertices", "nan", "NumVertices = 'nan' is not a whole number above 0"),
        ("PixelBoundaryNx", "0", "PixelBoundaryNx = '0' is not a whole number above 0"),
        ("PixelBoundaryNx", "7", "7 x 9 pixels must be square and odd"),
        ("NumVertices", "six", "NumVertices = 'six' is not a number"),
    ):
        cfg.write_text(re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text))
        assert refusal(read_galsim, stem) == f"{cfg}: {message}"
    cfg.write_text(re.sub(r"(?m)^NumVertices.*\n", "", text))
    assert refusal(read_galsim, stem) == f"{cfg}: NumVertices is missing"
