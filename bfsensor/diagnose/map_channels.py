"""Maps: what flats show against position, free of light's smooth shape in the prediction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.channels import Channel
from bfsensor.diagnose.conditions import Axes, Condition

BLOCKS = 16
"""Blocks of a map along its longer side."""

RINGS = 24
"""Bins of the spatial frequency, from 0 to half a cycle a pixel."""

ORDER = 4
"""Order of the smooth shape of the light in x and in y that rings are freed of."""

NEAREST, FARTHEST = 4, 40
"""Distances in x [pixel] at which a map is held against itself: nearer ones share boundaries."""

LOW = 8
"""Side of the boxes [pixel] that tell noise over many pixels."""


class MapShare(NamedTuple):
    """Part of a map that flats of one condition and exposure time make up.

    Attributes
    ----------
    weight : float
        Of the flats in the map; below 0 where the map is divided by them.
    condition : Condition
        Of the light.
    seconds, level : float
        Exposure time [s] and mean level [ADU].
    """

    weight: float
    condition: Condition
    seconds: float
    level: float


class MapChannels:
    """Adds up flats on the sensor, each over its amplifier's mean.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    """

    def __init__(self, shape: tuple[int, int], fold: str = "fit") -> None:
        self._shape, self.fold = shape, fold
        self._groups: dict[tuple, _Group] = {}
        self._conditions: dict[tuple[str, ...], Condition] = {}

    def add_pair(
        self,
        condition: Condition,
        time: float,
        first: NDArray[np.float64],
        second: NDArray[np.float64],
        shared: float = 0.0,
        level: float = 0.0,
    ) -> None:
        """Add a pair of flats, each over its amplifiers' means.

        Parameters
        ----------
        condition : Condition
            Of the light.
        time : float
            Exposure time [s].
        first, second : ndarray, shape of the sensor
            nan where no amplifier reads or a pixel is bad.
        shared : float
            Noise that all flats share, that of the mean bias, over the mean.
        level : float
            Mean level [ADU].
        """
        self._conditions[condition.key] = condition
        group = self._groups.setdefault(
            (condition.key, time),
            _Group(np.zeros(self._shape, np.float32), np.zeros(self._shape, np.uint16)),
        )
        for image in (first, second):
            good = np.isfinite(image)
            group.total[good] += image[good]
            group.count[good] += 1
        # Charges repel: noise is smaller over few pixels than over many.
        noise = np.nan_to_num((first - second) / np.sqrt(2.0))
        side = LOW
        ny, nx = (n // side * side for n in self._shape)
        low = (
            noise[:ny, :nx].reshape(ny // side, side, nx // side, side).mean((1, 3)) * side
        )
        group.low += float(low.var())
        group.high += float(np.diff(noise, axis=1).var()) / 2
        group.power += ring_power(noise)
        group.pairs += 1
        group.shared += shared
        group.level += level

    def channels(self) -> list[Channel]:
        """Columns, rows, blocks and rings of the map of all light, and of what differs.

        'all': all flats of the commonest condition together, weighted by their light; 'short':
        its short exposures over its long ones; other conditions over the commonest.
        """
        if not self._groups:
            return []
        maps: dict[str, tuple[_Map, Condition]] = {}
        made: dict[tuple, _Map] = {}
        for name, (key, times, below) in self._plan().items():
            for which in filter(None, ((key, times), below)):
                if which not in made:
                    made[which] = self._average(which[0], list(which[1]))
            image = made[key, times]
            maps[name] = (
                image if below is None else image.over(made[below]), self._conditions[key]
            )  # fmt: skip
        values, blocks, axes = [], [], Axes()
        for name, (image, where) in maps.items():
            for v, e, columns in self._parts(image, own=name == "all"):
                values.append(v)
                blocks.extend(np.square(e)[:, None, None])
                axes.add(len(v), where, map=name, **columns)
        return [Channel("flat_map", np.concatenate(values), tuple(blocks), axes.columns(), "",
                        self.fold)]  # fmt: skip

    def _plan(self) -> dict[str, tuple[tuple[str, ...], tuple[float, ...], tuple | None]]:
        """Of each map: condition, exposure times, and the two of what it is divided by."""
        times: dict[tuple[str, ...], list[float]] = {}
        for key, time in self._groups:
            times.setdefault(key, []).append(time)
        common = max(times, key=lambda k: sum(self._groups[k, t].pairs for t in times[k]))
        ordered = tuple(sorted(times[common]))
        out: dict[str, tuple[tuple[str, ...], tuple[float, ...], tuple | None]] = {
            "all": (common, ordered, None)
        }
        split = tuple(t for t in ordered if t < 0.25 * ordered[-1])
        if split and len(split) < len(ordered):
            long = tuple(t for t in ordered if t not in split)
            out["short"] = (common, split, (common, long))
        for other, members in times.items():
            if other != common:
                out["/".join(other)] = (other, tuple(members), (common, ordered))
        return out

    def shares(self) -> dict[str, tuple[MapShare, ...]]:
        """Of which flats each map is made."""
        out = {}
        for name, (key, times, below) in (self._plan() if self._groups else {}).items():
            parts = []
            for (k, members), sign in (((key, times), 1.0), (below or ((), ()), -1.0)):
                for t, w in zip(members, self._weights(k, members), strict=True):
                    group = self._groups[k, t]
                    parts.append(
                        MapShare(
                            sign * float(w),
                            self._conditions[k],
                            t,
                            group.level / group.pairs,
                        )
                    )
            out[name] = tuple(parts)
        return out

    def _weights(self, key: tuple[str, ...], times: Sequence[float]) -> NDArray[np.float64]:
        """Of groups in their mean, by inverse variance of their noise."""
        groups = [self._groups[key, t] for t in times]
        weights = np.array([g.pairs**2 / max(g.low, 1e-30) for g in groups])
        return np.asarray(weights / weights.sum())

    def _average(self, key: tuple[str, ...], times: list[float]) -> _Map:
        """Map of several exposure times, by inverse variance of their noise."""
        groups = [self._groups[key, t] for t in times]
        weights = self._weights(key, times)
        with np.errstate(invalid="ignore", divide="ignore"):
            image = sum(w * g.total / g.count for w, g in zip(weights, groups, strict=True))
        # The mean bias is the same in all; of it differences of pairs know nothing.
        common = (
            sum(w * g.shared / g.pairs for w, g in zip(weights, groups, strict=True)) ** 2
        )
        # A mean of 2 n flats, whose single noise each pair tells.
        low = sum(
            w**2 * g.low / (2 * g.pairs**2) for w, g in zip(weights, groups, strict=True)
        )
        power = sum(
            w**2 * g.power / (2 * g.pairs**2) for w, g in zip(weights, groups, strict=True)
        )
        pairs = sum(g.pairs for g in groups)
        ratio = sum(g.low / max(g.high, 1e-30) * g.pairs for g in groups) / pairs
        return _Map(
            np.asarray(image),
            float(low) + common,
            np.asarray(power) + common,
            float(ratio),
            pairs,
        )

    def _parts(
        self, image: _Map, *, own: bool
    ) -> list[tuple[NDArray, NDArray, Mapping[str, object]]]:
        """Columns, rows, blocks and rings of a map with errors.

        ``own``: the map holds the pixels' own response, of which its neighbours tell.
        """
        ny, nx = self._shape
        sigma = np.sqrt(image.low)
        if own:
            steps = np.diff(image.values, axis=1).ravel()
            seen = (
                1.4826
                * float(np.nanmedian(np.abs(steps - np.nanmedian(steps))))
                / np.sqrt(2.0)
            )
            sigma = max(sigma, seen * np.sqrt(image.ratio))
        good = np.isfinite(image.values)
        filled = np.where(good, image.values, 1.0) - 1.0
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
                    filled.sum(axis) / count,
                    sigma / np.sqrt(count),
                    {"what": what, "k": -1.0, **at},
                )
            )
        side = int(np.ceil(max(ny, nx) / BLOCKS))
        rows, columns = ny // side, nx // side
        count = _blocks(good.astype(float), side).sum((1, 3))
        mean = _blocks(filled, side).sum((1, 3)) / np.maximum(count, 1)
        y, x = ((index + 0.5) * side - 0.5 for index in np.indices((rows, columns)))
        full = count.ravel() > side * side // 2
        out.append(
            (
                mean.ravel()[full],
                (sigma / np.sqrt(np.maximum(count, 1))).ravel()[full],
                {"what": "block", "k": -1.0, "x": x.ravel()[full], "y": y.ravel()[full]},
            )
        )
        power = ring_power(_without_shape(filled))
        keep = self._modes > 50
        frequency = (np.arange(RINGS) + 0.5) / (2 * RINGS)
        # Of n modes, each exponential; in parts per million of a pixel.
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
        texture, dx, dy = map_texture(_without_shape(filled))
        spread = 1e6 * float(filled.var()) / np.sqrt(max(good.sum(), 1))
        out.append(
            (texture, np.full(len(texture), spread), {"what": "texture", "k": -1.0, "x": dx, "y": dy})
        )  # fmt: skip
        # Single pixels' noise is not evened out as that over many is.
        single = np.sqrt(sigma**2 / image.ratio)
        chess, centres = map_chess(filled)
        count = np.maximum(map_chess(good.astype(float), signed=False)[0] * good.size, 1)
        out.append(
            (
                chess,
                single / np.sqrt(count / len(chess)),
                {"what": "chess", "k": -1.0, "x": centres, "y": -1.0},
            )
        )
        return out

    @property
    def _modes(self) -> NDArray[np.int64]:
        """Modes of each ring."""
        return ring_modes(self._shape)


