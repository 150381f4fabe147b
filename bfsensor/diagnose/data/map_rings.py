"""Detection of tree rings of any profile in radius, in maps of flats: starting points of their fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.optimize import least_squares, minimize

from bfsensor.typing import FloatArray

HIGHEST = 0.2
"""Highest frequency of rings that is searched [1/pixel].  Chosen: periods from 5 pixels on; with
0.4, from 2.5 pixels on, in twice the time."""

ORDERS = 7
"""Order of the polynomial in radius that the phase is fitted by.  Chosen: its derivative has up
to six zeros, about three sways of the spacing; with 14, it also follows noise at the profile's
ends."""

CLEARER = 30.0
"""Decrease of the chi-square by unevenly spaced rings, beyond that by an even change of the
spacing, above which they are returned.  Chosen, to be derived: two more parameters gain 30 by
noise with probability 3e-7; with 60, weaker sways begin as even rings."""


WAFER = 3e4
"""Largest distance of the centre of tree rings from the sensor's corner along x and y [pixel].
Derived: rings grow about the axis of the ingot; a wafer of 300 mm, the largest that is made, holds
30,000 pixels of 10 um.  Straight waves, as of masks, fit rings about a centre at any distance; with
60,000, more of these are taken for rings."""


class RingLaw(NamedTuple):
    """Law of the phase against the radius: names of its parameters and steps of derivatives.

    A step of 0 stands for 1e-3 of the parameter.
    """

    names: tuple[str, ...]
    steps: tuple[float, ...]


EVEN = RingLaw(("period", "chirp"), (0.0, 1e-3))
"""Rings whose frequency changes linearly with radius.  Steps are chosen small against the
parameters; twice as large, derivatives are off by twice as much, and fits take a round more."""

UNEVEN = RingLaw(("period", "sway", "length", "sway_phase"), (0.0, 1e-3, 0.3, 1e-3))
"""Rings whose spacing varies sinusoidally with radius, over a length [pixel].  Steps are chosen
like those of :data:`EVEN`."""


def turns_of(
    law: RingLaw, r: FloatArray, r0: float, p: FloatArray
) -> tuple[FloatArray, FloatArray]:
    r"""Phase [cycles] and its derivative [1/pixel] by the radius.

    .. math::
        \phi = \frac{r}{p} \Big(1 + c \frac{r - r_0}{200}\Big) \quad\text{or}\quad
        \phi = \frac{r}{p} \Big(1 + s \sin 2 \pi (r / l + \varphi_s)\Big)

    Parameters
    ----------
    law : RingLaw
        :data:`EVEN` (period p, chirp c) or :data:`UNEVEN` (period, sway s, length l, sway_phase).
    r : ndarray
        Radii [pixel].
    r0 : float
        Radius of the pixel (0, 0) [pixel].
    p : ndarray
        Parameters of the law.

    Returns
    -------
    turns, slope : ndarray, shape of r
    """
    if law is EVEN:
        turns = r / p[0] * (1 + p[1] * (r - r0) / 200.0)
        return turns, (1 + p[1] * (2 * r - r0) / 200.0) / p[0]
    angle = 2 * np.pi * (r / p[2] + p[3])
    sine = p[1] * np.sin(angle)
    bend = p[1] * np.cos(angle) * (2 * np.pi / p[2])
    return r / p[0] * (1 + sine), (1 + sine + r * bend) / p[0]


def find_rings(
    values: FloatArray,
    x: FloatArray,
    y: FloatArray,
    start: tuple[float, float, float, float],
) -> list[tuple[float, dict[str, float]]]:
    """Fit rings to a map from circles nearby.

    The mean profile about the centre is fitted in radius with a polynomial phase, which starts
    fits of two laws: a frequency that changes linearly and, if that gains enough, one that varies
    sinusoidally.

    Parameters
    ----------
    values : ndarray, shape (ny, nx)
        Map, in units of its noise.
    x, y : ndarray, shape (ny, nx)
        Coordinates of its pixels [pixel].
    start : (float, float, float, float)
        Centre x and y [pixel], period at the pixel (0, 0) [pixel] and relative change of the
        frequency per 100 pixels.

    Returns
    -------
    list of (float, dict)
        Decrease of the chi-square, and parameters of the tree rings: 'xc', 'yc', 'period',
        'phase', 'amp', and 'chirp' or 'sway', 'length', 'sway_phase'.  Both laws if the uneven
        one gains :data:`CLEARER` more; empty if no fit succeeds.

    Examples
    --------
    >>> y, x = np.mgrid[:96., :96.]
    >>> r = np.hypot(x + 60, y - 150)
    >>> _, rings = find_rings(5 * np.cos(2 * np.pi * r / 14), x, y, (-55., 146., 14.2, 0.))[0]
    >>> round(rings["period"], 2), round(rings["xc"]), round(rings["yc"])
    (14.0, -60, 150)
    """
    found = [_fit(EVEN, values, x, y, np.array(start))]
    tried = [f for f in found if f is not None]
    if not tried:
        return []
    xc, yc = tried[0][1]["xc"], tried[0][1]["yc"]
    for law, numbers in _followed(
        values, np.hypot(x - xc, y - yc), float(np.hypot(xc, yc))
    ):
        one = _fit(law, values, x, y, np.array([xc, yc, *numbers]))
        if one is not None:
            tried.append(one)
    tried = [t for t in tried if max(abs(t[1]["xc"]), abs(t[1]["yc"])) < WAFER]
    if not any("chirp" in t[1] for t in tried):
        return []
    even = max((t for t in tried if "chirp" in t[1]), key=lambda t: t[0])
    best = max(tried, key=lambda t: t[0])
    # Both are starting points; without a clear gain the simpler law is enough.
    return [best, even] if best[0] > even[0] + CLEARER else [even]


def _fit(
    law: RingLaw, values: FloatArray, x: FloatArray, y: FloatArray, point: FloatArray
) -> tuple[float, dict[str, float]] | None:
    """Least squares of centre and phase (Levenberg-Marquardt), strength and phase linear."""
    flat = values.ravel()

    def solve(p: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        r, r0 = np.hypot(x - p[0], y - p[1]), float(np.hypot(p[0], p[1]))
        turns, slope = turns_of(law, r, r0, p[2:])
        # Rings displace charge along the radius; areas change by the derivative of that.
        turns, rate = 2 * np.pi * turns, 2 * np.pi * slope
        basis = np.stack([(rate * np.cos(turns)).ravel(), (-rate * np.sin(turns)).ravel()])
        found = np.linalg.lstsq(basis @ basis.T, basis @ flat, rcond=None)[0]
        model = found @ basis
        return float(((flat - model) ** 2).sum()), np.asarray(found, float), model

    # Half a pixel for the centre, which is hundreds of pixels away; damping after Marquardt.
    steps = np.array([0.5, 0.5, *(s or 1e-3 * point[2] for s in law.steps)])
    square, found, model = solve(point)
    damping = 1e-3
    for _ in range(15):
        slopes = np.stack([
            (solve(point + d)[2] - model) / d.sum() for d in np.diag(steps)
        ])  # fmt: skip
        normal = slopes @ slopes.T
        scale = np.sqrt(np.diag(normal))
        if not np.all(scale > 0):
            return None
        normal = normal / np.outer(scale, scale) + damping * np.eye(len(steps))
        step = np.linalg.solve(normal, slopes @ (flat - model) / scale) / scale
        new = point + step
        # No period below 2 pixels, the Nyquist limit.
        if not new[2] > 2.0:
            damping *= 8
            continue
        left, more, there = solve(new)
        if left < square:
            done = square - left < 1e-3
            point, square, found, model, damping = new, left, more, there, damping / 5
            if done:
                break
        else:
            damping *= 8
            if damping > 1e5:
                break
    if not np.isfinite(point).all():
        return None
    names = ("xc", "yc", *law.names)
    out = dict(zip(names, (float(v) for v in point), strict=True))
    if "sway_phase" in out:
        out["sway_phase"] = (out["sway_phase"] + 0.5) % 1.0 - 0.5
    phase = float(np.arctan2(found[1], found[0]) / (2 * np.pi))
    out |= {"amp": float(np.hypot(*found)), "phase": phase}
    return float(flat @ flat) - square, out


def _followed(
    values: FloatArray, r: FloatArray, r0: float
) -> list[tuple[RingLaw, list[float]]]:
    """Starting values of both laws, from the phase fitted along a map's mean profile in radius."""
    bins = np.floor(r - r.min()).astype(int).ravel()
    count = np.bincount(bins)
    kept = count > 3
    place = (np.bincount(bins, r.ravel()) / np.maximum(count, 1))[kept]
    mean = (np.bincount(bins, values.ravel()) / np.maximum(count, 1))[kept]
    weight = np.sqrt(count[kept])
    best: tuple[float, FloatArray, FloatArray] | None = None
    for middle, width, frequency in _windows(place, mean, weight)[:3]:
        one = _follow(place, mean, weight, middle, width, frequency)
        if one is not None and (best is None or one[0] < best[0]):
            best = one
    if best is None:
        return []
    _, turns, rate = best
    out = []
    sure = weight * np.abs(rate)
    design = np.stack([np.ones_like(place), place, place * (place - r0) / 200.0], axis=1)
    line = np.linalg.lstsq(design * sure[:, None], turns * sure, rcond=None)[0]
    if abs(line[1]) > 1e-4:
        out.append((EVEN, [1 / line[1], line[2] / line[1]]))
    span = float(np.ptp(place))
    swaying = []
    for length in np.geomspace(0.4 * span, 4 * span, 60):
        angle = 2 * np.pi * place / length
        design = np.stack([np.ones_like(place), place, place * np.sin(angle),
                           place * np.cos(angle)], axis=1)  # fmt: skip
        line = np.linalg.lstsq(design * sure[:, None], turns * sure, rcond=None)[0]
        left = float((((design @ line - turns) * sure) ** 2).sum())
        sway = float(np.hypot(line[2], line[3]) / max(abs(line[1]), 1e-9))
        if sway < 0.5:
            phase = float(np.arctan2(line[3] / line[1], line[2] / line[1]) / (2 * np.pi))
            swaying.append((left, [1 / line[1], sway, float(length), phase]))
    if swaying:
        out.append((UNEVEN, min(swaying, key=lambda s: s[0])[1]))
    # The sign of the period is absorbed by the linear amplitudes of sine and cosine.
    return [(law, [abs(n[0]), *n[1:]]) for law, n in out]


