"""The model of a diagnosis: predicts every channel from one set of parameters and effects."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channel_rows import Rows, rows_by_condition
from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel, step_of
from bfsensor.diagnose.data.exposure_info import label_of
from bfsensor.diagnose.data.map_channels import MapShare
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds import KINDS
from bfsensor.diagnose.model.baseline import Baseline, Curve
from bfsensor.diagnose.model.effect_chain import EffectChain, layout_of, pad_areas
from bfsensor.diagnose.model.effect_parameters import effects_at, parameters_of
from bfsensor.diagnose.model.flat_predictions import (
    flat_covariances_of,
    periodic_covariances,
    quadrant,
)
from bfsensor.diagnose.model.spot_predictor import SpotPredictor, width_of
from bfsensor.effects.changed_device import ChangedDevice
from bfsensor.effects.effect import Effect, Layout, Shot
from bfsensor.files import Cache
from bfsensor.inference.parameters import FreeParameter, ParameterSpace
from bfsensor.response.edge_response import area_matrix
from bfsensor.typing import FloatArray

Columns = Callable[[Channel], dict[str, FloatArray]]
"""Columns of further linear parameters of a channel, by name, in its unit."""


class _AtPoint:
    """Predictor at values of its parameters, as kinds of channels ask it."""

    def __init__(self, predictor: Predictor, values: FloatArray, only: str | None) -> None:
        self._predictor, self._values, self._only = predictor, values, only
        amps = predictor.space.of("gain").sum()
        self._gains, self.noise = values[:amps], values[amps : 2 * amps]
        self._chain, self._device = predictor.chain(values), predictor.device(values)

    def covariances(self, channel: Channel) -> FloatArray:
        """Covariances of flats, or a_ij, with all effects."""
        gains, chain, device = self._gains, self._chain, self._device
        baseline = self._predictor.baseline
        x = channel.axes
        i, j = x["i"].astype(int), x["j"].astype(int)
        amp = x["amp"].astype(int)
        lags = int(max(i.max(), j.max()))
        out = np.empty(len(channel))
        for where, rows in self._predictor.rows(channel).items():
            if channel.unit == PER_ELECTRON:
                for level in np.unique(x["level"][rows]):
                    own = rows[x["level"][rows] == level]
                    a = self._areas(where, float(level))
                    y, x0 = (n // 2 for n in a.shape)
                    out[own] = 0.5 * (
                        a[y + j[own], x0 + i[own]] + a[y - j[own], x0 + i[own]]
                    )
                    if chain is not None:
                        one = {k: v[own[:1]] for k, v in x.items()}
                        read = chain.area_readout(a, float(level), one)
                        if read is not None:
                            out[own] += read[j[own], i[own]]
                continue
            pairs = np.stack([amp[rows], x["level"][rows]], axis=1)
            groups, first, index = np.unique(
                pairs, axis=0, return_index=True, return_inverse=True
            )
            own = gains[groups[:, 0].astype(int)]
            levels = own * groups[:, 1]
            if chain is None:
                a = baseline.flat_areas(where, device, levels)
                c = flat_covariances_of(a, levels, lags=lags) / own[:, None, None] ** 2
            else:
                lit = self._predictor.with_light(channel, gains)
                axes = {k: v[rows[first]] for k, v in lit.items()} | {"level": levels}
                axes["level"] = levels = chain.collected(levels, axes)
                edges = baseline.at(where, device)[0]
                more = chain.area_change(edges, where)
                a = baseline.flat_areas(where, device, levels)
                reach = max(more.shape[-1], a.shape[-1]) // 2
                a = pad_areas(a, reach) + pad_areas(more, reach)
                bent = chain.level_change(edges, where, levels)
                if bent is not None:
                    a = a + pad_areas(bent, reach)
                whole = periodic_covariances(a, levels, law=chain.law)
                c = quadrant(chain.covariances(whole, axes), lags) / own[:, None, None] ** 2
            c[:, 0, 0] += self.noise[groups[:, 0].astype(int)]
            out[rows] = c[index.ravel(), j[rows], i[rows]]
        return out

    def _areas(self, where: Condition, level: float) -> FloatArray:
        """Area changes [1/e-] at one condition and level, as tables of a_ij hold them."""
        edges = self._predictor.baseline.edges_on(where, self._device, level)
        a = area_matrix(*edges)
        if self._chain is None:
            return a
        more = self._chain.area_change(edges, where)
        a = a * (1 + self._chain.law.bend * level)
        reach = max(more.shape[-1], a.shape[-1]) // 2
        a = pad_areas(a, reach) + pad_areas(more, reach)
        bent = self._chain.level_change(edges, where, np.array([level]), grown=False)
        return a if bent is None else np.asarray(a + pad_areas(bent[0], reach))

    def spots(self, channel: Channel) -> FloatArray:
        """Widths, fluxes and wings of spots, with all effects."""
        one = self._predictor
        return one.spots.predict(
            channel, one.rows(channel), self._gains, self._device,
            self._values[len(self._gains) + len(self.noise) + len(one.baseline.parameters) :],
            only=self._only, chain=self._chain,
        )  # fmt: skip

    def map_change(self, channel: Channel) -> FloatArray:
        """Change of maps by all effects."""
        return self._chain.map_change(channel) if self._chain else np.zeros(len(channel))

    def added(self, channel: Channel) -> FloatArray:
        """Change of a channel by all effects, each by its method of that name."""
        if self._chain is None:
            return np.zeros(len(channel))
        axes = self._predictor.with_light(channel, self._gains)
        return self._chain.added(channel, self._gains, axes)


class Predictor:
    """Predicts the channels of a campaign from a baseline, effects and all free parameters.

    Nonlinear parameters are the gain of each amplifier [e-/ADU], the variance of its read noise
    [ADU^2], the device's parameters less nominal in units of their spread, the widths of spots
    without charge for each wavelength and temperature [pixel], and the effects' parameters.  Linear
    ones, the columns of :meth:`linear`, are the light by amplifier and condition, dark current,
    shape of the light, and flux of the spots.

    Parameters
    ----------
    measured : MeasuredChannels
        Channels of the campaign, for its amplifiers, conditions and places of spots.
    baseline : Baseline
        Boundary shifts.
    effects : sequence of Effect
        Effects added to the baseline.

    Attributes
    ----------
    space : ParameterSpace
        Nonlinear parameters: of kind 'gain' and 'noise' by amplifier, 'device' by quantity, 'width'
        by wavelength and temperature, 'effect' by place among the effects.
    effects : tuple of Effect
        Effects added to the baseline, with their start values.
    notes : list of str
        Assumptions for the report.
    kept : Cache
        Cached results, shared with copies that have the same baseline.
    """

    def __init__(
        self, measured: MeasuredChannels, baseline: Baseline, effects: Sequence[Effect] = ()
    ) -> None:
        self.measured, self.baseline = measured, baseline
        self._curved = baseline
        self.layout = layout_of(measured, baseline)
        self.kept = Cache()
        self._of_channels = Cache()
        # Between two points of a fit the gains seldom change.
        self._shots = Cache(4)
        self._amps = len(measured.amplifiers)
        self.spots = SpotPredictor(measured, baseline)
        self.notes: list[str] = []
        noise = [0.0 if not np.isfinite(n) else n**2 for n in measured.read_noise]
        own = [
            FreeParameter(f"gain {a}", "gain", a, g, 1e-3 * g)
            for a, g in enumerate(measured.gains)
        ]
        own += [
            FreeParameter(f"noise {a}", "noise", a, n, 0.01 * max(n, 0.1))
            for a, n in enumerate(noise)
        ]
        for name in baseline.parameters:
            ends = np.array(baseline.bounds.get(name, (-np.inf, np.inf)))
            low, high = ends / baseline.spread[name]
            own.append(
                FreeParameter(f"device {name}", "device", name, 0.0, 0.1, True, low, high)
            )
        widths = [(width, axis) for width in self.spots.widths for axis in "xy"]
        own += [
            FreeParameter(f"sigma_{axis} {width}", "width", width, start, 2e-3)
            for (width, axis), start in zip(widths, self.spots.start, strict=True)
        ]
        self.space = ParameterSpace(tuple(own))
        self._noise_told = _noise_told(measured)
        if not self._noise_told.all():
            names = [
                a
                for a, told in zip(measured.amplifiers, self._noise_told, strict=True)
                if not told
            ]
            self.notes.append(
                f"read noise of {', '.join(names)} taken as {np.sqrt(noise[0]):.3g} ADU: there are no "
                "biases, and flats of one level do not separate it from the gain"
            )
        exact = {
            condition: baseline.at(condition)[1]
            for c in measured.channels if c.word in ("flat_cov", "spot")
            for condition in self.rows(c)
        }  # fmt: skip
        for condition, held in exact.items():
            if not held:
                self.notes.append(
                    "the baseline has no boundary shifts at wavelength/back bias/temperature "
                    f"{label_of(condition)} [nm/V/C]: those of the nearest condition are used"
                )

        self.columns: tuple[Columns, ...] = ()
        self.effects = tuple(effects)
        self.space += parameters_of(self.effects)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the nonlinear parameters."""
        return self.space.names

    @property
    def start(self) -> FloatArray:
        """Values at which fits of the nonlinear parameters start, shape (n,)."""
        return self.space.start

    def with_effects(
        self, effects: Sequence[Effect], point: FloatArray | None = None
    ) -> Predictor:
        """Make a copy with other effects, which shares cached results that do not depend on them.

        Parameters
        ----------
        effects : sequence of Effect
            Effects in place of the present ones.
        point : ndarray, optional
            Start values of the parameters other than the effects'.

        Notes
        -----
        Where the device was solved at an effect's value and the fitted quantities together, that
        solution takes the place of the baseline's own one at fitted quantities, its ``curve``.
        """
        other = copy(self)
        solved = [e.solved_beside for e in effects if isinstance(e, ChangedDevice)]
        pulls = next((p for p in solved if p is not None), None)
        other._solve_at(pulls)
        plain = self.space.without("effect")
        if point is not None:
            plain = plain.started(point[: len(plain)])
        other.effects = tuple(effects)
        other.space = plain + parameters_of(other.effects)
        return other

    def _solve_at(self, pulls: Mapping[str, float] | None) -> None:
        """Leave the baseline's curve to an effect that was solved at pulls; None: to the baseline."""
        whole, before = self._curved, self.baseline
        if pulls is None:
            self.baseline = whole
        else:
            self.baseline = replace(whole, curve=Curve(dict(pulls), {}))
        has = [b.curve is not None and bool(b.curve.edges) for b in (before, self.baseline)]
        if has[0] != has[1]:
            # Cached results depend on the baseline.
            self.kept, self.spots = Cache(), self.spots.with_baseline(self.baseline, None)

    def with_columns(self, columns: Columns, point: FloatArray | None = None) -> Predictor:
        """Make a copy with further linear parameters, whose fits start at ``point``."""
        other = copy(self)
        other.columns = (*self.columns, columns)
        if point is not None:
            other.space = self.space.started(point[: len(self.space)])
        return other

    def without_columns(self, columns: Sequence[Columns]) -> Predictor:
        """Make a copy without some of the further linear parameters."""
        other = copy(self)
        other.columns = tuple(c for c in self.columns if not any(c is d for d in columns))
        return other

    def with_shifts(
        self,
        edges: tuple[FloatArray, FloatArray],
        slopes: tuple[FloatArray, FloatArray] | None = None,
    ) -> Predictor:
        """Make a copy with boundary shifts added to the baseline's.

        Parameters
        ----------
        edges : tuple of ndarray
            Shifts of right and upper edges [pixel/e-] at the reference; at other conditions they
            are scaled by the ratio of the baseline's a_00.
        slopes : tuple of ndarray, optional
            Change of the shifts with the stored charge [pixel/e-^2].
        """
        other = copy(self)
        own = self.baseline
        scales = {k: own.scale_at(k) for k in own.edges}
        if slopes is not None:
            # The baseline's shifts hold at its level: the sum must have no change at zero charge.
            edges = edges[0] + own.level * slopes[0], edges[1] + own.level * slopes[1]
        moved = {
            k: tuple(o + scales[k] * d for o, d in zip(own.edges[k], edges, strict=True))
            for k in own.edges
        }
        changed: dict[str, object] = {"edges": moved}
        if slopes is not None:
            nothing = (np.zeros_like(edges[0]),) * 2
            changed["slopes"] = {
                k: tuple(
                    o + scales[k] * d
                    for o, d in zip(own.slopes.get(k, nothing), slopes, strict=True)
                )
                for k in own.edges
            }
        other.baseline = replace(own, **changed)  # type: ignore[arg-type]
        other._curved = replace(self._curved, **changed)  # type: ignore[arg-type]
        # Cached results depend on the baseline.
        other.kept, other.spots = Cache(), self.spots.with_baseline(other.baseline, slopes)
        return other

    def with_exposures(
        self,
        spots: Iterable[Condition] = (),
        maps: Mapping[tuple[str, str], tuple[MapShare, ...]] | None = None,
    ) -> Predictor:
        """Make a copy that also predicts spots at further conditions, and further maps.

        Spots have the places within their pixels of others of the same wavelength and temperature.

        Parameters
        ----------
        spots : iterable of Condition
            Conditions that the campaign may lack.
        maps : mapping of (fold, map) to tuple of MapShare, optional
            Flats that each further map is made of.

        Raises
        ------
        DiagnosisError
            The campaign has no spots of that wavelength and temperature, so that their width
            without charge is unknown.
        """
        other = copy(self)
        other.spots = self.spots.with_conditions(spots)
        if maps:
            other.measured = replace(self.measured, maps={**self.measured.maps, **maps})
        return other

    def predict(
        self,
        channel: Channel,
        parameters: FloatArray,
        *,
        only: str | None = None,
    ) -> FloatArray:
        """Predict a channel without its linear parameters.

        Parameters
        ----------
        channel : Channel
            Channel whose axes state where each value belongs; its values are not used.
        parameters : ndarray
            Nonlinear parameters in the order of ``names``.
        only : str, optional
            Predict only spots of this wavelength and temperature, such as '620/-100' [nm, C].

        Returns
        -------
        ndarray, shape (n,)
            Prediction in the channel's unit.
        """
        return KINDS[channel.word].predict(channel, _AtPoint(self, parameters, only))

    def chain(self, parameters: FloatArray) -> EffectChain | None:
        """Chain of the effects at given parameters; None without effects."""
        if not self.effects:
            return None
        return EffectChain(
            self.effects_at(parameters),
            self._layout_at(parameters),
            self.measured,
            self.baseline,
            self.kept,
            # Relaxation of patterns hardly depends on gain and device: the start values do.
            (_mean_gain(self.start[: self._amps]), self.device(self.start)),
        )

    def modes(self, channel: Channel, parameters: FloatArray) -> FloatArray:
        """Shapes of the effects' random effects in a channel, in its unit, shape (n, modes).

        Their strengths are independent with variance 1, so that they add ``modes @ modes.T`` to
        the covariance of the values.
        """
        chain = self.chain(parameters)
        if chain is None:
            return np.zeros((len(channel), 0))
        gains = parameters[: self._amps]
        return chain.modes(channel, gains, self.with_light(channel, gains))

    def device(self, parameters: FloatArray) -> dict[str, float]:
        """Device parameters less their nominal values, in their units."""
        own = parameters[2 * self._amps : 2 * self._amps + len(self.baseline.parameters)]
        return {
            name: float(value) * self.baseline.spread[name]
            for name, value in zip(self.baseline.parameters, own, strict=True)
        }

    def _layout_at(self, parameters: FloatArray) -> Layout:
        """Layout with gains and read noise at given parameters."""
        gains, noise = parameters[: self._amps], parameters[self._amps : 2 * self._amps]
        # Levels were calculated with rough gains, which may be off by a quarter.
        scale = _mean_gain(gains) / _mean_gain(np.array(self.layout.gains))

        def at_scale() -> tuple[Shot, ...]:
            return tuple(s._replace(level=scale * s.level) for s in self.layout.shots)

        return replace(
            self.layout,
            gains=tuple(gains.tolist()),
            read_noise=tuple(np.sqrt(np.maximum(noise, 0.0)).tolist()),
            shots=self._shots.get(scale, at_scale),
        )

    def effects_at(self, parameters: FloatArray) -> tuple[Effect, ...]:
        """Make the effects with given parameters."""
        return effects_at(self.effects, parameters[self.space.of("effect")])

    def rows(self, channel: Channel) -> Rows:
        """Indices of a channel's values by condition; cached, as channels do not change."""
        return self._of_channels.get(("rows", channel), lambda: rows_by_condition(channel))

    def with_light(self, channel: Channel, gains: FloatArray) -> dict[str, NDArray]:
        """Axes of a channel; for flats also 'light': electrons of a linear response to the lamp."""
        if channel.word not in ("flat_mean", "flat_cov") or channel.unit == PER_ELECTRON:
            return dict(channel.axes)
        light = self._of_channels.get(("light", channel), lambda: self._light(channel))
        amps = channel.axes["amp"].astype(int)
        return dict(channel.axes) | {"light": gains[amps] * light}

    def _light(self, channel: Channel) -> FloatArray:
        """Light of flats [ADU], calibrated on the levels of the weakest 40 %."""
        x = channel.axes
        light = x["time"] * x.get("lamp", np.array(1.0))
        out = np.zeros(len(channel))
        for rows in self.rows(channel).values():
            for amp in np.unique(x["amp"][rows]):
                here = rows[x["amp"][rows] == amp]
                ratio = x["level"][here] / np.maximum(light[here], 1e-300)
                weak = light[here] <= np.quantile(light[here], 0.4)
                out[here] = np.median(ratio[weak]) * light[here]
        return out

    def depends(self, channel: Channel) -> NDArray[np.bool_]:
        """Mask of the parameters that a channel can depend on; others need no derivative."""
        space = self.space
        changed = any(channel.word in e.touches for e in self.effects)
        out = space.of(*KINDS[channel.word].depends(channel, changed=changed))
        for n, noisy in enumerate(self._noise_told):
            if not noisy:
                out[space.rows("noise", n)] = False
        for n, effect in enumerate(self.effects):
            if channel.word in effect.touches:
                out[space.rows("effect", n)] = True
        return out

    def slope(
        self,
        channel: Channel,
        parameters: FloatArray,
        n: int,
        here: FloatArray,
    ) -> FloatArray:
        """Derivative of a channel by parameter ``n``, given the prediction ``here``."""
        step = parameters.copy()
        own = self.space.parameters[n]
        step[n] += own.step
        if channel.word == "spot" and own.kind == "width":
            # A width changes only spots of its own wavelength and temperature.
            only = str(own.owner)
            moved = self.predict(channel, step, only=only)
            out = np.zeros(len(channel))
            for condition, rows in self.rows(channel).items():
                if width_of(condition) == only:
                    out[rows] = (moved[rows] - here[rows]) / own.step
            return out
        ratio = own.kind == "gain" or own.name.endswith(" full_well")
        if channel.word == "flat_mean" and ratio:
            # Saturated flats constrain full well over gain to 1e-5, so that a one-sided difference
            # would bias the fit: take a central one.
            back = parameters.copy()
            back[n] -= own.step
            both = self.predict(channel, step) - self.predict(channel, back)
            return both / (2 * own.step)
        return (self.predict(channel, step) - here) / own.step

    def linear(self, channel: Channel) -> dict[str, FloatArray]:
        """Columns of the linear parameters by name; the same name is the same parameter."""
        out = KINDS[channel.word].columns(channel, self.rows(channel), self.measured)
        for more in self.columns:
            out |= more(channel)
        return out


def _mean_gain(gains: FloatArray) -> float:
    """Mean gain of the amplifiers [e-/ADU]; 1 for a_ij, which have no amplifiers."""
    return float(np.mean(gains)) if len(gains) else 1.0


def _noise_told(measured: MeasuredChannels) -> NDArray[np.bool_]:
    """Mask of the amplifiers whose read noise biases, or flats of several levels, constrain."""
    count = len(measured.amplifiers)
    told = np.zeros(count, bool)
    levels: list[set[float]] = [set() for _ in range(count)]
    for channel in measured.channels:
        if channel.word not in ("bias_cov", "flat_cov") or channel.unit == PER_ELECTRON:
            continue
        for n in np.unique(channel.axes["amp"]).astype(int):
            own = channel.axes["amp"] == n
            told[n] |= channel.word == "bias_cov"
            if channel.word == "flat_cov":
                levels[n] |= set(step_of(channel.axes)[own].tolist())
    flats = any(levels)
    return told | np.array([len(v) > 1 or not flats for v in levels], bool)


def used_channels(channels: Sequence[Channel], folds: Sequence[str]) -> list[Channel]:
    """Select the channels of given folds."""
    return [c for c in channels if c.fold in folds]
