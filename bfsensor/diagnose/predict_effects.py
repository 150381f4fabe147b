"""What effects change in each channel: from what they do to light, charge and signal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.baseline import Baseline, Edges, area_matrix
from bfsensor.diagnose.channels import Channel
from bfsensor.diagnose.conditions import Condition
from bfsensor.diagnose.extract import Measured
from bfsensor.diagnose.flat_channels import TAIL
from bfsensor.diagnose.map_channels import BLOCKS, RINGS, map_chess, map_texture, ring_power
from bfsensor.effects.effect import STAGES, Axes, Effect, Law, Layout, Shot

ADDED = (
    "flat_mean", "serial_overscan", "parallel_overscan", "bias_cov", "bias_level", "dark_map",
    "amp_cross", "code_hist",
)  # fmt: skip
"""Channels whose change effects give themselves, by a method of that name."""

ROUNDS = 4
"""Of the inversion of the signal's law: its departure from 1 is a few per cent at most."""


def layout_of(measured: Measured, baseline: Baseline) -> Layout:
    """Sensor and campaign as effects see them."""
    wavelength, bias = baseline.reference
    card = baseline.card
    reference = [s.temperature for s in measured.shots if np.isfinite(s.temperature)]
    return Layout(
        measured.shape, measured.segments, measured.shots, measured.gains,
        (wavelength if np.isfinite(wavelength) else 620.0, bias if np.isfinite(bias) else -60.0,
         float(np.median(reference)) if reference else -100.0),
        offsets=measured.offsets, read_noise=measured.read_noise, **card,
    )  # fmt: skip


