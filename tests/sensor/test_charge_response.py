"""Modes and effective charges give back the areas of the table that they were made of."""

import numpy as np
import pytest

from bfsensor import DistortionTable
from bfsensor.device.shipped import tables_dir
from bfsensor.sensor import charge_response
from bfsensor.sensor.charge_response import factor_table

LAGS = (0, 0), (1, 0), (0, 1), (1, 1)


def areas_of(vertical, horizontal, points):
    """Area changes to first order in the shifts [..., layer, row, column, point, (x, y)]."""
    lengths = np.zeros(len(points))
    lengths[1:] += 0.5 * np.diff(points)
    lengths[:-1] += 0.5 * np.diff(points)
    x, y = vertical[..., 0] @ lengths, horizontal[..., 1] @ lengths
    return x[..., 1:] - x[..., :-1] + y[..., 1:, :] - y[..., :-1, :]


def modelled(table, factors, charge, background):
    """Areas at the layers by the modes, for a charge on a background [per electron]."""
    response, out = factors.response, 0.0
    grids = [response.first, *np.moveaxis(response.near, -1, 0)]
    i, j = charge / response.charge_step, background / response.background_step
    for (vertical, horizontal), grid in zip(factors.modes, grids, strict=True):

        def at(q, grid=grid):
            # Grids are linear between their steps.
            a, b = min(int(q), len(grid) - 2), min(int(j), grid.shape[1] - 2)
            u, v = q - a, j - b
            low = (1 - v) * grid[a, b] + v * grid[a, b + 1]
            return (1 - u) * low + u * ((1 - v) * grid[a + 1, b] + v * grid[a + 1, b + 1])

        step = at(i) - at(background / response.charge_step)
        out = out + step * areas_of(vertical, horizontal, factors.points)
    return out / (charge - background)


@pytest.mark.parametrize("name", ["itl_sta3800c", "e2v_ccd250"])
def test_modes_give_the_areas_of_the_table_nearby(name):
    """At all levels of the table, for light that converts near the back surface."""
    table = DistortionTable.read(tables_dir() / name / "table.fits")
    factors = factor_table(table)
    pitch = np.array(table.pitch)
    sides = [s / pitch for s in charge_response.join_sides(*table._responses[:3])]
    worst = dict.fromkeys(LAGS, 0.0)
    for n, charge in enumerate(table.charges):
        for m, background in enumerate(table.backgrounds):
            if abs(charge - background) < 5000:
                continue
            true = areas_of(*(s[n, m, -1] for s in sides), factors.points)
            found = modelled(table, factors, charge, background)[-1]
            c = len(true) // 2
            for i, j in LAGS:
                error = abs(found[c + j, c + i] / true[c + j, c + i] - 1)
                worst[i, j] = max(worst[i, j], error)
    assert worst.pop((1, 1)) < 0.02
    assert max(worst.values()) < 0.006, worst


def test_fewer_modes_do_not(monkeypatch):
    """The neighbours of e2v_ccd250 need them all."""
    table = DistortionTable.read(tables_dir() / "e2v_ccd250" / "table.fits")
    whole = factor_table(table).residual
    made = charge_response._split

    def fewer(*args):
        modes = made(*args)
        amplitudes = modes.amplitudes.copy()
        amplitudes[:, 2:] = 0.0
        return charge_response._Modes(amplitudes, modes.patterns)

    monkeypatch.setattr(charge_response, "_split", fewer)
    assert factor_table(table).residual > 2 * whole
