"""Nonparametric terms of flats against position: columns, rows, boxes, pixel parity and ripples."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.map_channels import RINGS, ring_modes
from bfsensor.diagnose.explain.pursuit import Dictionary
from bfsensor.diagnose.explain.terms import SCALE, Family, Scene, Term
from bfsensor.diagnose.kinds.map_shapes import Places
from bfsensor.diagnose.model.map_predictions import reduce_map
from bfsensor.effects.effect import Layout
from bfsensor.typing import FloatArray

POWERS = (0, 1)
"""Powers of the level that relative patterns go with: the same at all levels, or growing with it.
Chosen: additive patterns (power -1) are left out, for bright flats hardly constrain them."""

OCTAVES = 5
"""Number of widths of strips, each half of the one before, from half the side on. Chosen: the
narrowest is 1/32 of the side; more widths lengthen the search, and single columns and rows are terms
of their own."""

PERIODS = 160
"""Number of ripple frequencies of the first search, evenly spaced. Chosen, to be derived: the step is
1.5e-3 cycles per pixel time; with half as many, ripples between two steps may be missed."""

FINE = 61
"""Number of frequencies of the second search, one step to either side.  Chosen: to 1/30 of a step; twice
as many double its time."""

FINEST, WIDE = 9, 4.0
"""Number of frequencies of the last two searches, which use the full prediction, and the half width
of the first of them [steps of the second search]. Chosen: the approximate prediction of the second
search leaves power out, so that its best frequency may be off by a few steps; wider costs time
only."""

SHORTEST, LONGEST = 4.0, 100.0
"""Range of ripple periods [pixel times]. Chosen, to be derived: shorter ones alternate between pixels
like a parity pattern, longer ones are smooth along a row; a wider range raises the threshold for
all."""

AXES = {"column": "x", "row": "y"}
"""Axis that columns and rows are counted along."""


def share_powers(scene: Scene, p: int) -> dict[tuple[str, str], float]:
    """Weight, by (fold, map), of a pattern that goes with the level (in 1e5 e-) to the power p."""
    measured = scene.model.predictor.measured
    gain = float(np.mean(scene.gains)) / SCALE
    return {
        key: float(sum(s.weight * (gain * s.level) ** p for s in shares))
        for key, shares in measured.maps.items()
    }


def pattern_column(
    change: FloatArray, shares: Mapping[tuple[str, str], float], channel: Channel
) -> FloatArray:
    """Change of columns, rows, blocks and the chess pattern by a relative change of flats.

    Rings and texture, which are quadratic in it, are left out: see :func:`_squared`.
    """
    out = np.zeros(len(channel))
    x = channel.axes
    linear = np.isin(x["what"], ("column", "row", "block", "chess"))
    found: FloatArray | None = None
    for name in dict.fromkeys(x["map"]):
        rows = np.nonzero(linear & (x["map"] == name))[0]
        share = shares.get((channel.fold, str(name)), 0.0)
        if not share or not len(rows):
            continue
        axes = {k: v[rows] for k, v in x.items()}
        # All maps share their columns, rows and blocks unless pixels are masked: reduce once.
        if found is None or len(found) != len(rows):
            found = reduce_map(change, axes)
        out[rows] = share * found
    return out


def map_families(scene: Scene) -> list[Family]:
    """Families of patterns of columns, rows and boxes, of two-pixel parity, and of readout ripples."""
    if not any(c.word == "flat_map" for c in scene.model.fit.channels):
        return []
    kinds: list[tuple[str, dict[str, Any], dict[tuple[str, str], float]]] = [
        (f" x S^{p}" if p else "", {"power": p}, share_powers(scene, p)) for p in POWERS
    ]
    names = {name for _, name in scene.model.predictor.measured.maps} - {"all", "short"}
    kinds += [
        (f" at {name}", {"condition": name}, {(f, name): 1.0 for f in ("fit", "held-out")})
        for name in sorted(names)
    ]
    out: list[Family] = []
    for label, told, shares in kinds:
        places: list[Term] = []
        for name, where, along, what in _shapes(scene):
            column = partial(_separable, scene, along, shares)
            image = partial(_image, along)
            more = (_squared(name + label, image, shares),) if what == "box" else ()
            places.append(Term(name + label, {**where, **told}, column, more=more))
        out.append(Family("pattern of position", tuple(places), ("flat_map",)))
    parity = [
        Term(
            name + label, {**where, **told}, partial(_pattern, image, shares),
            more=(_squared(name + label, image, shares),),
        )
        for label, told, shares in kinds[: len(POWERS)] for name, where, image in _parities(scene)
    ]  # fmt: skip
    ripples = [_ripple(scene, f) for f in np.linspace(1 / LONGEST, 1 / SHORTEST, PERIODS)]
    out.append(Family("pattern of two-pixel parity", tuple(parity), ("flat_map",)))
    out.append(Family("ripple in readout time", tuple(ripples), ("flat_map",)))
    return out


def refine_ripple(scene: Scene, term: Term) -> Family:
    """Refine a ripple's frequency in three searches of decreasing step.

    The family returned holds the best ripple alone: a neighbour in frequency beside it would
    take part of its amplitude.
    """
    step = (1 / SHORTEST - 1 / LONGEST) / (PERIODS - 1)
    for count, rough, wider in (
        (FINE, True, 1.0),
        (FINEST, False, WIDE),
        (FINEST, False, 1.0),
    ):
        step *= wider
        middle = 1 / term.where["period"]
        near = [_ripple(scene, middle + d) for d in np.linspace(-1, 1, count) * step]
        near = near if rough else [replace(t, rough=None) for t in near]
        family = Family("ripple in readout time", tuple(near), ("flat_map",))
        d = Dictionary(family, scene.model.fit)
        b = d.products(scene.model.fit.left)
        gain = np.where(d.free > 0, b / np.sqrt(np.where(d.free > 0, d.free, 1.0)), -np.inf)
        term = near[int(np.argmax(gain))]
        step *= 2 / (count - 1)
    return replace(family, terms=(term,), tried=PERIODS)


def _pattern(
    image: Callable[[], FloatArray],
    shares: Mapping[tuple[str, str], float],
    channel: Channel,
) -> FloatArray | None:
    """Column of a pattern given as an image."""
    return pattern_column(image(), shares, channel) if channel.word == "flat_map" else None


def _squared(
    name: str, image: Callable[[], FloatArray], shares: Mapping[tuple[str, str], float]
) -> Term:
    """Term of rings and texture, which are quadratic in a pattern."""
    return Term(f"square of {name}", {"square": True}, partial(_square, image, shares))


def _square(
    image: Callable[[], FloatArray],
    shares: Mapping[tuple[str, str], float],
    channel: Channel,
) -> FloatArray | None:
    """Rings and texture of a pattern given as an image."""
    if channel.word != "flat_map":
        return None
    out = np.zeros(len(channel))
    square = np.isin(channel.axes["what"], ("ring", "texture"))
    for label in dict.fromkeys(channel.axes["map"]):
        rows = np.nonzero(square & (channel.axes["map"] == label))[0]
        share = shares.get((channel.fold, str(label)), 0.0)
        if share and len(rows):
            axes = {k: v[rows] for k, v in channel.axes.items()}
            out[rows] = share**2 * reduce_map(image(), axes)
    return out


def _parities(
    scene: Scene,
) -> Iterator[tuple[str, dict[str, Any], Callable[[], FloatArray]]]:
    """Odd and even columns, rows and both, on the sensor; columns as they are read out."""
    layout = scene.model.predictor.layout
    mirrored = any(s.flip_x or s.flip_y for s in layout.segments)
    for by_x, by_y, word in (
        (1, 0, "odd and even columns"), (0, 1, "odd and even rows"), (1, 1, "checkerboard")
    ):  # fmt: skip
        yield word, {"parity": word}, partial(_parity, layout, by_x, by_y, False)
        if mirrored:
            told = f"{word} in readout order"
            yield told, {"parity": told}, partial(_parity, layout, by_x, by_y, True)


def _parity(layout: Layout, by_x: int, by_y: int, read: bool) -> FloatArray:
    """Half of even less odd places, by column and row of the sensor or as they are read."""
    y, x = np.indices(layout.shape)
    if read:
        for s in layout.segments:
            own = np.s_[s.y : s.y + s.rows, s.x : s.x + s.columns]
            column, row = x[own] - s.x, y[own] - s.y
            x[own] = s.columns - 1 - column if s.flip_x else column
            y[own] = s.rows - 1 - row if s.flip_y else row
    return np.asarray(0.5 - (by_x * x + by_y * y) % 2)


Along = Callable[[], tuple[FloatArray, FloatArray]]
"""Makes the factors of a separable shape along x, shape (nx,), and along y, shape (ny,): of thousands of
shapes of a large sensor, only the one at hand is in memory."""

Line = Callable[[int], FloatArray]
"""Makes a function of n places, shape (n,)."""


def _image(along: Along) -> FloatArray:
    """Image of a separable shape, shape (ny, nx)."""
    x, y = along()
    return np.outer(y, x)


def _shapes(scene: Scene) -> Iterator[tuple[str, dict[str, Any], Along, str]]:
    """Separable shapes: name, place, factors along x and y, and kind ('column', 'row' or 'box')."""
    ny, nx = scene.model.predictor.layout.shape
    for what, n in (("column", nx), ("row", ny)):
        axis = AXES[what]

        def both(make: Line, what: str = what) -> Along:
            return partial(_across if what == "column" else _down, make, nx, ny)

        for one in range(n):
            yield (
                f"{what} {one}",
                {axis: (one, one + 1)},
                both(partial(_between, one, one + 1)),
                what,
            )
        for octave in range(1, OCTAVES + 1):
            width = n / 2**octave
            for k in range(2 ** (octave + 1) - 1):
                low, high = int(0.5 * k * width), int(np.ceil((0.5 * k + 1) * width))
                strip = both(partial(_between, low, high))
                yield f"{what}s {low} to {high}", {axis: (low, high)}, strip, what
        for length in (2.0, 6.0, 15.0):
            for side in ("low", "high"):
                where = {
                    axis: (0, int(3 * length))
                    if side == "low"
                    else (n - int(3 * length), n)
                }
                name = f"{what}s at the {side} end, exp(-d/{length:g})"
                yield name, where, both(partial(_falling, length, side)), what
        for cycles in range(3, n // 4):
            for word in ("cosine", "sine"):
                told = {"period": n / cycles, "along": axis}
                name = f"{word} along {axis} of {n / cycles:.3g} pixels"
                yield name, told, both(partial(_wave, word, cycles)), what
    for octave in range(1, 4):
        wide, tall = nx / 2**octave, ny / 2**octave
        for a in range(2**octave):
            for b in range(2**octave):
                x, y = (
                    (int(a * wide), int((a + 1) * wide)),
                    (int(b * tall), int((b + 1) * tall)),
                )
                box = partial(_box, x, y, nx, ny)
                yield f"box {x}, {y}", {"x": x, "y": y}, box, "box"


def _across(make: Line, nx: int, ny: int) -> tuple[FloatArray, FloatArray]:
    """A function of x, the same in all rows."""
    return make(nx), np.ones(ny)


def _down(make: Line, nx: int, ny: int) -> tuple[FloatArray, FloatArray]:
    """A function of y, the same in all columns."""
    return np.ones(nx), make(ny)


def _between(low: int, high: int, n: int) -> FloatArray:
    """1 from ``low`` to ``high``, 0 elsewhere; shape (n,)."""
    out = np.zeros(n)
    out[low:high] = 1.0
    return out


def _falling(length: float, side: str, n: int) -> FloatArray:
    """Exponential of the distance from the first or the last of n places."""
    place = np.arange(n)
    return np.asarray(np.exp(-(place if side == "low" else n - 1 - place) / length))


def _wave(word: str, cycles: int, n: int) -> FloatArray:
    """Sine or cosine with some cycles over n places."""
    phase = 2 * np.pi * cycles * (np.arange(n) + 0.5) / n
    return np.asarray(np.cos(phase) if word == "cosine" else np.sin(phase))


def _box(
    x: tuple[int, int], y: tuple[int, int], nx: int, ny: int
) -> tuple[FloatArray, FloatArray]:
    """1 inside of some columns and rows, 0 elsewhere."""
    return _between(*x, nx), _between(*y, ny)


def _places(
    scene: Scene, channel: Channel
) -> tuple[Places, NDArray[np.str_], NDArray[np.int64]]:
    """Places of a channel's values, names of its maps, and the map of each value; cached."""

    def find() -> tuple[Places, NDArray[np.str_], NDArray[np.int64]]:
        places = Places.of(channel.axes, scene.model.predictor.layout.shape)
        return places, *np.unique(channel.axes["map"], return_inverse=True)

    return scene.kept.get(("maps", channel), find)


