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
from scipy.ndimage import (
    binary_dilation,
    find_objects,
    gaussian_filter,
    label,
    median_filter,
)

from bfsensor.diagnose.data.exposure_info import ExposureInfo, Frame, Source, condition_of
from bfsensor.typing import FloatArray

MOST_READ = 8
"""Largest number of flats, and of darks, that are read to find defects.  Chosen: a column of 256
pixels is then known to 1e-4 of its signal at 6e4 e-; twice as many cost as many readings more."""

BRIGHT = 0.6
"""Part of the most light of a flat that flats to find defects in are nearest to.  Chosen: below full
well, and bright enough that Poisson noise is below the pixels' own scatter; at 0.3, noise is 1.4
times as large."""

SURE = 8.0
"""Deviation above which a column or a pixel counts as a defect [robust standard deviations of its
like].  Chosen: noise reaches it in 1e-15 of the columns; with 16, defects of twice the size stay."""

LEAST = 0.004
"""Smallest departure of the response of a bad column from its neighbours'.  Chosen: 20 times the
scatter of columns of 256 pixels whose responses scatter by 0.3 %; with twice as much, columns of up
to 0.8 % stay in the maps as findings."""

WIDEST, QUIET = 8, 3
"""Most columns of one defect, and number of columns on either side of it that must be like the
others.  Chosen: patterns of light and of pixel edges (roll-off at the rim, tearing at a border of
amplifiers, rings) are wider or have no quiet side; with 16 and 3, narrow rings are taken for defects."""

LOST = 0.5
"""Part of the summed magnitudes of the departures that is lacking in all.  Chosen: where edges between
columns are displaced the sum is 0, where response is lacking it is the whole; at 0.25, tearing of
unequal sides passes."""

FEW = 0.1
"""Part of an amplifier's columns, or of a column's pixels, above which none is a defect: they are a
pattern, or a hot column.  Chosen: with 0.2, a ripple of every fifth column would be repaired away."""

DEAD = -0.5
"""Response less one below which a column is not divided by it but filled from its neighbours.
Chosen: its noise would be more than doubled; with -0.25, columns that lack 25 to 50 % are filled."""


BIN = 4
"""Side of the boxes in which dust spots are looked for [pixel].  Chosen: 0.3 % scatter of pixels
averages to 0.08 %; with 8, dust spots of 3 pixels radius fill a tenth of a box."""

WIDE = 15
"""Boxes of the median that light without dust spots is taken from: 60 pixels.  Chosen: twice the largest
dust spot of 30 pixels; with 31, light must be even over 120 pixels."""

EDGE = 2.0
"""Deviation [standard deviations of boxes] down to which a dust spot goes on from its middle.  Chosen:
of a depth of 20 standard deviations 10 % are left outside; with 4, 20 %."""

ROUND, SOLID = 2.5, 0.4
"""Largest ratio of the sides of a dust spot's box, and least part of it that is dark.  Chosen: a disc
fills 0.79 of a square; stripes, arcs of rings and rims do not pass.  With 5, short stripes do."""

SMOOTH = 1.5
"""Width of the Gaussian over which a dust spot's response is averaged [pixel].  Chosen: the scatter of
pixels averages to 0.06 % of them; with 3, edges of sharp dust spots stay."""


