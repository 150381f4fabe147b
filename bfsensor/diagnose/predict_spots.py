"""Widths of spots against flux, from boundary shifts: deterministic, as the fit measures them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.special import ndtr

from bfsensor.diagnose.spot_channels import STAMP, WING, stamp_moments
from bfsensor.effects.effect import Law
from bfsensor.measure.spot_fit import fit_spots
from bfsensor.measure.spots import Stamps

STEPS = 16
LINEAR = Law()


class _Light(NamedTuple):
    """One Gaussian of the light of spots, by pixel, and how it lies along the edges."""

    part: float
    sigma: tuple[float, float]
    along: tuple[NDArray[np.float64], NDArray[np.float64]]
    at: tuple[NDArray[np.float64], NDArray[np.float64]]
    below: tuple[NDArray[np.float64], NDArray[np.float64]]

    @classmethod
    def of(
        cls, part: float, sigma: tuple[float, float], edge: NDArray, x: NDArray, y: NDArray
    ) -> _Light:
        along_x = part * np.diff(ndtr((edge - x[:, None]) / sigma[0]), axis=1)[:, None]
        along_y = np.diff(ndtr((edge - y[:, None]) / sigma[1]), axis=1)[:, :, None]
        at_x = (edge[1:] - x[:, None])[:, None] / sigma[0]
        at_y = (edge[1:] - y[:, None])[:, :, None] / sigma[1]
        return cls(part, sigma, (along_x, along_y), (at_x, at_y), (ndtr(at_x), ndtr(at_y)))

    @property
    def whole(self) -> NDArray[np.float64]:
        return self.along[1] * self.along[0]

    def across_x(self, shift: NDArray[np.float64]) -> NDArray[np.float64]:
        """Light between right edges and where their shifts put them."""
        moved = ndtr(self.at[0] + shift / self.sigma[0]) - self.below[0]
        return self.part * self.along[1] * moved

    def across_y(self, shift: NDArray[np.float64]) -> NDArray[np.float64]:
        """Light between upper edges and where their shifts put them."""
        return self.along[0] * (ndtr(self.at[1] + shift / self.sigma[1]) - self.below[1])


def spill(
    charge: NDArray[np.float64], full_well: float, rounds: int = 64
) -> NDArray[np.float64]:
    """Charge beyond the full well goes to both neighbours in the column, shape (n, ny, nx).

    What finds no room within so many pixels, or leaves the image, is lost.
    """
    charge = charge.copy()
    for _ in range(rounds):
        excess = np.maximum(charge - full_well, 0.0)
        if not excess.any():
            return charge
        charge -= excess
        charge[:, 1:] += 0.5 * excess[:, :-1]
        charge[:, :-1] += 0.5 * excess[:, 1:]
    return np.minimum(charge, full_well)


def grow_spots(
    kx: NDArray[np.float64],
    ky: NDArray[np.float64],
    *,
    sigma: tuple[float, float],
    phases: NDArray[np.float64],
    flux: float,
    steps: int = STEPS,
    halo: tuple[float, float] = (0.0, 1.0),
    law: Law = LINEAR,
    slopes: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
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
    halo : tuple of float
        Share of the light in a wide component, and the sigma that it has more [pixel].
    law : Law
        How collection departs from linear shifts; what is beyond the full well is spilled.
    slopes : tuple of ndarray, optional
        Change of the shifts per electron with the charge Q of the pixel that pushes
        [pixel/e-^2]: boundaries move by these times Q^2 / 2 besides.

    Returns
    -------
    images : ndarray, shape (steps, n, 21, 21)
        Electrons at the end of each step [e-].
    """
    size = WING
    edge = np.arange(size + 1) - size / 2
    x, y = np.asarray(phases, float).T
    parts = [_Light.of(1.0 - halo[0], sigma, edge, x, y)]
    if halo[0]:
        wide = float(np.hypot(sigma[0], halo[1])), float(np.hypot(sigma[1], halo[1]))
        parts.append(_Light.of(halo[0], wide, edge, x, y))
    light = np.sum([part.whole for part in parts], axis=0)
    padded = next_fast_len(size + kx.shape[0] - 1)
    spectra = [rfft2(k, s=(padded, padded)) for k in (kx, ky)]
    bent = [] if slopes is None else [rfft2(k, s=(padded, padded)) for k in slopes]
    half = kx.shape[0] // 2
    inside = slice(half, half + size)
    charge = np.zeros_like(light)
    out = np.empty((steps, *light.shape))
    each = flux / steps
    for step in range(steps):
        middle = charge + 0.5 * each * light
        squared = rfft2(0.5 * middle**2, s=(padded, padded)) if bent else None
        if law.bend:
            middle = middle * (1 + 0.5 * law.bend * middle)
        seen = rfft2(middle, s=(padded, padded))
        shift_x, shift_y = (
            irfft2(seen * k, s=(padded, padded))[:, inside, inside] for k in spectra
        )
        if squared is not None:
            for shift, k in zip((shift_x, shift_y), bent, strict=True):
                shift += irfft2(squared * k, s=(padded, padded))[:, inside, inside]
        gained = each * light
        # Light changes across a shift of a tenth of a pixel: its integral, not its value.
        across = each * np.sum([part.across_x(shift_x) for part in parts], axis=0)
        across[..., -1] = 0.0
        gained += across
        gained[..., 1:] -= across[..., :-1]
        across = each * np.sum([part.across_y(shift_y) for part in parts], axis=0)
        across[:, -1] = 0.0
        gained += across
        gained[:, 1:] -= across[:, :-1]
        if law.loss:
            gained = gained * np.exp(-law.loss * (charge + 0.5 * gained))
        charge = charge + gained
        if charge.max() > law.full_well:
            charge = spill(charge, law.full_well)
        out[step] = charge
    return out


def predict_spots(
    kx: NDArray[np.float64],
    ky: NDArray[np.float64],
    *,
    sigma: tuple[float, float],
    phases: NDArray[np.float64],
    fluxes: ArrayLike,
    halo: tuple[float, float] = (0.0, 1.0),
    law: Law = LINEAR,
    slopes: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    change: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
) -> dict[str, NDArray[np.float64]]:
    """What the fit of the channels measures of such spots, at given fluxes.

    Parameters
    ----------
    kx, ky, sigma, phases
        As for :func:`grow_spots`.
    fluxes : array_like, shape (n,)
        Electrons of a spot [e-].
    halo, law, slopes
        As for :func:`grow_spots`.
    change : callable, optional
        What happens to the images [e-] after collection.

    Returns
    -------
    dict of str to ndarray, shape (n,)
        'sigma_x', 'sigma_y' [pixel], 'skew_x', 'skew_y' [pixel^3], 'wings'; 'flux', electrons
        gained or lost.
    """
    wanted = np.asarray(fluxes, float)
    top = float(wanted.max())
    images = grow_spots(
        kx, ky, sigma=sigma, phases=phases, flux=top, halo=halo, law=law, slopes=slopes
    )
    names = ["sigma_x", "sigma_y", "skew_x", "skew_y", "wings", "flux"]
    knots, rows = [], []
    margin = (WING - STAMP) // 2
    for step in range(STEPS // 4 - 1, STEPS, STEPS // 4):
        wide = images[step] if change is None else change(images[step])
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
        rows[-1][-1] -= knots[-1]
    table = np.array(rows)
    # Nearly straight in the flux: the cubic through four points.
    out = {}
    for n, name in enumerate(names):
        line = np.polynomial.Polynomial.fit(np.array(knots), table[:, n], 3)
        out[name] = line(wanted)
    return out
