"""How well each candidate explains what a fit leaves, all of the fit's parameters free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.fit.random_effects import likeliest, scatter_of
from bfsensor.diagnose.model.effect_parameters import fitted, widened
from bfsensor.diagnose.model.map_predictions import lines_of_map
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect, Layout, Parameter
from bfsensor.errors import BFSensorError, ConvergenceError
from bfsensor.files import Cache
from bfsensor.typing import FloatArray

REFINED = 2
"""Best starts of a candidate that are refined."""

MANY, LIKELY = 8, 6
"""More starts than these are held against one channel first, and so many of them against all."""

TELLING = "code_hist", "bias_cov", "flat_map"
"""Channels that are quickly predicted, and tell starts that are many apart."""

ASTRAY = 0.1
"""Part by which the best amplitude may be off the start's before the path to it is tried."""

OCCAM = 5.0
"""Logarithm of the evidence that a parameter costs a candidate that is not fitted on, for it is
far from the best (a third of a per cent of its range is about what data allow)."""

SCATTERED = 6.0
"""Gain of the likelihood by scatter from which a candidate that is told by it is not fitted on by
what it changes in the mean."""

STEP = 0.02
"""Of derivatives, as a part of a parameter."""

MOST_CALLS = 15
"""Evaluations of a refinement for each of its parameters."""


@dataclass(frozen=True, eq=False)
class Rival:
    """A candidate with its best parameters.

    Attributes
    ----------
    effect : Effect
        The candidate.
    gain : float
        Decrease of the chi-square, all other parameters refitted to first order.
    evidence : float
        Logarithm of its evidence over that of no effect (Laplace), parameters spread over
        their plausible range.
    template : ndarray
        What it changes, whitened, the fit's parameters projected out.
    select : float
        Decrease of the chi-square of the fold that selects, amplitude fitted without it; nan
        where the effect is not in that fold.
    share : float
        Part of what it changes, squared, that is in that fold.
    """

    effect: Effect
    gain: float
    evidence: float
    template: FloatArray
    select: float = np.nan
    share: float = 0.0

    @property
    def refuted(self) -> bool:
        """Whether the fold that selects speaks against it: a loss far below the gain due there.

        Of a gain G, of which the share s is due in that fold, noise leaves s G +- 2 (s G)^(1/2).
        """
        due = self.share * self.gain
        return self.select < min(0.0, due - 3 * 2 * float(np.sqrt(max(due, 0.0))))

    @property
    def word(self) -> str:
        """Class."""
        return self.effect.word


