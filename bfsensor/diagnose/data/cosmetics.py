"""Defects of a sensor and dust: found in flats and darks, and repaired in every frame.

A column of low response, a hot pixel or a dust spot is no missing physics, yet it stands out of
maps and darks by hundreds of standard deviations.  They are found robustly before anything is
measured, named in the report, and repaired: columns and dust spots are divided by their response; a dead
column and a hot pixel take the mean of the nearest good pixels of their row.  Covariances of flats
leave repaired columns and pixels out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from bfsensor.diagnose.data.exposure_info import (
    ExposureInfo,
    Frame,
    Source,
    condition_of,
    overscan_level,
)
from bfsensor.diagnose.data.flat_defects import (
    LEAST,
    QUIET,
    WIDEST,
    BadColumns,
    bad_columns,
    dust_spots,
    hot_pixels,
    low_pixels,
    smooth_light,
)
from bfsensor.typing import FloatArray

MOST_READ = 8
"""Largest number of flats, and of darks, that are read to find defects.  Chosen: a column of 256
pixels is then known to 1e-4 of its signal at 6e4 e-; twice as many cost as many readings more."""

BRIGHT = 0.6
"""Part of the most light of a flat that flats to find defects in are nearest to.  Chosen: below full
well, and bright enough that Poisson noise is below the pixels' own scatter; at 0.3, noise is 1.4
times as large."""

DEAD = -0.5
"""Response less one below which pixels are not divided by it but filled from their neighbours.
Chosen: their noise would be more than doubled; with -0.25, columns that lack 25 to 50 % are filled."""


BRIDGED = 1 / 3
"""Part of that number of columns on either side that maps do not use.  Chosen: at the rest a power of
the distance is fitted; with 2/3, defects of a few columns take a fifth of an amplifier of 64."""

SHIFTED = 200.0
"""Square of the number of columns that the edges of a column without any charge shift visibly.
Derived: such a column changes the areas of the next one's pixels by 2e-7 per electron in LSST's
sensors (sum over a column of a_ij, Lage et al. 2017), 2 % at 1e5 e-, and of one r columns away by
about r^-2 times that, which falls below 1e-4, an error of a column of 256 pixels, at r^2 = 200."""


ONE_SIDED = 48
"""Columns from whose slope bad ones at a border of amplifiers go on.

Derived: ten columns that go on from 16 give a block of 16 x 16 pixels 2.4 times the noise of one
without, from 48 1.3 times, and miss a fall of the light by .3 % towards the corners of 256 pixels by a
third of a block's noise; at twice the value by more than all of it."""


class Cosmetic(NamedTuple):
    """A defect of the sensor, as report.json lists it.

    Attributes
    ----------
    kind : str
        'bad_column', 'hot_pixel', 'dust', 'vignetting', or a nuisance of the bench: see
        :mod:`bfsensor.diagnose.data.bench_nuisances`.
    amp : int
        Index of the amplifier, from 0; -1 where all are meant.
    x, y : (int, int)
        First column and row on the sensor, and the ones after the last.
    size : float
        Response less one where it differs most, or charge per time.
    unit : str
        Unit of the size.
    z : float
        Significance [standard deviations].
    """

    kind: str
    amp: int
    x: tuple[int, int]
    y: tuple[int, int]
    size: float
    unit: str
    z: float

    def to_report(self) -> dict[str, Any]:
        """Make the entry of report.json; amplifiers are counted from 1."""
        return {
            "kind": self.kind, "x": list(self.x), "y": list(self.y),
            "amps": [self.amp + 1] if self.amp >= 0 else [],
            "size": float(f"{self.size:.4g}"), "unit": self.unit, "z": round(self.z, 1),
        }  # fmt: skip


