"""Changes of the maps of flats by effects, relaxed by brighter-fatter feedback per frequency."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, ifft, irfft, irfft2, rfft, rfft2

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channel_rows import condition_of_row
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import numbers_of
from bfsensor.diagnose.data.map_channels import (
    RINGS,
    MapShare,
    block_side,
    map_chess,
    spectrum_rings,
)
from bfsensor.diagnose.data.map_texture import map_texture
from bfsensor.diagnose.data.map_waves import smooth_shapes
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.effects.effect import Axes, Effect, Layout, Shot
from bfsensor.files import Cache
from bfsensor.response.edge_response import area_matrix
from bfsensor.typing import FloatArray

Spectrum = NDArray[np.complexfloating[Any, Any]]
"""Half of a two-dimensional Fourier transform, as ``scipy.fft.rfft2`` returns it."""

FAINT = 0.01
"""Least change of a texture relative to its error for the texture to be calculated. Chosen: smaller
changes change the chi-square by less than 1e-4 per value; twice as large, by less than 4e-4."""

KEPT, KEPT_PIXELS = 12, 2_000_000
"""Largest number of cached changes by single effects, and largest sensor for which they are cached,
and for which maps are predicted in double precision [pixel]. Chosen: up to 12 arrays of 16 MB; twice
as large doubles memory and changes no result."""


def precision_of(shape: tuple[int, int]) -> type[np.float32] | type[np.float64]:
    """Type of arrays of a sensor: single precision on a large one, in half of the memory and time.

    Rounding is then 1e-7 of a change, which itself is measured to 1e-3 of it at best.
    """
    return np.float32 if np.prod(shape) > KEPT_PIXELS else np.float64


def shot_at(
    layout: Layout, condition: Condition, kind: str = "flat", seconds: float = 0.0
) -> Shot:
    """Make an exposure at a condition; unknown settings are those of the reference."""
    values = (
        float(own) if np.isfinite(own) else usual
        for own, usual in zip(numbers_of(condition), layout.reference, strict=True)
    )
    return Shot(kind, -1, seconds, *values)


class MapChange:
    """Change of the flats' maps by effects.

    A pattern of pixel areas or of the light fills pixels unevenly, and the boundary shifts by that
    charge relax it.  At each spatial frequency, as for fluctuations of the light, a fraction
    (exp(a m) - 1) / (a m) is left at the level m.  Changes after collection are not relaxed.

    Parameters
    ----------
    effects : sequence of Effect
        Effects in the order of their stages.
    layout : Layout
        Sensor and campaign.
    measured : MeasuredChannels
        Channels of the campaign, for the flats that each map is made of.
    baseline : Baseline
        Boundary shifts, by which patterns are relaxed.
    kept : Cache
        Results that stay valid when effects change: rows of maps, remaining fractions of
        patterns, and changes by single effects.
    evening : (float, mapping of str to float)
        Gain [e-/ADU] and device parameters less their nominal values at which patterns are
        relaxed.
    """

    def __init__(
        self,
        effects: Sequence[Effect],
        layout: Layout,
        measured: MeasuredChannels,
        baseline: Baseline,
        kept: Cache,
        evening: tuple[float, Mapping[str, float]],
    ) -> None:
        self.effects = [e for e in effects if "flat_map" in e.touches]
        self.layout, self.measured, self.baseline = layout, measured, baseline
        self._gain, self._device = evening[0], dict(evening[1])
        self._rows = kept.get("rows", Cache)
        self._parts = kept.get("parts", partial(Cache, KEPT))
        # Arrays as large as the sensor: those of one gain and device at a time.
        state = self._gain, *self._device.values()
        self._evened = kept.get("evened", partial(Cache, 1)).get(state, Cache)
        self._by_time = any(e.maps_vary == "exposure" for e in self.effects)
        self._standing = all(e.maps_vary == "nothing" for e in self.effects)
        self._made: dict[tuple, Spectrum | None] = {}

    def of(self, channel: Channel) -> FloatArray:
        """Change of all values of a channel of flats against position."""
        out = np.zeros(len(channel))
        if not self.effects:
            return out
        for (fold, name), shares in self.measured.maps.items():
            if fold != channel.fold:
                continue
            delta, change = self._changes((fold, name), shares)
            rows, axes = self._rows.get((channel, name), partial(_rows, channel, name))
            if not len(rows):
                continue
            if delta is None:
                if change is not None and change.any():
                    out[rows] = reduce_image(change, axes)
                continue
            if change is not None:
                delta = delta + rfft2(change)
            if delta.any():
                out[rows] = reduce_spectrum(delta, self.layout.shape, axes)
        return out

    def _changes(
        self, name: tuple[str, str], shares: Sequence[MapShare]
    ) -> tuple[Spectrum | None, NDArray[np.floating[Any]] | None]:
        """Relative change of a map: the Fourier transform of a part, and the pixels of the other.

        Areas and light are relaxed or cached by their transforms; patterns need none.
        """
        total: Spectrum | None = None
        pixels: NDArray[np.floating[Any]] | None = None
        for key, group in self._groups(shares).items():
            for uneven in (self._areas(key, group[0]), self._light(key, group[0])):
                if uneven is not None:
                    uneven = uneven * self._left((*name, *key), group)
                    total = uneven if total is None else total + uneven
            if (pattern := self._patterns(group)) is not None:
                pixels = pattern if pixels is None else pixels + pattern
        return total, pixels

    def _groups(self, shares: Sequence[MapShare]) -> dict[tuple, list[MapShare]]:
        """Flats of a map in groups that effects change by the same amount."""
        out: dict[tuple, list[MapShare]] = {}
        for share in shares:
            where = None if self._standing else share.condition
            out.setdefault((where, share.seconds if self._by_time else 0.0), []).append(
                share
            )
        return out

    def _left(self, key: tuple, group: Sequence[MapShare]) -> FloatArray:
        """Sum of the flats' weights times the remaining fraction of a pattern, by spatial frequency."""

        def evened() -> FloatArray:
            parts = [
                s.weight * self._left_at(s.condition, self._gain * s.level) for s in group
            ]
            return np.asarray(np.sum(parts, axis=0))

        return self._evened.get(key, evened)

    def _left_at(self, condition: Condition, level: float) -> FloatArray:
        """Remaining fraction of a pattern at a level [e-], by spatial frequency of the sensor."""
        a = area_matrix(*self.baseline.at(condition, self._device)[0])
        wide = np.zeros(self.layout.shape)
        half = a.shape[0] // 2
        rows, columns = (np.arange(-half, half + 1) % n for n in self.layout.shape)
        np.add.at(wide, (rows[:, None], columns[None]), a)
        x = rfft2(wide).real * level
        small = np.abs(x) < 1e-9
        left = np.where(small, 1 + x / 2, np.expm1(x) / np.where(small, 1.0, x))
        return left.astype(precision_of(self.layout.shape), copy=False)

    def _areas(self, key: tuple, share: MapShare) -> Spectrum | None:
        """Transform of the relative change of the pixels' areas without charge."""

        def change(effect: Effect, shot: Shot) -> FloatArray | None:
            return area_change(effect, shot, self.layout)

        return self._sum("areas", key, share, change)

    def _light(self, key: tuple, share: MapShare) -> Spectrum | None:
        """Transform of the relative change of the light."""

        def change(effect: Effect, shot: Shot) -> FloatArray | None:
            factor = effect.light_map(shot, self.layout)
            return None if factor is None else factor - 1.0

        return self._sum("light", key, share, change)

    def _patterns(self, group: Sequence[MapShare]) -> NDArray[np.floating[Any]] | None:
        """Changes after collection, which depend on each flat's level."""
        total: FloatArray | None = None
        for effect in self.effects:
            # What is equal in all flats is made once.
            weights = (
                [(_weight(group), group[0])] if effect.maps_vary == "nothing"
                else [(s.weight, s) for s in group]
            )  # fmt: skip
            for weight, share in weights:
                one = effect.pattern(self._shot(share), self.layout) if weight else None
                if one is None:
                    continue
                if total is None:
                    total = np.zeros(self.layout.shape)
                total += weight * one
        return None if total is None else self._normalised(total)

    def _shot(self, share: MapShare) -> Shot:
        shot = shot_at(self.layout, share.condition, "flat", share.seconds)
        return shot._replace(level=self._gain * share.level)

    def _sum(
        self,
        word: str,
        key: tuple,
        share: MapShare,
        change: Callable[[Effect, Shot], FloatArray | None],
    ) -> Spectrum | None:
        """Transform of the sum of all effects' changes, cached."""
        if (word, *key) not in self._made:
            shot = self._shot(share)
            parts = [
                p for e in self.effects
                if (p := self._part(word, e, shot, change)) is not None
            ]  # fmt: skip
            self._made[word, *key] = (
                self._transform(np.sum(parts, axis=0)) if parts else None
            )
        return self._made[word, *key]

    def _part(
        self,
        word: str,
        effect: Effect,
        shot: Shot,
        change: Callable[[Effect, Shot], FloatArray | None],
    ) -> FloatArray | None:
        """Change by one effect, cached where there are several effects and the sensor is small."""
        if len(self.effects) == 1 or np.prod(self.layout.shape) > KEPT_PIXELS:
            return change(effect, shot)
        key = word, effect, None if effect.maps_vary == "nothing" else shot
        return self._parts.get(key, lambda: change(effect, shot))

    def _transform(self, change: FloatArray) -> Spectrum:
        """Fourier transform of a relative change, each amplifier divided by its mean."""
        return np.asarray(rfft2(self._normalised(change)))

    def _normalised(self, change: FloatArray) -> NDArray[np.floating[Any]]:
        """Relative change with each amplifier divided by its mean."""
        shape = self.layout.shape
        total: NDArray[Any] = np.array(np.broadcast_to(change, shape), precision_of(shape))
        for segment in self.layout.segments:
            part = total[segment.y : segment.y + segment.rows,
                         segment.x : segment.x + segment.columns]  # fmt: skip
            mean = float(part.mean(dtype=np.float64))
            part[...] = (part - mean) / (1.0 + mean)
        return total


