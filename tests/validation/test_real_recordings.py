"""What is said of real recordings, on drawn ones whose truth is known."""

import numpy as np
import pytest

from bfsensor.device.device import Device
from validation.real import real_rings, real_spots

N = 940
"""Radii of a drawn profile, as many as of the measured ones."""


def drawn_rings(amplitudes, *, seed, noise):
    rng = np.random.default_rng(seed)
    r = real_rings.STEP * np.arange(N)
    # A chirp through the band, fainter inside, as rings are.
    rings = np.cos(2 * np.pi * (r / 70.0 + (r / 900.0) ** 2)) * (0.1 + r / r[-1])
    light = np.linspace(-1, 1, N) ** 2
    return np.array([
        a * rings + light * rng.normal() + noise * rng.standard_normal(N) for a in amplitudes
    ])  # fmt: skip


@pytest.mark.parametrize("factor", [0.6, 1.3])
def test_conversion_depth_is_found_from_drawn_rings(factor):
    device = Device.load("itl_sta3800c")
    height, field = real_rings.drift_field(device)
    flat = real_rings.measure_amplitudes(
        drawn_rings(np.ones(8), seed=3301, noise=0.02), real_rings.REFERENCE
    )
    truth = real_rings.relative_shifts(field, height, flat.wave_number, factor, 173.0)
    found = real_rings.measure_amplitudes(
        drawn_rings(truth, seed=3302, noise=0.02), real_rings.REFERENCE
    )
    # Six are needed of eight: errors of 16 parts are good to a fifth themselves.
    assert (np.abs(found.values - truth) < 3 * found.errors + 1e-9).sum() >= 6
    fit = real_rings.fit_depths(found, device)["card"]
    assert abs(fit.factor - factor) < 4 * fit.error
    assert fit.chi2["achromatic"] > 100 > fit.chi2["fitted"]
    # Achromatic rings ask for no depth.
    assert np.all(np.abs(flat.values - 1) < 5 * flat.errors + 1e-9)


def test_volts_of_even_silicon_follow_the_closed_form():
    """Without doping the shift is V0 / (V + V0), so that V0 = 70 r / (1 - r)."""
    volts, error = real_rings.volts_of_gates(0.2, 0.01, 0.0, 0.013)
    assert volts == pytest.approx(17.5, rel=1e-6)
    assert error == pytest.approx(70 * 0.21 / 0.79 - 17.5, rel=1e-6)


def spots(slopes, *, seed):
    rng = np.random.default_rng(seed)
    fluxes = np.tile(np.linspace(0.28, 1.4, 5), (4, 1))
    widths = 1 + np.array(slopes)[:, None] * fluxes[..., None]
    return tuple("ABCD"), fluxes, widths + 3e-4 * rng.standard_normal((4, 5, 2))


def test_gain_singles_no_segment_out_and_a_shape_does():
    gains = [[0.012 * g, 0.0135 * g] for g in (1.0, 1.05, 0.95, 0.65)]
    growth = real_spots.fit_growth(*spots(gains, seed=3311), shared=False)
    told = real_spots.single_out(growth, shared=False, draws=200)
    assert told.p_single > 0.02 and told.chi2_same > 20 * told.chi2_gain
    gains[3] = [0.0075, 0.0135]
    growth = real_spots.fit_growth(*spots(gains, seed=3312), shared=False)
    told = real_spots.single_out(growth, shared=False, draws=200)
    assert told.p_single < 0.02 and np.argmax(told.decrease) == 3