def _windows(
    place: FloatArray, mean: FloatArray, weight: FloatArray
) -> list[tuple[float, float, float]]:
    """Middle, width and frequency of the clearest waves in parts of a profile."""
    span = float(np.ptp(place))
    found = []
    for part in (2, 4, 8):
        width = span / part
        if width < 20:
            continue
        frequencies = np.arange(0.7 / width, HIGHEST, 0.15 / width)
        for low in np.arange(place[0], place[-1] - 0.9 * width, 0.5 * width):
            own = (place >= low) & (place < low + width)
            level = np.average(mean[own], weights=weight[own] ** 2)
            target = (mean[own] - level) * weight[own]
            for f in frequencies:
                angle = 2 * np.pi * f * place[own]
                design = np.stack([np.sin(angle), np.cos(angle)]) * weight[own]
                normal = design @ design.T
                along = design @ target
                gain = float(along @ np.linalg.solve(normal, along))
                # Ranked by the explained part of a window's variance, so that short windows in
                # which rings are clear rank above long ones in which they are not.
                found.append(
                    (
                        gain / float(target @ target),
                        gain,
                        low + 0.5 * width,
                        width,
                        float(f),
                    )
                )
    clear = [f for f in found if f[1] > 30.0]
    clear.sort(key=lambda f: -f[0])
    out: list[tuple[float, float, float]] = []
    for _, _, middle, width, f in clear:
        if all(abs(middle - m) > 0.25 * width for m, _, _ in out):
            out.append((middle, width, f))
    return out


