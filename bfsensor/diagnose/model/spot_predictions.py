"""Widths of spots against flux, from boundary shifts: deterministic, as the fit measures them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.interpolate import PchipInterpolator
from scipy.special import ndtr

from bfsensor.diagnose.data.spot_channels import STAMP, WING, stamp_moments
from bfsensor.diagnose.data.spot_widths import fit_widths
from bfsensor.effects.effect import Law
from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray

STEPS = 12
"""Of equal light: widths of spots of one pixel and 1e6 e- are 5e-5 pixel off; 1.4e-4 with 8."""

SPILLING = 24
"""Steps where charge spills: what is measured turns sharply with the flux."""

KNOTS = 4
"""Fluxes at which spots are measured where nothing spills: nearly straight between them."""

CHANGES = 7
"""Fluxes, equal steps in their logarithm, at which changes after collection are found."""

MEASURED = ("sigma_x", "sigma_y", "skew_x", "skew_y", "wings", "flux")

LITTLE = 1e-5
"""Excess charge that is no longer shared out [full wells]."""

FEW = 4
"""Places of spots that are crossed with one another where charge spills."""

LINEAR = Law()
NO_HALO = (0.0, 1.0)
ALONE = (np.inf, 0.0)


class _Light(NamedTuple):
    """One Gaussian of the light of spots: in each pixel along an axis, and at its far edge.

    ``edges``: the light at the edge and its first three derivatives, each over the factorial
    of its order plus one: what a shift of the edge sweeps over is their power series.
    """

    along_x: FloatArray
    along_y: FloatArray
    edges_x: FloatArray
    edges_y: FloatArray

    @classmethod
    def of(
        cls,
        part: float,
        sigma: tuple[float, float],
        phases: FloatArray,
        neighbours: tuple[float, float] = ALONE,
    ) -> _Light:
        along_x, edges_x = _lines(phases[:, 0], sigma[0], neighbours)
        along_y, edges_y = _lines(phases[:, 1], sigma[1], neighbours)
        return cls(
            part * along_x[:, None], along_y[:, :, None],
            part * edges_x[:, :, None], edges_y[:, :, :, None],
        )  # fmt: skip

    @property
    def whole(self) -> FloatArray:
        return self.along_y * self.along_x

    def across_x(self, shift: FloatArray) -> FloatArray:
        """Light between right edges and where their shifts put them."""
        return self.along_y * _swept(self.edges_x, shift)

    def across_y(self, shift: FloatArray) -> FloatArray:
        """Light between upper edges and where their shifts put them."""
        return self.along_x * _swept(self.edges_y, shift)


def _lines(
    centre: FloatArray, sigma: float, neighbours: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Pixels of a Gaussian along one axis, shape (n, 21), and series at their far edges."""
    pitch, share = neighbours
    along: FloatArray | float = 0.0
    series: FloatArray | float = 0.0
    for n in (-1, 0, 1) if share else (0,):
        part = share if n else 1.0
        there = centre[:, None] + (n * pitch if n else 0.0)
        t = (np.arange(WING + 1) - WING / 2 - there) / sigma
        along = along + part * np.diff(ndtr(t), axis=1)
        t = t[:, 1:]
        density = part * np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi)
        series = series + np.array([
            density / sigma, -t * density / (2 * sigma**2),
            (t * t - 1) * density / (6 * sigma**3), (3 - t * t) * t * density / (24 * sigma**4),
        ])  # fmt: skip
    return np.asarray(along), np.asarray(series)


def _swept(series: FloatArray, s: FloatArray) -> FloatArray:
    return np.asarray(s * (series[0] + s * (series[1] + s * (series[2] + s * series[3]))))


def spill(charge: FloatArray, full_well: float, rounds: int = 64) -> FloatArray:
    """Charge beyond the full well goes to both neighbours in the column, shape (n, ny, nx).

    What finds no room within so many pixels, or leaves the image, is lost.
    """
    charge = charge.copy()
    for _ in range(rounds):
        excess = np.maximum(charge - full_well, 0.0)
        if excess.max() < LITTLE * full_well:
            break
        charge -= excess
        charge[:, 1:] += 0.5 * excess[:, :-1]
        charge[:, :-1] += 0.5 * excess[:, 1:]
    return np.minimum(charge, full_well)


