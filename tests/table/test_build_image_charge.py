"""Tables of the analytic engine: linear, of the same kind as the Poisson solver's."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from bfsensor.errors import TableError
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes
from bfsensor.table.build_image_charge import (
    ENGINE,
    build_image_charge_table,
    default_depths,
)
from bfsensor.table.table import DistortionTable

MODEL = ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0, drift_field=((0, 0.75), (100, 0.37)))
CHARGES, BACKGROUNDS, DEPTHS = (0.0, 30e3, 100e3), (0.0, 50e3), (1.4, 6.0, 30.0, 100.0)


@pytest.fixture(scope="module")
def table():
    return build_image_charge_table(
        MODEL,
        charges=CHARGES,
        backgrounds=BACKGROUNDS,
        depths=DEPTHS,
        vertices=16,
        pixels=7,
    )


def test_displacements_are_linear_in_charge(table):
    unit = table.displacements(charge=100e3, background=0.0, depth=30.0)
    for charge, background in ((30e3, 0.0), (0.0, 50e3), (80e3, 20e3)):
        moved = table.displacements(charge=charge, background=background, depth=30.0)
        for name in ("corners", "horizontal", "vertical"):
            # Single precision in the table, 6e-8.
            np.testing.assert_allclose(
                getattr(moved, name),
                (charge - background) / 100e3 * getattr(unit, name),
                rtol=3e-7,
                atol=1e-9,
            )
    assert np.abs(unit.corners).max() > 0.05


def test_areas_at_small_charge_are_those_of_the_edges(table):
    """Through lines, vertices, single precision and polygons, against closed forms."""
    for depth in DEPTHS[1:]:
        a = area_changes(MODEL, depth=depth, reach=3)
        found = table.area_changes(charge=100.0, depth=depth) / (100.0 * 100.0)
        # Lines of 48 points a pixel: 5e-4 of a shift, of which (1, 0) is a difference.
        np.testing.assert_allclose(found, a, rtol=2e-3, atol=1e-5 * a.max())


def test_nothing_moves_at_the_lowest_sealed_height(table):
    assert not np.any(table.vertical[:, :, 0])
    assert not np.any(table.horizontal[:, :, 0])
    assert np.any(table.horizontal[:, :, 1])


def test_symmetry_is_exact_and_files_come_back(table, tmp_path):
    np.testing.assert_array_equal(
        table.vertical[..., 0], -table.vertical[:, :, :, :, ::-1, :, 0]
    )
    table.write(tmp_path / "table.fits")
    assert DistortionTable.read(tmp_path / "table.fits") == table
    assert table.symmetric


def test_the_header_says_what_it_is(table):
    assert table.provenance["engine"] == ENGINE
    assert "linear in charge" in ENGINE
    stated = json.loads(table.provenance["parameters [um, V/um]"])
    assert ImageCharge(**stated) == MODEL
    # 0.03 um of 0.6 um at 100,000 e-: the charge deflects the drift field.
    assert 0.002 < table.errors["first order, largest charge [um]"] < 0.1
    assert table.errors["image series, bound [um]"] < 1e-6
    strong = build_image_charge_table(MODEL, charges=(0.0, 1e7), depths=[5.0], pixels=3)
    assert np.isnan(strong.errors["first order, largest charge [um]"])


def test_depths_between_levels():
    """Default depths: interpolated areas of the nearest pixels within 1.5 % of the source's."""
    table = build_image_charge_table(MODEL, pixels=3)
    assert table.depths.tolist() == pytest.approx(list(default_depths(MODEL)))
    for depth in (4.0, 5.0, 9.0, 15.0, 25.0, 60.0):
        a = area_changes(MODEL, depth=depth, reach=1)
        found = table.area_changes(charge=500.0, depth=depth) / (500.0 * 100.0)
        assert np.abs(found - a).max() < 0.015 * np.abs(a).max()


def test_pitches_may_differ():
    model = dataclasses.replace(MODEL, pitch_y=15.0)
    table = build_image_charge_table(model, depths=[100.0], pixels=3)
    assert table.pitch == (10.0, 15.0)
    a = area_changes(model, depth=100.0, reach=1)
    found = table.area_changes(charge=100.0, depth=100.0) / (100.0 * 150.0)
    np.testing.assert_allclose(found, a, rtol=2e-3, atol=1e-5 * a.max())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixels": 4}, "pixels = 4 must be odd and at least 3"),
        ({"vertices": 1}, "vertices = 1 must be at least 2 a side"),
        (
            {"charges": (0.0,)},
            "charges = [0.0] e- and backgrounds = [0.0] e- must be finite and differ somewhere: "
            "where they are equal nothing moves",
        ),
        ({"depths": [5.0, 4.0]}, "conversion depths [5.0, 4.0] um must ascend"),
        (
            {"depths": [101.0]},
            "conversion depth 101 um must be above 0 um, the gates, and at most 100 um, the "
            "back surface",
        ),
    ],
)
def test_refusals(changes, message):
    with pytest.raises(TableError) as caught:
        build_image_charge_table(MODEL, **changes)
    assert str(caught.value) == message
