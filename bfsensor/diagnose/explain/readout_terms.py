"""Nonparametric terms of the readout: echoes of earlier pixels, linear or quadratic in their signal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.data.flat_channels import TAIL
from bfsensor.diagnose.explain.map_terms import pattern_column, share_powers
from bfsensor.diagnose.explain.terms import SCALE, Family, Scene, Term, at_lags
from bfsensor.effects.effect import Effect, Layout, Parameter
from bfsensor.typing import FloatArray

LAGS = 64
"""Largest delay of an echo [pixel times].  Chosen, to be derived: twice as large doubles the search and
raises the threshold of each delay; overscans of fewer pixels do not constrain long ones."""

POWERS = (1, 2)
"""Powers of the earlier pixel's signal.  Chosen: linear, and the first correction to it."""

NEAR_SPOTS = (4, 16)
"""Range of delays [pixel times] whose echo of an amplifier's own spots falls on pixels where
crosstalk is measured. Chosen, to be derived: outside it the two do not overlap; a wider range adds
free parameters to each term and weakens crosstalk as a constraint."""

STEP = 1e-4
"""Coefficient of an echo by which derivatives of spots are taken. Chosen: the response is linear in
it, so that twice as large changes derivatives by errors of the spots' fit alone."""


def filter_family(scene: Scene) -> Family | None:
    """Make the family of echoes: a signal S adds h_n S^p to the pixel read n pixel times later.

    An echo shows in the overscan as a step that ends n pixels in, in the first n columns, which
    lack it, in covariances along the row at lag n, in the mean (p = 2) and in spots.  It is
    mirrored in amplifiers that read from the other side.  None without overscans and covariances.
    """
    # Area changes per electron have no level that an echo could be calculated from.
    words = {c.word for c in scene.model.fit.channels if c.unit != PER_ELECTRON}
    if not words & {"serial_overscan", "flat_cov"}:
        return None
    terms = tuple(
        Term(
            f"h_{n} S^{p}", {"lag": n, "power": p},
            partial(_column, scene, n, p, spots=True), partial(_column, scene, n, p, spots=False),
            tuple(_beside_spots(scene, n, p)),
        )
        for p in POWERS for n in range(1, LAGS + 1)
    )  # fmt: skip
    return Family("readout filter", terms, ("serial_overscan", "flat_cov", "flat_mean"))


def _beside_spots(scene: Scene, n: int, p: int) -> Iterator[Term]:
    """Terms for echoes of an amplifier's own spots that are measured as crosstalk.

    Their size depends on the places of the spots, which the channel does not hold, so that each
    pair of amplifiers has a free coefficient.
    """
    if not NEAR_SPOTS[0] <= n <= NEAR_SPOTS[1]:
        return
    channels = [c for c in scene.model.fit.channels if c.word == "amp_cross"]
    pairs = {
        (int(a), int(b)) for c in channels
        for a, b, w in zip(*(c.axes[k] for k in ("amp", "other", "what")), strict=True)
        if w == "crosstalk"
    }  # fmt: skip

    for amp, other in sorted(pairs):
        name = f"h_{n} S^{p} taken for crosstalk of {amp + 1} in {other + 1}"
        yield Term(name, {"crosstalk": (amp, other)}, partial(_crosstalk, amp, other))


def _crosstalk(amp: int, other: int, channel: Channel) -> FloatArray | None:
    """1 for the crosstalk of an amplifier in another."""
    if channel.word != "amp_cross":
        return None
    x = channel.axes
    own = (x["amp"] == amp) & (x["other"] == other) & (x["what"] == "crosstalk")
    return np.where(own, 1.0, 0.0)


def _column(
    scene: Scene, n: int, p: int, channel: Channel, *, spots: bool
) -> FloatArray | None:
    if channel.unit == PER_ELECTRON:
        return None
    make: dict[str, Callable[[Scene, int, int, Channel], FloatArray | None]] = {
        "serial_overscan": _overscan, "flat_cov": _covariances, "flat_mean": _means,
        "flat_map": _maps,
    }  # fmt: skip
    if channel.word == "spot" and spots:
        return _spots(scene, n, p, channel)
    return make[channel.word](scene, n, p, channel) if channel.word in make else None


