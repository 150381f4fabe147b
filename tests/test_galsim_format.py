"""Distortion tables: interpolation, polygons that tile, files, GalSim's format."""

from __future__ import annotations

import os
import pickle
from dataclasses import replace
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
from bfsensor.resources import tables_dir
from bfsensor.table import DistortionTable, vertex_fractions

PITCH = (10.0, 10.0)
CHARGES = np.array([0.0, 20_000.0, 50_000.0, 90_000.0, 150_000.0])
BACKGROUNDS = np.array([0.0, 20_000.0, 60_000.0, 100_000.0])
DEPTHS = np.array([2.0, 6.0, 20.0, 50.0, 100.0])
# Arrays are kept in single precision: half a unit in the last of 24 bits.
SINGLE = 2.0**-24

SENSORS = Path(galsim.meta_data.share_dir) / "sensors"
STEMS = sorted(path.stem for path in SENSORS.glob("lsst_*.cfg"))
DIFFUSION_KEYS = [
    "NumPhases", "CollectingPhases", "ChannelStopWidth", "FieldOxideTaper", "Vbb",
    "Vparallel_lo", "Vparallel_hi", "qfh", "CCDTemperature", "SensorThickness",
    "PixelSizeX", "CollectedCharge_0_0",
]  # fmt: skip


def pull(x, y):
    """Shift [um] towards the origin, larger across rows than across columns."""
    # Beyond one pixel its divergence is positive: neighbours gain what the source loses.
    softened = (1.0 + (x**2 + y**2) / 40.0) ** 2
    return np.stack(np.broadcast_arrays(-0.08 * x / softened, -0.12 * y / softened), -1)


def unit_response(charge, background, depth):
    """Smooth response, a cubic in the charge and in the background, rising with depth."""
    q, b = charge / 1e5, background / 1e5
    return (
        (1 - 0.3 * q + 0.1 * q**2 + 0.05 * q**3)
        * (1 + 0.2 * b - 0.1 * b**3)
        * (1 + 0 * depth)
    )


def make_table(
    charges=CHARGES, backgrounds=BACKGROUNDS, depths=DEPTHS, *, reach=2, vertices=4,
    response=unit_response, field=pull, pitch=PITCH, **other,
):  # fmt: skip
    """A table of (Q - B) / 1e5 times a response times a field of shifts."""
    charges, backgrounds, depths = (np.array(a) for a in (charges, backgrounds, depths))
    n = 2 * reach + 1
    x, y = ((np.arange(n + 1) - reach - 0.5) * p for p in pitch)
    f = vertex_fractions(vertices)
    inner_x, inner_y = x[:-1, None] + f * pitch[0], y[:-1, None] + f * pitch[1]
    q, b, z = np.meshgrid(charges, backgrounds, depths, indexing="ij")
    weight = (q - b) / 1e5 * response(q, b, z)

    def spread(shift):
        return weight[(...,) + (None,) * shift.ndim] * shift

    return DistortionTable(
        charges=charges, backgrounds=backgrounds, depths=depths, pitch=pitch,
        thickness=100.0, vertices=vertices, reach=reach,
        corners=spread(field(x[None, :], y[:, None])),
        horizontal=spread(field(inner_x[None], y[:, None, None])),
        vertical=spread(field(x[None, :, None], inner_y[:, None])),
        **other,
    )  # fmt: skip


def make_rough_table(seed, *, reach=2, vertices=3, pitch=(10.0, 8.0), **other):
    """A table of random shifts, without any symmetry."""
    rng = np.random.default_rng(seed)

    def field(x, y):
        return 0.3 * rng.normal(size=(*np.broadcast_shapes(x.shape, y.shape), 2))

    return make_table(
        [0.0, 70_000.0], [0.0, 30_000.0], [5.0, 100.0], reach=reach, vertices=vertices,
        pitch=pitch, symmetric=False, field=field, **other,
    )  # fmt: skip


def parts(shifts):
    return shifts.corners, shifts.horizontal, shifts.vertical


def polygon_area(points):
    after = np.roll(points, -1, axis=-2)
    return 0.5 * np.sum(points[..., 0] * after[..., 1] - points[..., 1] * after[..., 0], -1)


