"""Growth of Gaussian spots under boundary shifts, and their widths as the channel measures them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.special import ndtr

from bfsensor.diagnose.data.spot_channels import STAMP, WING, stamp_moments
from bfsensor.diagnose.data.spot_widths import fit_widths
from bfsensor.effects.effect import Halo, Law
from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray

STEPS = 12
"""Number of steps of equal light in which a spot grows.  Measured (compared with 96 steps in
tests/validation/effects/test_collection_spots.py): widths of spots of 1 pixel and 1e6 e- are off by 5e-5
pixel; with 8 steps, by 1.4e-4."""

SPILLING = 24
"""Number of steps where pixels exceed the full well. Chosen: each step is a knot of the interpolation
in flux, which has a sharp turn at the full well; twice as many take twice as long."""

KNOTS = 4
"""Number of fluxes at which spots are measured below the full well. Chosen: widths are nearly linear
in the flux, so that a cubic through four points is enough; twice as many take twice as long."""

CHANGES = 7
"""Number of fluxes, equidistant in the logarithm, at which changes after collection are calculated.
Chosen: twice as many follow sharper nonlinearity of the amplifier and take twice as long."""

MEASURED = ("sigma_x", "sigma_y", "skew_x", "skew_y", "wings", "flux")
"""Quantities of the channel of spots, in the order of :func:`_measure`."""

LITTLE = 1e-5
"""Largest excess charge that spilling leaves in a pixel [full wells]. Chosen: 1 e- of 1e5, far below
the noise; twice as large ends one or two rounds earlier."""

FEW = 5
"""Number of places along x and along y that are combined with one another where charge spills.
Measured: with 25 combinations, splines between them give widths of spots whose brightest pixels are full
of another bench's campaign to 0.006 pixel at worst, 0.002 usually; 10 take four times as long."""

LINEAR = Law()
"""Collection with shifts proportional to the stored charge, without loss or full well."""

ALONE = (np.inf, 0.0)
"""Distance of the next spots [pixel], and the fraction of places with one.  Defined: none."""


class _Light(NamedTuple):
    """One Gaussian component of the light of spots, as factors along x and along y.

    ``along_x``, ``along_y``: fraction of the light in each pixel.  ``edges_x``, ``edges_y``: density
    at the far edge of each pixel and its first three derivatives, divided by the factorial of
    their order plus one, so that the light that a shift s sweeps over is their power series in s.
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
        """Light that shifts of the right edges sweep over."""
        return self.along_y * _swept(self.edges_x, shift)

    def across_y(self, shift: FloatArray) -> FloatArray:
        """Light that shifts of the upper edges sweep over."""
        return self.along_x * _swept(self.edges_y, shift)

    @property
    def spread_x(self) -> FloatArray:
        """Light that a pixel gains across its right edge by a variance of 1 pixel^2."""
        # Half of the gradient of the light, which is the series' second term.
        return np.asarray(self.along_y * self.edges_x[1])

    @property
    def spread_y(self) -> FloatArray:
        """Light that a pixel gains across its upper edge by a variance of 1 pixel^2."""
        return np.asarray(self.along_x * self.edges_y[1])


def _lines(
    centre: FloatArray, sigma: float, neighbours: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Fractions of a Gaussian in pixels along one axis, shape (n, 21), and series at their far edges."""
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


FILLED = (0.1127, 0.5, 0.8873)
"""Parts of a step's charge at which a loss is evaluated and averaged.

Derived: nodes of Gauss and Legendre's rule of three points, here with equal weights, which are exact
for a straight line and good to 1 % for the root of the charge in the first step."""


def spill(
    charge: FloatArray, full_well: float, rounds: int = 64, *, drain: float = 0.0
) -> FloatArray:
    """Move charge beyond the full well to both neighbours in the column, shape (n, ny, nx) [e-].

    Charge that finds no room within ``rounds`` pixels, or leaves the image, is lost, and the part
    ``drain`` of it wherever it spills.
    """
    charge = charge.copy()
    for _ in range(rounds):
        excess = np.maximum(charge - full_well, 0.0)
        if excess.max() < LITTLE * full_well:
            break
        charge -= excess
        half = 0.5 * (1 - drain) * excess
        charge[:, 1:] += half[:, :-1]
        charge[:, :-1] += half[:, 1:]
    return np.minimum(charge, full_well)


