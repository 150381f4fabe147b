"""Changes of each channel by a chain of effects on light, charge and signal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.data.ptc_turnoff import find_turn_off
from bfsensor.diagnose.kinds import KINDS
from bfsensor.diagnose.model.baseline import Baseline, level_areas
from bfsensor.diagnose.model.flat_predictions import periodic_covariances, quadrant
from bfsensor.diagnose.model.map_predictions import MapChange, shot_at
from bfsensor.effects.effect import STAGES, Axes, Effect, Halo, Law, Layout, Shot
from bfsensor.files import Cache
from bfsensor.response.edge_response import area_matrix
from bfsensor.typing import Edges, FloatArray

ROUNDS = 4
"""Number of fixed-point iterations that invert the signal's law. Derived: each multiplies the error
by the law's slope less 1, at most about 0.05, so that four leave 0.05**5 = 3e-7 of the level."""


def layout_of(measured: MeasuredChannels, baseline: Baseline) -> Layout:
    """Make the description of sensor and campaign that effects calculate with."""
    wavelength, bias = baseline.reference
    card = baseline.card
    reference = [s.temperature for s in measured.shots if np.isfinite(s.temperature)]
    return Layout(
        measured.shape, measured.segments, measured.shots, measured.gains,
        (wavelength if np.isfinite(wavelength) else 620.0, bias if np.isfinite(bias) else -60.0,
         float(np.median(reference)) if reference else 173.15),
        offsets=measured.offsets, read_noise=measured.read_noise, biases=measured.biases,
        map_noise={
            name: float(sum(s.weight**2 / s.flats for s in shares))
            for name, shares in measured.maps.items()
        },
        sightings=measured.sightings, turn_off=_turn_off(measured), **card,
    )  # fmt: skip


def _turn_off(measured: MeasuredChannels) -> float:
    """Lowest level of flats whose variance has collapsed [e-], by the campaign's rough gains."""
    off = find_turn_off(measured.channels)
    return (
        min((v * measured.gains[a] for a, v in off.levels.items()), default=np.inf)
        if off
        else np.inf
    )