def _weight(group: Sequence[MapShare]) -> float:
    """Sum of the flats' weights; 0 in a ratio of maps, where it is 0 but for rounding."""
    weights = [s.weight for s in group]
    total = float(sum(weights))
    return total if abs(total) > 1e-12 * sum(map(abs, weights)) else 0.0


def _rows(channel: Channel, name: str) -> tuple[NDArray[np.int64], Axes]:
    """Indices of a map's values in a channel, and their places."""
    rows = np.nonzero(channel.axes["map"] == name)[0]
    parts = parts_of({k: channel.axes[k][rows] for k in ("what", "x", "y", "k")})
    errors = channel.errors[rows[parts["texture"]]]
    parts["faint"] = np.array(1e-6 * FAINT * min(errors, default=0.0))
    return rows, parts


def area_change(effect: Effect, shot: Shot, layout: Layout) -> FloatArray | None:
    """Relative change of the pixels' areas by an effect; None if it displaces no edges."""
    moved = effect.displacements(shot, layout)
    if moved is None:
        return None
    return np.asarray(np.diff(moved[0], axis=1) + np.diff(moved[1], axis=0))


def lines_of_map(effect: Effect, channel: Channel, layout: Layout) -> FloatArray:
    """Change of columns, rows and blocks of the map of all light, without relaxation."""
    x, out = channel.axes, np.zeros(len(channel))
    own = np.nonzero(x["map"] == "all")[0]
    if not len(own):
        return out
    shot = shot_at(layout, condition_of_row(channel, own[0]))
    light, change = effect.light_map(shot, layout), area_change(effect, shot, layout)
    total = np.zeros(layout.shape)
    for part in (change, None if light is None else light - 1.0):
        if part is not None:
            total += part
    for segment in layout.segments:
        box = np.s_[segment.y : segment.y + segment.rows,
                    segment.x : segment.x + segment.columns]  # fmt: skip
        total[box] -= total[box].mean()
    for what, axis, name in (("column", 0, "x"), ("row", 1, "y")):
        rows = own[x["what"][own] == what]
        out[rows] = total.mean(axis)[x[name][rows].astype(int)]
    rows = own[x["what"][own] == "block"]
    out[rows] = block_means(total)[block_places(x, rows, layout.shape)]
    return out


