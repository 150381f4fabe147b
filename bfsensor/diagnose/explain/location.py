"""Places where the effects found change the data: channels, lags, fluxes, columns, amplifiers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.explain.attribution import Attribution
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.typing import FloatArray

SHOWN = 0.02
"""Share of the effects' total chi-square change above which a channel, or an amplifier, is listed.
Chosen, to be derived: twice as large drops channels that hold 2 to 4 % of the change."""

MIDDLE = 0.9
"""Share of the change that the listed range of fluxes, columns and rows holds, the middle one.
Chosen, to be derived: with half as much outside (0.95) the ranges grow into the tails of the change."""

NEAREST, LIKE = 6, 1 / 3
"""Largest number of lags that are listed, and the least chi-square change at a listed lag relative to
the largest. Chosen, to be derived: twice as large, up to 12 lags, or only those above two thirds."""

FAINT = 0.1
"""Change of a column or row, relative to the largest, below which it is left out of the range.
Chosen, to be derived: twice as large narrows ranges with faint tails; near 0 the change that the
fit's own parameters take up everywhere makes every range the whole sensor."""

ALONE = 0.8
"""Share of the mean chi-square change per value, summed over wavelengths, above which one wavelength is
listed.  Chosen, to be derived: at 0.8 it has four times that of all others; at 0.9, nine times."""


def place_effects(
    attribution: Attribution, fit: BaselineFit, shape: tuple[int, int], amplifiers: int
) -> dict[str, Any] | None:
    """Locate the effects found by the chi-square that their templates change.

    Scans find where residuals stand out of the noise; the template of a known effect also shows
    where it acts below the noise of single values.

    Parameters
    ----------
    attribution : Attribution
        Effects found.
    fit : BaselineFit
        Fit of the same channels.
    shape : tuple of int
        Rows and columns of the sensor [pixel]; 0 of a reduced recording.
    amplifiers : int
        Number of amplifiers.

    Returns
    -------
    dict or None
        The key 'location' of report.json; None where a mismatch outside the library is left, or
        no effect was found.
    """
    n = len(fit.residuals)
    changed = np.zeros(n)
    for found in attribution.found:
        own = next((r for r in found.rivals if r.effect.name == found.effect.name), None)
        if own is not None and len(own.template) >= n:
            changed += own.template[:n] ** 2
    total = float(changed.sum())
    if attribution.open_world or not total > 0:
        return None
    parts = [
        (c, changed[s : s + len(c)]) for c, s in zip(fit.channels, fit.starts, strict=False)
    ]
    by_word: dict[str, float] = {}
    for channel, square in parts:
        by_word[channel.word] = by_word.get(channel.word, 0.0) + float(square.sum())
    words = [
        w for w, v in sorted(by_word.items(), key=lambda t: -t[1]) if v > SHOWN * total
    ]
    gain = float(np.mean(fit.values[:amplifiers])) if amplifiers else 1.0
    ny, nx = shape
    out: dict[str, Any] = {
        "channels": words,
        "lags": _lags(parts) if "flat_cov" in words else [],
        "flux_e": next((f for w in words if (f := _fluxes(parts, w, gain))), []),
        "x": _span(parts, "column", "x", nx)
        if "flat_map" in words
        else [0, nx]
        if nx
        else [],
        "y": _span(parts, "row", "y", ny) if "flat_map" in words else [0, ny] if ny else [],
        "amps": _amplifiers(parts, words, amplifiers),
        "wavelength": _wavelength(parts, words),
        "exposures": _exposures(parts) if "flat_mean" in words else [],
    }
    return out


def _gathered(
    parts: list[tuple[Channel, FloatArray]], use: Callable[[Channel], bool], name: str
) -> tuple[NDArray[Any], FloatArray]:
    """One axis of the channels of a kind, and the chi-square change of each value."""
    kept = [(c.axes[name], s) for c, s in parts if use(c) and name in c.axes]
    if not kept:
        return np.zeros(0), np.zeros(0)
    return np.concatenate([a for a, _ in kept]), np.concatenate([s for _, s in kept])