def _follow(
    place: FloatArray,
    mean: FloatArray,
    weight: FloatArray,
    middle: float,
    width: float,
    frequency: float,
) -> tuple[float, FloatArray, FloatArray] | None:
    """Fit a wave in ever wider parts of a profile, its phase a polynomial of increasing order.

    Returns the chi-square, the phase [cycles] and its derivative [1/pixel] at all radii.
    """
    reach, order = 0.5 * width, 1
    far = max(place[-1] - middle, middle - place[0])
    phase = np.array([0.0, frequency])
    strength: FloatArray | None = None
    while True:
        own = np.abs(place - middle) <= reach
        away = (place - middle) / reach
        powers = np.arange(order + 1)
        # Powers of the distance in units of the reach.
        start = np.zeros(order + 1)
        start[: len(phase)] = phase * reach ** np.arange(len(phase))

        def wave(
            p: FloatArray,
            u: FloatArray,
            powers: NDArray[np.int64] = powers,
            reach: float = reach,
        ) -> tuple[FloatArray, FloatArray, FloatArray]:
            turns = (u[:, None] ** powers) @ p[2:]
            slope = (u[:, None] ** np.maximum(powers - 1, 0) * powers) @ p[2:] / reach
            angle = 2 * np.pi * turns
            return 10 * slope * (p[0] * np.cos(angle) - p[1] * np.sin(angle)), turns, slope

        if strength is None:
            unit = np.concatenate([[1.0, 0.0], start]), np.concatenate([[0.0, 1.0], start])
            design = np.stack([wave(p, away[own])[0] for p in unit], axis=1)
            strength = np.asarray(
                np.linalg.lstsq(
                    design * weight[own, None], mean[own] * weight[own], rcond=None
                )[0],
                float,
            )
        found = least_squares(
            lambda p, u=away[own], m=mean[own], w=weight[own], wave=wave: (wave(p, u)[0] - m) * w,
            np.concatenate([strength, start]), max_nfev=30,
        )  # fmt: skip
        strength, phase = found.x[:2], found.x[2:] / reach**powers
        if not np.isfinite(found.x).all():
            return None
        if reach >= far:
            if order == ORDERS:
                _, turns, slope = wave(found.x, away)
                return 2 * float(found.cost), turns, slope
            order += 1
            continue
        reach, order = min(1.25 * reach, far), min(order + 1, ORDERS)


