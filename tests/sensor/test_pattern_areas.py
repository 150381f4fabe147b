"""Areas under rings: around their centre by polygons, elsewhere by mean shifts of the sides."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, ShiftMap, SiliconSensor
from bfsensor.sensor import pattern_areas

RINGS = galsim.SiliconSensor.simple_treerings(0.26, 47.0)
NX, NY = 130, 90
NO_SHIFT = ShiftMap(
    np.zeros((NY + 9, NX + 9)), np.zeros((NY + 9, NX + 9)), x0=-4.0, y0=-4.0
)


def areas(kind, centre, **options):
    sensor = kind(treering_func=RINGS, treering_center=centre, **options)
    image = galsim.ImageD(NX, NY)
    image.array[...] = 1e4 * np.random.default_rng(9176).random((NY, NX))
    return sensor.calculate_pixel_areas(image).array


@pytest.mark.parametrize(
    "centre", [(0, 0), (65.3, 41.8), (-20.0, 50.5), (131.0, 95.0), (-400, 60)]
)
def test_areas_hold_wherever_the_centre_of_the_rings_lies(centre):
    """A map without shifts beside the rings has every pixel drawn as a polygon."""
    centre = galsim.PositionD(*centre)
    fast = areas(BrighterFatterSensor, centre)
    whole = areas(BrighterFatterSensor, centre, shift_map=NO_SHIFT)
    off = areas(BrighterFatterSensor, galsim.PositionD(1e6, 0))
    # The quadrature is good to 1e-6, and so are sides of polygons in single precision.
    assert np.abs(fast - whole).max() < 3e-6
    assert np.abs(whole - off).max() > 0.01


@pytest.mark.parametrize("kind", [SiliconSensor, BrighterFatterSensor])
def test_few_pixels_are_drawn_as_polygons(kind, monkeypatch):
    """GalSim's default centre of the rings is the corner of an image."""
    drawn = []
    polygons = pattern_areas.pixel_areas

    def counted(*arguments):
        drawn.append(arguments[-1].size)
        polygons(*arguments)

    monkeypatch.setattr(pattern_areas, "pixel_areas", counted)
    areas(kind, galsim.PositionD(0, 0))
    areas(kind, galsim.PositionD(-100, -50))
    assert drawn == [30 * 30]