def _lags(parts: list[tuple[Channel, FloatArray]]) -> list[list[int]]:
    """Lags (x, y) at which covariances change most, the largest first."""
    i, square = _gathered(parts, lambda c: c.word == "flat_cov", "i")
    j, _ = _gathered(parts, lambda c: c.word == "flat_cov", "j")
    sums: dict[tuple[int, int], float] = {}
    for lag, value in zip(
        zip(i.astype(int), j.astype(int), strict=True), square, strict=True
    ):
        sums[lag] = sums.get(lag, 0.0) + float(value)
    out: list[list[int]] = []
    farthest = max(sums.values(), default=0.0)
    for lag, value in sorted(sums.items(), key=lambda t: -t[1])[:NEAREST]:
        if value > LIKE * farthest:
            out.append([int(v) for v in lag])
    return out


def _fluxes(parts: list[tuple[Channel, FloatArray]], word: str, gain: float) -> list[float]:
    """Range of fluxes [e-] of a channel that holds the middle of the change."""
    name, scale = ("flux", 1.0) if word == "spot" else ("level", gain)
    flux, square = _gathered(parts, lambda c: c.word == word, name)
    if not square.sum() > 0:
        return []
    return [scale * v for v in _middle(flux.astype(float), square)]


def _middle(places: FloatArray, weights: FloatArray) -> list[float]:
    """Range that holds :data:`MIDDLE` of the weights, with as much left out at either end."""
    order = np.argsort(places)
    share = np.cumsum(weights[order]) / weights.sum()
    low = int(np.searchsorted(share, 0.5 * (1 - MIDDLE)))
    high = min(int(np.searchsorted(share, 1 - 0.5 * (1 - MIDDLE))), len(order) - 1)
    return [float(places[order[low]]), float(places[order[high]])]


def _span(
    parts: list[tuple[Channel, FloatArray]], what: str, axis: str, size: int
) -> list[int]:
    """Range of columns or rows that holds the middle of the change of maps; the end is exclusive."""
    kept = [
        (c.axes[axis][own], np.sqrt(s[own])) for c, s in parts
        if c.word == "flat_map" and (own := c.axes["what"] == what).any()
    ]  # fmt: skip
    if not kept:
        return [0, size]
    place, weight = (np.concatenate(v).astype(float) for v in zip(*kept, strict=True))
    if not weight.sum() > 0:
        return [0, size]
    # Refitted parameters change every column a little: only columns with a clear change count.
    low, high = _middle(place, np.where(weight > FAINT * weight.max(), weight, 0.0))
    return [int(low), int(high) + 1]


def _amplifiers(
    parts: list[tuple[Channel, FloatArray]], words: list[str], count: int
) -> list[int]:
    """Amplifiers, counted from 1, that the effects change; all where no channel distinguishes them."""
    if not count:
        return []
    sums = np.zeros(count)
    for name in ("amp", "other"):
        amp, square = _gathered(parts, lambda c: c.word in words and c.word != "spot", name)
        known = np.array([isinstance(a, int | float | np.number) for a in amp], bool)
        if known.any():
            np.add.at(sums, amp[known].astype(int), square[known])
    shown = np.nonzero(sums > SHOWN * sums.sum())[0] if sums.sum() > 0 else range(count)
    return [int(a) + 1 for a in shown]


def _wavelength(parts: list[tuple[Channel, FloatArray]], words: list[str]) -> list[float]:
    """The wavelength [nm] at which the effects show, if it is one of several."""
    light, square = _gathered(parts, lambda c: c.word in words, "wavelength")
    if not square.sum() > 0:
        return []
    light = light.astype(float)
    every = np.unique(light[np.isfinite(light)])
    if len(every) < 2:
        return []
    # Means per value, as most values are recorded at one wavelength.
    means = {float(v): float(square[light == v].mean()) for v in every}
    best = max(means, key=lambda v: means[v])
    return [best] if means[best] > ALONE * sum(means.values()) else []


def _exposures(parts: list[tuple[Channel, FloatArray]]) -> list[int]:
    """First and last exposure whose mean changes by more than 1e-3 of the largest change."""
    number, square = _gathered(parts, lambda c: c.word == "flat_mean", "exposure")
    if not square.sum() > 0:
        return []
    here = number[square > 1e-3 * square.max()].astype(int)
    return [int(here.min()), int(here.max())]