def find_radial(
    values: FloatArray,
    x: FloatArray,
    y: FloatArray,
    near: Sequence[tuple[float, float]],
    *,
    least: float,
) -> dict[str, Any] | None:
    r"""Find the centre about which a map varies with the radius alone, and its profile as waves.

    The displacement is a sum of waves in radius,

    .. math:: u(r) = A \sum_k s_k \sin 2 \pi f_k r + c_k \cos 2 \pi f_k r,

    whose frequencies are found one after another (orthogonal matching pursuit).  Centres on the map
    are found by its symmetry: a pattern of circles is even under reflection in its centre, so that
    the map's convolution with itself has a peak at twice the centre.

    Parameters
    ----------
    values : ndarray, shape (ny, nx)
        Map, in units of its noise.
    x, y : ndarray, shape (ny, nx)
        Coordinates of its pixels [pixel].
    near : sequence of (float, float)
        Further centres x and y to begin with [pixel].
    least : float
        Decrease of the chi-square above which a wave is real, for a given centre; for the first one
        it grows by twice the logarithm of the number of centres that were searched.

    Returns
    -------
    dict or None
        'xc', 'yc' [pixel]; 'period' of the sine that has the same mean squares of displacement and
        slope along the radius [pixel]; 'amp' A [pixel]; 'waves', tuple of (f [1/pixel], s, c), of
        which the sum has the mean square of a sine; 'z', root of the decrease of the chi-square.  None
        without a wave.

    Examples
    --------
    >>> y, x = np.mgrid[:96., :96.]
    >>> r = np.hypot(x - 30, y - 50)
    >>> flat = np.cos(2 * np.pi * r / 14) + np.cos(2 * np.pi * r / 23)
    >>> noise = np.random.default_rng(8231).standard_normal(r.shape)
    >>> found = find_radial(flat + noise, x, y, [], least=35.0)
    >>> round(found["xc"]), round(found["yc"]), len(found["waves"]) >= 2, 14 < found["period"] < 23
    (30, 50, True, True)
    """
    step = float(x[0, 1] - x[0, 0])
    symmetric = _symmetric(values)
    starts = [(x[0, 0] + step * i, y[0, 0] + step * j) for i, j in symmetric]

    def gain(centre: FloatArray) -> float:
        # Excess of the squares of a profile's means over those of noise.
        _, mean, count = _profile(values, x, y, centre, step)
        return float((count * mean**2).sum()) - len(mean)

    first = [np.array(c, float) for c in (*starts, *near)]
    if not first:
        return None
    best = max(first, key=gain)
    found = minimize(
        lambda c: -gain(c), best, method="Nelder-Mead",
        options={
            "initial_simplex": best + step * np.array([[0, 0], [2, 0], [0, 2]]),
            "xatol": 0.1 * step, "fatol": 0.1, "maxfev": 80,
        },
    )  # fmt: skip
    xc, yc = (float(v) for v in found.x)
    if max(abs(xc), abs(yc)) >= WAFER:
        return None
    place, mean, count = _profile(values, x, y, found.x, step)
    # Centres are distinct if a wave of the shortest period is out of phase between them.
    tried = values.size * (step * HIGHEST * 2) ** 2
    waves, gained = _waves_of(place, mean, count, least, 2 * np.log(max(tried, 1.0)))
    if not waves:
        return None
    f, s, c = (np.array(w)[:, None] for w in zip(*waves, strict=True))
    turn = 2 * np.pi * f * place
    u = (s * np.sin(turn) + c * np.cos(turn)).sum(axis=0)
    slope = (2 * np.pi * f * (s * np.cos(turn) - c * np.sin(turn))).sum(axis=0)
    amp = float(np.sqrt(2 * np.average(np.square(u), weights=count)))
    period = 2 * np.pi * float(np.sqrt(np.square(u).sum() / np.square(slope).sum()))
    # Of waves close to each other in frequency single ones may be of any size: they cancel.
    return {
        "xc": xc, "yc": yc, "period": period, "amp": amp, "z": float(np.sqrt(gained)),
        "waves": tuple((f, s / amp, c / amp) for f, s, c in waves),
    }  # fmt: skip