class EffectChain:
    """Several effects in the order of their stages, as a campaign shows them.

    Parameters
    ----------
    effects : sequence of Effect
        Any order.
    layout : Layout
        Sensor and campaign.
    measured : Measured
        Of which flats the maps are made.
    baseline : Baseline
        Its shifts even patterns out.
    kept : dict
        Filled with what does not depend on effects.
    """

    def __init__(
        self,
        effects: Sequence[Effect],
        layout: Layout,
        measured: Measured,
        baseline: Baseline,
        kept: dict[tuple, NDArray[np.float64]],
    ) -> None:
        self.effects = tuple(sorted(effects, key=lambda e: STAGES.index(e.stage)))
        self.layout, self.measured, self.baseline = layout, measured, baseline
        self._kept_evened = kept
        self.law = Law()
        for effect in self.effects:
            self.law = self.law.with_law(effect.law())

    def shot(self, condition: Condition, kind: str = "flat", seconds: float = 0.0) -> Shot:
        """Exposure at a condition; what is not known is the reference's."""
        values = (
            float(own) if np.isfinite(own) else usual
            for own, usual in zip(condition, self.layout.reference, strict=True)
        )
        return Shot(kind, -1, seconds, *values)

    def edges(self, edges: Edges, condition: Condition) -> Edges:
        """Shifts with all effects."""
        for effect in self.effects:
            edges = effect.edges(*edges, self.shot(condition), self.layout)
        return edges

    def area_change(self, edges: Edges, condition: Condition) -> NDArray[np.float64]:
        """What effects add to the area changes of given shifts [1/e-]."""
        changed = self.edges(edges, condition)
        if changed is edges:
            return np.zeros_like(edges[0])
        a, more = area_matrix(*edges), area_matrix(*changed)
        if more.shape == a.shape:
            return more - a
        # Shifts may reach farther than the baseline's.
        margin = (more.shape[0] - a.shape[0]) // 2
        return np.asarray(more - np.pad(a, margin))

    def signal(self, level: NDArray[np.float64], axes: Axes) -> NDArray[np.float64]:
        """Signal after the amplifier of collected charge [e-]."""
        for effect in self.effects:
            level = effect.signal(level, axes, self.layout)
        return level

    def collected(self, signal: NDArray[np.float64], axes: Axes) -> NDArray[np.float64]:
        """Collected charge of a signal [e-]."""
        level = signal
        for _ in range(ROUNDS):
            level = signal - (self.signal(level, {**axes, "level": level}) - level)
        return np.asarray(level)

    def covariances(self, c: NDArray[np.float64], axes: Axes) -> NDArray[np.float64]:
        """Covariances of flats after all effects, the signal's slope among them [e-^2]."""
        level = np.asarray(axes["level"], float)
        for effect in self.effects:
            step = 1e-3 * np.maximum(level, 1.0)
            ends = level + step, level - step
            up, down = (effect.signal(x, {**axes, "level": x}, self.layout) for x in ends)
            if not (np.array_equal(up, ends[0]) and np.array_equal(down, ends[1])):
                c = c * (((up - down) / (2 * step)) ** 2)[:, None, None]
            c = effect.covariances(c, axes, self.layout)
        return c

    def added(
        self, channel: Channel, gains: NDArray[np.float64], axes: dict[str, NDArray]
    ) -> NDArray[np.float64]:
        """Change of a channel, of :data:`ADDED`, in its unit; axes as measured, levels in ADU."""
        rows = len(channel)
        amp = axes.get("amp", np.zeros(rows)).astype(int)
        own = gains[amp] if len(gains) else np.ones(rows)
        axes = dict(axes)
        if "level" in axes:
            axes["level"] = self.collected(own * axes["level"], axes)
        if channel.word == "dark_map":
            axes["after"] = own * axes["after"]
        out = np.zeros(rows)
        for effect in self.effects:
            if channel.word in effect.touches:
                out += getattr(effect, channel.word)(axes, self.layout)
            if channel.word in ("serial_overscan", "parallel_overscan"):
                out -= self._in_overscan(effect, channel.word, axes, TAIL)
            if channel.word == "flat_mean":
                out -= self._in_overscan(effect, "serial_overscan", axes, None)
        if channel.word == "flat_mean":
            level = axes["level"]
            out += self.signal(level, axes) - level
            if self.law.loss:
                # Light that brings the level m with a loss q: (exp(q m) - 1) / q.
                out += level - np.expm1(self.law.loss * level) / self.law.loss
        out = out / _unit(channel, own, gains)
        if channel.word == "bias_level":
            # Variances over those that white noise makes.
            what, ratio = axes["what"], out / own / axes["white"]
            out = np.where(what == "rows", ratio, out)
            out = np.where(what == "frames", np.log1p(np.maximum(ratio, 0.0)), out)
        return np.asarray(out)

    def _in_overscan(
        self, effect: Effect, word: str, axes: dict[str, NDArray], last: int | None
    ) -> NDArray[np.float64]:
        """Mean of what an effect adds to an overscan's last pixels, or to its second half [e-]."""
        out = np.zeros(len(axes["amp"]))
        if word not in effect.touches:
            return out
        depth = self.layout.of_amp(word, axes["amp"]).astype(int)
        for deep in np.unique(depth[depth > 0]):
            rows = depth == deep
            here = {k: v[rows] for k, v in axes.items()}
            first = deep // 2 if last is None else deep - last
            pixels = range(first + 1, deep + 1)
            change = [
                getattr(effect, word)(
                    {**here, "k": np.full(rows.sum(), float(k))}, self.layout
                )
                for k in pixels
            ]
            out[rows] = np.mean(change, axis=0)
        return out

    def spot_change(
        self, condition: Condition
    ) -> tuple[float, tuple[float, float], Mapping[str, float]]:
        """Added variance [pixel^2], halo and axes of the spots at a condition."""
        shot = self.shot(condition, "spot")
        variance, share, wide = 0.0, 0.0, 1.0
        for effect in self.effects:
            v, f, s = effect.spot_light(shot, self.layout)
            variance += v
            if f:
                share, wide = f, s
        axes = {k: getattr(shot, k) for k in ("wavelength", "back_bias", "temperature")}
        return variance, (share, wide), axes

    def spot_image(
        self, images: NDArray[np.float64], axes: Mapping[str, float]
    ) -> NDArray[np.float64]:
        """Mean images of spots [e-] as they are read."""
        for effect in self.effects:
            images = effect.spot_image(images, axes, self.layout)
            shaped = {
                **{k: np.full(images.shape, v) for k, v in axes.items()},
                "level": images,
            }
            images = effect.signal(images, shaped, self.layout)
        return images

    def map_change(self, channel: Channel) -> NDArray[np.float64]:
        """Change of the flats' maps.

        A pattern of pixel areas fills up unevenly and is evened out by the shifts that its own
        charge makes, mode by mode as the fluctuations of the light are:
        (exp(a m) - 1) / (a m) of it is left at the level m.
        """
        out = np.zeros(len(channel))
        names = channel.axes["map"]
        gain = float(np.mean(self.layout.gains or (1.0,)))
        by_time = any(e.by_time for e in self.effects)
        kept: dict[tuple, NDArray[np.complex128] | None] = {}
        for (fold, name), shares in self.measured.maps.items():
            if fold != channel.fold:
                continue
            delta: NDArray[np.complex128] | None = None
            for share in shares:
                key = (share.condition.key, share.seconds if by_time else 0.0)
                if key not in kept:
                    kept[key] = self._map(share.condition, share.seconds)
                one = kept[key]
                after = self._pattern(share.condition, share.seconds, gain * share.level)
                if after is not None:
                    after = share.weight * after
                    delta = after if delta is None else delta + after
                if one is not None:
                    one = (
                        share.weight
                        * one
                        * self._evened(share.condition, gain * share.level)
                    )
                    delta = one if delta is None else delta + one
            rows = np.nonzero(names == name)[0]
            if delta is not None and len(rows) and np.abs(delta).max() > 0:
                change = np.fft.irfft2(delta, s=self.layout.shape)
                out[rows] = reduce_map(
                    change, {k: v[rows] for k, v in channel.axes.items()}
                )
        return out

    def _evened(self, condition: Condition, level: float) -> NDArray[np.float64]:
        """What is left of a pattern's modes at a level [e-], on the sensor's grid."""
        key = (condition.key, round(level, -2), self.layout.shape)
        kept = self._kept_evened
        if key not in kept:
            a = area_matrix(*self.baseline.at(condition)[0])
            wide = np.zeros(self.layout.shape)
            half = a.shape[0] // 2
            rows, columns = (np.arange(-half, half + 1) % n for n in self.layout.shape)
            np.add.at(wide, (rows[:, None], columns[None]), a)
            x = np.fft.rfft2(wide).real * level
            small = np.abs(x) < 1e-9
            kept[key] = np.where(small, 1 + x / 2, np.expm1(x) / np.where(small, 1.0, x))
        return kept[key]

    def _map(self, condition: Condition, seconds: float) -> NDArray[np.complex128] | None:
        """Transform of the relative change of a weak flat, each amplifier over its mean."""
        shot = self.shot(condition, "flat", seconds)
        total: NDArray[np.float64] | None = None
        for effect in self.effects:
            moved = effect.displacements(shot, self.layout)
            if moved is not None:
                change = np.diff(moved[0], axis=1) + np.diff(moved[1], axis=0)
                total = change if total is None else total + change
            factor = effect.light_map(shot, self.layout)
            if factor is not None:
                total = factor - 1.0 if total is None else total + factor - 1.0
        return None if total is None else self._transform(total)

    def _pattern(
        self, condition: Condition, seconds: float, level: float
    ) -> NDArray[np.complex128] | None:
        """Transform of what is not evened out, for it comes after collection."""
        shot = self.shot(condition, "flat", seconds)._replace(level=level)
        parts = [e.pattern(shot, self.layout) for e in self.effects]
        found = [p for p in parts if p is not None]
        return self._transform(np.sum(found, axis=0)) if found else None

    def _transform(self, total: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Spatial frequencies of a map, each amplifier less its mean."""
        total = total.copy()
        for segment in self.layout.segments:
            part = np.s_[segment.y : segment.y + segment.rows,
                         segment.x : segment.x + segment.columns]  # fmt: skip
            total[part] -= total[part].mean()
        return np.asarray(np.fft.rfft2(total))


def reduce_map(change: NDArray[np.float64], axes: Axes) -> NDArray[np.float64]:
    """What a change of a map does to its columns, rows, blocks, rings, texture and chess pattern."""
    ny, nx = change.shape
    what = axes["what"]
    out = np.zeros(len(what))
    column, row, block, ring = (what == w for w in ("column", "row", "block", "ring"))
    if column.any():
        out[column] = change.mean(0)[axes["x"][column].astype(int)]
    if row.any():
        out[row] = change.mean(1)[axes["y"][row].astype(int)]
    if block.any():
        side = int(np.ceil(max(ny, nx) / BLOCKS))
        mean = change[: ny // side * side, : nx // side * side]
        mean = mean.reshape(ny // side, side, nx // side, side).mean((1, 3))
        y, x = (((axes[n][block] + 0.5) / side).astype(int) for n in "yx")
        out[block] = mean[y, x]
    if ring.any():
        power = ring_power(change)
        out[ring] = 1e6 * power[(axes["k"][ring] * 2 * RINGS).astype(int)]
    for name, values in (("texture", map_texture), ("chess", map_chess)):
        if (own := what == name).any():
            out[own] = values(change)[0]
    return out


def pad_areas(a: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Area changes on a wider window."""
    more = reach - a.shape[-1] // 2
    if more <= 0:
        return a
    return np.pad(a, [(0, 0)] * (a.ndim - 2) + [(more, more)] * 2)


def _unit(
    channel: Channel, own: NDArray[np.float64], gains: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Electrons of one unit of each value."""
    if channel.unit == "adu2" and "other" in channel.axes:
        return np.asarray(own * gains[channel.axes["other"].astype(int)])
    if channel.unit == "adu2":
        return np.asarray(own**2)
    if channel.unit != "adu":
        return np.ones(len(channel))
    counted = channel.axes["what"] == "struck" if "what" in channel.axes else False
    return np.where(counted, 1.0, own)
