"""Tearing: a field distortion beside one boundary between columns, in a random range of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from scipy.special import ndtr
from scipy.stats import norm

from bfsensor.effects.effect import Axes, Effect, Layout, Parameter, Seen, Shot
from bfsensor.effects.random_covariances import scatter_of_pairs
from bfsensor.typing import Edges, FloatArray

BRIDGE = 12
"""Number of modes that describe the random rows of the tear in a map.

Derived: the modes of a Brownian bridge have variances 6 / (pi k)^2; twelve hold 95 % of them."""


class Tearing(Effect):
    """Edges at the distance d from one column boundary are displaced by ``amp`` exp(-d / length).

    ``column`` is the place of the boundary as a fraction of the sensor's width.  The tear ends at a
    row that differs at random in every exposure: uniform between the fraction ``open`` of the rows
    and the top; where ``top`` is 1, rows count from the top.  Without a number of an exposure,
    :meth:`displacements` are the mean ones.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.003 to 0.2 in magnitude, either sign (0 changes
        nothing); ``length`` [pixel]: 1 to 5; ``column``: 0 to 1; ``open``: 0 to 1; ``top``: 0
        to 1, whole.

    Examples
    --------
    >>> shape = {"length": 2.0, "column": 0.5, "open": 0.5, "top": 0}
    >>> Tearing({"amp": 0.02} | shape).name
    'tearing'
    """

    word = "tearing"
    stage = "collect"
    parameters = (
        Parameter("amp", "pixel", 3e-3, 0.2, signed=True, amplitude=True),
        Parameter("length", "pixel", 1.0, 5.0),
        Parameter("column", "", 0.0, 1.0, law="flat", step=2e-4, ends=(0.0, 1.0)),
        Parameter("open", "", 0.0, 1.0, law="flat", ends=(-np.inf, 1.0)),
        Parameter("top", "", 0, 1, law="whole", plain=0.0),
    )
    touches = ("flat_map", "flat_cov")
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    response = "quadratic"
    source = (
        "Juramy et al. 2020, Proc. SPIE 11454, 1145412 (arXiv 2002.09439: holes in channel stops "
        "moved by clocks, worst beside segments' edges); exponential, rows and range are assumed"
    )
    maps_vary = "nothing"
    law_name = "same_way"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Begin with boundaries in strips detected in maps; without any, with evenly spaced ones."""
        width = layout.shape[1]
        found = [
            s["x"] for s in seen if s["word"] == "flat_map" and "x" in s
            and s.get("what", "column") == "column"
        ][:3]  # fmt: skip
        near = {
            b for low, high in found for b in range(int(low) - 4, int(high) + 5)
            if high - low < width / 8
        }  # fmt: skip
        return [
            {"amp": 0.02, "length": length, "column": boundary / width, "open": 0.4, "top": top}
            for boundary in sorted(near or range(2, width, max(width // 64, 2)))
            for length in (1.5, 3.5) for top in (0.0, 1.0)
            if 0 < boundary < width
        ]  # fmt: skip

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        ny, nx = layout.shape
        part = self._open(ny)
        if shot.number >= 0:
            # One exposure: the row at which the tear ends is drawn with its number as the seed.
            part = (part > np.random.default_rng(shot.number).random()).astype(float)
        return part[:, None] * self._torn(nx), np.zeros((ny + 1, nx))

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        # The tear ends at other rows in both flats of a pair: it stays in the difference in between.
        side = c.shape[-1]
        level = np.asarray(axes["level"], float)
        added = np.zeros_like(c)
        for amp in np.unique(axes["amp"]).astype(int):
            own = np.asarray(axes["amp"]).astype(int) == amp
            segment = layout.segments[amp]
            columns = np.s_[segment.x : segment.x + segment.columns]
            rows = np.s_[segment.y : segment.y + segment.rows]
            area = np.diff(self._torn(layout.shape[1]))
            left = _relaxed(area, c[own], level[own])[:, columns]
            # In standard deviations of the difference of the pair.
            variance = c[own, 0, 0] if c.any() else level[own]
            shift = left * level[own, None] / np.sqrt(2 * variance[:, None])
            chance = self._chance(layout.shape[0])[rows, rows]
            for j in range(layout.lags + 1):
                across = np.diagonal(chance, j).mean()
                for i in range(layout.lags + 1):
                    one = 2 * variance * across * _kept_products(shift, layout.clip, i, j)
                    for a, b in {(j, i), (j, -i), (-j, i), (-j, -i)}:
                        added[own, a % side, b % side] = one
        return np.asarray(c + added)

    def modes(self, word: str, axes: Axes, layout: Layout) -> FloatArray | None:
        if word == "flat_cov":
            # The distance of two uniform random rows has a scatter of sqrt(1/2) of its mean.
            return scatter_of_pairs(self, axes, layout, lambda *_: np.sqrt(0.5))
        ny, nx = layout.shape
        area = np.diff(self._torn(nx))
        t = (np.arange(ny) + 0.5 - self["open"] * ny) / max((1 - self["open"]) * ny, 1.0)
        t = t[::-1] if self["top"] else t
        out, fold = [], str(axes["fold"][0])
        for name in dict.fromkeys(axes["map"]):
            spread = np.sqrt(layout.map_noise.get((fold, str(name)), 0.0)) * (
                axes["map"] == name
            )
            for k in range(1, BRIDGE + 1):
                rows = np.where(
                    t > 0, np.sqrt(2) / (k * np.pi) * np.sin(k * np.pi * t), 0.0
                )
                out.append(spread * _reduced(rows, area, axes))
        return np.stack(out, axis=1)

    def _torn(self, nx: int) -> FloatArray:
        """Displacements of the edges between columns in rows with the tear [pixel]."""
        from_tear = np.arange(nx + 1.0) - self["column"] * nx
        fallen = np.exp(-np.abs(from_tear) / self["length"])
        return np.asarray(self["amp"] * fallen * self._way(from_tear))

    def _way(self, from_tear: FloatArray) -> FloatArray | float:
        """Direction of the displacement at a distance from the tear [pixel]: the same on both sides."""
        del from_tear
        return 1.0

    def _open(self, ny: int) -> FloatArray:
        """Fraction of the exposures in which each row has the tear."""
        row, never = np.arange(ny) + 0.5, self["open"] * ny
        above = np.clip((ny - row) / max(ny - never, 1.0), 0.0, 1.0)
        part = np.where(row <= never, 1.0, above)
        return part[::-1] if self["top"] else part

    def _chance(self, ny: int) -> FloatArray:
        """Covariance between rows of having the tear (0 or 1) in an exposure, shape (ny, ny)."""
        part = self._open(ny)
        both = np.minimum(part[:, None], part)
        return np.asarray(both - part[:, None] * part)


class DivisaderoTearing(Tearing):
    """Edges on either side of a tear are displaced away from it, or towards it.

    Missing holes in one channel stop attract or repel the electrons of both sides alike.  Between
    the two sides, within half a pixel of the tear, the displacement is linear.  ``column`` may lie
    within a column, whose two edges then move apart.  ``amp`` is positive away from the tear; all other
    parameters are those of :class:`Tearing`.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.003 to 0.2 in magnitude, either sign (0 changes
        nothing); ``length`` [pixel]: 1 to 5; ``column``: 0 to 1; ``open``: 0 to 1; ``top``: 0
        to 1, whole.

    Examples
    --------
    >>> shape = {"length": 2.0, "column": 0.5, "open": 0.5, "top": 0}
    >>> DivisaderoTearing({"amp": 0.02} | shape).name
    'tearing:divisadero'
    """

    variant = "divisadero"
    law_name = "divisadero"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Begin within columns as well as at the boundaries that :class:`Tearing` begins with."""
        half = 0.5 / layout.shape[1]
        return [
            s | {"column": s["column"] + more}
            for s in super().starts(layout, seen) for more in (0.0, half)
        ]  # fmt: skip

    def _way(self, from_tear: FloatArray) -> FloatArray | float:
        return np.clip(2 * from_tear, -1.0, 1.0)


def _relaxed(area: FloatArray, c: FloatArray, level: FloatArray) -> FloatArray:
    """Contrast of columns, relaxed by brighter-fatter feedback, shape (flats, columns).

    Stored charge takes as much of a standing pattern's power as of the photon noise's, to second order
    in a_ij times the level: within 1 % for a_ij of 3e-6 and 1e5 electrons.  ``c`` are the covariances
    of the flats [e-^2].  Where they are 0 nothing relaxes.
    """
    if not c.any():
        return np.broadcast_to(area, (len(level), len(area)))
    side = c.shape[-1]
    power = np.fft.rfft(c.sum(axis=1)).real / np.maximum(level, 1.0)[:, None]
    kernel = np.fft.irfft(np.sqrt(np.maximum(power, 0.0)), side)
    wide = np.zeros((len(level), len(area)))
    reach = min(side, len(area)) // 2
    at = np.arange(-reach, reach)
    wide[:, at % len(area)] = kernel[:, at % side]
    return np.fft.irfft(np.fft.rfft(wide) * np.fft.rfft(area), len(area))


def _kept_products(shift: FloatArray, clip: float, i: int, j: int) -> FloatArray:
    """Mean over columns of the products at a lag that shifted columns add to noise, shape (flats,).

    ``shift`` (flats, columns) and the products are in standard deviations of one pixel.  Excluded are
    pixels beyond the clipping limit, and their neighbours: a product counts if no pixel among the
    3 x 3 about either of the two exceeds it.  Measured on drawn pairs: within their errors of 5 % for
    shifts up to 3.4; at 4.2, where three quarters are excluded, a fourth too small.
    """
    if np.isinf(clip):
        n = shift.shape[1] - i
        return np.asarray((shift[:, :n] * shift[:, i:]).mean(axis=1))
    clear = ndtr(clip - shift) - ndtr(-clip - shift)
    low, high = -clip - shift, clip - shift
    first = shift * clear + norm.pdf(low) - norm.pdf(high)
    # Rows of each column, counted from that of the first pixel, that have to be clear.
    need = np.zeros(i + 3, int)
    need[:3] += 3
    need[i : i + 3] += np.where(need[i : i + 3] > 0, min(j, 3), 3)
    if i or j:
        np.subtract.at(need, [1, i + 1], 1)
    else:
        need[1] -= 1
    wide = np.pad(clear, ((0, 0), (1, 1)), constant_values=1.0)
    n = shift.shape[1] - i
    around = np.prod([wide[:, k : k + n] ** r for k, r in enumerate(need)], axis=0)
    if i == j == 0:
        second = (1 + shift**2) * clear + 2 * shift * (norm.pdf(low) - norm.pdf(high))
        second = second + low * norm.pdf(low) - high * norm.pdf(high)
        width = 1 - 2 * clip * norm.pdf(clip) / (2 * ndtr(clip) - 1)
        pair = second - width * clear
    else:
        pair = first[:, :n] * first[:, i:]
    return np.asarray((around * pair).mean(axis=1))


def _reduced(rows: FloatArray, columns: FloatArray, axes: Axes) -> FloatArray:
    """Values of the channel ``flat_map`` for a map ``rows`` times ``columns``; 0 for rings."""
    what = axes["what"]
    out = np.zeros(len(what))
    column, row, block = (what == w for w in ("column", "row", "block"))
    out[column] = rows.mean() * columns[axes["x"][column].astype(int)]
    out[row] = columns.mean() * rows[axes["y"][row].astype(int)]
    if block.any():
        x, y = axes["x"][block], axes["y"][block]
        half = 0.5 * _spacing(x)
        mean_x, mean_y = _running(columns), _running(rows)
        low_x, low_y = (np.rint(v + 0.5 - half).astype(int) for v in (x, y))
        high_x, high_y = (np.rint(v + 0.5 + half).astype(int) for v in (x, y))
        out[block] = (
            (mean_x[high_x] - mean_x[low_x]) * (mean_y[high_y] - mean_y[low_y])
            / (4 * half * half)
        )  # fmt: skip
    return out


def _running(values: FloatArray) -> FloatArray:
    """Cumulative sums from 0: differences of two are sums over a range."""
    return np.concatenate([[0.0], np.cumsum(values)])


def _spacing(places: FloatArray) -> float:
    """Smallest distance between blocks, which is their side [pixel]."""
    steps = np.diff(np.unique(places))
    return float(steps.min()) if len(steps) else 1.0