@pytest.fixture(scope="module")
def table():
    return make_table(full_well=170_000.0)


# -- interpolation ---------------------------------------------------------------------


@pytest.mark.parametrize("vertices", [1, 2, 7, 32])
def test_vertices_stand_at_equal_angles_seen_from_the_pixel_centre(vertices):
    angles = np.arctan(2 * vertex_fractions(vertices) - 1)
    steps = np.diff([-np.pi / 4, *angles, np.pi / 4])
    assert np.allclose(steps, np.pi / 2 / (vertices + 1), rtol=1e-12)


@given(
    background=st.floats(BACKGROUNDS[0], BACKGROUNDS[-1]),
    depth=st.floats(DEPTHS[0], DEPTHS[-1]),
)
@settings(max_examples=40, deadline=None)
def test_a_uniform_image_does_not_distort(table, background, depth):
    shifts = table.displacements(charge=background, background=background, depth=depth)
    assert all(np.all(part == 0) for part in parts(shifts))
    nearby = table.displacements(
        charge=background + 100, background=background, depth=depth
    )
    assert np.abs(nearby.corners).max() > 0


def test_levels_come_back(table):
    for q, charge in enumerate(CHARGES):
        for b, background in enumerate(BACKGROUNDS):
            for d, depth in enumerate(DEPTHS):
                shifts = table.displacements(
                    charge=charge, background=background, depth=depth
                )
                for name in ("corners", "horizontal", "vertical"):
                    kept = getattr(table, name)[q, b, d]
                    # A division and a multiplication: a few times the double round-off.
                    assert np.allclose(getattr(shifts, name), kept, rtol=1e-13, atol=1e-15)


@given(
    charge=st.floats(CHARGES[0], CHARGES[-1]),
    background=st.floats(BACKGROUNDS[0], BACKGROUNDS[-1]),
    depth=st.floats(DEPTHS[0], DEPTHS[-1]),
)
@settings(max_examples=60, deadline=None)
def test_responses_cubic_in_both_charges_are_interpolated_exactly(
    charge, background, depth
):
    # No level has Q = B, so nothing is filled in; four levels carry a cubic.
    table = make_table(backgrounds=[1e3, 23e3, 61e3, 1e5], charges=CHARGES)
    background = max(background, 1e3)
    shifts = table.displacements(charge=charge, background=background, depth=depth)
    exact = (charge - background) / 1e5 * unit_response(charge, background, depth)
    expected = exact * pull(np.array(5.0), np.array(5.0))
    # Single precision of a level, |D| / |Q - B| at most at the closest Q and B (1000 e-
    # apart), times |Q - B| < 1.5e5 e-, times the weights of the splines (below 3 each).
    size = np.abs(pull(np.array(5.0), np.array(5.0))).max()
    assert np.abs(shifts.corners[3, 3] - expected).max() < 9 * 2 * SINGLE * size * 1.5


def test_smooth_responses_converge_with_the_levels():
    def bent(charge, background, depth):
        return np.exp(-charge / 6e4 + background / 2e5) * (1 + 0 * depth)

    errors = []
    for count in (5, 9, 17):
        levels = np.linspace(0.0, 150_000.0, count)
        table = make_table(levels, [0.0], [95.0], response=bent)
        asked = np.linspace(2_000.0, 149_000.0, 40)
        found = [table.displacements(charge=q, depth=95.0).corners[3, 3, 1] for q in asked]
        exact = asked / 1e5 * bent(asked, 0.0, 95.0) * pull(np.array(5.0), np.array(5.0))[1]
        errors.append(np.abs(np.array(found) - exact).max() / np.abs(exact).max())
    # The level Q = B is filled by a parabola, the rest by cubics: third order, 8 a halving.
    # A fifth less is left for levels that are not yet asymptotic.
    assert errors[0] / errors[1] > 6.4
    assert errors[1] / errors[2] > 6.4
    # Third order: h^3 / (6 scale^3) times (2/3)^(3/2) / 6 at most, with h / scale = 0.16.
    assert errors[2] < 5e-4