def _separable(
    scene: Scene,
    along: Along,
    shares: Mapping[tuple[str, str], float],
    channel: Channel,
) -> FloatArray | None:
    """Column of a pattern that is a product of functions of x and of y, without making the image."""
    if channel.word != "flat_map":
        return None
    places, names, maps = _places(scene, channel)
    out = places.product(*along(), len(channel))
    factor = np.array([shares.get((channel.fold, str(n)), 0.0) for n in names])
    return np.asarray(out * factor[maps])


def _ripple(scene: Scene, frequency: float) -> Term:
    """Sine of the readout time with the same phase in all frames, relative to the signal.

    Its coefficient is the square of its amplitude [1e-6], as power spectra are quadratic.  Ratios
    of maps do not contain it.
    """
    return Term(
        f"ripple of {1 / frequency:.4g} pixel times", {"period": 1 / frequency},
        partial(_ripple_column, scene, frequency), partial(_ripple_rough, scene, frequency),
    )  # fmt: skip


def _ripple_column(scene: Scene, frequency: float, channel: Channel) -> FloatArray | None:
    if channel.word != "flat_map":
        return None
    layout = scene.model.predictor.layout
    image = np.zeros(layout.shape)
    for s in layout.segments:
        width = s.prescan + s.columns + s.serial_overscan
        row, column = np.indices((s.rows, s.columns))
        wave = np.sin(2 * np.pi * frequency * (row * width + s.prescan + column))
        wave = wave[::-1] if s.flip_y else wave
        image[s.y : s.y + s.rows, s.x : s.x + s.columns] = (
            wave[:, ::-1] if s.flip_x else wave
        )
    own = (channel.axes["map"] == "all") & np.isin(
        channel.axes["what"], ("ring", "texture")
    )
    out = np.zeros(len(channel))
    out[own] = reduce_map(image, {k: v[own] for k, v in channel.axes.items()})
    return 1e-6 * out