def grow_spots(
    kx: FloatArray,
    ky: FloatArray,
    *,
    sigma: tuple[float, float],
    phases: FloatArray,
    flux: float,
    steps: int = STEPS,
    halo: Halo = (),
    neighbours: tuple[float, float] = ALONE,
    law: Law = LINEAR,
    slopes: tuple[FloatArray, FloatArray] | None = None,
    growth: float = 0.0,
) -> FloatArray:
    """Calculate mean images of Gaussian spots as they build up.

    In each step the light that a boundary's shift sweeps over, with the shift of the middle of
    the step, moves from one of its pixels to the other.  Products of two shifts at a corner, of
    second order, are left out.

    Parameters
    ----------
    kx, ky : ndarray, odd sides
        Shifts of right and upper edges [pixel/e-].
    sigma : tuple of float
        Width in x and y with diffusion [pixel].
    phases : ndarray, shape (n, 2)
        Centres within the middle pixel [pixel].
    flux : float
        Charge of a whole spot at the end [e-].
    steps : int
        Steps of equal charge; the error falls with the third power of their number.
    halo : tuple of (float, float)
        Wide components: fraction of the light in each, and the sigma that is added to its width in
        quadrature [pixel].
    neighbours : tuple of float
        Distance of the next spots in x and y [pixel], and the fraction of those places that hold
        one; only their halos reach this spot.
    law : Law
        Departure of the collection from shifts proportional to charge; charge beyond its full
        well spills.
    slopes : tuple of ndarray, optional
        Change of the shifts per electron with the charge Q of the pixel that causes them
        [pixel/e-^2]: boundaries move by these times Q^2 / 2 in addition.
    growth : float
        Growth of the variance of diffusion with the charge of a pixel [pixel^2/e-]: across an edge
        light diffuses by the mean of its two pixels.

    Returns
    -------
    images : ndarray, shape (steps, n, 21, 21)
        Charge at the end of each step [e-].
    """
    centres = np.asarray(phases, float)
    parts = [_Light.of(1.0 - sum(share for share, _ in halo), sigma, centres)]
    for share, added in halo:
        wide = float(np.hypot(sigma[0], added)), float(np.hypot(sigma[1], added))
        parts.append(_Light.of(share, wide, centres, neighbours))
    each = flux / steps
    light = each * np.sum([part.whole for part in parts], axis=0)
    # Shifts farther than the image is wide are not needed, so that the periodic array may be small.
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
    # Charge gained in the last two steps, by which the next is extrapolated linearly.
    last, before = light, light
    for step in range(steps):
        # The mean gain of the first step holds half of the growth of later ones: double it once.
        coming = last + (last - before) * (2.0 if step == 1 else 1.0)
        middle = charge + 0.5 * coming - 0.125 * (coming - last)
        kept_part = np.exp(-law.lost(middle)) if law.loses else None
        if law.losses:
            # A loss that rises steeply from empty pixels is averaged over the step.
            filled = [charge + f * coming for f in FILLED]
            kept_part = np.mean([np.exp(-law.lost(q)) for q in filled], axis=0)
        squared = None if bent is None else rfft2(0.5 * middle**2, s=(side, side))
        wider = 0.5 * each * growth * middle
        if law.bend:
            middle = middle * (1 + 0.5 * law.bend * middle)
        seen = rfft2(middle, s=(side, side))
        moved = seen * spectra if squared is None else seen * spectra + squared * bent
        shift_x, shift_y = irfft2(moved, s=(side, side))[..., :WING, :WING]
        gained = light.copy()
        across = each * np.sum([part.across_x(shift_x) for part in parts], axis=0)
        if growth:
            both_x = wider + np.roll(wider, -1, axis=-1)
            across += both_x * np.sum([part.spread_x for part in parts], axis=0)
        across[..., -1] = 0.0
        gained += across
        gained[..., 1:] -= across[..., :-1]
        across = each * np.sum([part.across_y(shift_y) for part in parts], axis=0)
        if growth:
            both_y = wider + np.roll(wider, -1, axis=-2)
            across += both_y * np.sum([part.spread_y for part in parts], axis=0)
        across[:, -1] = 0.0
        gained += across
        gained[:, 1:] -= across[:, :-1]
        if kept_part is not None:
            gained = gained * kept_part
        charge = charge + gained
        last, before = gained, last
        if charge.max() > law.full_well:
            charge = spill(charge, law.full_well, drain=law.drain)
        out[step] = charge
    return out


