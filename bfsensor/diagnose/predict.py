"""Every channel from one set of parameters: device, gains, noise, lamp, pixel response."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.baseline import Baseline, Edges, area_matrix
from bfsensor.diagnose.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.conditions import Condition
from bfsensor.diagnose.extract import Measured
from bfsensor.diagnose.linear_columns import linear_columns
from bfsensor.diagnose.map_channels import MapShare
from bfsensor.diagnose.predict_effects import ADDED, EffectChain, layout_of, pad_areas
from bfsensor.diagnose.predict_flats import (
    flat_covariances_of,
    periodic_covariances,
    quadrant,
)
from bfsensor.diagnose.predict_spots import predict_spots, representative_phases
from bfsensor.effects.effect import Effect, Layout, Parameter
from bfsensor.errors import DiagnosisError

REDUCED_LEVEL = 40_000.0
"""Background [e-] at which a_ij without a level are predicted: halfway to a flat of 80,000 e-, at
which published covariances are quoted."""

Columns = Callable[[Channel], dict[str, NDArray[np.float64]]]
"""Columns of further linear parameters of a channel, by name, in its unit."""


class Predictor:
    """Predicts the channels of a campaign; what may float honestly is a parameter.

    Non-linear parameters: gain of each amplifier [e-/ADU], variance of its read noise [ADU^2],
    the device's parameters in units of their spread, widths of the spots without charge for
    each wavelength and temperature.  Linear ones, as columns of :meth:`linear`: light by amplifier and
    condition, dark current, shape of the light, levels of bias and noise, flux of the spots.

    Parameters
    ----------
    measured : Measured
        The campaign, for its amplifiers, conditions and positions of spots.
    baseline : Baseline
        Boundary shifts.
    effects : sequence of Effect
        What is added to it; their parameters are non-linear ones.
    """

    def __init__(
        self, measured: Measured, baseline: Baseline, effects: Sequence[Effect] = ()
    ) -> None:
        self.measured, self.baseline = measured, baseline
        self.layout = layout_of(measured, baseline)
        self._evened: dict[tuple, Any] = {}
        self._grown: dict[
            tuple[str, ...], tuple[tuple[NDArray, ...], dict[str, NDArray]]
        ] = {}
        self._lit: dict[int, tuple[Channel, NDArray[np.float64]]] = {}
        self._amps = len(measured.amplifiers)
        self._kept: dict[int, tuple[Channel, dict[tuple[str, ...], NDArray[np.int64]]]] = {}
        self._spot_conditions: list[tuple[str, ...]] = []
        self._spot_of: dict[tuple[str, ...], Condition] = {}
        # Optics know of the wavelength, diffusion of the silicon's temperature, of which cards do
        # not speak; what goes with voltages at one temperature is left to be found.
        self._widths: list[str] = []
        self._phases: dict[tuple[str, ...], NDArray[np.float64]] = {}
        self.notes: list[str] = []
        start_sigma: list[float] = []
        exposure = 0
        for channel in measured.channels:
            if channel.word != "spot":
                continue
            rows = np.nonzero(channel.axes["what"] == "sigma_x")[0]
            for row in rows:
                condition = _condition(channel, row)
                phases = measured.phases[exposure]
                exposure += 1
                if condition.key not in self._spot_of:
                    self._spot_conditions.append(condition.key)
                    self._spot_of[condition.key] = condition
                    if _width_of(condition.key) not in self._widths:
                        self._widths.append(_width_of(condition.key))
                        both = channel.values[row], channel.values[row + 1]
                        start_sigma += [float(v) for v in both]
                    self._phases[condition.key] = phases
                else:
                    self._phases[condition.key] = np.concatenate(
                        [self._phases[condition.key], phases]
                    )
        self._phases = {k: representative_phases(p) for k, p in self._phases.items()}
        noise = [0.0 if not np.isfinite(n) else n**2 for n in measured.read_noise]
        self.names = (
            *(f"gain {a}" for a in range(self._amps)),
            *(f"noise {a}" for a in range(self._amps)),
            *(f"device {p}" for p in baseline.parameters),
            *(f"sigma_{axis} {width}" for width in self._widths for axis in "xy"),
        )
        self.start = np.array([
            *measured.gains, *noise, *(0.0 for _ in baseline.parameters), *start_sigma,
        ])  # fmt: skip
        self.steps = np.array([
            *(1e-3 * g for g in measured.gains), *(0.01 * max(n, 0.1) for n in noise),
            *(0.1 for _ in baseline.parameters), *(2e-3 for _ in start_sigma),
        ])  # fmt: skip
        n, p = 2 * self._amps, len(baseline.parameters)
        self.prior_rows = np.arange(n, n + p)
        """Parameters with a prior of mean 0 and width 1."""
        self._noise_told = _noise_told(measured)
        if not self._noise_told.all():
            names = [
                a
                for a, told in zip(measured.amplifiers, self._noise_told, strict=True)
                if not told
            ]
            self.notes.append(
                f"read noise of {', '.join(names)} taken as {np.sqrt(noise[0]):.3g} ADU: no biases, "
                "and flats of one level cannot tell it from the gain"
            )
        exact = {
            key: baseline.at(_condition(c, rows[0]))[1]
            for c in measured.channels if c.word in ("flat_cov", "spot")
            for key, rows in self._rows(c).items()
        }  # fmt: skip
        for key, held in exact.items():
            if not held:
                self.notes.append(
                    f"baseline has no shifts at {'/'.join(key)}: the nearest condition's are taken"
                )

        self.columns: tuple[Columns, ...] = ()
        self.spot_slopes: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self.effects: tuple[Effect, ...] = ()
        self._add(effects)

    def with_effects(
        self, effects: Sequence[Effect], point: NDArray[np.float64] | None = None
    ) -> Predictor:
        """Copy with other effects, which shares what does not depend on them.

        Parameters
        ----------
        effects : sequence of Effect
            Instead of those there are.
        point : ndarray, optional
            Where fits begin: parameters other than effects'.
        """
        other = copy(self)
        plain = len(self.names) - self._effect_count
        other.names, other.steps = self.names[:plain], self.steps[:plain]
        other.start = (self.start if point is None else point)[:plain].copy()
        other._add(effects)
        return other

    def with_columns(
        self, columns: Columns, point: NDArray[np.float64] | None = None
    ) -> Predictor:
        """Copy with further linear parameters; fits begin at ``point``."""
        other = copy(self)
        other.columns = (*self.columns, columns)
        if point is not None:
            other.start = point[: len(self.names)].copy()
        return other

    def with_shifts(
        self,
        edges: tuple[NDArray[np.float64], NDArray[np.float64]],
        slopes: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    ) -> Predictor:
        """Copy with shifts of boundaries added to the baseline's [pixel/e-].

        Parameters
        ----------
        edges : tuple of ndarray
            Of right and upper edges; at other conditions scaled as the baseline's own are.
        slopes : tuple of ndarray, optional
            Their change with the charge that pushes [pixel/e-^2].
        """
        other = copy(self)
        own = self.baseline
        scales = {k: own.scale_at(k) for k in own.edges}
        if slopes is not None:
            # The baseline's own hold at a level that may not be 0.
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
            other.spot_slopes = slopes
        other.baseline = replace(own, **changed)  # type: ignore[arg-type]
        # What was kept goes with the baseline.
        other._evened, other._grown = {}, {}
        return other

    def with_exposures(
        self,
        spots: Iterable[Condition] = (),
        maps: Mapping[tuple[str, str], tuple[MapShare, ...]] | None = None,
    ) -> Predictor:
        """Copy that predicts spots at further conditions, and further maps, as well.

        Spots fall on their pixels as others of the same light and temperature do.

        Parameters
        ----------
        spots : iterable of Condition
            Conditions that the campaign may lack.
        maps : mapping of (fold, map) to tuple of MapShare, optional
            Of which flats each is made.

        Raises
        ------
        DiagnosisError
            The campaign has no spots of that wavelength and temperature: nothing tells their width.
        """
        other = copy(self)
        other._spot_of, other._phases = dict(self._spot_of), dict(self._phases)
        other._spot_conditions = list(self._spot_conditions)
        for condition in spots:
            key = condition.key
            if key in other._spot_of:
                continue
            width = _width_of(key)
            like = next((k for k in self._spot_conditions if _width_of(k) == width), None)
            if like is None:
                raise DiagnosisError(
                    f"spots at wavelength/temperature {width}: their width without charge is known "
                    f"at {', '.join(self._widths) or 'none'} only"
                )
            other._spot_of[key], other._phases[key] = condition, self._phases[like]
            other._spot_conditions.append(key)
        if maps:
            other.measured = replace(self.measured, maps={**self.measured.maps, **maps})
        return other

    def _add(self, effects: Sequence[Effect]) -> None:
        """Append the parameters of effects."""
        self.effects = tuple(effects)
        each = [(n, e, p) for n, e in enumerate(self.effects) for p in fitted(e)]
        self.names = (*self.names, *(f"effect {n} {e.name} {p.name}" for n, e, p in each))
        self.start = np.append(self.start, [e[p.name] for _, e, p in each])
        self.steps = np.append(self.steps, [_effect_step(e, p) for _, e, p in each])

    def predict(
        self,
        channel: Channel,
        parameters: NDArray[np.float64],
        *,
        only: str | None = None,
    ) -> NDArray[np.float64]:
        """What a channel should read, linear terms left out.

        Parameters
        ----------
        channel : Channel
            Its axes say where.
        parameters : ndarray
            In the order of ``names``.
        only : str, optional
            Predict spots of this wavelength and temperature alone, such as '620/173.15'.
        """
        a = self._amps
        chain = self.chain(parameters)
        gains, noise = parameters[:a], parameters[a : 2 * a]
        count = len(self.baseline.parameters)
        device = self._device(parameters)
        if channel.word == "flat_cov":
            return self._flat_cov(channel, gains, noise, device, chain)
        if channel.word == "spot":
            return self._spots(
                channel, gains, device, parameters[2 * a + count :], only, chain
            )
        out = np.zeros(len(channel))
        if channel.word == "bias_cov":
            own = noise[channel.axes["amp"].astype(int)]
            out = np.where(channel.axes["lag"] == 0, own, 0.0)
        if chain is not None:
            if channel.word in ADDED:
                out = out + chain.added(channel, gains, self._with_light(channel, gains))
            elif channel.word == "flat_map":
                out = out + chain.map_change(channel)
        return out

    def chain(self, parameters: NDArray[np.float64]) -> EffectChain | None:
        """Effects with their parameters as given; None of none."""
        if not self.effects:
            return None
        return EffectChain(
            self.effects_at(parameters),
            self._layout_at(parameters),
            self.measured,
            self.baseline,
            self._evened,
            # Patterns are evened out as where the fit began: they hardly depend on it.
            (_mean_gain(self.start[: self._amps]), self._device(self.start)),
        )

    def modes(
        self, channel: Channel, parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """What chance adds to a channel by its effects, in its unit, shape (n, modes).

        Shapes whose strengths are independent and of variance 1: the values' covariance grows
        by ``modes @ modes.T``.
        """
        chain = self.chain(parameters)
        if chain is None:
            return np.zeros((len(channel), 0))
        gains = parameters[: self._amps]
        return chain.modes(channel, gains, self._with_light(channel, gains))

    def _device(self, parameters: NDArray[np.float64]) -> dict[str, float]:
        """Departures of the device's parameters from nominal."""
        own = parameters[2 * self._amps : 2 * self._amps + len(self.baseline.parameters)]
        return {
            name: float(value) * self.baseline.spread[name]
            for name, value in zip(self.baseline.parameters, own, strict=True)
        }

    def _layout_at(self, parameters: NDArray[np.float64]) -> Layout:
        """Layout with the gains and the read noise that parameters say."""
        gains, noise = parameters[: self._amps], parameters[self._amps : 2 * self._amps]
        # Levels of exposures are by the rough gains, which may be a quarter off.
        scale = _mean_gain(gains) / _mean_gain(np.array(self.layout.gains))
        return replace(
            self.layout,
            gains=tuple(gains.tolist()),
            read_noise=tuple(np.sqrt(np.maximum(noise, 0.0)).tolist()),
            shots=tuple(s._replace(level=scale * s.level) for s in self.layout.shots),
        )

    def effects_at(self, parameters: NDArray[np.float64]) -> tuple[Effect, ...]:
        """Effects with their parameters as given."""
        values = iter(parameters[len(parameters) - self._effect_count :])
        return tuple(
            e.with_values(**{p.name: float(next(values)) for p in fitted(e)})
            for e in self.effects
        )

    @property
    def kept(self) -> dict[tuple, Any]:
        """What copies with other effects share; filled by those who use it."""
        return self._evened

    @property
    def _effect_count(self) -> int:
        return sum(len(fitted(e)) for e in self.effects)

    def shapes(self) -> NDArray[np.bool_]:
        """Which parameters are of the shape of an effect, not its amplitude."""
        out = np.zeros(len(self.names), bool)
        n = len(self.names) - self._effect_count
        for effect in self.effects:
            for p in fitted(effect):
                out[n] = not p.amplitude
                n += 1
        return out

    def reach(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Smallest and largest steps of a fit from a point, shape (2, parameters).

        Effects stay in their ranges, widened; parameters of a shape go no farther than a
        derivative can tell: to half or twice, or a quarter of a range.
        """
        ends = np.full((2, len(self.names)), np.inf)
        ends[0] = -np.inf
        n = len(self.names) - self._effect_count
        for effect in self.effects:
            for p in fitted(effect):
                ends[:, n] = reach_of(p, float(point[n]))
                n += 1
        return ends

    def _with_light(
        self, channel: Channel, gains: NDArray[np.float64]
    ) -> dict[str, NDArray]:
        """Axes, of flats with 'light': electrons that light in proportion would bring."""
        if channel.word not in ("flat_mean", "flat_cov") or channel.unit == PER_ELECTRON:
            return dict(channel.axes)
        kept = self._lit.get(id(channel))
        if kept is None or kept[0] is not channel:
            x = channel.axes
            light = x["time"] * x.get("lamp", np.array(1.0))
            out = np.zeros(len(channel))
            for rows in self._rows(channel).values():
                for amp in np.unique(x["amp"][rows]):
                    here = rows[x["amp"][rows] == amp]
                    ratio = x["level"][here] / np.maximum(light[here], 1e-300)
                    weak = light[here] <= np.quantile(light[here], 0.4)
                    out[here] = np.median(ratio[weak]) * light[here]
            kept = self._lit[id(channel)] = channel, out
        amps = channel.axes["amp"].astype(int)
        return dict(channel.axes) | {"light": gains[amps] * kept[1]}

    def _rows(self, channel: Channel) -> dict[tuple[str, ...], NDArray[np.int64]]:
        """Rows of each condition, found once: channels do not change."""
        kept = self._kept.get(id(channel))
        if kept is None or kept[0] is not channel:
            kept = self._kept[id(channel)] = channel, _by_condition(channel)
        return kept[1]

    def depends(self, channel: Channel) -> NDArray[np.bool_]:
        """Which parameters a channel can depend on: the others need no derivative."""
        names = np.array(self.names)
        device = np.char.startswith(names, "device")
        sigma = np.char.startswith(names, "sigma")
        effect = np.zeros(len(names), bool)
        n = len(names) - self._effect_count
        for e in self.effects:
            for _ in fitted(e):
                effect[n] = channel.word in e.touches
                n += 1
        return effect | self._baseline_depends(channel, device, sigma)

    def _baseline_depends(
        self, channel: Channel, device: NDArray[np.bool_], sigma: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        a, names = self._amps, np.array(self.names)
        gain = np.char.startswith(names, "gain")
        noise = np.char.startswith(names, "noise")
        noise[a : 2 * a] &= self._noise_told
        if channel.word == "flat_cov":
            return device if channel.unit == PER_ELECTRON else gain | noise | device
        if channel.word == "spot":
            return gain | device | sigma
        if channel.word == "flat_mean" and any(
            "flat_mean" in e.touches for e in self.effects
        ):
            return gain
        return noise if channel.word == "bias_cov" else np.zeros(len(names), bool)

    def slope(
        self,
        channel: Channel,
        parameters: NDArray[np.float64],
        n: int,
        here: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Derivative of a channel by one parameter, given the prediction there."""
        step = parameters.copy()
        step[n] += self.steps[n]
        if channel.word == "spot" and self.names[n].startswith("sigma"):
            # Of one width the spots of others know nothing.
            first = self.names.index(next(m for m in self.names if m.startswith("sigma")))
            only = self._widths[(n - first) // 2]
            moved = self.predict(channel, step, only=only)
            out = np.zeros(len(channel))
            for key, rows in self._rows(channel).items():
                if _width_of(key) == only:
                    out[rows] = (moved[rows] - here[rows]) / self.steps[n]
            return out
        if channel.word == "flat_mean" and self.names[n].startswith("gain"):
            # Full pixels tell the ratio of full well and gain to one part in 1e5: both sides.
            back = parameters.copy()
            back[n] -= self.steps[n]
            both = self.predict(channel, step) - self.predict(channel, back)
            return both / (2 * self.steps[n])
        return (self.predict(channel, step) - here) / self.steps[n]

    def linear(self, channel: Channel) -> dict[str, NDArray[np.float64]]:
        """Columns of the linear parameters, by name; the same name is the same parameter."""
        out = linear_columns(channel, self._rows(channel), self.measured)
        for more in self.columns:
            out |= more(channel)
        return out

    def _flat_cov(
        self,
        channel: Channel,
        gains: NDArray[np.float64],
        noise: NDArray[np.float64],
        device: dict[str, float],
        chain: EffectChain | None,
    ) -> NDArray[np.float64]:
        x = channel.axes
        i, j = x["i"].astype(int), x["j"].astype(int)
        amp = x["amp"].astype(int)
        lags = int(max(i.max(), j.max()))
        out = np.empty(len(channel))
        for key, rows in self._rows(channel).items():
            del key
            if channel.unit == PER_ELECTRON:
                where = _condition(channel, rows[0])
                edges = self.baseline.edges_on(where, device, REDUCED_LEVEL)
                a = area_matrix(*edges)
                if chain is not None:
                    more = chain.area_change(edges, where)
                    a = a * (1 + chain.law.bend * REDUCED_LEVEL)
                    reach = max(more.shape[-1], a.shape[-1]) // 2
                    a = pad_areas(a, reach) + pad_areas(more, reach)
                    bent = chain.level_change(where, np.array([REDUCED_LEVEL]), grown=False)
                    if bent is not None:
                        a = a + pad_areas(bent[0], reach)
                y, x0 = (n // 2 for n in a.shape)
                out[rows] = 0.5 * (
                    a[y + j[rows], x0 + i[rows]] + a[y - j[rows], x0 + i[rows]]
                )
                continue
            pairs = np.stack([amp[rows], x["level"][rows]], axis=1)
            groups, first, index = np.unique(
                pairs, axis=0, return_index=True, return_inverse=True
            )
            own = gains[groups[:, 0].astype(int)]
            levels = own * groups[:, 1]
            where = _condition(channel, rows[0])
            if chain is None:
                a = self.baseline.flat_areas(where, device, levels)
                c = flat_covariances_of(a, levels, lags=lags) / own[:, None, None] ** 2
            else:
                lit = self._with_light(channel, gains)
                axes = {k: v[rows[first]] for k, v in lit.items()} | {"level": levels}
                axes["level"] = levels = chain.collected(levels, axes)
                more = chain.area_change(self.baseline.at(where, device)[0], where)
                a = self.baseline.flat_areas(where, device, levels)
                reach = max(more.shape[-1], a.shape[-1]) // 2
                a = pad_areas(a, reach) + pad_areas(more, reach)
                bent = chain.level_change(where, levels)
                if bent is not None:
                    a = a + pad_areas(bent, reach)
                whole = periodic_covariances(a, levels, law=chain.law)
                c = quadrant(chain.covariances(whole, axes), lags) / own[:, None, None] ** 2
            c[:, 0, 0] += noise[groups[:, 0].astype(int)]
            out[rows] = c[index.ravel(), j[rows], i[rows]]
        return out

    def _spots(
        self,
        channel: Channel,
        gains: NDArray[np.float64],
        device: dict[str, float],
        sigmas: NDArray[np.float64],
        only: str | None,
        chain: EffectChain | None,
    ) -> NDArray[np.float64]:
        x = channel.axes
        # Images were put on the scale of electrons with rough gains.
        scale = float(np.mean(gains / np.array(self.measured.gains)))
        out = np.zeros(len(channel))
        for key in self._spot_conditions:
            rows = self._rows(channel).get(key, np.zeros(0, int))
            if not len(rows) or (only is not None and _width_of(key) != only):
                continue
            n = self._widths.index(_width_of(key))
            edges, slopes = self._spot_shifts(self._spot_of[key], device)
            sigma = float(sigmas[2 * n]), float(sigmas[2 * n + 1])
            fluxes = scale * x["flux"][rows]
            if chain is None or chain.leaves_spots:
                found = dict(
                    self._unchanged(key, (*edges, np.array(sigma), fluxes), slopes)
                )
            else:
                variance, halo, axes = chain.spot_change(self._spot_of[key])
                if "hours" in x:
                    axes = {**axes, "hours": float(np.mean(x["hours"][rows]))}
                if "background" in x:
                    # Dark current grows with the time that the flux takes.
                    per = float(x["background"][rows].sum() / x["flux"][rows].sum())
                    axes = {**axes, "background": per}
                wide = sigma
                if variance:
                    squares = [max(s * s + variance, 0.01 * s * s) for s in sigma]
                    wide = float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))
                edges, slopes = chain.spot_edges(edges, slopes, self._spot_of[key])
                found = predict_spots(
                    *edges, sigma=wide,
                    phases=self._phases[key], fluxes=fluxes, halo=halo, law=chain.law,
                    neighbours=self.measured.neighbours, slopes=slopes,
                    change=partial(chain.spot_image, axes=axes),
                )  # fmt: skip
            found["flux"] = found["flux"] / scale
            for what, values in found.items():
                here = x["what"][rows] == what
                out[rows[here]] = values[here]
        if chain is not None:
            here = x["what"] == "flux"
            axes = {k: v[here] for k, v in x.items()} | {"flux": scale * x["flux"][here]}
            out[here] += chain.spot_flux(axes) / scale
        return out

    def _spot_shifts(
        self, condition: Condition, device: dict[str, float]
    ) -> tuple[Edges, Edges | None]:
        """Shifts of spots, without charge where they go with it, and their slopes."""
        (kx, ky), _ = self.baseline.at(condition, device)
        key = self.baseline.nearest(condition)
        if not self.baseline.spots_bend or key not in self.baseline.slopes:
            return (kx, ky), self.spot_slopes
        # Slopes of free forms are among them.
        sx, sy = self.baseline.slopes[key]
        level = self.baseline.level
        return (kx - level * sx, ky - level * sy), (sx, sy)

    def _unchanged(
        self,
        key: tuple[str, ...],
        state: tuple[NDArray[np.float64], ...],
        slopes: Edges | None,
    ) -> dict[str, NDArray[np.float64]]:
        """Spots that no effect changes, at a condition; kept while effects' parameters alone move."""
        kept = self._grown.get(key)
        if kept is None or not all(map(np.array_equal, kept[0], state)):
            kx, ky, sigma, fluxes = state
            found = predict_spots(
                kx, ky, sigma=(float(sigma[0]), float(sigma[1])), phases=self._phases[key],
                fluxes=fluxes, slopes=slopes,
            )  # fmt: skip
            kept = self._grown[key] = state, found
        return kept[1]


def _width_of(key: tuple[str, ...]) -> str:
    """Wavelength and temperature of a condition: what spots have one width at."""
    return f"{key[0]}/{key[2]}"


def fitted(effect: Effect) -> list[Parameter]:
    """Parameters that a fit may move: whole numbers stay where the search put them."""
    return [p for p in effect.parameters if p.law != "whole"]


def widened(p: Parameter) -> tuple[float, float]:
    """Range of a parameter in fits: ten times beyond the plausible one, or half of its width."""
    if p.law == "log":
        low = -10 * p.high if p.signed else (0.0 if p.amplitude else 0.3 * p.low)
        return p.neutral + low, p.neutral + (10 * p.high if p.amplitude else 3 * p.high)
    reach = 0.5 * (p.high - p.low)
    return p.low - reach, p.high + reach


def reach_of(p: Parameter, value: float) -> tuple[float, float]:
    """Smallest and largest step of an effect's parameter from a value: see :meth:`Predictor.reach`."""
    away, far = value - p.neutral, 0.25 * (p.high - p.low)
    range_ = np.array(widened(p)) - value
    step = np.array([-0.5, 1.0]) * away if p.law == "log" else far * np.array([-1, 1])
    held = p.amplitude or (p.law == "log" and p.signed)
    low, high = range_ if held else np.clip(step, *range_)
    # From beyond its range no farther.
    return min(float(low), 0.0), max(float(high), 0.0)


def _effect_step(effect: Effect, p: Parameter) -> float:
    """Of derivatives: small against the value, or the least plausible one."""
    if p.step:
        return p.step
    scale = abs(effect[p.name] - p.neutral)
    return 0.02 * max(scale, p.low) if p.law == "log" else 0.01 * (p.high - p.low)


def _mean_gain(gains: NDArray[np.float64]) -> float:
    """Mean over amplifiers; 1 for a_ij, which have none."""
    return float(np.mean(gains)) if len(gains) else 1.0


def _noise_told(measured: Measured) -> NDArray[np.bool_]:
    """Of which amplifiers biases, or flats of several levels, tell the read noise."""
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
                levels[n] |= set(channel.axes["time"][own].tolist())
    flats = any(levels)
    return told | np.array([len(v) > 1 or not flats for v in levels], bool)


def _by_condition(channel: Channel) -> dict[tuple[str, ...], NDArray[np.int64]]:
    """Rows of each condition."""
    columns = np.column_stack([channel.axes[n].astype(float) for n in Condition._fields])
    # nan equals nan here.
    _, first, index = np.unique(
        np.nan_to_num(columns, nan=-1e99), axis=0, return_index=True, return_inverse=True
    )
    return {
        Condition(*(float(v) for v in columns[row])).key: np.nonzero(index.ravel() == n)[0]
        for n, row in enumerate(first)
    }


def _condition(channel: Channel, row: int | np.integer) -> Condition:
    return Condition(*(float(channel.axes[n][row]) for n in Condition._fields))


def used_channels(channels: Sequence[Channel], folds: Sequence[str]) -> list[Channel]:
    """Channels of some folds."""
    return [c for c in channels if c.fold in folds]
