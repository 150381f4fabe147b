"""Turbulence: the illumination pattern of flats differs at random from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import numpy as np
from scipy.ndimage import gaussian_filter

from bfsensor.effects.effect import Axes, Effect, Layout, Parameter, Seen, Shot
from bfsensor.effects.random_covariances import scatter_of_pairs
from bfsensor.typing import FloatArray

REACH = 4.0
"""Margin around the sensor on which the pattern is made [sigma of the smoothing].

Derived: scipy's ``gaussian_filter`` ends at 4 sigma, so that no pixel inside sees the border."""


class IlluminationTurbulence(Effect):
    r"""Relative variations of the light of flats, random in each frame and correlated over a length.

    They are Gaussian with the covariance :math:`\mathrm{rms}^2 e^{-r^2 / 2\,\mathrm{corr}^2}` at the
    distance r.  The difference of a pair keeps them: covariances grow with the square of the
    level, by the same at all near lags except for the subtracted means of boxes.  Means of
    amplifiers scatter.  The noise of maps is included in their errors, which are measured on the
    same pairs.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rms``: 0.0001 to 0.002 (0 changes nothing); ``corr`` [pixel]: 10 to 60.

    Examples
    --------
    >>> IlluminationTurbulence({"rms": 0.0004, "corr": 20.0}).name
    'illumination_turbulence'
    """

    word = "illumination_turbulence"
    stage = "light"
    parameters = (
        Parameter("rms", "", 1e-4, 2e-3, amplitude=True),
        Parameter("corr", "pixel", 10.0, 60.0),
    )
    touches = ("flat_cov", "flat_mean")
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    response = "quadratic"
    scatters = ("flat_mean",)
    source = (
        "Banovetz et al. 2024, arXiv 2411.13386 (1e-3 from peak to peak in differenced flats); a "
        "Gaussian correlation and the range are assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"rms": rms, "corr": corr}
            for rms in (1.5e-4, 5e-4, 1.5e-3) for corr in (11.0, 17.0, 27.0, 45.0)
        ]  # fmt: skip

    def turbulence(
        self, shot: Shot, layout: Layout, rng: np.random.Generator
    ) -> FloatArray | None:
        if shot.kind != "flat" or not self["rms"]:
            return None
        width = self["corr"] / np.sqrt(2.0)
        margin = int(np.ceil(REACH * width))
        white = rng.standard_normal([n + 2 * margin for n in layout.shape])
        smooth = gaussian_filter(white, width, mode="constant")
        inside = smooth[margin:-margin, margin:-margin]
        # A Gaussian filter leaves 1 / (4 pi width^2) of the variance of white noise: scale it to 1.
        return np.asarray(1 + self["rms"] * np.sqrt(4 * np.pi) * width * inside)

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        side = c.shape[-1]
        level = np.asarray(axes["level"], float)
        amps = np.asarray(axes["amp"]).astype(int)
        added = np.zeros_like(c)
        lags = np.arange(-layout.lags, layout.lags + 1)
        for amp in np.unique(amps):
            segment = layout.segments[amp]
            left = self._left(segment.rows, segment.columns, layout)
            one = left[np.abs(lags)[:, None], np.abs(lags)]
            here = np.nonzero(amps == amp)[0]
            strength = (self["rms"] * level[here]) ** 2
            added[np.ix_(here, lags % side, lags % side)] = strength[:, None, None] * one
        return np.asarray(c + added)

    def modes(self, word: str, axes: Axes, layout: Layout) -> FloatArray | None:
        if word == "flat_cov":
            return scatter_of_pairs(self, axes, layout, partial(self._few, layout=layout))
        if word != "flat_mean":
            return None
        amps = np.asarray(axes["amp"]).astype(int)
        which = np.unique(amps)
        spans = [layout.segments[a] for a in which]
        shared = np.array([
            [self._between(a.x, a.columns, b.x, b.columns) * self._between(a.y, a.rows, b.y, b.rows)
             for b in spans] for a in spans
        ])  # fmt: skip
        root = np.linalg.cholesky(shared + 1e-12 * np.eye(len(which)))
        frames, frame = np.unique(axes["exposure"], return_inverse=True)
        out = np.zeros((len(amps), len(frames), len(which)))
        row = np.arange(len(amps))
        out[row, frame.ravel()] = root[np.searchsorted(which, amps)]
        out *= (self["rms"] * np.asarray(axes["level"], float))[:, None, None]
        return out.reshape(len(amps), -1)

    def _few(self, amp: int, level: float, time: float, layout: Layout) -> float:
        """Relative scatter of the pattern's power in one pair: that of a finite number of patches."""
        del level, time
        segment = layout.segments[amp]
        # Subtracted means of boxes leave no patch much wider than a third of a box: an estimate.
        width = min(self["corr"], layout.box / 3)
        return float(np.sqrt(2 * np.pi * width**2 / (segment.rows * segment.columns)))

    def _along(self, distance: FloatArray) -> FloatArray:
        """Correlation at a distance along one axis; in the plane it is the product of both axes."""
        return np.asarray(np.exp(-0.5 * (distance / self["corr"]) ** 2))

    def _between(self, x: int, n: int, y: int, m: int) -> float:
        """Mean correlation of n pixels from x on with m pixels from y on, along one axis."""
        return float(
            self._along(
                (x + np.arange(float(n)))[:, None] - (y + np.arange(float(m)))
            ).mean()
        )

    def _left(self, rows: int, columns: int, layout: Layout) -> FloatArray:
        """Correlation that is left after the means of boxes are subtracted, by lag [j, i].

        From the product d(p) d(q) the subtraction removes the mean correlation of p with q's box and
        of q with p's box, and adds that of both boxes.  The measurement corrects the bias of its
        box means by adding the sum over the measured lags divided by the pixels of a box.
        """
        y, x = (self._taken(n, layout) for n in (rows, columns))
        out = (
            np.multiply.outer(y[0], x[0])
            - np.multiply.outer(y[1], x[1])
            - np.multiply.outer(y[2], x[2])
            + np.multiply.outer(y[3], x[3])
        )
        fold = np.where(np.arange(layout.lags + 1) > 0, 2.0, 1.0)
        boxes = max(round(rows / layout.box), 1) * max(round(columns / layout.box), 1)
        return np.asarray(out + fold @ out @ fold * boxes / (rows * columns))

    def _taken(self, n: int, layout: Layout) -> FloatArray:
        """Mean correlations along one axis by lag: p with q, p with q's box, q with p's, both boxes."""
        count = max(round(n / layout.box), 1)
        edges = np.round(np.linspace(0, n, count + 1)).astype(int)
        box = np.repeat(np.arange(count), np.diff(edges))
        place = np.arange(n)
        away = np.subtract.outer(place, place).astype(float)
        with_box = np.add.reduceat(self._along(away), edges[:-1], axis=1)
        with_box /= np.diff(edges)
        both = np.add.reduceat(with_box, edges[:-1], axis=0) / np.diff(edges)[:, None]
        out = []
        for lag in range(layout.lags + 1):
            p, q = place[: n - lag], place[lag:]
            out.append((
                float(self._along(np.array(float(lag)))), with_box[p, box[q]].mean(),
                with_box[q, box[p]].mean(), both[box[p], box[q]].mean(),
            ))  # fmt: skip
        return np.array(out).T