def representative_phases(phases: FloatArray) -> FloatArray:
    """Choose four centres whose mean of any smooth function of the centre is nearly that of all.

    They are the means of the four quarters of the sorted places, in x and in y, combined so that x
    and y are uncorrelated.  For evenly spread places this is exact up to three waves per pixel.

    Parameters
    ----------
    phases : ndarray, shape (n, 2)
        Centres within their pixels [pixel].

    Returns
    -------
    ndarray, shape (4, 2)
        Centres [pixel].
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
    halo: Halo = (),
    neighbours: tuple[float, float] = ALONE,
    law: Law = LINEAR,
    slopes: tuple[FloatArray, FloatArray] | None = None,
    growth: float = 0.0,
    change: Callable[[FloatArray], FloatArray] | None = None,
    places: Sequence[FloatArray] | None = None,
) -> dict[str, FloatArray]:
    """Predict the quantities that the channel of spots measures, at given fluxes.

    Parameters
    ----------
    kx, ky, sigma, phases
        As for :func:`grow_spots`.
    fluxes : array_like, shape (n,)
        Fluxes of the spots as they are read, after ``change``, including charge that is lost or
        lies outside the stamp [e-].
    halo, neighbours, law, slopes, growth
        As for :func:`grow_spots`.
    change : callable, optional
        Function of the images [e-] that applies effects after collection.
    places : sequence of ndarray, shape (m, 2), optional
        Centres of the spots of each flux within their pixels [pixel]: what full pixels spill depends
        on them.  By default spots of all fluxes have the centres ``phases``.

    Returns
    -------
    dict of str to ndarray, shape (n,)
        'sigma_x', 'sigma_y' [pixel], 'skew_x', 'skew_y' [pixel^3], 'wings' (fraction of the flux);
        'flux', charge gained or lost [e-].

    Raises
    ------
    ConvergenceError
        A flux is not above 0, or shifts are so large that images are not finite.
    """
    wanted = np.asarray(fluxes, float)
    top = float(wanted.max())
    if not (np.isfinite(wanted).all() and wanted.min() > 0):
        raise ConvergenceError(
            f"spots of {wanted.min():.3g} to {top:.3g} e- cannot be predicted: fluxes must be above 0"
        )
    centres = np.asarray(phases, float)
    grow = partial(
        grow_spots, kx, ky, sigma=sigma, flux=top, halo=halo, neighbours=neighbours, law=law,
        slopes=slopes, growth=growth,
    )  # fmt: skip
    # A loss that follows a root of the charge is no polynomial in the flux.
    bending = bool(law.losses)
    every = 1 if bending else STEPS // KNOTS
    images = grow(phases=centres, steps=SPILLING if bending else STEPS)
    spilling = bool(images[-1].max() >= law.full_well)
    if spilling:
        # The flux at which pixels spill depends on the place: combine all x with all y.
        if places is not None:
            every_spot = np.concatenate(list(places))
            nodes = np.linspace(every_spot.min(0), every_spot.max(0), FEW)
            centres = np.array(np.meshgrid(*nodes.T)).reshape(2, -1).T
        elif len(centres) <= FEW:
            centres = np.array(np.meshgrid(*centres.T)).reshape(2, -1).T
        every = 1
        images = grow(phases=centres, steps=SPILLING)
    measure = partial(_measure, sigma=sigma, centres=centres)
    light = top * np.arange(every, len(images) + 1, every) / len(images)
    if not np.isfinite(images).all():
        raise ConvergenceError(
            f"spots of {top:.3g} e- cannot be predicted: boundary shifts exceed a pixel"
        )
    shown = images[every - 1 :: every]
    if spilling and places is not None:
        each = _measure_each(shown, sigma, centres)
        mean = _curves(each.mean(1), light, turning=True)
        own = _at_places(each, light, wanted - mean(wanted)[:, -1], _weights(nodes, places))

        def at_places(flux: FloatArray) -> FloatArray:
            # Spots at their own places, which hardly differ in the flux before other changes.
            return np.asarray(own + mean(flux) - mean(wanted))

        lines: Callable[[FloatArray], FloatArray] = at_places
    else:
        lines = _curves(measure(shown), light, turning=spilling or bending)
    if change is None or np.array_equal(change(images[-1]), images[-1]):
        return dict(zip(MEASURED, lines(wanted).T, strict=True))
    # Changes after collection need not be smooth in the flux: interpolate them piecewise.
    knots = np.geomspace(min(wanted.min(), 0.999 * top), top, CHANGES)
    those = np.array([_image_at(images, flux / top) for flux in knots])
    both = measure(np.concatenate([those, change(those)]))
    changes = PchipInterpolator(np.log(knots), both[CHANGES:] - both[:CHANGES])
    before = wanted
    for _ in range(2):
        before = wanted - changes(np.log(before))[:, -1]
    return dict(zip(MEASURED, (lines(before) + changes(np.log(before))).T, strict=True))


def _curves(
    plain: FloatArray, light: FloatArray, *, turning: bool
) -> Callable[[FloatArray], FloatArray]:
    """Quantities :data:`MEASURED` by flux as it is measured, from those of steps of the light."""
    values = np.column_stack([plain[:, :-1], plain[:, -1] - light])
    return _interpolate(plain[:, -1], values, turning=turning)


def _measure_each(
    images: FloatArray, sigma: tuple[float, float], centres: FloatArray
) -> FloatArray:
    """Quantities :data:`MEASURED` of spots by step and centre, shape (steps, centres, 6)."""
    steps, n = images.shape[:2]
    alone = images.reshape(steps * n, 1, *images.shape[2:])
    found = _measure(alone, sigma, np.tile(centres, (steps, 1))[:, None])
    return found.reshape(steps, n, -1)


def _at_places(
    each: FloatArray, light: FloatArray, wanted: FloatArray, weights: FloatArray
) -> FloatArray:
    """Quantities of spots of some light, from those by step of the light and centre."""
    values = each.copy()
    values[..., -1] -= light[:, None]
    pieces = PchipInterpolator(light, values.reshape(len(light), -1))
    here = pieces(np.maximum(wanted, light[0])).reshape(len(wanted), *each.shape[1:])
    return np.asarray(np.einsum("nc,ncq->nq", weights, here))


def _weights(nodes: FloatArray, places: Sequence[FloatArray]) -> FloatArray:
    """Weights of all combinations of nodes for spots at given places, shape (fluxes, nodes^2).

    Splines through the nodes, shape (nodes, 2), in x and in y; mean over the spots of each flux.
    """
    hats = []
    for axis in (0, 1):
        at = nodes[:, axis]
        # All spots at one place: the first node is as good as any.
        spread = at[-1] > at[0]
        hats.append(CubicSpline(at, np.eye(len(at))) if spread else None)
    out = []
    for spots in places:
        x, y = (
            np.eye(len(nodes))[np.zeros(len(spots), int)]
            if hat is None
            else hat(spots[:, n])
            for n, hat in enumerate(hats)
        )
        out.append(np.einsum("sx,sy->yx", x, y).ravel() / len(spots))
    return np.array(out)


def _interpolate(
    knots: FloatArray, values: FloatArray, *, turning: bool
) -> Callable[[FloatArray], FloatArray]:
    """Interpolation in the flux: one cubic, or monotonic pieces where values turn sharply."""
    if turning:
        pieces = PchipInterpolator(knots, values)
        return lambda flux: np.asarray(pieces(np.maximum(flux, knots[0])))
    scale = knots[-1]
    line = np.linalg.solve(np.vander(knots / scale, increasing=True), values)
    return lambda flux: np.vander(flux / scale, len(knots), increasing=True) @ line


def _image_at(images: FloatArray, part: float) -> FloatArray:
    """Images at a fraction of the last flux, their shapes interpolated linearly between steps."""
    at = part * len(images)
    low = int(np.clip(np.floor(at), 1, len(images) - 1))
    one, two = images[low - 1] / low, images[low] / (low + 1)
    return np.asarray(at * (one + (at - low) * (two - one)))


def _measure(
    wide: FloatArray, sigma: tuple[float, float], centres: FloatArray
) -> FloatArray:
    """Quantities :data:`MEASURED` of k sets of images, shape (k, 6)."""
    count, n = wide.shape[:2]
    margin = (WING - STAMP) // 2
    stamps = wide[..., margin:-margin, margin:-margin]
    fit = fit_widths(stamps, sigma, centres)
    moments = stamp_moments(
        wide.reshape(count * n, WING, WING),
        fit.centre_x.ravel(), fit.centre_y.ravel(),
    )  # fmt: skip
    means = [moments[name].reshape(count, n).mean(1) for name in MEASURED[2:]]
    return np.array([fit.sigma_x, fit.sigma_y, *means]).T