def _ripple_rough(scene: Scene, frequency: float, channel: Channel) -> FloatArray | None:
    """Closed form of :func:`_ripple_column`, without the power that leaks into other rings."""
    if channel.word != "flat_map":
        return None
    x = channel.axes
    layout = scene.model.predictor.layout
    out = np.zeros(len(channel))
    texture, ring = ((x["map"] == "all") & (x["what"] == w) for w in ("texture", "ring"))
    rings = (np.round(x["k"][ring] * 2 * RINGS - 0.5)).astype(int)
    power = np.zeros(RINGS + 1)
    modes = ring_modes(layout.shape)
    pixels = layout.shape[0] * layout.shape[1]
    for s in layout.segments:
        share = s.rows * s.columns / pixels
        width = s.prescan + s.columns + s.serial_overscan
        way = (-1 if s.flip_x else 1) * (-1 if s.flip_y else 1)
        lag = x["x"][texture] * way + x["y"][texture] * width
        out[texture] += 0.5 * share * np.cos(2 * np.pi * frequency * lag)
        down = abs((frequency * width + 0.5) % 1 - 0.5)
        place = min(int(np.hypot(frequency, down) * 2 * RINGS), RINGS)
        if place < RINGS:
            power[place] += 0.25 * share * pixels / max(modes[place], 1)
    out[ring] = power[rings]
    return out