@given(depths=st.tuples(st.floats(2.0, 100.0), st.floats(2.0, 100.0)))
@settings(max_examples=40, deadline=None)
def test_shifts_rise_with_depth_without_overshoot(depths):
    table = make_table(
        [5e4], [0.0], DEPTHS, response=lambda q, b, z: np.minimum(z / 20.0, 1.0) + 0 * q
    )
    low, high = sorted(depths)
    shallow, deep = (
        np.abs(table.displacements(charge=5e4, depth=z).corners).max() for z in (low, high)
    )
    top = np.abs(table.corners).max()
    assert shallow <= deep * (1 + 1e-12)
    assert deep <= top * (1 + 1e-12)


@pytest.mark.parametrize("charge", [0.0, 1.0, 37_000.0, 100_000.0])
def test_a_table_of_one_charge_is_linear_in_charge(charge):
    table = make_table([1e5], [0.0], [95.0])
    shifts = table.displacements(charge=charge, depth=95.0)
    assert np.allclose(
        shifts.vertical, table.vertical[0, 0, 0] * charge / 1e5, rtol=1e-12, atol=1e-15
    )


def test_one_background_and_one_depth_answer_only_there():
    table = make_table(CHARGES, [20_000.0], [50.0])
    assert table.area_changes(charge=5e4, background=2e4, depth=50.0)[2, 2] < 0
    with pytest.raises(TableError, match=r"background = 0 is outside .* holds 20000 e-"):
        table.displacements(charge=5e4, depth=50.0)
    with pytest.raises(TableError, match=r"depth = 51 is outside .* holds 50 um"):
        table.displacements(charge=5e4, background=2e4, depth=51.0)


@pytest.mark.parametrize(
    ("question", "message"),
    [
        (
            {"charge": 2e5, "depth": 9.0},
            r"charge = 200000 .*0 to 150000.*full well 170,000 e-",
        ),
        ({"charge": -1.0, "depth": 9.0}, r"charge = -1 is outside"),
        ({"charge": np.nan, "depth": 9.0}, r"charge = nan is outside"),
        (
            {"charge": 1e4, "background": 1.1e5, "depth": 9.0},
            r"background = 110000 .*0 to 100000",
        ),
        ({"charge": 1e4, "depth": 1.9}, r"depth = 1.9 .*from 2 to 100 um"),
        ({"charge": 1e4, "depth": 100.1}, r"depth = 100.1 is outside"),
    ],
)
def test_questions_outside_the_table_are_refused(table, question, message):
    for method in (table.displacements, table.areas, table.area_changes):
        with pytest.raises(TableError, match=message):
            method(**question)


# -- polygons and areas ----------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1), vertices=st.integers(1, 6), reach=st.integers(0, 3))
@settings(max_examples=40, deadline=None)
def test_polygons_tile_the_plane(seed, vertices, reach):
    table = make_rough_table(seed, reach=reach, vertices=vertices)
    where = {"charge": 51_000.0, "background": 7_000.0, "depth": 33.0}
    areas = table.areas(**where)
    shifts, nominal = table.displacements(**where), table.nominal()
    c, h, v = (a + b for a, b in zip(parts(shifts), parts(nominal), strict=True))
    n = 2 * reach + 1
    outline = []
    for i in range(n):
        outline += [c[0, i], *h[0, i]]
    for j in range(n):
        outline += [c[j, n], *v[j, n]]
    for i in reversed(range(n)):
        outline += [c[n, i + 1], *h[n, i, ::-1]]
    for j in reversed(range(n)):
        outline += [c[j + 1, 0], *v[j, 0, ::-1]]
    assert areas.sum() == pytest.approx(polygon_area(np.array(outline)), rel=1e-9)
    assert areas.shape == (n, n)


def test_areas_are_those_of_the_polygons_and_neighbours_gain(table):
    where = {"charge": 1e5, "depth": 40.0}
    areas = table.areas(**where)
    for i, j in ((0, 0), (1, 0), (0, 1), (-2, 1)):
        polygon = table.polygon(i, j, **where)
        assert polygon.shape == (4 * table.vertices + 4, 2)
        # Counter-clockwise: the signed area is positive.
        assert polygon_area(polygon) == pytest.approx(areas[j + 2, i + 2], rel=1e-12)
    changes = table.area_changes(**where)
    assert np.allclose(changes, areas - 100.0)
    assert changes[2, 2] < 0 < changes[2, 3] < changes[3, 2]


