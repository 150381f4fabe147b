"""Widths of spots against flux, from boundary shifts: deterministic, as the fit measures them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.special import ndtr

from bfsensor.diagnose.spot_channels import STAMP, WING, stamp_moments
from bfsensor.measure.spot_fit import fit_spots
from bfsensor.measure.spots import Stamps

STEPS = 16


def grow_spots(
    kx: NDArray[np.float64],
    ky: NDArray[np.float64],
    *,
    sigma: tuple[float, float],
    phases: NDArray[np.float64],
    flux: float,
    steps: int = STEPS,
) -> NDArray[np.float64]:
    """Mean images of Gaussian spots as they build up.

    The light that each boundary sweeps over by its shift, seen at the middle of each step,
    goes from one of its pixels to the other.  What two shifts share at a corner, second order
    in them, is left out.

    Parameters
    ----------
    kx, ky : ndarray, odd sides
        Shifts of right and upper edges [pixel/e-].
    sigma : tuple of float
        Width in x and y with diffusion [pixel].
    phases : ndarray, shape (n, 2)
        Centres within the middle pixel [pixel].
    flux : float
        Electrons of a whole spot at the end [e-].
    steps : int
        Steps of equal charge; the error falls with their square.

    Returns
    -------
    images : ndarray, shape (steps, n, 21, 21)
        Electrons at the end of each step [e-].
    """
    size = WING
    edge = np.arange(size + 1) - size / 2
    x, y = np.asarray(phases, float).T
    along_x = np.diff(ndtr((edge - x[:, None]) / sigma[0]), axis=1)
    along_y = np.diff(ndtr((edge - y[:, None]) / sigma[1]), axis=1)

    light = along_y[:, :, None] * along_x[:, None]
    at_x = (edge[1:] - x[:, None])[:, None] / sigma[0]
    at_y = (edge[1:] - y[:, None])[:, :, None] / sigma[1]
    below_x, below_y = ndtr(at_x), ndtr(at_y)
    padded = next_fast_len(size + kx.shape[0] - 1)
    spectra = [rfft2(k, s=(padded, padded)) for k in (kx, ky)]
    half = kx.shape[0] // 2
    inside = slice(half, half + size)
    charge = np.zeros_like(light)
    out = np.empty((steps, *light.shape))
    each = flux / steps
    for step in range(steps):
        seen = rfft2(charge + 0.5 * each * light, s=(padded, padded))
        shift_x, shift_y = (
            irfft2(seen * k, s=(padded, padded))[:, inside, inside] for k in spectra
        )
        gained = each * light
        # Light changes across a shift of a tenth of a pixel: its integral, not its value.
        across = each * along_y[:, :, None] * (ndtr(at_x + shift_x / sigma[0]) - below_x)
        across[..., -1] = 0.0
        gained += across
        gained[..., 1:] -= across[..., :-1]
        across = each * along_x[:, None] * (ndtr(at_y + shift_y / sigma[1]) - below_y)
        across[:, -1] = 0.0
        gained += across
        gained[:, 1:] -= across[:, :-1]
        charge = charge + gained
        out[step] = charge
    return out


def predict_spots(
    kx: NDArray[np.float64],
    ky: NDArray[np.float64],
    *,
    sigma: tuple[float, float],
    phases: NDArray[np.float64],
    fluxes: ArrayLike,
) -> dict[str, NDArray[np.float64]]:
    """What the fit of the channels measures of such spots, at given fluxes.

    Parameters
    ----------
    kx, ky, sigma, phases
        As for :func:`grow_spots`.
    fluxes : array_like, shape (n,)
        Electrons of a spot [e-].

    Returns
    -------
    dict of str to ndarray, shape (n,)
        'sigma_x', 'sigma_y' [pixel], 'skew_x', 'skew_y' [pixel^3], 'wings'.
    """
    wanted = np.asarray(fluxes, float)
    top = float(wanted.max())
    images = grow_spots(kx, ky, sigma=sigma, phases=phases, flux=top)
    names = ["sigma_x", "sigma_y", "skew_x", "skew_y", "wings"]
    knots, rows = [], []
    margin = (WING - STAMP) // 2
    for step in range(STEPS // 4 - 1, STEPS, STEPS // 4):
        wide = images[step]
        stamps = wide[:, margin:-margin, margin:-margin]
        fit = fit_spots(
            Stamps(stamps),
            weights="equal",
            largest_offset=2.0,
            limit=1e6,
            correct_bias=False,
        )
        moments = stamp_moments(stamps, wide, fit.centre_x, fit.centre_y)
        rows.append(
            [fit.sigma_x, fit.sigma_y, *(float(moments[n].mean()) for n in names[2:])]
        )
        knots.append(top * (step + 1) / STEPS)
    table = np.array(rows)
    # Nearly straight in the flux: the cubic through four points.
    out = {}
    for n, name in enumerate(names):
        line = np.polynomial.Polynomial.fit(np.array(knots), table[:, n], 3)
        out[name] = line(wanted)
    return out
