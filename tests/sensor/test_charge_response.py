"""Areas by the factors of a table against those of the table itself, at its own levels."""

import numpy as np
import pytest

from bfsensor import DistortionTable
from bfsensor.sensor import charge_response
from bfsensor.table.table import Displacements

NEAR, LAG_2 = ((0, 0), (1, 0), (0, 1), (1, 1)), ((2, 0), (0, 2), (2, 1), (1, 2), (2, 2))
LOWEST = 16.0
"""Height above the gates [um] below which at most a sixth of the light of 1000 nm converts."""


def area_errors(table, factors, offsets):
    """Largest relative error of the area of each pixel, at levels that differ by 5,000 e-.

    The effective charges of a level are read off their grid: that of the source less that of a pixel
    of the background.
    """
    heights = np.asarray(factors.heights)
    patterns = factors.modes
    middle = table.reach
    worst = dict.fromkeys(offsets, 0.0)
    for q in table.charges:
        for b in table.backgrounds:
            if abs(q - b) < 5000.0:
                continue
            charges = effective(factors, q, b) - effective(factors, b, b)
            for depth in [*heights[heights > LOWEST][::8].tolist(), heights[-1]]:
                own = table.area_changes(charge=q, background=b, depth=depth)
                layer = int(np.flatnonzero(heights == depth)[0])
                upright, flat = (
                    sum(
                        c * pattern[side][layer]
                        for c, pattern in zip(charges, patterns, strict=True)
                    )
                    for side in (0, 1)
                )
                found = areas(table, upright, flat)
                for i, j in offsets:
                    at = middle + j, middle + i
                    error = abs(found[at] / own[at] - 1)
                    worst[i, j] = max(worst[i, j], float(error))
    return worst


def effective(factors, charge, background):
    """Effective charges of all modes, linear between the steps of the grid."""
    response = factors.response
    grids = np.concatenate([response.first[..., None], response.near], -1).astype(float)
    q, b = charge / response.charge_step, background / response.background_step
    i, j = (min(int(x), n - 2) for x, n in zip((q, b), grids.shape[:2], strict=True))
    u, v = q - i, b - j
    low = (1 - v) * grids[i, j] + v * grids[i, j + 1]
    return (1 - u) * low + u * ((1 - v) * grids[i + 1, j] + v * grids[i + 1, j + 1])


def areas(table, upright, flat):
    """Area changes [%] of pixels whose sides are shifted by so much of a pixel."""
    pitch = np.array(table.pitch)
    corners = np.concatenate([upright[:, :, 0], upright[-1:, :, -1]])
    moved = Displacements(
        pitch * corners, pitch * flat[..., 1:-1, :], pitch * upright[..., 1:-1, :]
    )
    x, y = np.moveaxis(table._outlines(moved), -1, 0)
    x, y = x - x[..., :1], y - y[..., :1]
    area = 0.5 * (x * np.roll(y, -1, -1) - y * np.roll(x, -1, -1)).sum(-1)
    return 100 * (area / pitch.prod() - 1)


@pytest.mark.parametrize("name", ["itl_sta3800c", "e2v_ccd250"])
def test_factors_give_the_areas_of_the_table(name):
    table = DistortionTable.load(name)
    found = area_errors(table, charge_response.factor_table(table), NEAR + LAG_2)
    # Measured: 0.6 and 0.9 %, two pixels away 2.8 and 1.8 %, where the far mode alone acts.
    assert max(found[n] for n in NEAR) < 0.01
    assert max(found[n] for n in LAG_2) < 0.03


@pytest.mark.parametrize("name", ["itl_sta3800c", "e2v_ccd250"])
def test_fewer_near_modes_would_not_give_them(name, monkeypatch):
    monkeypatch.setattr(charge_response, "NEAR_MODES", 2)
    table = DistortionTable.load(name)
    found = area_errors(table, charge_response.factor_table(table), NEAR)
    # Measured: 2.0 and 5.1 %; with one near mode as before, chosen by shifts, 4.5 and 34 %.
    assert max(found.values()) > 0.015