class Screen:
    """Judges candidates against the residuals of one fit.

    To first order in what the other parameters have to give way: whatever lies in their span is
    projected out of residuals and templates; effects themselves are not linearised.

    Parameters
    ----------
    predictor : Predictor
        Of the fit, effects that are in it already included.
    fit : BaselineFit
        Whose residuals.
    seen : sequence of mapping
        What the scans found, for those candidates whose place must be looked for.
    """

    def __init__(
        self, predictor: Predictor, fit: BaselineFit, seen: Sequence[Mapping[str, Any]] = ()
    ) -> None:
        self.fit, self.seen = fit, tuple(seen)
        self.point = fit.values[: len(predictor.names)]
        self.predictor = predictor.with_effects(
            predictor.effects_at(self.point), self.point
        )
        self._here: list[FloatArray | None] = [None] * len(fit.channels)
        select = [np.full(len(c), c.fold == "select") for c in fit.channels]
        priors = np.zeros(len(fit.left) - len(fit.residuals), bool)
        self._select = np.concatenate([*select, priors])
        # Of starts: what they change hardly depends on the effects that there are.
        self._starts = predictor.kept.get(("starts", *fit.channels), Cache)
        self.passed_over: dict[str, str] = {}
        """Candidates of which a start or a fit could not be worked out, and why."""
        self._scaled_templates: dict[Effect, FloatArray] = {}
        self._scattered: set[Effect] = set()

    def change(self, effect: Effect) -> FloatArray:
        """What an effect changes: whitened, priors' rows after it, parameters projected out."""
        return self._projected(self._change(effect))

    def _projected(self, change: NDArray[np.floating]) -> FloatArray:
        out = np.zeros(len(self.fit.left))
        out[: len(change)] = change
        return np.asarray(out - self.fit.basis @ (self.fit.basis.T @ out))

    def _change_of_start(self, effect: Effect) -> FloatArray:
        """As :meth:`change`, found once for all screens of an attribution."""
        change = self._starts.get(effect, lambda: self._change(effect).astype(np.float32))
        return self._projected(change)

    def _change(self, effect: Effect) -> FloatArray:
        """What an effect changes, whitened."""
        both = self.predictor.with_effects((*self.predictor.effects, effect), self.point)
        more = both.start[len(both.names) - len(fitted(effect)) :]
        # Parameters of effects that are there already stay where the fit put them.
        point = np.concatenate([self.point, more])
        out = np.zeros(len(self.fit.residuals))
        for n, (channel, start) in enumerate(
            zip(self.fit.channels, self.fit.starts, strict=False)
        ):
            if channel.word not in effect.touches:
                continue
            here = self._here[n]
            if here is None:
                here = self._here[n] = self.predictor.predict(channel, self.point)
            with np.errstate(over="ignore", invalid="ignore"):
                moved = both.predict(channel, point) - here
            if not np.isfinite(moved).all():
                raise ConvergenceError(f"predictions of {channel.word} overflow")
            out[start : start + len(channel)] = channel.whiten(moved)
        return out

    def tried(self, kind: type[Effect]) -> list[tuple[float, Effect]]:
        """Places where a fit of a kind of effect may begin, with their gains, greatest first.

        Amplitudes are those that fit best, what changes being a multiple of them and of their
        square; empty where nothing of it could be seen.
        """
        starts = [_inside(kind(v)) for v in kind.starts(self.predictor.layout, self.seen)]
        tried = []
        for effect in self._likely(kind, starts):
            try:
                tried.append(self._scaled(effect))
            except BFSensorError as error:
                # So far off that what is measured cannot be worked out.
                self.passed_over[effect.name] = str(error)
        return sorted((t for t in tried if t is not None), key=lambda t: -t[0])

    def shapes(self, kind: type[Effect], layout: Layout) -> list[FloatArray]:
        """What an effect changes, of unit length, at each place where a fit of it may begin.

        Of many places (:data:`MANY`) only what one channel shows (:data:`TELLING`).

        Parameters
        ----------
        kind : type
            Of effect.
        layout : Layout
            Which the places are those of.
        """
        starts = [_inside(kind(v)) for v in kind.starts(layout)]
        telling = self._telling(kind) if len(starts) > MANY else None
        out = []
        for effect in starts:
            try:
                if telling is None:
                    template = self._change_of_start(effect)
                else:
                    channel, first = telling
                    change = np.zeros(len(self.fit.residuals))
                    change[first : first + len(channel)] = self._told(effect, channel)
                    template = self._projected(change)
            except BFSensorError as error:
                self.passed_over[effect.name] = str(error)
                continue
            length = float(np.sqrt(template @ template))
            if length > 0:
                out.append(template / length)
        return out

    def _telling(self, kind: type[Effect]) -> tuple[Channel, int] | None:
        """First channel that tells places of an effect apart, and where it begins."""
        word = next((w for w in TELLING if w in kind.touches), "")
        return next((
            (c, int(start)) for c, start in zip(self.fit.channels, self.fit.starts, strict=False)
            if c.word == word and c.fold == "fit"
        ), None)  # fmt: skip

    def _told(self, effect: Effect, channel: Channel) -> FloatArray:
        """What an effect changes in a telling channel, whitened."""
        if channel.word == "flat_map":
            return channel.whiten(lines_of_map(effect, channel, self.predictor.layout))
        plain = self.predictor.with_effects((), self.point)
        chain = self.predictor.with_effects((effect,), self.point)
        more = chain.start[len(chain.start) - len(fitted(effect)) :]
        change = chain.predict(channel, np.append(plain.start, more))
        return channel.whiten(change - plain.predict(channel, plain.start))

    def _scaled(self, effect: Effect) -> tuple[float, Effect] | None:
        """Gain of an effect of the best amplitude; None of what cannot be seen."""
        template = self._change_of_start(effect)
        length = float(template @ template)
        if length <= 0:
            return None
        factor = float(template @ self.fit.left) / length
        if effect.told_by_scatter:
            found = self._by_scatter(effect, template)
            if found is not None:
                return found
        signed = any(p.signed for p in effect.parameters if p.amplitude)
        if factor <= 0 and not signed:
            self._scaled_templates[effect] = template
            return 0.0, effect
        if not effect.bends or abs(factor - 1) < ASTRAY:
            best = _inside(effect.scaled(factor))
            self._scaled_templates[best] = factor * template
            return factor**2 * length, best
        # What it changes is f t1 + f^2 t2: both from another amplitude.
        other = self._change_of_start(effect.scaled(0.5))
        one, two = 4 * other - template, 2 * template - 4 * other
        factor = _best_factor((one, two), self.fit.left, signed=signed)
        best = _inside(effect.scaled(factor)) if factor else effect
        template = self.change(best)
        self._scaled_templates[best] = template
        # As it is: far from the start what it changes is another thing.
        return max(float(template @ (2 * self.fit.left - template)), 0.0), best

    def _by_scatter(
        self, effect: Effect, template: FloatArray
    ) -> tuple[float, Effect] | None:
        """Gain of an effect as strong as scatter tells; None where it tells hardly anything."""
        fit = self.fit
        own = scatter_of(self.predictor, fit.channels, fit.starts, effect, self.point)
        modes = np.concatenate([own, np.zeros((len(fit.left) - len(own), own.shape[1]))])
        modes -= fit.basis @ (fit.basis.T @ modes)
        nothing = np.zeros(len(fit.left))
        if likeliest(modes, fit.left, nothing, nothing)[0] < SCATTERED:
            return None
        other = self._change_of_start(effect.scaled(0.5))
        one, two = 4 * other - template, 2 * template - 4 * other
        gain, factor = likeliest(modes, fit.left, one, two)
        best = _inside(effect.scaled(factor))
        self._scaled_templates[best] = factor * one + factor**2 * two
        self._scattered.add(best)
        return max(gain, 0.0), best

    def _likely(self, kind: type[Effect], starts: list[Effect]) -> list[Effect]:
        """Those of many starts that one channel finds likeliest."""
        telling = self._telling(kind)
        if len(starts) <= MANY or telling is None:
            return starts
        (channel, first), gains = telling, []
        own = slice(first, first + len(channel))
        basis, left = self.fit.basis[own], self.fit.left[own]
        for effect in starts:
            template = self._told(effect, channel)
            along = basis.T @ template
            length = float(template @ template) - float(along @ along)
            gains.append(float(template @ left) ** 2 / length if length > 0 else 0.0)
        order = np.argsort(gains)[::-1][:LIKELY]
        return [starts[n] for n in order]

    def best(
        self, tried: Sequence[tuple[float, Effect]], *, least: float = 0.0
    ) -> Rival | None:
        """Best parameters of a kind of effect; None where nothing of it could be seen.

        Parameters
        ----------
        tried : sequence of (float, Effect)
            From :meth:`tried`.
        least : float
            Gain of a start below which it is not worth while to fit on from there.
        """
        if not tried:
            return None
        gain, effect = tried[0]
        if gain < least or effect in self._scattered:
            template = self._scaled_templates.get(effect)
            if template is None:
                template = self.change(effect)
            return Rival(effect, gain, 0.5 * gain - OCCAM, template)
        rivals = []
        for gain, effect in tried[:REFINED]:
            try:
                rivals += [self._refine(effect)] if gain >= least else []
            except BFSensorError as error:
                # On its way the fit came to where nothing can be measured.
                self.passed_over[effect.name] = str(error)
        return max(rivals, key=lambda r: r.gain, default=None)

    def _refine(self, effect: Effect) -> Rival:
        """Fit all parameters of a candidate from where it is."""
        names = fitted(effect)
        scales = np.array([_scale(effect, p) for p in names])
        low, high = np.array([widened(p) for p in names]).T
        start = np.array([effect[p.name] for p in names])
        start = np.clip(start, low + 1e-9 * scales, high - 1e-9 * scales)
        # Derivatives take 2 % of a value; of those with a step of their own, counted from where
        # they start, that is it.
        origin = np.array([
            x - s if p.step else 0.0 for p, x, s in zip(names, start, scales, strict=True)
        ])  # fmt: skip

        def at(x: FloatArray) -> Effect:
            values = origin + x * scales
            return effect.with_values(**{
                p.name: float(v) for p, v in zip(names, values, strict=True)
            })  # fmt: skip

        def left(x: FloatArray) -> FloatArray:
            return self.fit.left - self.change(at(x))

        first, lowest, highest = ((v - origin) / scales for v in (start, low, high))
        found = least_squares(
            left, first, bounds=(lowest, highest), diff_step=STEP,
            xtol=1e-3, ftol=1e-4, max_nfev=MOST_CALLS,
        )  # fmt: skip
        best = at(found.x)
        gain = float(self.fit.left @ self.fit.left) - 2 * float(found.cost)
        template = self.fit.left - found.fun
        return Rival(
            best, gain, evidence(best, names, gain, found.jac / scales), template,
            *self._select_gain(template),
        )  # fmt: skip

    def _select_gain(self, template: FloatArray) -> tuple[float, float]:
        """Gain on the fold that selects, the amplitude from the others; what is due there."""
        own = self._select
        inside = float(template[own] @ template[own])
        outside = float(template[~own] @ template[~own])
        # Of an effect that this fold hardly sees it cannot judge.
        if inside < 0.05 * (inside + outside) or outside == 0:
            return float("nan"), 0.0
        factor = float(template[~own] @ self.fit.left[~own]) / outside
        residuals = self.fit.left[own]
        after = residuals - factor * template[own]
        gain = float(residuals @ residuals - after @ after)
        return gain, inside / (inside + outside)