class Repair(NamedTuple):
    """Defects of one amplifier, in readout order.

    Attributes
    ----------
    response : ndarray, shape (rows, columns)
        Response of bad columns that their pixels are divided by, 1 where it is like the others'.
    shade : ndarray, shape (rows, columns)
        Response of each pixel by dust, 1 where there is none.
    filled : ndarray of bool, shape (rows, columns)
        Pixels that take the mean of the nearest good ones of their row.
    near : list of (int, int)
        First column, and the one after the last, of bad columns with those whose edges they shift.
    hot : ndarray of bool, shape (rows, columns)
        Hot pixels: filled, and left out of means, as their charge is dark current.
    zero : float
        Level of pixels without light, less that of the serial overscan [ADU].
    """

    response: FloatArray
    shade: FloatArray
    filled: NDArray[np.bool_]
    near: list[tuple[int, int]]
    hot: NDArray[np.bool_]
    zero: float = 0.0

    @classmethod
    def none(cls, shape: tuple[int, ...], zero: float = 0.0) -> Repair:
        """Nothing to repair in an image."""
        filled, hot = np.zeros((2, *shape), bool)
        return cls(np.ones(shape), np.ones(shape), filled, [], hot, zero)

    def of_image(self, image: FloatArray, zero: float) -> FloatArray:
        """Repair an image whose pixels without light have the value ``zero``."""
        return interpolated(
            zero + (image - zero) / (self.response * self.shade), self.filled
        )

    def made(self, frame: Frame) -> RepairedFrame:
        """Repair a frame; values are rounded to codes again, as those of all other pixels are."""
        zero = overscan_level(frame) + self.zero
        image = self.of_image(frame.image.astype(np.float64), zero)
        repaired = self.filled | (self.response != 1.0)
        changed = repaired | (self.shade != 1.0)
        for start, stop in self.near:
            repaired[:, start:stop] = True
        return RepairedFrame(
            frame.name, frame.pixels, frame.mask | repaired,
            np.where(changed, np.rint(image), frame.image).astype(np.float32),
            frame.prescan, frame.serial_overscan, frame.parallel_overscan,
            frame.flip_x, frame.flip_y, frame.origin, repaired & ~frame.mask, self.filled,
            tuple(self.near), changed, frame.image, repaired & ~frame.mask & ~self.hot,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RepairedFrame:
    """A :class:`~bfsensor.diagnose.data.exposure_info.Frame` with defects repaired in its image."""

    name: str
    pixels: NDArray[np.float32]
    mask: NDArray[np.bool_]
    image: NDArray[np.float32]
    prescan: NDArray[np.float32]
    serial_overscan: NDArray[np.float32]
    parallel_overscan: NDArray[np.float32]
    flip_x: bool
    flip_y: bool
    origin: tuple[int, int] | None
    repaired: NDArray[np.bool_]
    """Pixels of the mask whose values are usable in means, although not in covariances."""
    filled: NDArray[np.bool_]
    """Pixels of the mask whose values are replaced by their neighbours'."""
    near: tuple[tuple[int, int], ...]
    """Columns whose edges are shifted by bad columns between them."""
    recoded: NDArray[np.bool_] | None = None
    """Pixels whose values were divided and rounded, which are not the converter's codes; None: none."""
    recorded: NDArray[np.float32] | None = None
    """Image before the repair [ADU]."""
    summed: NDArray[np.bool_] | None = None
    """Repaired pixels whose recorded values count in the mean of a flat: all but hot ones."""


def reach_of(size: float) -> float:
    """Number of columns on either side whose edges a column of relative response 1 + size shifts."""
    return float(np.sqrt(abs(size) * SHIFTED))


def interpolated(image: FloatArray, bad: NDArray[np.bool_]) -> FloatArray:
    """Image whose bad pixels take the value between the nearest good ones of their row.

    Examples
    --------
    >>> interpolated(np.array([[1.0, 9.0, 3.0]]), np.array([[False, True, False]]))
    array([[1., 2., 3.]])
    """
    out = np.array(image)
    columns = np.arange(image.shape[1])
    for row in np.flatnonzero(bad.any(1) & ~bad.all(1)):
        own = bad[row]
        out[row, own] = np.interp(columns[own], columns[~own], image[row, ~own])
    return out


def bridged(image: FloatArray, frame: Frame) -> FloatArray:
    """Image whose bad columns, and those beside them, go on straight from the columns around.

    A bad column holds less charge and repels less, so that it collects light that falls on its
    neighbours, more of it at higher levels.  Neither what it lacks nor what they lack belongs in maps of
    the response.
    """
    return _bridge(image, frame.near if isinstance(frame, RepairedFrame) else ())


def _bridge(
    image: FloatArray, ranges: Sequence[tuple[int, int]], *, even: bool = False
) -> FloatArray:
    """Image whose columns in the ranges go on straight from those around them.

    In an ``even`` image, whose light was taken off, they do not slope from one side alone: what slopes
    there, such as the rim of a dust spot, ends.
    """
    if not ranges:
        return image
    out = np.array(image)
    columns = np.arange(image.shape[1])
    clear = ~np.any([(columns >= a) & (columns < b) for a, b in ranges], axis=0)
    # A row's own light, as at a rim where the field rolls off, is not averaged with its neighbours'.
    rows = np.median(image[:, clear], axis=1) if clear.any() else np.zeros(len(image))
    for start, stop in ranges:
        low, high = columns[clear & (columns < start)], columns[clear & (columns >= stop)]
        # At an amplifier's border the light's slope goes on from one side.
        both = len(low) > 0 and len(high) > 0
        each = WIDEST if both or even else ONE_SIDED
        near = np.concatenate([low[-each:], high[:each]])
        if len(near) < 2:
            continue
        middle = near.mean()
        away = near - middle
        # Over some rows, so that their noise is hardly seen in the bridge.
        lines = image[:, near] - rows[:, None]
        lines = uniform_filter1d(lines, QUIET, axis=0, mode="nearest") + rows[:, None]
        slope = lines @ away / (away @ away) * (both or not even)
        out[:, start:stop] = lines.mean(1)[:, None] + np.outer(
            slope, columns[start:stop] - middle
        )
    return out


def repaired_of(frame: Frame) -> NDArray[np.bool_]:
    """Pixels of a frame with values that are usable in means, although they are no codes."""
    if isinstance(frame, RepairedFrame):
        return frame.repaired
    return np.zeros(frame.image.shape, bool)


def recoded_of(frame: Frame) -> NDArray[np.bool_]:
    """Pixels of a frame whose values are not those that the converter gave."""
    if isinstance(frame, RepairedFrame) and frame.recoded is not None:
        return frame.recoded
    return np.zeros(frame.image.shape, bool)


def with_defects(frame: Frame) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Recorded image of a frame [ADU], and the masked pixels that count in its mean all the same.

    A column of low response holds less charge than its neighbours and repels less, so that it collects
    light that falls on them, more of it at higher levels.  Means of flats are in proportion to the light
    only if they include the column.  One at the border of an amplifier also collects what falls on the
    next one: it is left out with all columns beside it, on both sides.
    """
    if isinstance(frame, RepairedFrame) and frame.recorded is not None:
        assert frame.summed is not None
        summed, width = frame.summed.copy(), frame.summed.shape[1]
        for start, stop in frame.near:
            if start == 0 or stop == width:
                summed[:, start:stop] = False
        return frame.recorded.astype(np.float64), summed
    return frame.image.astype(np.float64), np.zeros(frame.image.shape, bool)


class RepairedSource:
    """A source whose frames have their defects repaired."""

    def __init__(self, source: Source, repairs: Sequence[Repair]) -> None:
        self._source, self._repairs = source, tuple(repairs)
        self.exposures, self.shape = source.exposures, source.shape
        self.lamp_error = source.lamp_error

    def read(self, exposure: Any) -> list[RepairedFrame]:
        """Frames of an exposure, repaired."""
        frames = self._source.read(exposure)
        return [r.made(f) for f, r in zip(frames, self._repairs, strict=True)]


def find_cosmetics(
    source: Source, exposures: Sequence[ExposureInfo]
) -> tuple[Source, tuple[Cosmetic, ...]]:
    """Find columns of low response, hot pixels and dust, and a source without them.

    Parameters
    ----------
    source : Source
        The campaign.
    exposures : sequence of ExposureInfo
        Its exposures, less those with charge of earlier ones.

    Returns
    -------
    source : Source
        The given one where there are no defects.
    found : tuple of Cosmetic
    """
    flats, darks = _bright(exposures), _long(exposures)
    if not flats and not darks:
        return source, ()
    layout = source.read((flats or darks)[0])
    found: list[Cosmetic] = []
    zeros = _zeros(source, exposures, len(layout))
    repairs = [Repair.none(f.image.shape, z) for f, z in zip(layout, zeros, strict=True)]
    # Hot pixels first: in flats they look like light that dust cannot have made.
    for amp, (rate, deviate) in enumerate(_faintest_darks(source, darks)):
        for y, x in np.argwhere(hot_pixels(deviate)).tolist():
            place = _place(layout[amp], range(x, x + 1), range(y, y + 1))
            found.append(
                Cosmetic(
                    "hot_pixel",
                    amp,
                    *place,
                    float(rate[y, x]),
                    "adu/s",
                    float(deviate[y, x]),
                )
            )
            repairs[amp].filled[y, x] = repairs[amp].hot[y, x] = True
    images = _mean_flats(source, flats, zeros)
    if images:
        found += _repair_response(repairs, layout, images, source.shape)
    changed = any(
        r.filled.any() or (r.response != 1.0).any() or (r.shade != 1.0).any()
        for r in repairs
    )
    return (RepairedSource(source, repairs) if changed else source), tuple(found)


def _repair_response(
    repairs: Sequence[Repair],
    layout: Sequence[Frame],
    images: Sequence[FloatArray],
    shape: tuple[int, int],
) -> list[Cosmetic]:
    """Find what lacks response in mean flats, enter it in the repairs, and list it."""
    found: list[Cosmetic] = []
    whole, owner = np.zeros(shape), np.full(shape, -1)
    good = []
    for amp, (repair, frame, image) in enumerate(zip(repairs, layout, images, strict=True)):
        low = low_pixels(image)
        repair.filled[low] = True
        found += [_low_pixel(frame, amp, image, *at) for at in np.argwhere(low).tolist()]
        good.append(repair.of_image(image, -1.0))
        _on_sensor(whole, frame)[...] = good[-1]
        _on_sensor(owner, frame)[...] = amp
    shade, change = np.ones(shape), np.zeros(shape)
    # Dust beside a column hides that the column stands alone, a column disturbs dust's shape, and
    # shallow dust pulls the light down: each is sought again in the image without the others.
    for _ in range(2):
        light, steps = smooth_light((1 + whole) / (1 + change) - 1, owner, shade != 1.0)
        even = np.where(owner < 0, 0.0, whole - light - steps)
        columns = []
        change[:] = 0.0
        for amp, (frame, image) in enumerate(zip(layout, good, strict=True)):
            here = (1 + image) / _on_sensor(shade, frame) - 1
            for one in bad_columns(here, _on_sensor(light, frame)):
                columns.append((amp, one))
                own = _on_sensor(change, frame)
                own[:, one.columns.start : one.columns.stop] = one.change
        # Pixels between bad columns lose charge to them and look like shallow dust.
        for frame, near in zip(layout, _near(layout, columns), strict=True):
            view = _on_sensor(even, frame)
            own = (1 + view) / (1 + _on_sensor(change, frame)) - 1
            view[...] = _bridge(own, near, even=True)
        dust = dust_spots(even)
        shade[:] = 1.0
        for rows_of, columns_of, part, _ in dust:
            shade[np.ix_(rows_of, columns_of)] *= part
    corners = light[[0, 0, -1, -1], [0, -1, 0, -1]]
    outside, middle = (
        owner[[0, 0, -1, -1], [0, -1, 0, -1]],
        light[shape[0] // 2, shape[1] // 2],
    )
    # Corners darker than the middle: a slope of the light has one brighter and one darker.
    fall = float(corners.mean() - middle)
    if (outside >= 0).all() and -fall > LEAST:
        noise = float(np.std(even[owner >= 0]) / np.sqrt(even.size))
        place = (0, shape[1]), (0, shape[0])
        found.append(
            Cosmetic("vignetting", -1, *place, fall, "of the signal", -fall / noise)
        )
    for amp, one in columns:
        worst = float(one.change.flat[np.abs(one.change).argmax()])
        place = _place(layout[amp], one.columns, one.rows)
        found.append(Cosmetic("bad_column", amp, *place, worst, "of the signal", one.z))
    for repair, near in zip(repairs, _near(layout, columns), strict=True):
        repair.near.extend(near)
    for repair, frame in zip(repairs, layout, strict=True):
        own = _on_sensor(change, frame)
        repair.filled[own < DEAD] = True
        repair.response[:] = np.where(own < DEAD, 1.0, 1.0 + own)
        repair.shade[:] = _on_sensor(shade, frame)
    for rows_of, columns_of, part, z in dust:
        middle = owner[rows_of[len(rows_of) // 2], columns_of[len(columns_of) // 2]]
        place = (columns_of.start, columns_of.stop), (rows_of.start, rows_of.stop)
        size = float(part.min()) - 1.0
        found.append(Cosmetic("dust", int(middle), *place, size, "of the signal", z))
    return found


def _near(
    layout: Sequence[Frame], columns: Sequence[tuple[int, BadColumns]]
) -> list[list[tuple[int, int]]]:
    """Columns of each amplifier, in readout order, that are bad or whose edges bad ones shift."""
    out: list[list[tuple[int, int]]] = [[] for _ in layout]
    for amp, one in columns:
        worst = float(np.abs(one.change).max())
        (start, stop), _ = _place(layout[amp], one.columns, one.rows)
        reach = int(np.ceil(BRIDGED * reach_of(worst)))
        # Beyond a border of amplifiers the neighbour's columns are shifted, too.
        for near, frame in zip(out, layout, strict=True):
            if frame is layout[amp] or _faces(frame, layout[amp]):
                near.extend(_columns_of(frame, start - reach, stop + reach))
    return out


def _faces(frame: Frame, other: Frame) -> bool:
    """Whether two amplifiers are different ones that read the same rows."""
    y, z = (frame.origin or (0, 0))[1], (other.origin or (0, 0))[1]
    apart = y >= z + other.image.shape[0] or z >= y + frame.image.shape[0]
    return frame is not other and not apart


def _columns_of(frame: Frame, start: int, stop: int) -> list[tuple[int, int]]:
    """Columns of an amplifier in readout order from columns of the sensor; none if it has none."""
    x, size = (frame.origin or (0, 0))[0], frame.image.shape[1]
    low, high = max(start - x, 0), min(stop - x, size)
    if low >= high:
        return []
    return [(size - high, size - low) if frame.flip_x else (low, high)]


def _on_sensor(image: NDArray[Any], frame: Frame) -> NDArray[Any]:
    """View of an amplifier's part of an image of the sensor, in readout order."""
    (x, y), (rows, columns) = frame.origin or (0, 0), frame.image.shape
    view = image[y : y + rows, x : x + columns]
    return view[:: -1 if frame.flip_y else 1, :: -1 if frame.flip_x else 1]


def _low_pixel(frame: Frame, amp: int, image: FloatArray, y: int, x: int) -> Cosmetic:
    """List a pixel of low response, as a column of one row."""
    near = image[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
    middle = float(np.median(near))
    scatter = 1.4826 * float(np.median(np.abs(near - middle)))
    size = float(image[y, x]) - middle
    place = _place(frame, range(x, x + 1), range(y, y + 1))
    return Cosmetic(
        "bad_column", amp, *place, size, "of the signal", abs(size) / max(scatter, 1e-12)
    )


def _bright(exposures: Sequence[ExposureInfo]) -> list[ExposureInfo]:
    """Flats of the commonest condition, nearest to BRIGHT of its longest exposure time."""
    flats = [e for e in exposures if e.kind == "flat" and e.exposure_time]
    if not flats:
        return []
    conditions = [condition_of(e) for e in flats]
    usual = max(dict.fromkeys(conditions), key=conditions.count)
    own = [e for e, c in zip(flats, conditions, strict=True) if c == usual]
    wanted = BRIGHT * max(e.exposure_time or 0.0 for e in own)
    return sorted(own, key=lambda e: abs((e.exposure_time or 0.0) - wanted))[:MOST_READ]


def _long(exposures: Sequence[ExposureInfo]) -> list[ExposureInfo]:
    """The longest darks; none unless at least QUIET, so that particles differ from defects."""
    darks = [e for e in exposures if e.kind == "dark" and e.exposure_time]
    longest = max((e.exposure_time or 0.0 for e in darks), default=0.0)
    own = [e for e in darks if e.exposure_time == longest]
    return own[:MOST_READ] if len(own) >= QUIET else []


def _zeros(source: Source, exposures: Sequence[ExposureInfo], count: int) -> list[float]:
    """Level of a bias by amplifier, less that of its overscan [ADU]; 0 without any bias."""
    bias = next((e for e in exposures if e.kind == "bias"), None)
    if bias is None:
        return [0.0] * count
    return [float(np.median(_signal(f))) for f in source.read(bias)]


def _mean_flats(
    source: Source, flats: Sequence[ExposureInfo], zeros: Sequence[float]
) -> list[FloatArray]:
    """Mean relative response of each amplifier's pixels, less one."""
    total: list[FloatArray] = []
    for exposure in flats:
        for n, frame in enumerate(source.read(exposure)):
            signal = _signal(frame) - zeros[n]
            level = float(np.median(signal))
            if len(total) <= n:
                total.append(np.zeros(signal.shape))
            total[n] += (signal / level - 1.0) / len(flats) if level > 0 else 0.0
    return total


def _faintest_darks(
    source: Source, darks: Sequence[ExposureInfo]
) -> list[tuple[FloatArray, FloatArray]]:
    """Each pixel's smallest rate [ADU/s] and deviate of all darks; no particle is in all of them."""
    out: list[tuple[FloatArray, FloatArray]] = []
    for exposure in darks:
        for n, frame in enumerate(source.read(exposure)):
            signal = _signal(frame)
            signal = signal - np.median(signal)
            deviate = signal / max(1.4826 * float(np.median(np.abs(signal))), 0.3)
            rate = signal / (exposure.exposure_time or 1.0)
            if len(out) <= n:
                out.append((rate, deviate))
            else:
                out[n] = np.minimum(out[n][0], rate), np.minimum(out[n][1], deviate)
    return out


def _signal(frame: Frame) -> FloatArray:
    """Image less the overscan's level [ADU]."""
    return frame.image.astype(np.float64) - overscan_level(frame)


def _place(
    frame: Frame, columns: range, rows: range
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Columns and rows on the sensor, ends excluded, of some in readout order."""
    ends = []
    for own, start, size, flip in zip(
        (columns, rows), frame.origin or (0, 0), frame.image.shape[::-1],
        (frame.flip_x, frame.flip_y), strict=True,
    ):  # fmt: skip
        low, high = (size - own.stop, size - own.start) if flip else (own.start, own.stop)
        ends.append((start + low, start + high))
    return ends[0], ends[1]
