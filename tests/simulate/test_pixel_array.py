"""Arrays of pixels from a nested start: the same solution, in fewer cycles."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.simulate.pixel_array import PixelArray
from bfsensor.simulate.poisson import TOLERANCE
from bfsensor.simulate.unit_cell import tile


@pytest.mark.parametrize("name", ["itl_sta3800c", "e2v_ccd250"])
@pytest.mark.parametrize(("charge", "background"), [(96_000.0, 0.0), (49_000.0, 44_000.0)])
def test_the_nested_start_gives_the_same_solution_in_fewer_cycles(name, charge, background):
    array = PixelArray(Device.load(name), period=6, cells=16)
    cycles = array.solver.multigrid.cycles
    nested = array.solve(charge, background)
    from_nested = array.solver.multigrid.cycles - cycles
    charges = np.full(array.solver.pixel_shape, background)
    charges[0, 0] = charge
    tiled = array.solver.solve(charges, start=tile(array.unit(background), array.mesh))
    from_tiles = array.solver.multigrid.cycles - cycles - from_nested
    assert np.abs(nested.phi - tiled.phi).max() < nested.error_volts + tiled.error_volts
    assert nested.error_volts < TOLERANCE
    assert from_nested < 0.8 * from_tiles


def test_a_solution_does_not_depend_on_what_was_solved_before():
    device = Device.load("itl_sta3800c")
    array = PixelArray(device, period=6, cells=16)
    for charge, background in ((20_000.0, 0.0), (90_000.0, 44_000.0)):
        array.solve(charge, background)
    again = array.solve(50_000.0, 10_000.0)
    alone = PixelArray(device, period=6, cells=16).solve(50_000.0, 10_000.0)
    assert np.array_equal(again.phi, alone.phi)