def block_means(change: NDArray[np.floating[Any]]) -> FloatArray:
    """Mean values of a map's blocks."""
    ny, nx = change.shape
    side = block_side((ny, nx))
    whole = change[: ny // side * side, : nx // side * side]
    boxes = whole.reshape(ny // side, side, nx // side, side)
    return np.asarray(boxes.mean((1, 3), dtype=np.float64))


def block_places(
    axes: Axes, rows: NDArray[np.int64], shape: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column of the block that each value belongs to."""
    side = block_side(shape)
    y, x = (((axes[n][rows] + 0.5) / side).astype(int) for n in "yx")
    return y, x


PARTS = ("column", "row", "block", "ring", "texture", "chess")
"""Kinds of values of a map: axis 'what' of the channel."""


def parts_of(axes: Axes) -> dict[str, NDArray[Any]]:
    """Axes 'x', 'y', 'k' of a map's values, and the indices of each of :data:`PARTS`."""
    found = {w: np.nonzero(axes["what"] == w)[0] for w in PARTS}
    return found | {k: axes[k] for k in ("x", "y", "k")}


def reduce_map(change: FloatArray, axes: Axes) -> FloatArray:
    """Reduce a relative change of a map to the values of the channel.

    Parameters
    ----------
    change : ndarray, shape (ny, nx)
        Relative change of each pixel.
    axes : mapping
        Axes 'what', 'x', 'y' and 'k' of the values.
    """
    return reduce_image(change, parts_of(axes))


def reduce_image(change: NDArray[np.floating[Any]], axes: Axes) -> FloatArray:
    """Reduce a relative change of each pixel, as :func:`reduce_spectrum` does its transform."""
    out = np.zeros(len(axes["x"]))
    column, row = axes["column"], axes["row"]
    out[column] = change.mean(0, dtype=np.float64)[axes["x"][column].astype(int)]
    out[row] = change.mean(1, dtype=np.float64)[axes["y"][row].astype(int)]
    _reduce_rest(out, change, None, axes)
    return out


def reduce_spectrum(delta: Spectrum, shape: tuple[int, int], axes: Axes) -> FloatArray:
    """Reduce the transform of a map's change to columns, rows, blocks, rings, texture and chess.

    Parameters
    ----------
    delta : ndarray, shape (ny, nx // 2 + 1)
        Fourier transform of the relative change.
    shape : tuple of int
        Rows and columns of the map.
    axes : mapping
        From :func:`parts_of`; 'faint': mean square of a change up to which its texture is 0.
    """
    ny, nx = shape
    out = np.zeros(len(axes["x"]))
    column, row = axes["column"], axes["row"]
    out[column] = (irfft(delta[0], n=nx) / ny)[axes["x"][column].astype(int)]
    out[row] = (ifft(delta[:, 0]).real / nx)[axes["y"][row].astype(int)]
    if any(len(axes[w]) for w in PARTS[2:]):
        _reduce_rest(out, irfft2(delta, s=shape), delta, axes)
    return out


def _reduce_rest(
    out: FloatArray,
    change: NDArray[np.floating[Any]],
    delta: Spectrum | None,
    axes: Axes,
) -> None:
    """Enter blocks, rings, texture and chess of a change, whose transform may be known, in ``out``."""
    (ny, nx), shape = change.shape, (change.shape[0], change.shape[1])
    block, ring, texture, chess = (axes[w] for w in PARTS[2:])
    if len(block):
        out[block] = block_means(change)[block_places(axes, block, shape)]
    if len(chess):
        out[chess] = map_chess(change)[0]
    if not len(ring) and not len(texture):
        return
    # Rings and texture are measured on maps whose smooth shape is removed.
    q_y, q_x = (smooth_shapes(n).astype(change.dtype, copy=False) for n in shape)
    smooth = q_y.T @ change @ q_x
    if delta is None:
        rough = np.asarray(rfft2(change - q_y @ smooth @ q_x.T))
    else:
        (f_y, _), (_, f_x) = (_smooth_spectra(n) for n in shape)
        f_y, f_x = (f.astype(delta.dtype, copy=False) for f in (f_y, f_x))
        rough = delta - f_y @ smooth @ f_x.T
    power = spectrum_rings(rough, shape)
    out[ring] = 1e6 * power[(axes["k"][ring] * 2 * RINGS).astype(int)]
    square = 2 * float((rough.real**2).sum() + (rough.imag**2).sum()) / (ny * nx) ** 2
    if len(texture) and square > axes.get("faint", 0.0):
        out[texture] = map_texture(change - q_y @ smooth @ q_x.T)[0]


@lru_cache(maxsize=8)
def _smooth_spectra(n: int) -> tuple[Spectrum, Spectrum]:
    """Transforms of the smooth shapes along a side, at all and at non-negative frequencies."""
    shapes = smooth_shapes(n)
    return fft(shapes, axis=0), rfft(shapes, axis=0)