def grow_spots(
    kx: FloatArray,
    ky: FloatArray,
    *,
    sigma: tuple[float, float],
    phases: FloatArray,
    flux: float,
    steps: int = STEPS,
    halo: tuple[float, float] = NO_HALO,
    neighbours: tuple[float, float] = ALONE,
    law: Law = LINEAR,
    slopes: tuple[FloatArray, FloatArray] | None = None,
) -> FloatArray:
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
        Steps of equal charge; the error falls with the third power of their number.
    halo : tuple of float
        Share of the light in a wide component, and the sigma that it has more [pixel].
    neighbours : tuple of float
        Distance of the next spots in x and y [pixel], and how many of the places there hold
        one: of their light the halo alone reaches so far.
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
    centres = np.asarray(phases, float)
    parts = [_Light.of(1.0 - halo[0], sigma, centres)]
    if halo[0]:
        wide = float(np.hypot(sigma[0], halo[1])), float(np.hypot(sigma[1], halo[1]))
        parts.append(_Light.of(halo[0], wide, centres, neighbours))
    each = flux / steps
    light = each * np.sum([part.whole for part in parts], axis=0)
    # Farther than across the image no shift is asked for; a cyclic array need not be wider.
    half = min(kx.shape[0] // 2, WING - 1)
    kept = slice(kx.shape[0] // 2 - half, kx.shape[0] // 2 + half + 1)
    side = next_fast_len(WING + half, real=True)
    both = np.zeros((2, 1, side, side))
    both[:, 0, : 2 * half + 1, : 2 * half + 1] = kx[kept, kept], ky[kept, kept]
    spectra = rfft2(np.roll(both, (-half, -half), (-2, -1)))
    bent = None
    if slopes is not None:
        more = np.zeros_like(both)
        more[:, 0, : 2 * half + 1, : 2 * half + 1] = (
            slopes[0][kept, kept],
            slopes[1][kept, kept],
        )
        bent = rfft2(np.roll(more, (-half, -half), (-2, -1)))
    charge = np.zeros_like(light)
    out = np.empty((steps, *light.shape))
    # Gains of the last step and of the one before: they go nearly straight with time.
    last, before = light, light
    for step in range(steps):
        # In the first step the gain itself has grown by half of what it grows in later ones.
        coming = last + (last - before) * (2.0 if step == 1 else 1.0)
        middle = charge + 0.5 * coming - 0.125 * (coming - last)
        kept_part = np.exp(-law.loss * middle) if law.loss else None
        squared = None if bent is None else rfft2(0.5 * middle**2, s=(side, side))
        if law.bend:
            middle = middle * (1 + 0.5 * law.bend * middle)
        seen = rfft2(middle, s=(side, side))
        moved = seen * spectra if squared is None else seen * spectra + squared * bent
        shift_x, shift_y = irfft2(moved, s=(side, side))[..., :WING, :WING]
        gained = light.copy()
        across = each * np.sum([part.across_x(shift_x) for part in parts], axis=0)
        across[..., -1] = 0.0
        gained += across
        gained[..., 1:] -= across[..., :-1]
        across = each * np.sum([part.across_y(shift_y) for part in parts], axis=0)
        across[:, -1] = 0.0
        gained += across
        gained[:, 1:] -= across[:, :-1]
        if kept_part is not None:
            gained = gained * kept_part
        charge = charge + gained
        last, before = gained, last
        if charge.max() > law.full_well:
            charge = spill(charge, law.full_well)
        out[step] = charge
    return out


def representative_phases(phases: FloatArray) -> FloatArray:
    """Four centres whose mean of what changes smoothly over a pixel is nearly that of all.

    In x and in y the means of the four quarters of the sorted places, of evenly spread ones
    exact up to three waves a pixel; put together so that x and y do not correlate.

    Parameters
    ----------
    phases : ndarray, shape (n, 2)
        Centres within their pixels [pixel].
    """
    quarters = [
        [part.mean() if part.size else np.nan for part in np.array_split(np.sort(v), 4)]
        for v in np.asarray(phases, float).T
    ]
    out = np.array([quarters[0], [quarters[1][n] for n in (1, 3, 0, 2)]]).T
    return np.where(np.isfinite(out), out, np.mean(phases, axis=0))


@np.errstate(over="ignore", invalid="ignore")
def predict_spots(
    kx: FloatArray,
    ky: FloatArray,
    *,
    sigma: tuple[float, float],
    phases: FloatArray,
    fluxes: ArrayLike,
    halo: tuple[float, float] = NO_HALO,
    neighbours: tuple[float, float] = ALONE,
    law: Law = LINEAR,
    slopes: tuple[FloatArray, FloatArray] | None = None,
    change: Callable[[FloatArray], FloatArray] | None = None,
) -> dict[str, FloatArray]:
    """What the fit of the channels measures of such spots, at given fluxes.

    Parameters
    ----------
    kx, ky, sigma, phases
        As for :func:`grow_spots`.
    fluxes : array_like, shape (n,)
        Electrons of a spot as they are read, with what is lost or lies beside, after ``change``
        [e-].
    halo, neighbours, law, slopes
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
    if not (np.isfinite(wanted).all() and wanted.min() > 0):
        raise ConvergenceError(f"spots of {wanted.min():.3g} to {top:.3g} e- have no shape")
    centres = np.asarray(phases, float)
    grow = partial(
        grow_spots, kx, ky, sigma=sigma, flux=top, halo=halo, neighbours=neighbours, law=law,
        slopes=slopes,
    )  # fmt: skip
    every = STEPS // KNOTS
    images = grow(phases=centres)
    spilling = bool(images[-1].max() >= law.full_well)
    if spilling:
        # Where the first pixels spill depends on places: all in x with all in y.
        if len(centres) <= FEW:
            centres = np.array(np.meshgrid(*centres.T)).reshape(2, -1).T
        every = 1
        images = grow(phases=centres, steps=SPILLING)
    measure = partial(_measure, sigma=sigma, centres=centres)
    light = top * np.arange(every, len(images) + 1, every) / len(images)
    if not np.isfinite(images).all():
        raise ConvergenceError(
            f"spots of {top:.3g} e- have no shape: shifts reach over pixels"
        )
    plain = measure(images[every - 1 :: every])
    lines = _interpolate(plain[:, -1], np.column_stack([plain[:, :-1], plain[:, -1] - light]),
                         turning=spilling)  # fmt: skip
    if change is None or np.array_equal(change(images[-1]), images[-1]):
        return dict(zip(MEASURED, lines(wanted).T, strict=True))
    # What comes after collection need not be smooth: between fluxes as they are.
    knots = np.geomspace(min(wanted.min(), 0.999 * top), top, CHANGES)
    those = np.array([_image_at(images, flux / top) for flux in knots])
    both = measure(np.concatenate([those, change(those)]))
    changes = PchipInterpolator(np.log(knots), both[CHANGES:] - both[:CHANGES])
    before = wanted
    for _ in range(2):
        before = wanted - changes(np.log(before))[:, -1]
    return dict(zip(MEASURED, (lines(before) + changes(np.log(before))).T, strict=True))


def _interpolate(
    knots: FloatArray, values: FloatArray, *, turning: bool
) -> Callable[[FloatArray], FloatArray]:
    """Lines through values at knots of the flux: cubics, or pieces where they turn sharply."""
    if turning:
        pieces = PchipInterpolator(knots, values)
        return lambda flux: np.asarray(pieces(np.maximum(flux, knots[0])))
    scale = knots[-1]
    line = np.linalg.solve(np.vander(knots / scale, increasing=True), values)
    return lambda flux: np.vander(flux / scale, len(knots), increasing=True) @ line


def _image_at(images: FloatArray, part: float) -> FloatArray:
    """Images at a part of their last flux, their shapes being straight in it between steps."""
    at = part * len(images)
    low = int(np.clip(np.floor(at), 1, len(images) - 1))
    one, two = images[low - 1] / low, images[low] / (low + 1)
    return np.asarray(at * (one + (at - low) * (two - one)))


def _measure(
    wide: FloatArray, sigma: tuple[float, float], centres: FloatArray
) -> FloatArray:
    """What the channels measure of k images, shape (k, 6), in the order of :data:`MEASURED`."""
    count, n = wide.shape[:2]
    margin = (WING - STAMP) // 2
    stamps = wide[..., margin:-margin, margin:-margin]
    fit = fit_widths(stamps, sigma, centres)
    moments = stamp_moments(
        stamps.reshape(count * n, STAMP, STAMP), wide.reshape(count * n, WING, WING),
        fit.centre_x.ravel(), fit.centre_y.ravel(),
    )  # fmt: skip
    means = [moments[name].reshape(count, n).mean(1) for name in MEASURED[2:]]
    return np.array([fit.sigma_x, fit.sigma_y, *means]).T