class EffectChain:
    """Several effects, applied in the order of their stages from light to converter.

    Parameters
    ----------
    effects : sequence of Effect
        Effects in any order.
    layout : Layout
        Sensor and campaign.
    measured : MeasuredChannels
        Channels of the campaign, for the flats that each map is made of.
    baseline : Baseline
        Boundary shifts, by which the brighter-fatter feedback relaxes patterns of flats.
    kept : Cache
        Results of :class:`MapChange` that stay valid when effects change.
    evening : (float, mapping of str to float)
        Gain [e-/ADU] and device parameters less their nominal values at which that feedback is
        calculated.
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
        self.effects = tuple(sorted(effects, key=lambda e: STAGES.index(e.stage)))
        self.layout, self.measured, self.baseline = layout, measured, baseline
        self._kept, self._evening = kept, evening
        self._maps: MapChange | None = None
        self.law = Law()
        for effect in self.effects:
            self.law = self.law.with_law(effect.law())

    def shot(self, condition: Condition, kind: str = "flat", seconds: float = 0.0) -> Shot:
        """Make an exposure at a condition; unknown settings are those of the reference."""
        return shot_at(self.layout, condition, kind, seconds)

    def edges(self, edges: Edges, condition: Condition) -> Edges:
        """Boundary shifts [pixel/e-] with all effects."""
        for effect in self.effects:
            edges = effect.edges(*edges, self.shot(condition), self.layout)
        return edges

    @property
    def leaves_spots(self) -> bool:
        """Whether effects leave growth and readout of spots unchanged, except for added light."""
        own = (
            "edges", "law", "level_response", "bend_edges", "spot_light", "diffusion_growth",
            "spot_image", "signal",
        )  # fmt: skip
        return not any(e.changes(*own) for e in self.effects)

    def area_change(self, edges: Edges, condition: Condition) -> FloatArray:
        """Change that effects make to the area changes of given shifts [1/e-]."""
        changed = self.edges(edges, condition)
        if changed is edges:
            return np.zeros_like(edges[0])
        a, more = area_matrix(*edges), area_matrix(*changed)
        if more.shape == a.shape:
            return more - a
        # An effect's shifts may have a wider window than the baseline's.
        margin = (more.shape[0] - a.shape[0]) // 2
        return np.asarray(more - np.pad(a, margin))

    def level_change(
        self, edges: Edges, condition: Condition, levels: FloatArray, *, grown: bool = True
    ) -> FloatArray | None:
        """Change of the areas by effects that depend on the level [1/e-]; None without such effects."""
        total = None
        for level, slope, bend in self._level_responses(edges, condition):
            one = level_areas(slope, bend, level, levels, grown=grown)
            total = one if total is None else total + one
        return total

    def _level_responses(
        self, edges: Edges, condition: Condition
    ) -> list[tuple[float, Edges, Edges | None]]:
        shot = self.shot(condition)
        out: list[tuple[float, Edges, Edges | None]] = []
        for effect in self.effects:
            found = effect.level_response(shot, self.layout)
            if found is not None:
                out.append(found)
            bent = effect.bend_edges(*edges)
            if bent is not None:
                out.append((0.0, bent, None))
        return out

    def spot_edges(
        self, edges: Edges, slopes: Edges | None, condition: Condition
    ) -> tuple[Edges, Edges | None]:
        """Shifts of spots without charge, and their slopes with charge, with all effects."""
        kx, ky = self.edges(edges, condition)
        responses = self._level_responses(edges, condition)
        # Shifts may have a wider window than their slopes.
        reach = kx.shape[0] // 2
        if slopes is not None:
            slopes = pad_areas(slopes[0], reach), pad_areas(slopes[1], reach)
        for level, slope, _ in responses:
            sx, sy = (pad_areas(s, reach) for s in slope)
            kx, ky = kx - level * sx, ky - level * sy
            slopes = (sx, sy) if slopes is None else (slopes[0] + sx, slopes[1] + sy)
        return (kx, ky), slopes

    def signal(self, level: FloatArray, axes: Axes) -> FloatArray:
        """Signal after the amplifier [e-] of collected charge [e-]."""
        for effect in self.effects:
            level = effect.signal(level, axes, self.layout)
        return level

    def collected(self, signal: FloatArray, axes: Axes) -> FloatArray:
        """Collected charge [e-] of a signal [e-], by fixed-point iteration."""
        level = signal
        for _ in range(ROUNDS):
            level = signal - (self.signal(level, {**axes, "level": level}) - level)
        return np.asarray(level)

    def covariances(self, c: FloatArray, axes: Axes) -> FloatArray:
        """Covariances of flats [e-^2] after all effects, scaled by the square of the signal's slope."""
        level = np.asarray(axes["level"], float)
        for effect in self.effects:
            step = 1e-3 * np.maximum(level, 1.0)
            ends = level + step, level - step
            up, down = (effect.signal(x, {**axes, "level": x}, self.layout) for x in ends)
            if not (np.array_equal(up, ends[0]) and np.array_equal(down, ends[1])):
                c = c * (((up - down) / (2 * step)) ** 2)[:, None, None]
            c = effect.covariances(c, axes, self.layout)
        return c

    def area_readout(self, a: FloatArray, level: float, axes: Axes) -> FloatArray | None:
        """Change of measured a_ij by charge or signal that moves between pixels [1/e-].

        Measured a_ij are covariances over the square of the level.  The change of the variance in
        proportion to the level is not in a_00, as a gain measured on photon transfer curves holds it.

        Parameters
        ----------
        a : ndarray, odd sides
            Area changes [1/e-] before the readout.
        level : float
            Level of the flats [e-].
        axes : mapping
            Axes of one flat, arrays of shape (1,), as in :meth:`covariances`.

        Returns
        -------
        change : ndarray or None
            Lags from 0; None if there is no such effect, or at level 0, which is a limit.
        """
        own = copy(self)
        own.effects = tuple(e for e in self.effects if e.in_areas)
        if not own.effects or level <= 0:
            return None
        both = np.array([a, np.zeros_like(a)])
        c = periodic_covariances(both, [level, level])
        twice = {k: np.repeat(v, 2) for k, v in axes.items()} | {"level": np.full(2, level)}
        read = own.covariances(c, twice)
        signal = own.signal(twice["level"], twice)[0]
        change = read[0] / signal**2 - c[0] / level**2
        change[0, 0] -= read[1, 0, 0] / signal**2 - c[1, 0, 0] / level**2
        return quadrant(change[None], a.shape[-1] // 2)[0]

    def added(
        self, channel: Channel, gains: FloatArray, axes: dict[str, NDArray]
    ) -> FloatArray:
        """Change of a channel by all effects, in its unit; ``axes`` with levels in ADU."""
        kind = KINDS[channel.word]
        own, axes = self._in_electrons(channel, gains, axes)
        out = np.zeros(len(channel))
        for effect in self.effects:
            out += kind.change(effect, axes, self.layout)
        if channel.word == "flat_mean":
            level = axes["level"]
            out += self.signal(level, axes) - level
            if self.law.loses:
                out += level - self.law.light(level)
        out = np.where(_usual(channel), 0.0, out / _unit(channel, own, gains))
        return np.asarray(kind.in_unit(out, own, axes))

    def _in_electrons(
        self, channel: Channel, gains: FloatArray, axes: dict[str, NDArray]
    ) -> tuple[FloatArray, dict[str, NDArray]]:
        """Gain of each value [e-/ADU], and axes with levels in electrons."""
        rows = len(channel)
        amp = axes.get("amp", np.zeros(rows)).astype(int)
        own = gains[amp] if len(gains) else np.ones(rows)
        axes = dict(axes)
        if "level" in axes:
            axes["level"] = self.collected(own * axes["level"], axes)
        if channel.word == "dark_map":
            axes["after"] = own * axes["after"]
        return own, axes

    def spot_change(self, condition: Condition) -> tuple[float, Halo, Mapping[str, float]]:
        """Added variance [pixel^2], halo and axes of spots at a condition."""
        shot = self.shot(condition, "spot")
        each = [effect.spot_light(shot, self.layout) for effect in self.effects]
        variance = float(sum(v for v, _ in each))
        halo = tuple(part for _, parts in each for part in parts)
        axes = {k: getattr(shot, k) for k in ("wavelength", "back_bias", "temperature")}
        return variance, halo, axes

    def diffusion_growth(self, condition: Condition) -> float:
        """Growth of the variance of diffusion with the charge of a pixel [pixel^2/e-]."""
        shot = self.shot(condition, "spot")
        return sum(effect.diffusion_growth(shot, self.layout) for effect in self.effects)

    def spot_image(self, images: FloatArray, axes: Mapping[str, float]) -> FloatArray:
        """Mean images of spots [e-] after readout."""
        for effect in self.effects:
            images = effect.spot_image(images, axes, self.layout)
            shaped = {
                **{k: np.full(images.shape, v) for k, v in axes.items()},
                "level": images,
            }
            images = effect.signal(images, shaped, self.layout)
        return images

    def map_change(self, channel: Channel) -> FloatArray:
        """Change of a channel of flats against position."""
        if self._maps is None:
            self._maps = MapChange(
                self.effects,
                self.layout,
                self.measured,
                self.baseline,
                self._kept,
                self._evening,
            )
        return self._maps.of(channel)

    def spot_flux(self, axes: Axes) -> FloatArray:
        """Change of the fluxes of spots by effects, exposure by exposure [e-]."""
        out = np.zeros(len(axes["flux"]))
        for effect in self.effects:
            if "spot" in effect.touches:
                out += effect.spot_flux(axes, self.layout)
        return out

    def spot_ghosts(self, shown: FloatArray, lit: FloatArray) -> FloatArray | None:
        """Fractions of the charge of spots ``lit`` that reappear in ``shown``, shape (n, m), or None."""
        parts = [e.spot_ghosts(shown, lit, self.layout) for e in self.effects]
        some = [p for p in parts if p is not None]
        return np.sum(some, axis=0) if some else None

    def modes(
        self, channel: Channel, gains: FloatArray, axes: dict[str, NDArray]
    ) -> FloatArray:
        """Shapes of the random effects in a channel, in its unit, shape (n, modes)."""
        own, axes = self._in_electrons(channel, gains, axes)
        axes["fold"] = np.full(len(channel), channel.fold)
        found = [
            e.modes(channel.word, axes, self.layout)
            for e in self.effects if channel.word in e.touches
        ]  # fmt: skip
        unit = np.where(_usual(channel), np.inf, _unit(channel, own, gains))[:, None]
        parts = [m / unit for m in found if m is not None]
        return np.concatenate([np.zeros((len(channel), 0)), *parts], axis=1)


def pad_areas(a: FloatArray, reach: int) -> FloatArray:
    """Pad area changes with zeros to a window of ``reach`` pixels to either side."""
    more = reach - a.shape[-1] // 2
    if more <= 0:
        return a
    return np.pad(a, [(0, 0)] * (a.ndim - 2) + [(more, more)] * 2)


def _usual(channel: Channel) -> NDArray[np.bool_]:
    """Values that hold the baseline's dark current to that of usual sensors: no effect changes them."""
    if channel.word != "dark_map":
        return np.zeros(len(channel), bool)
    return np.isin(channel.axes["what"], ("usual", "usual offset"))


def _unit(channel: Channel, own: FloatArray, gains: FloatArray) -> FloatArray:
    """Electrons (or their square) per unit of each value."""
    if channel.unit == "adu2" and "other" in channel.axes:
        return np.asarray(own * gains[channel.axes["other"].astype(int)])
    if channel.unit == "adu2":
        return np.asarray(own**2)
    if channel.unit != "adu":
        return np.ones(len(channel))
    what = channel.axes.get("what")
    counted = np.isin(what, ("struck", "tracks")) if what is not None else False
    return np.where(counted, 1.0, own)
