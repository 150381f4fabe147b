"""Slopes in closed form against spots grown step by step, and against the direct simulation."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.diagnose.data.spot_channels import WING
from bfsensor.diagnose.data.spot_widths import fit_widths
from bfsensor.diagnose.model.cached_response import walk
from bfsensor.diagnose.model.spot_predictions import grow_spots
from bfsensor.errors import FitError
from bfsensor.fit.spot_response import STAMP, UNIT_PEAK, slope_weights
from tests.fit.toys import toy_emulator

SIGMA = 1.02


def test_weights_are_what_grown_spots_do():
    """Grown in steps and fitted by iteration, with a background free: no code is shared."""
    kx, ky = toy_emulator().edges
    places = (np.arange(8) + 0.5) / 8 - 0.5
    phases = np.array([(x, y) for y in places for x in places])
    flux = 2000.0
    margin = (WING - STAMP) // 2
    images = [
        grow_spots(f * kx, f * ky, sigma=(SIGMA, SIGMA), phases=phases, flux=flux)[-1]
        for f in (1.0, 0.0)
    ]
    wide, plain = (
        fit_widths(one[None, :, margin:-margin, margin:-margin], (SIGMA, SIGMA), phases)
        for one in images
    )
    central = images[1][:, WING // 2, WING // 2].mean()
    grown = [
        100 * UNIT_PEAK / central * float(getattr(wide, name)[0] - getattr(plain, name)[0])
        for name in ("sigma_x", "sigma_y")
    ]
    told = slope_weights(SIGMA, background=True).slopes(kx, ky)
    # Second order: shifts of 2000 e- are 1e-4 of a pixel.
    np.testing.assert_allclose(told, grown, rtol=2e-4)
    assert grown[1] > 1.2 * grown[0] > 0.1


def test_slopes_go_with_the_shifts_of_one_axis():
    kx, ky = toy_emulator().edges
    weights = slope_weights(SIGMA)
    x, y = weights.slopes(kx, 0 * ky)
    both = weights.slopes(np.stack([kx, 2 * kx]), np.stack([ky, 2 * ky]))
    np.testing.assert_allclose(both[1], 2 * both[0])
    turned = weights.slopes(ky.T, kx.T)
    np.testing.assert_allclose(turned, both[0][::-1])
    assert abs(x) > 5 * abs(y)


def test_direct_simulation_of_spots():
    """Six spots of 40 steps at -60 V, +4/-8 V: 0.654 and 0.749, each +- 0.010
    (validation/results/spot_slopes.ecsv); the response at one level is good to 5 %."""
    device = Device.load("itl_sta3800c").with_operating_point(
        back_bias="-60 V", gate_high="4 V"
    )
    found = slope_weights(SIGMA).slopes(*walk(device, cells=8).edges(None, 173.0))
    np.testing.assert_allclose(found, [0.654, 0.749], rtol=0.05)


def test_widths_out_of_range_are_refused():
    with pytest.raises(FitError, match=r"sigma = 5 .*0\.3 to 3"):
        slope_weights(5.0)
