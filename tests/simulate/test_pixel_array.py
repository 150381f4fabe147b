"""Arrays of pixels from a nested start: the same solution, in fewer cycles."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.response.vertices import vertex_fractions
from bfsensor.simulate.boundaries import find_boundaries
from bfsensor.simulate.pixel_array import PixelArray
from bfsensor.simulate.poisson import TOLERANCE
from bfsensor.simulate.unit_cell import tile


@pytest.mark.parametrize(
    ("name", "cells"),
    [("itl_sta3800c", 16), ("itl_sta3800c", (32, 16)), ("e2v_ccd250", 16)],
)
@pytest.mark.parametrize(("charge", "background"), [(96_000.0, 0.0), (49_000.0, 44_000.0)])
def test_the_nested_start_gives_the_same_solution_in_fewer_cycles(
    name, cells, charge, background
):
    array = PixelArray(Device.load(name), period=6, cells=cells)
    cycles = array.solver.multigrid.cycles
    nested = array.solve(charge, background)
    from_nested = array.solver.multigrid.cycles - cycles
    charges = np.full(array.solver.pixel_shape, background)
    charges[0, 0] = charge
    tiled = array.solver.solve(charges, start=tile(array.unit(background), array.mesh))
    from_tiles = array.solver.multigrid.cycles - cycles - from_nested
    assert np.abs(nested.phi - tiled.phi).max() < nested.error_volts + tiled.error_volts
    assert nested.error_volts < TOLERANCE
    # Of a small charge on a background tiles are nearly as good a start.
    assert from_nested < (0.95 if charge - background < 1e4 else 0.8) * from_tiles


def test_a_solution_does_not_depend_on_what_was_solved_before():
    device = Device.load("itl_sta3800c")
    array = PixelArray(device, period=6, cells=16)
    for charge, background in ((20_000.0, 0.0), (90_000.0, 44_000.0)):
        array.solve(charge, background)
    again = array.solve(50_000.0, 10_000.0)
    alone = PixelArray(device, period=6, cells=16).solve(50_000.0, 10_000.0)
    assert np.array_equal(again.phi, alone.phi)


def test_fewer_cells_in_y_resolve_as_much():
    """With half as many cells in y the area of the charged pixel moves by less than 0.5 %."""
    device = Device.load("itl_sta3800c")
    areas = []
    for cells in ((32, 32), 32):
        array = PixelArray(device, period=4, cells=cells)
        lines = find_boundaries(array.solve(100_000.0, 0.0), [95.0], reach=1)
        _, horizontal, vertical = lines.vertices(8, vertex_fractions(8))
        right, upper = vertical[0, 1, 2, :, 0].mean(), horizontal[0, 2, 1, :, 1].mean()
        areas.append(right + upper)
        assert array.mesh.cells == (32, 32 if cells == (32, 32) else 16)
    assert areas[1] == pytest.approx(areas[0], rel=5e-3)
