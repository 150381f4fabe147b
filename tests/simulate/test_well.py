"""The well's barriers against what the electrons themselves do, and against symmetry."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.simulate.unit_cell import solve_unit_cell
from bfsensor.simulate.well import barrier, surface_barrier


@pytest.fixture(scope="module")
def pixels():
    """Unit cells with few, many and very many electrons under one gate high at 5 V."""
    device = Device.load("itl_sta3800c").with_value("collecting_phases", "1")
    device = device.with_value("gate_high", "5 V")
    return {
        charge: solve_unit_cell(device, charge, cells=16) for charge in (4e4, 1.2e5, 2.4e5)
    }


def test_surface_barrier_is_the_logarithm_of_the_densities(pixels):
    """Counted on the electrons, which the solver finds by another way than the height."""
    potential = pixels[1.2e5]
    device = potential.device
    kt = device.material.thermal_voltage(device.operating_point.temperature)
    density = np.divide(
        potential.electrons, potential.silicon, where=potential.silicon > 0,
        out=np.zeros_like(potential.electrons),
    )  # fmt: skip
    lowest = np.argmax(potential.silicon > 0, axis=0)
    at_oxide = np.take_along_axis(density, lowest[None], axis=0).max()
    height = surface_barrier(potential)
    assert 0.02 < height < 0.3
    # Newton leaves 1e-6 V, of kT = 0.015 V; the densities are exponentials of this potential.
    assert density.max() / at_oxide == pytest.approx(np.exp(height / kt), rel=1e-3)


def test_surface_barrier_falls_to_zero_as_the_well_fills(pixels):
    heights = [surface_barrier(pixels[charge]) for charge in sorted(pixels)]
    assert heights[0] > 0.4 and heights[0] > heights[1] > heights[2] == 0.0


def test_the_barrier_along_the_column_is_another(pixels):
    """The cloud lies at the oxide while volts still keep it from spilling."""
    assert surface_barrier(pixels[2.4e5]) == 0.0
    assert barrier(pixels[2.4e5]) > 1.0