@dataclass
class _Group:
    """Sums over the pairs of one condition and exposure time: 6 bytes a pixel, of large sensors too."""

    total: NDArray[np.float32]
    count: NDArray[np.uint16]
    low: float = 0.0
    high: float = 0.0
    power: NDArray[np.float64] = field(default_factory=lambda: np.zeros(RINGS))
    pairs: int = 0
    shared: float = 0.0
    level: float = 0.0


@dataclass
class _Map:
    """A map, its noise over many pixels as a pixel's variance, and by ring.

    ``ratio``: of that variance to the one between neighbours; the effect evens the response of
    single pixels out as it does their noise, to first order.
    """

    values: NDArray[np.float64]
    low: float
    power: NDArray[np.float64]
    ratio: float
    pairs: int

    def over(self, other: _Map) -> _Map:
        """Ratio of two maps."""
        return _Map(
            self.values / other.values, self.low + other.low, self.power + other.power,
            self.ratio, min(self.pairs, other.pairs),
        )  # fmt: skip


def _blocks(image: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    ny, nx = (n // side for n in image.shape)
    return image[: ny * side, : nx * side].reshape(ny, side, nx, side)


def _ring_bins(shape: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Ring of each mode, and which are used: rows' and columns' own are not."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    bins = np.minimum((np.hypot(fy, fx) * 2 * RINGS).astype(int), RINGS)
    return bins, (np.abs(fy) > 0) & (fx > 0) & (bins < RINGS)


def ring_modes(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Modes of each ring of a map of that shape."""
    bins, use = _ring_bins(shape)
    return np.bincount(bins[use], minlength=RINGS)[:RINGS]


def ring_power(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean power of a mode by ring; that of white noise is a pixel's variance."""
    bins, use = _ring_bins(image.shape)
    power = np.abs(np.fft.rfft2(image)) ** 2 / image.size
    count = np.bincount(bins[use], minlength=RINGS)[:RINGS]
    return np.bincount(bins[use], power[use], minlength=RINGS)[:RINGS] / np.maximum(
        count, 1
    )


def map_texture(
    image: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Hold a map against itself: mean products [1e-6] of pixels (dx, dy) apart, with dx and dy.

    In the same row and from one row to the next: patterns that go with the time of readout
    keep step along a row and start the next one with another phase.  Means of columns and of
    rows are taken off: they are told by themselves.

    Examples
    --------
    >>> wave = np.sin(2 * np.pi * np.arange(64 * 100) / 8.1).reshape(64, 100)
    >>> values, dx, dy = map_texture(wave)
    >>> [float(values[(dx == n) & (dy == 0)][0].round(-5)) for n in (4, 8)]
    [-500000.0, 500000.0]
    """
    ny, nx = image.shape
    image = image - image.mean(0) - image.mean(1)[:, None] + image.mean()
    reach = min(FARTHEST, nx // 2)
    spectrum = np.fft.rfft(image, 2 * nx, axis=1)
    same = np.fft.irfft((spectrum.real**2 + spectrum.imag**2).sum(0), 2 * nx)
    following = np.fft.irfft((spectrum[:-1].conj() * spectrum[1:]).sum(0), 2 * nx)
    near, both = np.arange(NEAREST, reach + 1), np.arange(-reach, reach + 1)
    both = both[np.abs(both) >= NEAREST]
    values = [
        same[near] / (ny * (nx - near)),
        following[both] / ((ny - 1) * (nx - np.abs(both))),
    ]
    dy = np.repeat([0.0, 1.0], [len(near), len(both)])
    return 1e6 * np.concatenate(values), np.concatenate([near, both]).astype(float), dy


def map_chess(
    image: NDArray[np.float64], *, signed: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Half of the difference of even and odd pixels (row plus column), in strips, and their x.

    Columns and rows do not show it, nor do rings, which end at half a cycle a pixel.
    """
    ny, nx = image.shape
    side = int(np.ceil(max(ny, nx) / BLOCKS))
    sign = 1.0 - 2.0 * (np.indices(image.shape).sum(0) % 2)
    columns = ((sign if signed else 1.0) * image).mean(0)[: nx // side * side]
    centres = (np.arange(nx // side) + 0.5) * side - 0.5
    return columns.reshape(-1, side).mean(1), centres


def _without_shape(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Take a polynomial of order :data:`ORDER` in x and y off."""
    ny, nx = image.shape
    v, u = np.linspace(-1, 1, ny), np.linspace(-1, 1, nx)
    left_y = np.polynomial.legendre.legvander(v, ORDER)
    left_x = np.polynomial.legendre.legvander(u, ORDER)
    q_y, q_x = np.linalg.qr(left_y)[0], np.linalg.qr(left_x)[0]
    return np.asarray(image - q_y @ (q_y.T @ image @ q_x) @ q_x.T)