def test_areas_of_a_uniform_stretch_are_exact():
    # x -> (1 + a) x, y -> (1 + b) y multiplies every area by (1 + a)(1 + b).
    table = make_table(
        [1e5], [0.0], [95.0], response=lambda q, b, z: 1.0 + 0 * q,
        field=lambda x, y: np.stack(np.broadcast_arrays(0.02 * x, -0.01 * y), -1),
    )  # fmt: skip
    areas = table.areas(charge=1e5, depth=95.0)
    assert np.allclose(areas, 100 * 1.02 * 0.99, rtol=40 * SINGLE)


@pytest.mark.parametrize("vertices", [2, 4, 8, 32])
def test_polygons_start_on_the_left_just_below_the_centre(vertices):
    table = make_table([1e5], [0.0], [95.0], vertices=vertices)
    first, last = table.polygon(0, 0, charge=0.0, depth=95.0)[[0, -1]]
    assert first[0] == last[0] == -5.0
    assert first[1] < 0 < last[1]
    assert first[1] == pytest.approx(-last[1], rel=1e-12)


def test_polygons_are_refused_beyond_the_reach(table):
    with pytest.raises(TableError, match=r"offset \(3, 0\) .* reaches 2 pixels"):
        table.polygon(3, 0, charge=1e4, depth=9.0)


# -- construction ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"charges": CHARGES[::-1]}, "charges = .* must be finite and ascend"),
        ({"depths": np.array([2.0, 6.0, 20.0, np.nan, 100.0])}, "depths = .* finite"),
        ({"backgrounds": BACKGROUNDS - 1.0}, "must not be negative"),
        (
            {"charges": CHARGES[:-1]},
            r"corners has the shape \(5, 4, 5, 6, 6, 2\), not \(4,",
        ),
        ({"depths": DEPTHS - 2.0}, "depths = .* must be above the gates"),
        ({"depths": DEPTHS + 1.0}, "not be above the thickness, 100 um"),
        ({"pitch": (10.0, 0.0)}, "pitch y = 0.0 um must be finite and above 0"),
        ({"thickness": np.inf}, "thickness = inf um"),
        ({"full_well": 0.0}, "full_well = 0.0 e-"),
        ({"vertices": 0}, "vertices = 0 must be a whole number from 1"),
        ({"reach": 1.5}, "reach = 1.5 must be a whole number"),
    ],
)
def test_wrong_tables_are_refused(table, change, message):
    with pytest.raises(TableError, match=message):
        replace(table, **change)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39])
def test_values_that_are_not_finite_are_refused(table, value):
    vertical = table.vertical.copy()
    vertical[1, 1, 1, 0, 0, 0, 0] = value
    with pytest.raises(TableError, match="vertical holds values that are not finite"):
        replace(table, vertical=vertical)


def test_one_charge_equal_to_a_background_says_nothing():
    with pytest.raises(TableError, match="one that differs from the background, 20000 e-"):
        make_table([20_000.0], BACKGROUNDS, DEPTHS)


