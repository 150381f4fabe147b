"""Defects of a sensor's response and dust in a mean flat, and hot pixels in darks, found robustly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_dilation,
    binary_fill_holes,
    center_of_mass,
    distance_transform_edt,
    find_objects,
    gaussian_filter,
    label,
    maximum,
    maximum_filter,
    median_filter,
    minimum,
)

from bfsensor.typing import FloatArray

SURE = 8.0
"""Deviation above which a column or a pixel counts as a defect [robust standard deviations of its
like].  Chosen: noise reaches it in 1e-15 of the columns; with 16, defects of twice the size stay."""

LEAST = 0.004
"""Smallest departure of the response of a bad column from its neighbours'.  Chosen: 20 times the
scatter of columns of 256 pixels whose responses scatter by 0.3 %; with twice as much, columns of up
to 0.8 % stay in the maps as findings."""

COMMON = 20.0
"""Number of bad columns for each boundary between columns that displaces light.  Chosen: tested sensors
have many bad columns, and tears at borders of amplifiers at most.  With 40, the excess beside a defect
of 16 standard deviations must be 0.2 of its own larger to be taken for displaced light."""

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

BIN = 4
"""Side of the boxes in which dust spots are looked for [pixel].  Chosen: 0.3 % scatter of pixels
averages to 0.08 %; with 8, dust spots of 3 pixels radius fill a tenth of a box."""

WIDE = 15
"""Boxes of the median that light without dust spots is taken from: 60 pixels.  Chosen: twice the largest
dust spot of 30 pixels; with 31, light must be even over 120 pixels."""

LIGHT = 8
"""Order of the polynomial of the light that dust spots stand out of.  Chosen: cos^4 of the field and a
edge of a stop are smooth over half of the sensor; with 16, waves of an eighth of the sensor, 32 of 256
pixels, are light and wide dust spots with them."""

EDGE = 2.0
"""Deviation [standard deviations of averaged boxes] down to which a dust spot goes on from its middle.
Chosen: of a depth of 20 standard deviations 10 % are left outside; with 4, 20 %."""

MOST = 0.5
"""Part of the sensor beneath dust above which none is told apart.  Derived: the median of the boxes that
light is taken from must lie beside dust.  Chosen at that limit; with 0.25, ten spots of 15 pixels radius
on 256 x 256 pixels are not found."""

OUTSIDE = 5.0
"""Departure of a box from the polynomial above which it has no part in it [robust standard deviations].
Chosen: dust spots are farther out; with 3, corners that a stop darkens lie outside, too."""

DARK = 4.0
"""Depth of a dust spot above which it is sure [robust standard deviations of averaged boxes].  Chosen:
of ten campaigns without dust one then lists a spot, of 0.25 %, that is none; with 5, spots of 0.3 %
stay in the maps, where their blocks of 16 pixels are 6 sigma; with 8, spots of twice the depth."""

SHALLOW = 1e-3
"""Smallest depth of a dust spot, where boxes are averaged.  Chosen: three times the error of a block of
a map in a campaign of 256 x 256 pixels; with 2e-3, dust spots of twice the depth stay in the maps."""

ROUND, SOLID = 2.5, 0.4
"""Largest ratio of the sides of a dust spot's box, and least part of it that is dark.  Chosen: a disc
fills 0.79 of a square; stripes, arcs of rings and rims do not pass.  With 5, short stripes do."""

GRAINS = 4
"""Most grains of dust that touch.  Chosen: of eight with radii of 4 to 16 pixels at random places on
256 x 256 pixels four touch in one sensor of 800 (4,000 draws), five in none; with 8, arcs of fringes
may be cut into as many."""

NECK = 0.75
"""Half of the width where grains that touch are cut, over the radius of the smaller one, above which
they are one patch.  Chosen: equal discs 1.3 radii apart have 0.75, stripes 1.  With 0.37, only grains
that hardly touch are cut."""

UNEVEN = 1.3
"""Scatter of averaged pixels beneath dust, less its mean by distance, over that beside it, above which
dust is not round.  Chosen: noise of 70 independent averages reaches it once in 2,000; with 2.6, rests
of touching grains stay."""

SMOOTH = 1.5
"""Width of the Gaussian over which a dust spot's response is averaged [pixel].  Chosen: the scatter of
pixels averages to 0.06 % of them; with 3, edges of sharp dust spots stay."""


class BadColumns(NamedTuple):
    """Adjacent columns of low response in an amplifier.

    Attributes
    ----------
    columns, rows : range
        Columns, and rows from the first to the last that any of them lacks response in.
    change : ndarray, shape (rows, columns) of the amplifier's rows and these columns
        Response less one; 0 where it is like the neighbours'.
    z : float
        Largest deviate [robust standard deviations].
    """

    columns: range
    rows: range
    change: FloatArray
    z: float


def low_pixels(image: FloatArray) -> NDArray[np.bool_]:
    """Mask of single pixels, or two adjacent ones, of low response.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Response of each pixel less one.

    Returns
    -------
    low : ndarray of bool, shape (rows, columns)

    Examples
    --------
    >>> image = 3e-3 * np.random.default_rng(4).standard_normal((64, 64))
    >>> image[20, 30] -= 0.06
    >>> np.argwhere(low_pixels(image)).tolist()
    [[20, 30]]
    """
    away = image - median_filter(image, 5, mode="nearest")
    scatter = 1.4826 * float(np.median(np.abs(away)))
    # Pixels of a bad column are low beside other columns, not along their own.
    along = image - median_filter(image, (9, 1), mode="nearest")
    low = np.maximum(away, along) < -max(SURE * scatter, LEAST)
    groups, _ = label(low, np.ones((3, 3)))
    for n, where in enumerate(find_objects(groups), 1):
        if max(s.stop - s.start for s in where) > 2:
            low[groups == n] = False
    # Pixels of a column are a column's defect, patterns of light are in many.
    low[:, low.mean(0) > FEW] = False
    return low if low.mean() < FEW**2 else np.zeros_like(low)


def bad_columns(image: FloatArray, light: FloatArray | None = None) -> list[BadColumns]:
    """Find columns of low response in an amplifier, whole or from a row on.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Response of each pixel less one, without single low pixels.
    light : ndarray, shape (rows, columns), optional
        Smooth light that the image holds: columns some way off are compared without it.

    Returns
    -------
    defects : list of BadColumns

    Examples
    --------
    >>> image = 3e-3 * np.random.default_rng(4).standard_normal((200, 100))
    >>> image[:, [40, 41]] -= 0.02, 0.05
    >>> image[80:, 70] -= 0.04
    >>> image[:, [60, 61]] += 0.02, -0.02
    >>> [(list(d.columns), d.rows, d.change[150].round(2).tolist()) for d in bad_columns(image)]
    [([40, 41], range(0, 200), [-0.02, -0.05]), ([70], range(80, 200), [-0.04])]
    """
    ny, nx = image.shape
    across = 2 * WIDEST + 2 * QUIET + 1
    profile = np.median(image, axis=0)
    whole = profile - median_filter(profile, across, mode="mirror")
    scatter = 1.4826 * float(np.median(np.abs(whole)))
    if scatter <= 0:
        return []
    # Parts of columns are compared with their nearest neighbours: light and dust change slowly.
    strips = np.array_split(image, max(ny // (2 * BIN), 1))
    away = np.concatenate(
        [
            s - median_filter(np.median(s, axis=0), 2 * QUIET + 3, mode="mirror")
            for s in strips
        ]
    )
    first, last = _lacking_rows(away)
    rows = np.arange(ny)[:, None]
    part = (rows >= first) & (rows < last)
    count = part.sum(0)
    # Columns without a usable row have no mean and no defect.
    part_mean = np.where(part, away, 0.0).sum(0) / np.maximum(count, 1)
    # A column's own median is robust against what a part of it has.
    mean = np.where(count == ny, whole, part_mean)
    z = mean * np.sqrt(count / ny) / scatter
    # Neighbours of a clear defect belong to it from half of that deviate on.
    size = np.minimum(np.abs(z) / SURE, np.abs(mean) / LEAST)
    off = size > 0.5
    # What lies beside a deep defect, but not next to it, is the shape of the light.
    strong = off & (np.abs(mean) > FEW * maximum_filter(np.abs(mean), 2 * QUIET + 1))
    off &= maximum_filter(strong, 3)
    at = np.flatnonzero(off)
    even = image if light is None else image - light
    found, number = [], 0
    # Columns with fewer than QUIET others between them are one defect.
    for own in np.split(at, np.flatnonzero(np.diff(at) > QUIET) + 1) if len(at) else []:
        start, stop = int(own[0]), int(own[-1]) + 1
        # At an amplifier's border there may be fewer neighbours, but not none.
        sides = off[max(start - QUIET, 0) : start], off[stop : stop + QUIET]
        alone = not any(s.any() for s in sides) and sum(map(len, sides)) >= QUIET
        # An excess is dark current of a hot column, which the diagnosis explains.
        # Neighbours that a dust spot crosses depart in its rows only.
        light_of = mean[own] * count[own]
        lost = -float(light_of.sum()) > LOST * float(np.abs(light_of).sum())
        span = range(int(first[own].min()), int(last[own].max()))
        error = scatter * np.sqrt(ny / max(len(span), 1))
        lost &= not _is_displaced(even[span.start : span.stop], off, start, stop, error)
        sure = int((size[own] > 1.0).sum())
        if alone and lost and sure and stop - start <= WIDEST:
            number += sure
            change = np.zeros((ny, stop - start))
            change[:, own - start] = np.where(part[:, own], mean[own], 0.0)
            found.append(
                BadColumns(range(start, stop), span, change, float(np.abs(z[own]).max()))
            )
    # Neighbours of a defect are none of their own.
    return found if number <= FEW * nx else []


def _is_displaced(
    image: FloatArray, off: NDArray[np.bool_], start: int, stop: int, error: float
) -> bool:
    """Whether the light that a defect lacks is more probably in the neighbouring columns than lost.

    Defect and neighbours are compared with columns farther away.  Displaced edges only move light:
    what the columns of a tear lack, their neighbours have more.  Columns that are other defects, and
    those beside them, are left out; at the rim, one side stands for both.  A column has the ``error``.
    """
    profile, reach = np.median(image, axis=0), 2 * QUIET
    # Columns beside other defects lack the light that these draw from them.
    others_off = off.copy()
    others_off[start:stop] = False
    clear = np.flatnonzero(~(off | maximum_filter(others_off, 2 * QUIET + 1)))
    near, bases = [], []
    for side, away in ((clear < start, start - 1 - clear), (clear >= stop, clear - stop)):
        far = clear[side & (away >= reach) & (away < reach + WIDEST)]
        if (side & (away < reach)).any() and len(far) >= QUIET:
            near.append(clear[side & (away < reach)])
            bases.append((float(far.mean()), float(np.median(profile[far])), len(far)))
    if not bases:
        return False
    # Light is a straight line between the columns farther away, level where one side stands for both.
    (x, low, _), (y, high, _) = bases[0], bases[-1]
    slope = (high - low) / (y - x) if len(bases) == 2 else 0.0
    beside = sum(float((profile[c] - low - slope * (c - x)).sum()) for c in near)
    own = profile[start:stop] - low - slope * (np.arange(start, stop) - x)
    lacking = -float(np.minimum(own, 0.0).sum())
    count = sum(map(len, near))
    gained = float(np.maximum(own, 0.0).sum()) + beside * 2 * reach / count
    # Errors of the neighbours' sum: their own, and that of the medians beneath them, pi / 2 of a mean's.
    base = np.pi / 2 * sum(1 / n for *_, n in bases) / len(bases) ** 2
    variance = (2 * reach * error) ** 2 * (1 / count + base)
    # Gaussian errors: displaced light has an expected gain of all that is lacking, lost light of none.
    return bool(lacking * (gained - lacking / 2) > variance * np.log(COMMON))


def _lacking_rows(
    away: FloatArray,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First row, and the one after the last, of the part of each column that departs most clearly.

    It begins or ends at the image's edge: charge that a site holds back is lacking in all rows that
    are read through it.
    """
    ny = len(away)
    sums = np.concatenate([np.zeros((1, away.shape[1])), np.cumsum(away, axis=0)])
    length = np.maximum(np.arange(ny + 1), 1)[:, None]
    low, high = sums**2 / length, (sums[-1] - sums) ** 2 / length[::-1]
    # Short parts are few pixels: they are no column.
    least = max(ny // 16, 4)
    low[:least], high[ny - least + 1 :] = 0.0, 0.0
    end, start = low.argmax(0), high.argmax(0)
    from_start = low.max(0) >= high.max(0)
    return np.where(from_start, 0, start), np.where(from_start, end, ny)


def smooth_light(
    image: FloatArray,
    amplifiers: NDArray[np.int64] | None = None,
    apart: NDArray[np.bool_] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Fit a smooth function of the place to boxes of a mean flat, with a step for each amplifier.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Response of each pixel of the sensor less one.
    amplifiers : ndarray of int, shape (rows, columns), optional
        Index of each pixel's amplifier, below 0 where none reads; by default one reads all.
    apart : ndarray of bool, shape (rows, columns), optional
        Pixels that have no part in the fit, such as those beneath dust.

    Returns
    -------
    light, steps : ndarray, shape (rows, columns)
        The light, and the amplifiers' steps: dust spots and patterns stand out of their sum.
    """
    owner = np.zeros(image.shape, int) if amplifiers is None else amplifiers
    y, x = (np.linspace(-1.0, 1.0, n) for n in image.shape)
    step = max(1, int(np.ceil(max(image.shape) / 64)))
    y_at, x_at = (np.arange(step // 2, n - step + step // 2 + 1, step) for n in image.shape)
    ny, nx = len(y_at), len(x_at)
    boxes = image[: ny * step, : nx * step].reshape(ny, step, nx, step)
    # The median of a box is that of its good pixels.
    values = np.median(boxes, axis=(1, 3)).ravel()
    own = owner[np.ix_(y_at, x_at)].ravel()
    there = own >= 0
    if apart is not None:
        there &= ~apart[np.ix_(y_at, x_at)].ravel()
    powers = [(p, q) for p in range(LIGHT + 1) for q in range(LIGHT + 1 - p) if p + q]
    orders = np.arange(LIGHT + 1)
    # Powers to half of the order, cosines above: those do not run wild at the rims.
    low = [u[:, None] ** orders for u in (x, y)]
    high = [np.cos(0.5 * np.pi * np.outer(u + 1, orders)) for u in (x, y)]
    shapes = [low if p + q <= LIGHT // 2 else high for p, q in powers]
    columns = [
        np.outer(f[1][y_at, q], f[0][x_at, p]).ravel()
        for f, (p, q) in zip(shapes, powers, strict=True)
    ]
    steps = [(own == n).astype(float) for n in range(int(owner.max()) + 1)]
    design = np.column_stack([*columns, *steps])
    used = there
    for _ in range(6):
        found = np.linalg.lstsq(design[used], values[used], rcond=None)[0]
        away = values - design @ found
        middle = np.median(away[used])
        spread = 1.4826 * float(np.median(np.abs(away[used] - middle)))
        used = there & (np.abs(away - middle) <= OUTSIDE * spread)
    light = sum(
        c * np.outer(f[1][:, q], f[0][:, p])
        for c, f, (p, q) in zip(found, shapes, powers, strict=False)
    )
    offsets = np.append(found[len(powers) :], 0.0)
    return np.asarray(light), offsets[owner]


def dust_spots(image: FloatArray) -> list[tuple[range, range, FloatArray, float]]:
    """Find round dark patches in the response of a sensor's pixels.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Response of each pixel less one, without the smooth light.

    Returns
    -------
    spots : list of (range, range, ndarray, float)
        Rows, columns, response of the pixels there, and the deviate of the darkest place.

    Examples
    --------
    >>> y, x = np.indices((96, 64))
    >>> image = 3e-3 * np.random.default_rng(4).standard_normal(y.shape)
    >>> image -= 0.03 * np.exp(-0.5 * ((x - 30) ** 2 + (y - 50) ** 2) / 4**2)
    >>> ((rows, columns, shade, z),) = dust_spots(image)
    >>> 50 in rows, 30 in columns, float(shade.min().round(2))
    (True, True, 0.96)
    """
    ny, nx = (n // BIN * BIN for n in image.shape)
    if min(ny, nx) < WIDE:
        return []
    boxes = image[:ny, :nx].reshape(ny // BIN, BIN, nx // BIN, BIN).mean((1, 3))
    light = _median_around(boxes)
    every = np.zeros(boxes.shape, bool)
    # A second time with the light beneath the first dust spots, which pulled the medians down.
    for _ in range(2):
        # Towards a rim of the sensor the field rolls off along all of it, which is no dust.
        light += _whole_lines(boxes - light, every)
        chosen, bright = _dark_patches(boxes - light)
        every = (
            np.any([w for w, _ in chosen], axis=0) if chosen else np.zeros_like(boxes, bool)
        )
        if not chosen or every.mean() > MOST:
            return []
        light = _beneath(boxes, every)
    # Dust only takes light away; rings, cells of air and fringes are as often as bright as dark.
    usual = float(np.median([z for _, z in chosen]))
    if sum(z > usual for z in bright) > len(chosen) // 4:
        return []
    found = []
    light += _whole_lines(boxes - light, every)
    change = image[:ny, :nx] - np.kron(light, np.ones((BIN, BIN)))
    smooth = gaussian_filter(change, SMOOTH)
    usual = float(smooth[~np.kron(every, np.ones((BIN, BIN), bool))].std())
    # What the average takes off the middle of a dust spot, averaged in turn (Tukey's twicing).
    smooth += gaussian_filter(change - smooth, SMOOTH)
    known = np.zeros((ny, nx), bool)
    for whole, z in chosen:
        # Where the margins of two patches overlap, the light that is lacking belongs to one of them.
        fine = np.kron(whole, np.ones((BIN, BIN), bool)) & ~known
        if not fine.any():
            continue
        rows, columns = (np.flatnonzero(fine.any(k)) for k in (1, 0))
        part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        dark = _round_shade(change[part], smooth[part], fine[part])
        # Grains that touch, or are not round, are averaged over the pixels around each instead.
        left = gaussian_filter(np.where(fine[part], change[part] - dark, 0.0), SMOOTH)
        if left[fine[part]].std() > UNEVEN * usual:
            dark = smooth[part]
        shade = np.where(fine[part], 1.0 + dark, 1.0)
        known |= fine
        found.append(
            (range(rows[0], rows[-1] + 1), range(columns[0], columns[-1] + 1), shade, z)
        )  # fmt: skip
    return found


def _round_shade(
    change: FloatArray, smooth: FloatArray, inside: NDArray[np.bool_]
) -> FloatArray:
    """Mean of a patch around its centre by the distance from it, which patterns of the sensor leave.

    The centre is the one with the least scatter about that mean, to half a pixel.
    """
    y, x = np.nonzero(inside)
    values = change[y, x]
    dark = np.maximum(-smooth[y, x], 0.0)
    centre = np.array([y @ dark, x @ dark]) / max(float(dark.sum()), 1e-300)

    def rings(place: FloatArray) -> FloatArray:
        away = np.hypot(y - place[0], x - place[1])
        number = np.rint(away).astype(int)
        count = np.bincount(number)
        mean = np.bincount(number, values) / np.maximum(count, 1)
        at = np.flatnonzero(count)
        return np.interp(away, at, mean[at])

    for step in (1.0, 0.5):
        tried = [centre + step * np.array(d) for d in np.ndindex(5, 5)]
        tried = [t - 2 * step for t in tried]
        centre = min(tried, key=lambda t: float(np.square(values - rings(t)).sum()))
    out = np.zeros(change.shape)
    out[y, x] = rings(centre)
    return out


def _median_around(boxes: FloatArray) -> FloatArray:
    """Median of WIDE x WIDE boxes around each; at rims of the outermost ones that are all there."""
    half = WIDE // 2
    y, x = (np.clip(np.arange(n), half, n - 1 - half) for n in boxes.shape)
    return np.asarray(median_filter(boxes, WIDE)[np.ix_(y, x)])


def _whole_lines(boxes: FloatArray, dusty: NDArray[np.bool_]) -> FloatArray:
    """Medians of the columns and rows of boxes beside dust; 0 for those that noise can have made."""
    clear = np.ma.array(boxes, mask=dusty)
    middle = float(np.ma.median(clear))
    scatter = 1.4826 * float(np.ma.median(np.abs(clear - middle)))
    across, down = (np.ma.median(clear, axis=k).filled(middle) - middle for k in (0, 1))
    for line, count in ((across, len(down)), (down, len(across))):
        line[np.abs(line) < DARK * scatter * np.sqrt(np.pi / 2 / count)] = 0.0
    return np.asarray(across + down[:, None])


def _beneath(boxes: FloatArray, dusty: NDArray[np.bool_]) -> FloatArray:
    """Median of the boxes around each that hold no dust."""
    high = 1.0 + float(np.abs(boxes).max())
    out = _median_around(np.where(dusty, high, boxes))
    low = _median_around(np.where(dusty, -high, boxes))
    # With as many boxes above as below, the mean of both medians is that of the clear ones.
    known = (np.abs(out) < high) & (np.abs(low) < high)
    return np.asarray(np.where(known, 0.5 * (out + low), np.median(boxes[~dusty])))


def _dark_patches(
    away: FloatArray,
) -> tuple[list[tuple[NDArray[np.bool_], float]], list[float]]:
    """Masks of round dark patches of boxes with their deviates; those of bright maxima.

    Boxes alone show small patches, their averages over the neighbours wide and shallow ones.
    """
    out: list[tuple[NDArray[np.bool_], float]] = []
    taken = np.zeros(away.shape, bool)
    bright: list[float] = []
    for width in (0.0, 0.5, 1.0):
        mean = gaussian_filter(away, width) if width else away
        scatter = 1.4826 * float(np.median(np.abs(mean)))
        least = max(DARK * scatter, SHALLOW if width else LEAST)
        inner = np.s_[2:-2, 2:-2]
        top = mean[inner][((mean == maximum_filter(mean, 5)) & (mean > least))[inner]]
        bright += (top / scatter).tolist()
        # Dust spots that touch are apart at a greater depth.
        for edge in (EDGE, 2 * EDGE, 4 * EDGE):
            groups, number = label((mean < -edge * scatter) & ~taken)
            deepest = -np.atleast_1d(minimum(mean, groups, np.arange(1, number + 1)))
            windows = find_objects(groups)
            # Large maps have thousands of groups that are too shallow, and all are small parts.
            for n in np.flatnonzero(deepest >= least):
                # The mask of a patch is wider than the patch by two boxes.
                window = tuple(slice(max(w.start - 3, 0), w.stop + 3) for w in windows[n])
                own, values = groups[window] == n + 1, mean[window]
                parts = _grains(own)
                depths = [-float(values[p & own].min(initial=0.0)) for p in parts]
                if not all(map(_is_round, parts)) or min(depths) < least:
                    continue
                for part, depth in zip(parts, depths, strict=True):
                    whole = np.zeros_like(taken)
                    whole[window] = binary_dilation(part, iterations=2)
                    taken |= whole
                    out.append((whole, depth / scatter))
    return out, bright


def _is_round(patch: NDArray[np.bool_]) -> bool:
    """Whether a patch of boxes has the shape and the size of a grain of dust."""
    (where,) = find_objects(patch.astype(int))
    sides = patch[where].shape
    compact = max(sides) <= ROUND * min(sides) and patch[where].mean() >= SOLID
    return bool(compact and max(sides) <= WIDE)


def _grains(patch: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """A patch of boxes without its holes, cut where grains that touch are narrowest."""
    patch = binary_fill_holes(patch)
    if _is_round(patch):
        return [patch]
    # Each box belongs to the disc inside of the patch whose rim is nearest.
    depth = distance_transform_edt(np.pad(patch, 1, mode="edge"))[1:-1, 1:-1]
    middles, number = label(patch & (depth == maximum_filter(depth, 5)), np.ones((3, 3)))
    if number > GRAINS:
        return [patch]
    numbers = np.arange(1, number + 1)
    places = np.array(center_of_mass(middles > 0, middles, numbers))
    radii = np.array(maximum(depth, middles, numbers))
    y, x = np.indices(patch.shape)
    rims = [np.hypot(y - a, x - b) - r for (a, b), r in zip(places, radii, strict=True)]
    nearest = np.where(patch, np.argmin(rims, axis=0), number)
    parts = [nearest == n for n in range(number)]
    for part, radius in zip(parts, radii, strict=True):
        neck = part & binary_dilation(patch & ~part)
        if float(depth[neck].max(initial=0.0)) > NECK * radius:
            # As wide as the parts themselves: a stripe.
            return [patch]
    return parts


def hot_pixels(deviate: FloatArray) -> NDArray[np.bool_]:
    """Mask of single hot pixels, by the deviates of pixels in the faintest of several darks.

    Hot columns, in which many pixels are hot, and clusters of light are left to the diagnosis.
    """
    hot = deviate > SURE
    hot[:, hot.mean(0) > FEW] = False
    return hot if hot.mean() < FEW**2 else np.zeros_like(hot)