def evidence(
    effect: Effect, names: Sequence[Parameter], gain: float, slopes: FloatArray
) -> float:
    r"""Logarithm of the evidence of an effect over that of none, after Laplace.

    .. math::
        \tfrac12 \Delta\chi^2 + \sum_p \ln \pi(p) + \tfrac{k}{2} \ln 2\pi - \tfrac12 \ln |J^T J|

    with priors flat in the parameter or in its logarithm over the plausible range; beyond it they
    fall off as a Gaussian of the logarithm of a width of a factor of two.

    Parameters
    ----------
    effect : Effect
        With its best parameters.
    names : sequence of Parameter
        Those that were fitted.
    gain : float
        Decrease of the chi-square.
    slopes : ndarray, shape (n, k)
        Derivatives of the whitened prediction.
    """
    out = 0.5 * gain
    for p in effect.parameters:
        if p.law == "whole":
            out -= np.log(max(p.high - p.low + 1, 1))
    if not names:
        return out
    matrix = slopes.T @ slopes
    prior = 0.0
    widths = np.empty(len(names))
    for n, p in enumerate(names):
        value = effect[p.name] - p.neutral if p.law == "log" else effect[p.name]
        if p.law == "log":
            size = float(np.clip(abs(value), p.low, p.high))
            prior -= np.log(size * np.log(p.high / p.low) * (2 if p.signed else 1))
            beyond = np.log(max(abs(value), 1e-3 * p.low) / size) / np.log(2.0)
            widths[n] = 0.3 * size * np.log(p.high / p.low)
        else:
            prior -= np.log(p.high - p.low)
            out_by = max(p.low - value, value - p.high, 0.0)
            beyond = 4 * out_by / (p.high - p.low)
            widths[n] = 0.3 * (p.high - p.low)
        prior -= 0.5 * beyond**2
    # No wider than the prior: of what the data leave open the prior is all there is.
    matrix = matrix + np.diag(1.0 / widths**2)
    sign, logarithm = np.linalg.slogdet(matrix)
    del sign
    return float(out + prior + 0.5 * len(names) * np.log(2 * np.pi) - 0.5 * logarithm)