def test_tables_are_constant_and_pickle(table):
    for name in ("charges", "backgrounds", "depths", "corners", "horizontal", "vertical"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(table, name)[0] = 1.0
    with pytest.raises(TypeError):
        table.errors["mesh [%]"] = 1.0
    assert pickle.loads(pickle.dumps(table)) == table


@pytest.mark.parametrize(
    "change",
    [
        {"full_well": 1.0}, {"full_well": np.nan}, {"errors": {"mesh [%]": 1.0}},
        {"errors": {"mesh [%]": np.nan}}, {"provenance": {"cells": "16"}},
        {"device_text": "x"}, {"symmetric": False}, {"thickness": 101.0},
        {"depths": np.array([2.0, 6.0, 20.0, 50.0, 99.9])},
    ],
)  # fmt: skip
def test_tables_differ_when_anything_does(table, change):
    changed = replace(table, **change)
    assert changed != table
    assert changed == replace(table, **change)
    corners = table.corners.copy()
    corners[1, 0, 0, 0, 0, 0] = np.nextafter(
        np.float32(corners[1, 0, 0, 0, 0, 0]), np.float32(1)
    )
    assert replace(table, corners=corners) != table


# -- files -----------------------------------------------------------------------------

TEXTS = st.text(st.characters(codec="utf-8"), max_size=40)
# A FITS card holds 20 characters of a number: all digits from 0.1 on.
NUMBERS = st.floats(0.1, 1e9)


@given(
    seed=st.integers(0, 2**32 - 1),
    pitch=st.tuples(NUMBERS, NUMBERS),
    full_well=NUMBERS | st.just(np.nan),
    errors=st.dictionaries(TEXTS, st.floats(), max_size=3),
    provenance=st.dictionaries(TEXTS, TEXTS, max_size=3),
    device_text=TEXTS,
)
@settings(max_examples=40, deadline=None)
def test_what_was_written_reads_back_equal(
    tmp_path_factory, seed, pitch, full_well, errors, provenance, device_text
):
    path = tmp_path_factory.mktemp("tables") / "table.fits"
    rough = make_rough_table(
        seed, reach=1, vertices=2, pitch=pitch, full_well=full_well, errors=errors,
        provenance=provenance, device_text=device_text,
    )  # fmt: skip
    rough.write(path)
    assert DistortionTable.read(path) == rough


@pytest.mark.parametrize("vertices", [1, 4, 5])
@pytest.mark.parametrize("reach", [0, 2])
def test_of_symmetric_tables_a_quadrant_is_stored(tmp_path, vertices, reach):
    table = make_table(vertices=vertices, reach=reach)
    # Nominal positions are symmetric to round-off only, single precision removes that.
    table.write(tmp_path / "whole.fits")
    assert DistortionTable.read(tmp_path / "whole.fits") == table
    with fits.open(tmp_path / "whole.fits") as hdus:
        assert hdus[0].header["QUADRANT"]
        assert hdus["VERTICAL"].shape[3:5] == (reach + 1, reach + 1)


@pytest.mark.parametrize("name", ["corners", "horizontal", "vertical"])
def test_one_bit_of_asymmetry_is_kept(tmp_path, table, name):
    array = getattr(table, name).copy()
    array[(1,) + (0,) * (array.ndim - 1)] += 1e-5
    bent = replace(table, **{name: array})
    bent.write(tmp_path / "bent.fits")
    assert DistortionTable.read(tmp_path / "bent.fits") == bent != table


def test_a_usual_table_takes_less_than_two_megabytes(tmp_path):
    table = make_table(
        np.linspace(0, 1.6e5, 7), [0.0, 4e4, 8e4, 1.4e5], DEPTHS, reach=4, vertices=32
    )
    table.write(tmp_path / "usual.fits")
    # 140 levels of a quadrant of 25 (2 + 2 x 64) numbers of 4 byte, and 2880-byte blocks.
    assert 140 * 25 * 130 * 4 < (tmp_path / "usual.fits").stat().st_size < 1.9e6


def test_headers_tell_people_what_the_file_is(tmp_path, table):
    known = replace(table, errors={"mesh [%]": 0.25}, provenance={"cells": "32"})
    known.write(tmp_path / "table.fits")
    with fits.open(tmp_path / "table.fits") as hdus:
        header = hdus[0].header
        assert header["SCHEMA"] == "bfsensor distortion table"
        assert [header["BUNIT"], hdus["CHARGES"].header["BUNIT"]] == ["um", "electron"]
        assert "cells = 32" in str(header["HISTORY"])
        assert "mesh [%] = 0.25" in str(header["COMMENT"])
        assert all("CHECKSUM" in hdu.header for hdu in hdus)
    assert [path.name for path in tmp_path.iterdir()] == ["table.fits"]


@pytest.fixture(scope="module")
def small_file(tmp_path_factory):
    """A written table and its bytes, few enough to damage each."""
    table = make_rough_table(7043, reach=0, vertices=1, device_text="[pixel]\n")
    path = tmp_path_factory.mktemp("small") / "small.fits"
    table.write(path)
    return table, path.read_bytes()


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_a_damaged_byte_is_never_read_as_another_table(small_file, tmp_path_factory, data):
    table, whole = small_file
    telling = [at for at, byte in enumerate(whole) if byte not in b" \0"]
    at = data.draw(st.sampled_from(telling))
    value = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "damaged.fits"
    path.write_bytes(whole[:at] + bytes([value]) + whole[at + 1 :])
    try:
        found = DistortionTable.read(path)
    except TableError as error:
        found, message = None, str(error)
    # Equal: the byte was not changed, or lies in what does not count.
    assert found == table or (found is None and "damaged.fits: " in message)


@pytest.mark.parametrize(
    "name",
    [
        "CORNERS",
        "HORIZONTAL",
        "VERTICAL",
        "CHARGES",
        "BACKGROUNDS",
        "DEPTHS",
        "META",
        "DEVICE",
    ],
)
def test_changed_data_are_refused_by_their_checksum(small_file, tmp_path, name):
    _, whole = small_file
    path = tmp_path / "changed.fits"
    path.write_bytes(whole)
    with fits.open(path) as hdus:
        at = hdus[name].fileinfo()["datLoc"] + 3
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    with pytest.raises(TableError, match=r"changed.fits: .*damaged: .*[Cc]hecksum"):
        DistortionTable.read(path)


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_truncated_files_are_refused(small_file, tmp_path_factory, data):
    _, whole = small_file
    blocks = st.integers(0, len(whole) // 2880 - 1).map(lambda n: n * 2880)
    end = data.draw(st.integers(0, len(whole) - 1) | blocks)
    path = tmp_path_factory.mktemp("short") / "short.fits"
    path.write_bytes(whole[:end])
    with pytest.raises(TableError, match=r"short.fits: "):
        DistortionTable.read(path)


def test_foreign_files_are_refused(tmp_path, small_file):
    with pytest.raises(TableError, match=r"absent.fits: no such file"):
        DistortionTable.read(tmp_path / "absent.fits")
    (tmp_path / "text.fits").write_text("not a table\n")
    with pytest.raises(TableError, match=r"text.fits: not a FITS file"):
        DistortionTable.read(tmp_path / "text.fits")
    with pytest.raises(TableError, match="not a FITS file"):
        DistortionTable.read(tmp_path)
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / "image.fits")
    with pytest.raises(TableError, match=r"image.fits: not a distortion table"):
        DistortionTable.read(tmp_path / "image.fits")
    path = tmp_path / "later.fits"
    path.write_bytes(small_file[1])
    with fits.open(path, mode="update", checksum=True) as hdus:
        hdus[0].header["SCHEMAV"] = 2
    with pytest.raises(TableError, match=r"later.fits: schema version 2 is not 1"):
        DistortionTable.read(path)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [("REACH", 3, "has the shape"), ("VERTICES", None, "VERTICES.* not found")],
)
def test_headers_that_contradict_the_data_are_refused(
    tmp_path, small_file, key, value, message
):
    path = tmp_path / "odd.fits"
    path.write_bytes(small_file[1])
    with fits.open(path, mode="update", checksum=True) as hdus:
        if value is None:
            del hdus[0].header[key]
        else:
            hdus[0].header[key] = value
    with pytest.raises(TableError, match=rf"odd.fits: .*{message}"):
        DistortionTable.read(path)


def test_files_are_only_replaced_when_told_and_never_halved(tmp_path, table, monkeypatch):
    path = tmp_path / "table.fits"
    table.write(path)
    other = replace(table, device_text="other")
    with pytest.raises(TableError, match=r"table.fits exists"):
        other.write(path)
    with monkeypatch.context() as patch:

        def fail(*_):
            raise OSError("disk full")

        patch.setattr(os, "replace", fail)
        with pytest.raises(TableError, match=r"table.fits: cannot be written: disk full"):
            other.write(path, overwrite=True)
    assert DistortionTable.read(path) == table
    other.write(path, overwrite=True)
    assert DistortionTable.read(path) == other
    assert [p.name for p in tmp_path.iterdir()] == ["table.fits"]
    with pytest.raises(TableError, match="cannot be written"):
        table.write(tmp_path / "absent" / "table.fits")


# -- GalSim's format -------------------------------------------------------------------


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