def _symmetric(values: FloatArray) -> list[tuple[float, float]]:
    """Places (column, row) of a map, to half a pixel, about which it is most symmetric."""
    ny, nx = values.shape
    shape = 2 * ny, 2 * nx
    even = irfft2(rfft2(values, s=shape) ** 2, s=shape)
    # A sum of n products of noise has the variance n, or 2 n as each product is there twice.
    inside = irfft2(rfft2(np.ones_like(values), s=shape) ** 2, s=shape)
    z = even / np.sqrt(2 * np.maximum(inside, 1.0))
    # Centres near the rim leave a few pixels, whose products are far from Gaussian.
    z[inside < 0.1 * values.size] = 0.0
    out: list[tuple[float, float]] = []
    for flat in np.argsort(z, axis=None)[::-1][:200]:
        j, i = np.unravel_index(flat, z.shape)
        if all(max(abs(i / 2 - a), abs(j / 2 - b)) > 2 for a, b in out):
            out.append((float(i) / 2, float(j) / 2))
        if len(out) == 4:
            break
    return out


def _profile(
    values: FloatArray, x: FloatArray, y: FloatArray, centre: FloatArray, step: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean radius [pixel], mean value and number of the pixels of each annulus about a centre."""
    r = np.hypot(x - centre[0], y - centre[1]).ravel()
    bins = ((r - r.min()) / step).astype(int)
    count = np.bincount(bins)
    kept = count > 3
    one = np.maximum(count, 1)
    place, mean = (np.bincount(bins, v)[kept] / one[kept] for v in (r, values.ravel()))
    return place, mean, count[kept].astype(float)


def _waves_of(
    place: FloatArray, mean: FloatArray, count: FloatArray, least: float, more: float
) -> tuple[list[tuple[float, float, float]], float]:
    """Waves (frequency, sine, cosine) of the displacement in a profile, and their gain."""
    weight = np.sqrt(count)
    target = mean * weight
    # Four frequencies within the width of a peak, from one and a half waves on.
    grid = np.arange(1.5, HIGHEST * np.ptp(place), 0.25) / np.ptp(place)

    def columns(f: float) -> FloatArray:
        turn = 2 * np.pi * f * place
        over = 1 / np.maximum(place, 0.5)
        rate = 2 * np.pi * f
        return weight * np.stack([
            rate * np.cos(turn) + over * np.sin(turn), -rate * np.sin(turn) + over * np.cos(turn)
        ])  # fmt: skip

    every = np.stack([columns(f) for f in grid])
    chosen: list[float] = []
    design = np.zeros((0, len(place)))
    left = target
    while len(grid):
        along = every @ left
        normal = every @ every.transpose(0, 2, 1)
        gains = (along * np.linalg.solve(normal, along[..., None])[..., 0]).sum(1)
        k = int(np.argmax(gains))
        trial = np.concatenate([design, columns(grid[k])])
        parts = np.linalg.lstsq(trial.T, target, rcond=None)[0]
        after = target - parts @ trial
        if left @ left - after @ after < least + (0.0 if chosen else more):
            break
        chosen.append(float(grid[k]))
        design, left = trial, after
    if not chosen:
        return [], 0.0

    def fitted(f: FloatArray) -> tuple[FloatArray, FloatArray]:
        design = np.concatenate([columns(v) for v in f])
        parts = np.linalg.lstsq(design.T, target, rcond=None)[0]
        return parts, parts @ design

    # Between frequencies of the grid: the strengths are linear, so that only frequencies are searched.
    width = 0.25 / np.ptp(place)
    better = least_squares(
        lambda d: target - fitted(np.array(chosen) + width * d)[1], np.zeros(len(chosen)),
        bounds=(-2.0, 2.0), max_nfev=20,
    )  # fmt: skip
    frequencies = np.array(chosen) + width * better.x
    parts, model = fitted(frequencies)
    waves = [
        (float(f), float(s), float(c))
        for f, (s, c) in zip(frequencies, parts.reshape(-1, 2), strict=True)
    ]
    left = target - model
    return waves, float(target @ target - left @ left)
