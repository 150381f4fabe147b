"""Channel 'flat_map': relative response of flats by column, row, block, ring, texture and chess.

Flats over their amplifiers' means are averaged by condition and exposure time; the smooth shape of
the light stays in the values and is a linear term of the prediction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft2

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel, Common, join_common
from bfsensor.diagnose.data.exposure_info import Axes, label_of
from bfsensor.diagnose.data.map_borders import Border, find_borders
from bfsensor.diagnose.data.map_noise import BlockNoise, block_noise
from bfsensor.diagnose.data.map_texture import (
    SLOW,
    map_texture,
    slow_power,
    slow_texture,
    texture_noise,
)
from bfsensor.diagnose.data.map_waves import find_patterns, without_shape, without_steps
from bfsensor.typing import FloatArray

BLOCKS = 16
"""Number of blocks along the longer side of a map.  Chosen: 225 of 256 blocks are independent of
columns and rows; with 32, 961, whose covariance matrix is 18 times as large."""

RINGS = 24
"""Number of bins of the spatial frequency, from 0 to half a cycle per pixel.  Chosen: with 48,
rings have half the modes, and errors of their power are 1.4 times as large."""

FULL = 0.5
"""Relative variance times level of a flat, in units of the median of fainter ones, below which its
wells are full.  Chosen: Poisson noise over 8 x 8 pixels keeps it at 1, full wells near 0; with 1
every second flat would count as full."""

LOW = 8
"""Side of the boxes [pixel] whose scatter measures noise over many pixels.  Chosen: brighter-fatter
covariances of near lags are inside of them; with 16 a quarter of the boxes are left, and the noise
is known half as well."""

LONG = 4
"""Shortest wave [blocks] that counts as noise on large scales: light that differs between the flats
of a pair.  Chosen: with 8, a quarter of the modes are left to measure it."""

CERTAIN = 5.0
"""Significance [sigma] above which large-scale noise is added to the errors.  Chosen: noise
exceeds 5 in 3e-7 of maps; with 10, weaker fluctuations of the light are no part of the errors."""

SHORT = 0.25
"""Part of the longest exposure time of a condition below which flats count as short: their map
is divided by that of the longer ones, to find the shutter's pattern.  Chosen: with 0.5 more
flats count as short, in which that pattern, in proportion to 1 / time, is weaker."""


class MapShare(NamedTuple):
    """Contribution of flats of one condition and exposure time to a map.

    Attributes
    ----------
    weight : float
        Weight of these flats in the map; negative where the map is divided by them.
    condition : Condition
        Condition of the flats.
    seconds, level : float
        Exposure time [s] and mean level [ADU].
    flats : int
        Number of flats.
    """

    weight: float
    condition: Condition
    seconds: float
    level: float
    flats: int = 1


class MapChannels:
    """Averages flats on the sensor, each over its amplifier's mean.

    Memory holds few maps of a large sensor: flats of one exposure time are weighted and added to
    one of two sums per condition, of short and of long exposures, as soon as the next exposure
    time begins.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    longest : mapping of Condition to float
        Longest exposure time [s] of the flats of each condition.
    fold : str
        Fold of the flats that are added.
    amplifiers : sequence of (slice, slice)
        Rows and columns of each amplifier on the sensor.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        longest: Mapping[Condition, float],
        fold: str = "fit",
        amplifiers: Sequence[tuple[slice, slice]] = (),
    ) -> None:
        self._shape, self._longest, self.fold = shape, longest, fold
        # A box lacks the brighter-fatter covariances with pixels outside of it, nearly in proportion
        # to the inverse of its side.  The noise grows from LOW / 2 to LOW pixels by a step that is
        # measured; from LOW pixels to a block it grows, by that law, by this part of the step.
        self._outside = max(1.0 - LOW / block_side(shape), 0.0)
        self._amplifiers = tuple(amplifiers)
        self.sightings: tuple[Mapping[str, Any], ...] = ()
        self._borders: dict[tuple[int, int], Border] = {}
        self._groups: list[_MapGroup] = []
        self._sums: dict[tuple[Condition, bool], _Sum] = {}
        self._closed = True
        self._total = np.zeros((0, 0), np.float32)
        self._count = np.zeros((0, 0), np.uint16)
        self._filled = np.zeros(shape, bool)

    def add_pair(
        self,
        condition: Condition,
        time: float,
        first: NDArray[np.float32],
        second: NDArray[np.float32],
        shared: float = 0.0,
        level: float = 0.0,
        filled: NDArray[np.bool_] | None = None,
    ) -> None:
        """Add a pair of flats, each over its amplifiers' means, less one.

        Parameters
        ----------
        condition : Condition
            Condition of the flats.
        time : float
            Exposure time [s]; pairs of one exposure time should follow one another.
        first, second : ndarray of float32, shape of the sensor
            Relative response less one; nan where no amplifier reads or a pixel is bad.
        shared : float
            Noise of the mean bias, which all flats share, over the mean level.
        level : float
            Mean level [ADU].
        filled : ndarray of bool, shape of the sensor, optional
            Pixels that have values of others in either flat, and with them no noise of their own.
        """
        last = self._groups[-1] if self._groups else None
        if last is None or (last.condition, last.time) != (condition, time):
            self._close()
            self._groups.append(_MapGroup(condition, time))
            self._total = np.zeros(self._shape, np.float32)
            self._count = np.zeros(self._shape, np.uint16)
            self._closed = False
        group = self._groups[-1]
        for image in (first, second):
            good = np.isfinite(image)
            np.add(self._total, image, out=self._total, where=good)
            self._count += good
        # The brighter-fatter effect makes the noise of single pixels smaller than Poisson's, with
        # positive covariances beside it; averages over many pixels keep Poisson noise.
        noise = first - second
        noise *= np.float32(np.sqrt(0.5))
        own = np.isfinite(noise)
        if filled is not None:
            own &= ~filled
            self._filled |= filled
        noise[~own] = 0.0
        part = max(float(own.mean()), 1e-30)
        low, near = (_box_variance(noise, own, side) for side in (LOW, LOW // 2))
        group.low += low
        group.wide += low + (low - near) * self._outside
        group.high += float(_steps(noise, own).var(dtype=np.float64)) / 2
        modes = rfft2(noise)
        group.power += spectrum_rings(modes, self._shape) / part
        group.long += long_power(modes, self._shape) / part
        group.slow = group.slow + slow_power(noise, modes) / part
        group.pairs += 1
        group.shared += shared
        group.level += level

    def _close(self) -> None:
        """Add the flats of the last exposure time to the sum of their condition, or drop full ones.

        Weights are inverse variances of the noise.
        """
        if self._closed:
            return
        self._closed = True
        group = self._groups[-1]
        if self._is_full(group):
            self._groups.pop()
            return
        weight = group.weight
        with np.errstate(invalid="ignore", divide="ignore"):
            self._total /= self._count
        self._total *= np.float32(weight)
        name = group.condition, self._is_short(group)
        if name in self._sums:
            self._sums[name].image += self._total
            self._sums[name].weight += weight
        else:
            self._sums[name] = _Sum(self._total, weight)
        self._total = np.zeros((0, 0), np.float32)

    def _keep(self, border: Border) -> None:
        """Keep a border that was cut, with its largest ratio in any map."""
        name = border.axis, border.line
        self._borders[name] = max(
            border, self._borders.get(name, border), key=lambda b: b.ratio
        )

    @property
    def notes(self) -> list[str]:
        """Sentences on borders that were left out of the maps."""
        return [str(border) for border in self._borders.values()]

    def _is_short(self, group: _MapGroup) -> bool:
        return group.time < SHORT * self._longest[group.condition]

    def channels(self) -> list[Channel]:
        """Channel 'flat_map': the map of all flats, and ratios of maps.

        The axis 'map' is 'all' for all flats of the commonest condition, weighted by inverse
        variance; 'short' for its short exposures over its long ones; and the condition's label
        for those of another condition over 'all'.
        """
        self._close()
        if not self._groups:
            return []
        values, axes = [], Axes()
        blocks: list[FloatArray] = []
        common: list[Common] = []
        # At most two maps are in memory: the one at hand and the one it is divided by.
        kept: tuple[list[_MapGroup], _Map] | None = None
        for name, (groups, below) in self._plan().items():
            image = self._average(groups)
            if name == "all":
                kept = groups, image
            if below:
                if kept is None or kept[0] is not below:
                    kept = None
                    kept = below, self._average(below)
                image = image.over(kept[1])
            if self.fold == "fit" and name != "short":
                self.sightings += tuple(find_patterns(image.values, name, self._amplifiers))
            parts, noise = self._parts(image, own=name == "all")
            for v, e, columns in parts:
                values.append(v)
                blocks.extend([e] if e.ndim == 2 else np.square(e)[:, None, None])
                axes.add(len(v), groups[0].condition, map=name, **columns)
            others = sum(len(v) for v, _, _ in parts[3:])
            common += [noise.common(), Common.none(others)]
        return [Channel("flat_map", np.concatenate(values), tuple(blocks), axes.columns(), "",
                        self.fold, join_common(common))]  # fmt: skip

    def _plan(self) -> dict[str, tuple[list[_MapGroup], list[_MapGroup]]]:
        """Flats of each map, and of the map that it is divided by, if any."""
        members: dict[Condition, list[_MapGroup]] = {}
        for group in self._groups:
            members.setdefault(group.condition, []).append(group)
        common = max(members, key=lambda k: sum(g.pairs for g in members[k]))
        ordered = sorted(members[common], key=lambda g: g.time)
        out: dict[str, tuple[list[_MapGroup], list[_MapGroup]]] = {"all": (ordered, [])}
        short = [g for g in ordered if self._is_short(g)]
        if short and len(short) < len(ordered):
            out["short"] = short, [g for g in ordered if not self._is_short(g)]
        for other, own in members.items():
            if other != common:
                out[label_of(other)] = own, ordered
        return out

    def _is_full(self, group: _MapGroup) -> bool:
        """Whether flats are at full well, where noise and pattern of the light are lost.

        Noise over many pixels is Poisson's with or without the brighter-fatter effect: relative
        variance times level is the same at all levels, larger only where read noise adds to it.
        Flats come by increasing level, so that those before give the usual value.
        """
        white = [g.low * g.level / g.pairs**2 for g in (*self._groups[:-1], group)]
        return len(white) > 2 and white[-1] < FULL * float(np.median(white[:-1]))

    def shares(self) -> dict[str, tuple[MapShare, ...]]:
        """Contributions of flats to each map, by its name."""
        out = {}
        for name, both in (self._plan() if self._groups else {}).items():
            out[name] = tuple(
                MapShare(
                    sign * float(w), g.condition, g.time, g.level / g.pairs, 2 * g.pairs
                )
                for groups, sign in zip(both, (1.0, -1.0), strict=True)
                for g, w in zip(groups, _weights(groups), strict=True)
            )
        return out

    def _average(self, groups: list[_MapGroup]) -> _Map:
        """Mean map of all short exposures of a condition, or all long ones, or both."""
        weights = _weights(groups)
        which = dict.fromkeys((g.condition, self._is_short(g)) for g in groups)
        sums = [self._sums[name] for name in which]
        whole = np.float32(sum(s.weight for s in sums))
        image = sums[0].image / whole
        for other in sums[1:]:
            image += other.image / whole
        # Noise of the mean bias is the same in all flats and cancels in differences of pairs.
        common = (
            sum(w * g.shared / g.pairs for w, g in zip(weights, groups, strict=True)) ** 2
        )
        # A mean of 2 n flats, whose single noise is measured by the difference of each pair.
        low = sum(
            w**2 * g.low / (2 * g.pairs**2) for w, g in zip(weights, groups, strict=True)
        )
        power = sum(
            w**2 * g.power / (2 * g.pairs**2) for w, g in zip(weights, groups, strict=True)
        )
        slow = sum(
            w**2 * g.slow / (2 * g.pairs**2) for w, g in zip(weights, groups, strict=True)
        )
        for border in find_borders(image):
            border.cut(image)
            self._keep(border)
        pairs = sum(g.pairs for g in groups)
        # Pixels' response is smoothed in each flat, so that both ratios follow the flats' weights.
        ratio, wide = (
            sum(w * a / max(b, 1e-30) for w, a, b in zip(weights, up, down, strict=True))
            for up, down in (
                ([g.low for g in groups], [g.high for g in groups]),
                ([g.wide for g in groups], [g.low for g in groups]),
            )
        )
        long = self._long(groups, weights)
        return _Map(
            image, float(low) + common, np.asarray(power) + common, float(ratio), pairs,
            max(long - float(low), 0.0), float(wide), np.where(slow > 0, slow + common, 0.0),
        )  # fmt: skip

    def _long(self, groups: list[_MapGroup], weights: FloatArray) -> float:
        """Noise of a mean in long waves, as a pixel's variance; 0 unless significantly larger."""
        modes = int(_is_long(self._shape).sum())
        parts = np.array(
            [w**2 / (2 * g.pairs**2) for w, g in zip(weights, groups, strict=True)]
        )
        low, long = (np.array([getattr(g, k) for g in groups]) for k in ("low", "long"))
        pairs = np.array([g.pairs for g in groups])
        if not modes:
            return 0.0
        error = np.sqrt(float(((parts * low) ** 2 / (modes * pairs)).sum()))
        found = float(parts @ long)
        return found if found > float(parts @ low) + CERTAIN * error else 0.0

    def _parts(
        self, image: _Map, *, own: bool
    ) -> tuple[list[tuple[NDArray, NDArray, Mapping[str, object]]], BlockNoise]:
        """Columns, rows, blocks, rings, texture and chess of a map, with errors or their covariance.

        ``own``: the map holds the response of single pixels, white like noise, whose scatter is
        measured by differences of neighbours and counts in the errors.
        """
        ny, nx = self._shape
        single = np.sqrt(image.low)
        good = np.isfinite(image.values)
        filled = np.where(good, image.values, np.float32(0.0))
        measured = good & ~self._filled
        if own:
            steps = _steps(image.values, measured)
            steps -= np.median(steps)
            seen = 1.4826 * float(np.median(np.abs(steps, out=steps))) / np.sqrt(2.0)
            del steps
            single = max(single, seen * np.sqrt(image.ratio))
        sigma = np.sqrt(single**2 + image.long)
        out: list[tuple[NDArray, NDArray, Mapping[str, object]]] = []
        for what, axis, n in (("column", 0, nx), ("row", 1, ny)):
            count = np.maximum(good.sum(axis), 1)
            at = (
                {"x": np.arange(n), "y": -1.0}
                if what == "column"
                else {"x": -1.0, "y": np.arange(n)}
            )
            out.append(
                (
                    filled.sum(axis, dtype=np.float64) / count,
                    sigma / np.sqrt(count),
                    {"what": what, "k": -1.0, **at},
                )
            )
        side = block_side(self._shape)
        rows, columns = ny // side, nx // side
        count = _blocks(good, side).sum((1, 3))
        mean = _blocks(filled, side).sum((1, 3), dtype=np.float64) / np.maximum(count, 1)
        y, x = ((index + 0.5) * side - 0.5 for index in np.indices((rows, columns)))
        noise = block_noise(good, side)
        mean, x, y = (v.ravel()[noise.kept] for v in (mean, x, y))
        told = {"what": "block", "k": -1.0, "x": x, "y": y}
        of_blocks = single**2 * image.wide + image.long
        out.append((mean, of_blocks * noise.covariance, told))
        free = without_steps(without_shape(filled), self._amplifiers)
        # Pixels that are filled in go on smoothly: zeros would mix columns and rows into the rings.
        power = ring_power(free) / max(float(measured.mean()), 1e-30)
        free[~measured] = 0.0
        keep = self._modes > 50
        # The lowest frequencies are those of the light's own shape.
        keep[0] = False
        frequency = (np.arange(RINGS) + 0.5) / (2 * RINGS)
        # The power of a mode of noise is exponential, so that a mean of n has the relative error
        # n^(-1/2); in units of 1e-6.
        out.append(
            (
                1e6 * (power - image.power)[keep],
                1e6
                * np.sqrt(
                    (power**2 + image.power**2 / image.pairs) / np.maximum(self._modes, 1)
                )[keep],
                {"what": "ring", "k": frequency[keep], "x": -1.0, "y": -1.0},
            )
        )
        texture = map_texture(free, measured)
        values, spread = texture.values, texture_noise(free, texture, int(measured.sum()))
        if image.long:
            # The ring next to the slow modes: in boxes, noise that is not white counts too.
            flat = float(image.power[int(np.ceil(2 * RINGS * SLOW))])
            mean, more = slow_texture(image.slow, flat, self._shape, texture, image.pairs)
            spread = more + (spread if spread.ndim == 2 else np.diag(spread**2))
            values = values - mean
        told = {"what": "texture", "k": -1.0, "x": texture.dx, "y": texture.dy}
        out.append((values, spread, told))
        chess, centres = map_chess(filled)
        # Noise of single pixels: that over many, divided by their ratio.
        error = np.sqrt(single**2 / image.ratio * len(chess) / max(good.sum(), 1))
        out.append(
            (chess, np.full(len(chess), error), {"what": "chess", "k": -1.0, "x": centres, "y": -1.0})
        )  # fmt: skip
        return out, noise

    @property
    def _modes(self) -> NDArray[np.int64]:
        """Number of modes of each ring."""
        return ring_modes(self._shape)


@dataclass
class _MapGroup:
    """Sums of noise measures over the pairs of one condition and exposure time."""

    condition: Condition
    time: float
    low: float = 0.0
    wide: float = 0.0
    high: float = 0.0
    long: float = 0.0
    power: FloatArray = field(default_factory=lambda: np.zeros(RINGS))
    slow: FloatArray = field(default_factory=lambda: np.zeros(()))
    pairs: int = 0
    shared: float = 0.0
    level: float = 0.0

    @property
    def weight(self) -> float:
        """Inverse variance of the noise of their mean."""
        return float(self.pairs**2 / max(self.low, 1e-30))


@dataclass
class _Sum:
    """Weighted sum of the maps of several exposure times: 4 bytes a pixel, of large sensors too."""

    image: NDArray[np.float32]
    weight: float


@dataclass
class _Map:
    """A map less one, its noise over many pixels as a pixel's variance (``low``), and by ring.

    ``ratio``: that variance over the one between neighbours.  The brighter-fatter effect smooths
    the response of single pixels as it does their noise, to first order.  ``long``: excess of the
    noise in waves of several blocks.  ``wide``: noise over a block in units of ``low``.  ``slow``:
    power of the noise by mode, of :func:`~bfsensor.diagnose.data.map_texture.slow_power`.
    """

    values: NDArray[np.float32]
    low: float
    power: FloatArray
    ratio: float
    pairs: int
    long: float = 0.0
    wide: float = 1.0
    slow: FloatArray = field(default_factory=lambda: np.zeros(()))

    def over(self, other: _Map) -> _Map:
        """Ratio of two maps, less one."""
        return _Map(
            (self.values - other.values) / (1 + other.values), self.low + other.low,
            self.power + other.power, self.ratio, min(self.pairs, other.pairs),
            self.long + other.long,
            (self.wide * self.low + other.wide * other.low) / max(self.low + other.low, 1e-30),
            self.slow + other.slow,
        )  # fmt: skip


def block_side(shape: tuple[int, int]) -> int:
    """Side of the blocks of a map [pixel]."""
    return int(np.ceil(max(shape) / BLOCKS))


def _weights(groups: list[_MapGroup]) -> FloatArray:
    """Weights of groups in their mean, by inverse variance of their noise; their sum is 1."""
    weights = np.array([g.weight for g in groups])
    return np.asarray(weights / weights.sum())


def _steps(image: NDArray, own: NDArray[np.bool_]) -> NDArray:
    """Differences of neighbours along rows, of those that both have values of their own."""
    return np.asarray(np.diff(image, axis=1)[own[:, 1:] & own[:, :-1]])


def _box_variance(noise: NDArray, own: NDArray[np.bool_], side: int) -> float:
    """Noise over boxes of some side [pixel], as a pixel's variance; 0 without a box."""
    number = _blocks(own, side).sum((1, 3))
    boxes = _blocks(noise, side).sum((1, 3), dtype=np.float64)[number > 0]
    return float((boxes / np.sqrt(number[number > 0])).var()) if len(boxes) else 0.0


def _blocks(image: NDArray, side: int) -> NDArray:
    ny, nx = (n // side for n in image.shape)
    return image[: ny * side, : nx * side].reshape(ny, side, nx, side)


@lru_cache(maxsize=1)
def _ring_bins(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Ring of each mode, RINGS where it is not used: modes of row or column means are not."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    bins = np.minimum((np.hypot(fy, fx) * 2 * RINGS).astype(np.uint8), RINGS)
    bins[0], bins[:, 0] = RINGS, RINGS
    bins.setflags(write=False)
    return bins


@lru_cache(maxsize=1)
def _is_long(shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Mask of the modes longer than LONG blocks, without those of row or column means."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    out = np.hypot(fy, fx) * LONG * block_side(shape) < 1
    out[0], out[:, 0] = False, False
    out.setflags(write=False)
    return out


def long_power(modes: NDArray, shape: tuple[int, int]) -> float:
    """Mean power of a mode longer than :data:`LONG` blocks, from a map's transform.

    Parameters
    ----------
    modes : ndarray, shape (ny, nx // 2 + 1)
        ``scipy.fft.rfft2`` of the map.
    shape : (int, int)
        Shape (ny, nx) of the map.

    Returns
    -------
    power : float
        That of white noise is a pixel's variance; 0 if there is no such mode.

    Examples
    --------
    >>> noise = np.random.default_rng(1).standard_normal((128, 128))
    >>> 0.5 < long_power(rfft2(noise), noise.shape) < 2.0
    True
    """
    own = modes[_is_long(shape)]
    return (
        float((own.real**2 + own.imag**2).mean()) / (shape[0] * shape[1])
        if own.size
        else 0.0
    )


def ring_modes(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Number of modes of each ring of a map of some shape, shape (RINGS,)."""
    return np.bincount(_ring_bins(shape).ravel(), minlength=RINGS)[:RINGS]


def ring_power(image: NDArray) -> FloatArray:
    """Mean power of a mode by ring, shape (RINGS,); that of white noise is a pixel's variance."""
    ny, nx = image.shape
    return spectrum_rings(rfft2(image), (ny, nx))


def spectrum_rings(modes: NDArray, shape: tuple[int, int]) -> FloatArray:
    """Mean power of a mode by ring, from a map's transform ``modes`` (``rfft2``)."""
    bins = _ring_bins(shape).ravel()
    power = modes.real**2
    power += modes.imag**2
    count = np.bincount(bins, minlength=RINGS + 1)[:RINGS]
    total = np.bincount(bins, power.ravel(), minlength=RINGS + 1)[:RINGS]
    return np.asarray(total / (shape[0] * shape[1]) / np.maximum(count, 1))


def map_chess(image: NDArray) -> tuple[FloatArray, FloatArray]:
    """Amplitude of a chess pattern in vertical strips: half of even less odd pixels (row + column).

    Means of columns and rows do not show it, nor do rings, which end at half a cycle per pixel.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Map.

    Returns
    -------
    values : ndarray, shape (strips,)
        Half of the mean difference, in units of the map.
    x : ndarray, shape (strips,)
        Middle of each strip [pixel].

    Examples
    --------
    >>> values, x = map_chess(np.indices((32, 32)).sum(0) % 2)
    >>> float(values.min()), float(values.max()), x[:3].tolist()
    (-0.5, -0.5, [0.5, 2.5, 4.5])
    """
    ny, nx = image.shape
    side = block_side((ny, nx))
    columns = image[::2].sum(0, dtype=np.float64) - image[1::2].sum(0, dtype=np.float64)
    columns[1::2] *= -1.0
    kept = columns[: nx // side * side].reshape(-1, side)
    centres = np.arange(len(kept), dtype=np.float64) * side + 0.5 * (side - 1)
    return np.asarray(kept.mean(1) / ny, float), centres