def _scale(effect: Effect, p: Parameter) -> float:
    """Size of a parameter for the minimiser."""
    if p.step:
        return p.step / STEP
    if p.law != "log":
        return p.high - p.low
    return max(abs(effect[p.name] - p.neutral), p.low)


def _inside(effect: Effect) -> Effect:
    """Copy with all parameters inside the range of fits."""
    values = {}
    for p in fitted(effect):
        low, high = widened(p)
        values[p.name] = float(np.clip(effect[p.name], low, high))
    return effect.with_values(**values)


def _best_factor(
    parts: tuple[FloatArray, FloatArray],
    left: FloatArray,
    *,
    signed: bool,
) -> float:
    """Factor f of f t1 + f^2 t2 that explains most of what is left; 0 if none does."""
    one, two = parts
    p = 2 * float(one @ left), 2 * float(two @ left) - float(one @ one)
    q = -2 * float(one @ two), -float(two @ two)
    # Gain p0 f + p1 f^2 + q0 f^3 + q1 f^4, whose slope is a cubic.
    roots = np.roots([4 * q[1], 3 * q[0], 2 * p[1], p[0]])
    best, most = 0.0, 0.0
    for f in roots[np.abs(roots.imag) < 1e-6 * (1 + np.abs(roots))].real:
        gain = float(f * (p[0] + f * (p[1] + f * (q[0] + f * q[1]))))
        if gain > most and (f > 0 or signed):
            best, most = float(f), gain
    return best