class Cosmetic(NamedTuple):
    """A defect of the sensor, as report.json lists it.

    Attributes
    ----------
    kind : str
        'bad_column', 'hot_pixel' or 'dust'.
    amp : int
        Index of the amplifier, from 0.
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
            "kind": self.kind, "x": list(self.x), "y": list(self.y), "amps": [self.amp + 1],
            "size": float(f"{self.size:.4g}"), "unit": self.unit, "z": round(self.z, 1),
        }  # fmt: skip


class Repair(NamedTuple):
    """Defects of one amplifier, in readout order.

    Attributes
    ----------
    response : ndarray, shape (columns,)
        Response of each column that its pixels are divided by, 1 where it is like the others.
    shade : ndarray, shape (rows, columns)
        Response of each pixel by dust, 1 where there is none.
    filled : ndarray of bool, shape (rows, columns)
        Pixels that take the mean of the nearest good ones of their row.
    """

    response: FloatArray
    shade: FloatArray
    filled: NDArray[np.bool_]

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> Repair:
        """Nothing to repair in an image."""
        return cls(np.ones(shape[1]), np.ones(shape), np.zeros(shape, bool))

    def of_image(self, image: FloatArray, zero: float) -> FloatArray:
        """Repair an image whose pixels without light have the value ``zero``."""
        out = zero + (image - zero) / (self.response * self.shade)
        columns = np.arange(image.shape[1])
        for row in np.flatnonzero(self.filled.any(1)):
            bad = self.filled[row]
            out[row, bad] = np.interp(columns[bad], columns[~bad], out[row, ~bad])
        return np.asarray(out)

    def made(self, frame: Frame) -> RepairedFrame:
        """Repair a frame; values are rounded to codes again, as those of all other pixels are."""
        over = frame.serial_overscan
        zero = float(over[:, over.shape[1] // 2 :].mean()) if over.size else 0.0
        image = self.of_image(frame.image.astype(np.float64), zero)
        repaired = self.filled | (self.response != 1.0)
        changed = repaired | (self.shade != 1.0)
        return RepairedFrame(
            frame.name, frame.pixels, frame.mask | repaired,
            np.where(changed, np.rint(image), frame.image).astype(np.float32),
            frame.prescan, frame.serial_overscan, frame.parallel_overscan,
            frame.flip_x, frame.flip_y, frame.origin, repaired & ~frame.mask, self.filled,
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


def repaired_of(frame: Frame) -> NDArray[np.bool_]:
    """Pixels of a frame with values that are usable in means, although they are no codes."""
    if isinstance(frame, RepairedFrame):
        return frame.repaired
    return np.zeros(frame.image.shape, bool)


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
    repairs = [Repair.none(f.image.shape) for f in layout]
    for amp, image in enumerate(_mean_flats(source, flats)):
        rows = image.shape[0]
        for columns, departures, z in bad_columns(np.median(image, axis=0)):
            worst = float(departures[np.argmax(np.abs(departures))])
            place = _place(layout[amp], columns, range(rows))
            found.append(Cosmetic("bad_column", amp, *place, worst, "of the signal", z))
            for column, departure in zip(columns, departures, strict=True):
                if departure < DEAD:
                    repairs[amp].filled[:, column] = True
                else:
                    repairs[amp].response[column] = 1.0 + departure
        for rows_of, columns_of, shade, z in dust_spots(repairs[amp].of_image(image, -1.0)):
            place = _place(layout[amp], columns_of, rows_of)
            found.append(
                Cosmetic("dust", amp, *place, float(shade.min()) - 1.0, "of the signal", z)
            )
            where = np.ix_(rows_of, columns_of)
            repairs[amp].shade[where] *= shade
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
            repairs[amp].filled[y, x] = True
    return (RepairedSource(source, repairs) if found else source), tuple(found)


def bad_columns(profile: FloatArray) -> list[tuple[range, FloatArray, float]]:
    """Find columns of low response in an amplifier.

    Parameters
    ----------
    profile : ndarray, shape (n,)
        Response of each column less one.

    Returns
    -------
    defects : list of (range, ndarray, float)
        Columns, their departures from their neighbours', and the largest deviate.

    Examples
    --------
    >>> profile = 1e-4 * np.random.default_rng(4).standard_normal(100)
    >>> profile[[40, 41]] -= 0.02, 0.05
    >>> profile[[60, 61]] += 0.02, -0.02
    >>> [(list(c), d.round(2).tolist()) for c, d, _ in bad_columns(profile)]
    [([40, 41], [-0.02, -0.05])]
    """
    away = profile - median_filter(profile, 2 * WIDEST + 2 * QUIET + 1, mode="nearest")
    scatter = 1.4826 * float(np.median(np.abs(away)))
    if scatter <= 0:
        return []
    # Neighbours of a clear defect belong to it from half of that deviate on.
    off = np.abs(away) > 0.5 * max(SURE * scatter, LEAST)
    groups, count = label(off)
    found = []
    for n in range(1, count + 1):
        own = np.flatnonzero(groups == n)
        first, last, size = int(own[0]), int(own[-1]) + 1, np.abs(away[own])
        sides = off[max(first - QUIET, 0) : first], off[last : last + QUIET]
        alone = all(len(s) == QUIET and not s.any() for s in sides)
        # An excess is dark current of a hot column, which the diagnosis explains.
        lost = -float(away[own].sum()) > LOST * float(size.sum())
        clear = float(size.max()) > max(SURE * scatter, LEAST)
        if alone and lost and clear and len(own) <= WIDEST:
            found.append((range(first, last), away[own], float(size.max()) / scatter))
    return found if sum(len(c) for c, *_ in found) <= FEW * len(profile) else []


def dust_spots(image: FloatArray) -> list[tuple[range, range, FloatArray, float]]:
    """Find round dark patches in the response of an amplifier's pixels.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Response of each pixel less one.

    Returns
    -------
    spots : list of (range, range, ndarray, float)
        Rows, columns, response of the pixels there, and the deviate of the darkest box.

    Examples
    --------
    >>> y, x = np.indices((96, 64))
    >>> image = 3e-3 * np.random.default_rng(4).standard_normal(y.shape)
    >>> image -= 0.03 * np.exp(-0.5 * ((x - 30) ** 2 + (y - 50) ** 2) / 4**2)
    >>> ((rows, columns, shade, z),) = dust_spots(image)
    >>> 50 in rows, 30 in columns, float(shade.min().round(2))
    (True, True, 0.97)
    """
    ny, nx = (n // BIN * BIN for n in image.shape)
    if min(ny, nx) < WIDE:
        return []
    boxes = image[:ny, :nx].reshape(ny // BIN, BIN, nx // BIN, BIN).mean((1, 3))
    light = median_filter(boxes, WIDE, mode="nearest")
    away = boxes - light
    scatter = 1.4826 * float(np.median(np.abs(away)))
    groups, _ = label(away < -EDGE * scatter)
    chosen = []
    for n, where in enumerate(find_objects(groups), 1):
        own = groups[where] == n
        depth = -float(away[where][own].min())
        sides = own.shape
        compact = max(sides) <= ROUND * min(sides) and own.mean() >= SOLID
        if depth < max(SURE * scatter, LEAST) or not compact or max(sides) > WIDE:
            continue
        chosen.append((binary_dilation(groups == n, iterations=2), depth / scatter))
    every = np.any([whole for whole, _ in chosen], axis=0) if chosen else np.zeros(0, bool)
    if every.sum() > 2 * FEW * boxes.size:
        return []
    found = []
    # The light beneath the dust spots, which pulled the first median down.
    light = (
        median_filter(np.where(every, light, boxes), WIDE, mode="nearest")
        if chosen
        else light
    )
    change = image[:ny, :nx] - np.kron(light, np.ones((BIN, BIN)))
    smooth = gaussian_filter(change, SMOOTH)
    # What the average takes off the middle of a dust spot, averaged in turn (Tukey's twicing).
    smooth += gaussian_filter(change - smooth, SMOOTH)
    for whole, z in chosen:
        fine = np.kron(whole, np.ones((BIN, BIN), bool))
        rows, columns = (np.flatnonzero(fine.any(k)) for k in (1, 0))
        part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        shade = np.where(fine[part], 1.0 + smooth[part], 1.0)
        found.append(
            (range(rows[0], rows[-1] + 1), range(columns[0], columns[-1] + 1), shade, z)
        )  # fmt: skip
    return found


def hot_pixels(deviate: FloatArray) -> NDArray[np.bool_]:
    """Mask of single hot pixels, by the deviates of pixels in the faintest of several darks.

    Hot columns, in which many pixels are hot, and clusters of light are left to the diagnosis.
    """
    hot = deviate > SURE
    hot[:, hot.mean(0) > FEW] = False
    return hot if hot.mean() < FEW**2 else np.zeros_like(hot)


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


def _mean_flats(source: Source, flats: Sequence[ExposureInfo]) -> list[FloatArray]:
    """Mean relative response of each amplifier's pixels, less one."""
    total: list[FloatArray] = []
    for exposure in flats:
        for n, frame in enumerate(source.read(exposure)):
            signal = _signal(frame)
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
    over = frame.serial_overscan
    zero = float(over[:, over.shape[1] // 2 :].mean()) if over.size else 0.0
    return frame.image.astype(np.float64) - zero


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
