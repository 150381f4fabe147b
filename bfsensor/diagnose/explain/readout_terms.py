"""Free-form model of the readout: a linear response to earlier pixels, of either power of them."""

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
"""Farthest pixel back."""

POWERS = (1, 2)
"""Of the earlier pixel's signal."""

NEAR_SPOTS = (4, 16)
"""Lags that put a trace where crosstalk is measured, beside an amplifier's own spots [pixel]."""

STEP = 1e-4
"""Of the derivatives of spots."""


def filter_family(scene: Scene) -> Family | None:
    """Response h_n S^p of the pixel n pixel times later.

    Seen behind the light, in the overscan, as a step that ends n pixels in; in the first n
    columns, which lack it; in covariances along the row at the lag n; in the mean (p = 2); in
    spots.  Amplifiers that read from the other side are mirrored.
    """
    # Area changes know no level that a response could go with.
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
    """What stands beside an amplifier's own spots is taken for crosstalk of another's.

    How much depends on where spots lie, which the channel does not say: free for each pair.
    """
    if not NEAR_SPOTS[0] <= n <= NEAR_SPOTS[1]:
        return
    channels = [c for c in scene.model.fit.channels if c.word == "amp_cross"]
    pairs = {
        (int(a), int(b)) for c in channels
        for a, b, w in zip(*(c.axes[k] for k in ("amp", "other", "what")), strict=True)
        if w == "crosstalk"
    }  # fmt: skip

    def column(amp: int, other: int, channel: Channel) -> FloatArray | None:
        if channel.word != "amp_cross":
            return None
        x = channel.axes
        own = (x["amp"] == amp) & (x["other"] == other) & (x["what"] == "crosstalk")
        return np.where(own, 1.0, 0.0)

    for amp, other in sorted(pairs):
        name = f"h_{n} S^{p} taken for crosstalk of {amp + 1} in {other + 1}"
        yield Term(name, {"crosstalk": (amp, other)}, partial(column, amp, other))


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
    """Response of a coefficient of 1 to a signal [e-]: S, or S^2 at 1e5 e-."""
    return np.asarray(level * (level / SCALE) ** (p - 1))


def _overscan(scene: Scene, n: int, p: int, channel: Channel) -> FloatArray:
    x = channel.axes
    amp = x["amp"].astype(int)
    gain = scene.gains[amp]
    head = int(x["k"].max())
    # The last pixels are the profile's zero.
    zero = np.mean(np.arange(head + 1, head + TAIL + 1) <= n)
    columns = np.array([s.columns for s in scene.model.predictor.layout.segments])[amp]
    lit = (x["k"] <= n) & (n - x["k"] < columns)
    return np.asarray((lit - zero) * _answer(gain * x["level"], p) / gain)


def _means(scene: Scene, n: int, p: int, channel: Channel) -> FloatArray:
    x = channel.axes
    amp = x["amp"].astype(int)
    gain = scene.gains[amp]
    segments = scene.model.predictor.layout.segments
    # Of the mean the first n columns get nothing; the overscan's second half is its zero.
    share = np.array([
        max(s.columns - n, 0) / s.columns - _of_zero(n, s.serial_overscan) for s in segments
    ])  # fmt: skip
    return np.asarray(share[amp] * _answer(gain * x["level"], p) / gain)


def _of_zero(n: int, depth: int) -> float:
    """Part of an overscan's second half, the zero of a frame, that the response reaches."""
    return float(np.mean(np.arange(depth // 2, depth) < n)) if depth else 0.0


def _covariances(scene: Scene, n: int, p: int, channel: Channel) -> FloatArray:
    x = channel.axes
    i, j = x["i"].astype(int), x["j"].astype(int)
    out = np.zeros(len(channel))
    for flats in scene.flats(channel):
        if n >= flats.c.shape[-1] // 2:
            continue
        slope = p * (flats.level / SCALE) ** (p - 1)
        # A pixel and the one n before: C(i - n) + C(i + n), rows apart by j.
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
    """The response in spots: widths and wings are what a fit makes of the images."""

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
    """By a small step; amplifiers that read from either side are averaged."""
    return scene.changed_by(_Echo({"h": STEP, "lag": n, "power": p}), channel) / STEP
