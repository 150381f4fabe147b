"""Electronic memory: earlier pixels remain in the amplifier, or drive its offset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen, Shot
from bfsensor.effects.transfer import trail_image
from bfsensor.typing import FloatArray


class ElectronicMemory(Effect):
    """The fraction ``alpha`` of the signal of the pixel read before is added to each pixel.

    It is the same in all columns, whereas charge left behind by transfers grows with the column; a
    stage that overshoots has a negative fraction, which transfers cannot have.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``alpha``: 1e-05 to 0.001 in magnitude, either sign (0 changes nothing).

    Examples
    --------
    >>> ElectronicMemory({"alpha": 0.0001}).name
    'electronic_memory'
    """

    word = "electronic_memory"
    parameters = (Parameter("alpha", "", 1e-5, 1e-3, signed=True, amplitude=True),)
    touches = ("serial_overscan", "flat_mean", "flat_cov", "flat_map", "spot")
    maps_vary = "nothing"
    in_areas = True
    source = (
        "Electronic offset drift of ITL sensors, here of one pixel: Snyder et al. 2021, JATIS 7, "
        "048002; range assumed"
    )

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        if self["alpha"] == 0:
            return frames
        out = []
        for frame in frames:
            before = np.zeros_like(frame)
            before.ravel()[1:] = frame.ravel()[:-1]
            out.append(frame + np.asarray(self["alpha"], frame.dtype) * before)
        return out

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        # The pixel before the first column, of the prescan or overscan, holds no light.
        out = np.zeros(layout.shape)
        for s in layout.segments:
            column = s.x + (s.columns - 1 if s.flip_x else 0)
            out[s.y : s.y + s.rows, column] = -self._share
        return out

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        return level * (1.0 + self["alpha"])

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        # Each pixel is a weighted mean of two, as the gain is that of uniform light.
        both = np.roll(c, 1, -1) + np.roll(c, -1, -1)
        part = self._share
        return np.asarray(c + part * (1 - part) * (both - 2 * c))

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        return trail_image(images, self._share, layout.backwards("x"), -1)

    def serial_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        return np.where(axes["k"] == 1, self["alpha"] * axes["level"], 0.0)

    @property
    def _share(self) -> float:
        """Fraction of a uniform signal that is of the pixel before."""
        return self["alpha"] / (1.0 + self["alpha"])


class Settling(Effect):
    r"""Pixel n receives :math:`\alpha \sum_{d \ge 1} e^{-(d-1)/\tau} S_{n-d}`: one slow stage.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``alpha``: 1e-05 to 0.001 in magnitude, either sign (0 changes nothing);
        ``tau`` [pixel times]: 0.5 to 30.

    Examples
    --------
    >>> Settling({"alpha": 0.0001, "tau": 3.0}).name
    'electronic_memory:settling'
    """

    word = "electronic_memory"
    variant = "settling"
    parameters = (
        Parameter("alpha", "", 1e-5, 1e-3, signed=True, amplitude=True),
        Parameter("tau", "pixel times", 0.5, 30.0),
    )
    touches = ("serial_overscan", "flat_mean", "flat_cov", "flat_map", "spot")
    maps_vary = "nothing"
    in_areas = True
    source = (
        "Exponential settling of a stage of first order: Horowitz & Hill, The Art of Electronics, "
        "section 1.4; Janesick 2001, Scientific Charge-Coupled Devices, SPIE Press, section 6.2; "
        "ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"alpha": 1e-4, "tau": tau} for tau in (1.0, 4.0, 15.0)]

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        if self["alpha"] == 0:
            return frames
        return [
            (f + self._before(f.ravel()).reshape(f.shape)).astype(f.dtype) for f in frames
        ]

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        out = np.zeros(layout.shape)
        for s in layout.segments:
            # Columns read first have less light before them.
            read = np.arange(s.columns)
            missing = self._sum * np.exp(-read / self["tau"]) / (1 + self._sum)
            line = np.zeros(s.columns)
            line[s.sensor_column(read) - s.x] = -missing
            out[s.y : s.y + s.rows, s.x : s.x + s.columns] = line
        return out

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        return level * (1.0 + self._sum)

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        total, out = self._sum / (1 + self._sum), c
        out = c * (1 - 2 * total)
        for late in range(1, c.shape[-1] // 2):
            share = self["alpha"] * np.exp(-(late - 1) / self["tau"]) / (1 + self._sum)
            out = out + share * (np.roll(c, late, -1) + np.roll(c, -late, -1))
        return np.asarray(out)

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        share = layout.backwards("x")
        late = (1 - share) * self._before(images)
        late = late + share * self._before(images[..., ::-1])[..., ::-1]
        return np.asarray((images + late) / (1 + self._sum))

    def serial_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        return self._sum * np.exp(-(axes["k"] - 1) / self["tau"]) * axes["level"]

    def _before(self, lines: NDArray) -> FloatArray:
        """Part of earlier pixels of the last axis that each receives."""
        keep = float(np.exp(-1 / self["tau"]))
        return np.asarray(lfilter([0.0, self["alpha"]], [1.0, -keep], lines))

    @property
    def _sum(self) -> float:
        """Part of a uniform signal that all earlier pixels add."""
        return float(self["alpha"] / -np.expm1(-1 / self["tau"]))


class OffsetDrift(Effect):
    r"""An offset that bright pixels drive and that decays: :math:`o_n` is added to pixel n.

    .. math:: o_n = \max(\mathrm{scale}\, (S_n - \mathrm{threshold}),\ o_{n-1} e^{-1/\tau},\ 0)

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``scale``: 1e-05 to 0.001 (0 changes nothing); ``threshold`` [e-]: 300
        to 100000; ``tau`` [pixel times]: 0.5 to 100.

    Examples
    --------
    >>> OffsetDrift({"scale": 0.0001, "threshold": 1e4, "tau": 10.0}).name
    'electronic_memory:offset_drift'
    """

    word = "electronic_memory"
    variant = "offset_drift"
    parameters = (
        Parameter("scale", "", 1e-5, 1e-3, amplitude=True),
        Parameter("threshold", "e-", 300.0, 1e5),
        Parameter("tau", "pixel times", 0.5, 100.0),
    )
    touches = ("serial_overscan", "flat_mean", "flat_cov", "spot")
    source = (
        "Drift of the local electronic offset of ITL sensors: Snyder et al. 2021, JATIS 7, 048002, "
        "section 3; ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"scale": 1e-4, "threshold": level, "tau": tau}
            for level in (5e3, 4e4) for tau in (2.0, 15.0)
        ]  # fmt: skip

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        if self["scale"] == 0:
            return frames
        return [
            (f + self._offsets(f.reshape(1, -1)).reshape(f.shape)).astype(f.dtype)
            for f in frames
        ]

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        return level + self._driven(level)

    def serial_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        return self._driven(axes["level"]) * np.exp(-axes["k"] / self["tau"])

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        if self["scale"] == 0:
            return images
        level = axes.get("background", 0.0) * images.sum((-2, -1), keepdims=True)
        lines = images + level
        out = images.astype(float)
        share = layout.backwards("x")
        for part, order in ((1 - share, 1), (share, -1)):
            if part:
                own = lines[..., ::order].reshape(-1, lines.shape[-1])
                # `signal` adds the offset that each pixel drives itself.
                more = (self._offsets(own) - self._driven(own)).reshape(lines.shape)
                out = out + part * more[..., ::order]
        return np.asarray(out)

    def _driven(self, level: NDArray) -> FloatArray:
        """Offset that pixels drive themselves [e-]."""
        return np.asarray(self["scale"] * np.maximum(level - self["threshold"], 0.0))

    def _offsets(self, lines: NDArray) -> FloatArray:
        """Offsets of pixels along the last axis, shape (n, pixels)."""
        # The largest of all earlier driven offsets, decayed, is a running maximum in the logarithm.
        driven = self._driven(lines)
        place = np.arange(lines.shape[-1]) / self["tau"]
        with np.errstate(divide="ignore"):
            log = np.log(driven) + place
        return np.asarray(np.exp(np.maximum.accumulate(log, axis=-1) - place))