def _answer(level: FloatArray, p: int) -> FloatArray:
    """Echo [e-] of a signal S [e-] for a coefficient of 1: S, or S^2 / 1e5 e-."""
    return np.asarray(level * (level / SCALE) ** (p - 1))


def _overscan(scene: Scene, n: int, p: int, channel: Channel) -> FloatArray:
    x = channel.axes
    amp = x["amp"].astype(int)
    gain = scene.gains[amp]
    head = int(x["k"].max())
    # The mean of the last TAIL pixels is subtracted from every profile as its zero.
    zero = np.mean(np.arange(head + 1, head + TAIL + 1) <= n)
    columns = np.array([s.columns for s in scene.model.predictor.layout.segments])[amp]
    lit = (x["k"] <= n) & (n - x["k"] < columns)
    return np.asarray((lit - zero) * _answer(gain * x["level"], p) / gain)


def _means(scene: Scene, n: int, p: int, channel: Channel) -> FloatArray:
    x = channel.axes
    amp = x["amp"].astype(int)
    gain = scene.gains[amp]
    segments = scene.model.predictor.layout.segments
    # The first n columns have no echo, and the overscan's second half is subtracted as the zero.
    share = np.array([
        max(s.columns - n, 0) / s.columns - _of_zero(n, s.serial_overscan) for s in segments
    ])  # fmt: skip
    return np.asarray(share[amp] * _answer(gain * x["level"], p) / gain)


def _of_zero(n: int, depth: int) -> float:
    """Fraction of an overscan's second half, the zero of a frame, that the echo reaches."""
    return float(np.mean(np.arange(depth // 2, depth) < n)) if depth else 0.0


def _covariances(scene: Scene, n: int, p: int, channel: Channel) -> FloatArray:
    x = channel.axes
    i, j = x["i"].astype(int), x["j"].astype(int)
    out = np.zeros(len(channel))
    for flats in scene.flats(channel):
        if n >= flats.c.shape[-1] // 2:
            continue
        slope = p * (flats.level / SCALE) ** (p - 1)
        # An echo of the pixel n before adds h (C(i - n) + C(i + n)) at lag (i, j).
        both = np.roll(flats.c, n, -1) + np.roll(flats.c, -n, -1)
        changed = slope[:, None, None] * both / flats.gain[:, None, None] ** 2
        out[flats.rows] = at_lags(changed, flats.flat, i[flats.rows], j[flats.rows])
    return out


def _maps(scene: Scene, n: int, p: int, channel: Channel) -> FloatArray:
    layout = scene.model.predictor.layout
    lacking = np.zeros(layout.shape)
    for s in layout.segments:
        part = lacking[s.y : s.y + s.rows, s.x : s.x + s.columns]
        first = np.s_[:, s.columns - n :] if s.flip_x else np.s_[:, :n]
        part[first] = -1.0
        part -= part.mean()
    return pattern_column(lacking, share_powers(scene, p - 1), channel)


class _Echo(Effect):
    """Echo in images of spots, whose widths and wings the fit then measures as in recordings."""

    word = "readout_filter"
    parameters = (
        Parameter("h", "", 1e-6, 1e-2, signed=True, amplitude=True),
        Parameter("lag", "", 1, LAGS, law="whole"),
        Parameter("power", "", 1, 2, law="whole"),
    )
    touches = ("spot",)

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        n, h = int(self["lag"]), self["h"]
        if n >= images.shape[-1]:
            return images
        back = (
            float(np.mean([s.flip_x for s in layout.segments])) if layout.segments else 0.0
        )
        extra = h * _answer(images, int(self["power"]))
        out = images.copy()
        out[..., n:] += (1 - back) * extra[..., :-n]
        out[..., :-n] += back * extra[..., n:]
        return out


def _spots(scene: Scene, n: int, p: int, channel: Channel) -> FloatArray:
    """Derivative of spots by a small echo; amplifiers that read from either side are averaged."""
    return scene.changed_by(_Echo({"h": STEP, "lag": n, "power": p}), channel) / STEP
