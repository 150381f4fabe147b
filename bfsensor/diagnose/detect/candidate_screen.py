"""Screening of candidate effects: gain in chi-square and evidence, the fit's parameters projected out.

A candidate's template, the change of all predictions by it, is a matched filter of the residuals.
Parameters of the fit give way to first order; the candidate itself is not linearised.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.detect.scatter import scatter_of
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.diagnose.model.map_predictions import lines_of_map
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect, Layout, Parameter
from bfsensor.effects.family import EffectFamily
from bfsensor.errors import BFSensorError, ConvergenceError
from bfsensor.files import Cache
from bfsensor.typing import FloatArray

REFINED = 2
"""Number of a candidate's best starting points from which all its parameters are fitted.  Chosen:
with 4, screens take up to twice as long, and minima near a third or fourth start are found, too."""

MANY, LIKELY = 8, 6
"""Number of starting points above which they are first ranked in the channels below alone, and
number of those that are then compared in all channels.  Chosen, to be derived: with 16 and 12
about twice as many predictions of all channels are made; a start that one channel ranks seventh
is then kept."""

TELLING = "code_hist", "bias_cov", "serial_overscan", "flat_map", "flat_mean"
"""Channels that are fast to predict and separate many starting points of one effect (bits, rows,
positions in a map, times), in the order of preference."""

ASTRAY = 0.1
"""Relative change of the amplitude by the linear fit above which the template of an effect that
is not linear in it is extrapolated quadratically.  Chosen: below it, a quadratic term of the size
of the linear one makes an error of at most 5 % of the template; with 0.2, of 9 %."""

OCCAM = 5.0
"""Logarithm of the evidence subtracted from a candidate that is not fitted, whatever its number of
parameters: ln(R / ((2 pi)^(1/2) s)) for one parameter of prior range R and error s = 0.27 % of it.
Chosen, to be derived: with 10 (s = 0.002 % of R) candidates below the limit for a fit would rank 5
lower in logarithmic evidence against those that are fitted."""

SCATTERED = 6.0
"""Twice the logarithm of the likelihood ratio by scatter alone, at least which an effect with
random effects is ranked by its likelihood and not fitted by its mean change.  Chosen, to be
derived: for one amplitude at its bound noise exceeds 6 with probability 0.7 % (half a chi-square
of one degree of freedom); with 12 (0.03 %), more effects of weak scatter would be fitted by
their means alone."""

STEP = 0.02
"""Step of finite differences, relative to a parameter.  Chosen: a curvature as large as the slope
makes an error of about 1 % of the derivative; twice as large, of 2 %."""

MOST_CALLS = 15
"""Largest number of function evaluations of a refinement, without those for derivatives.  Chosen:
with 30, candidates that converge slowly rank higher, and screens take up to twice as long."""


HIDDEN = 1e-3
"""Part of the square of a candidate's template in one channel up to which the channel is left out
while the candidate's shape is fitted; its gain is then that of all channels.  Chosen: of a candidate
of 30 standard deviations the channel sees less than one; with 2e-3, 1.3."""


@dataclass(frozen=True, eq=False)
class Rival:
    """A candidate with its best parameters, and how well it explains the residuals.

    Attributes
    ----------
    effect : Effect
        The candidate.
    gain : float
        Decrease of the chi-square, all other parameters refitted to first order.
    evidence : float
        Natural logarithm of the Bayes factor against no effect, by Laplace's approximation,
        with priors over the parameters' plausible ranges.
    template : ndarray, shape (n + priors,)
        Whitened change of all predictions, the fit's parameters projected out.
    select : float
        Decrease of the chi-square in the fold 'select' with the amplitude fitted in the other
        folds; nan where less than 5 % of the template's square is in that fold.
    share : float
        Part of the template's square that is in that fold, 0 to 1.
    law : float
        Further gain by other laws of the effect, less their charge; not part of ``gain``.
    """

    effect: Effect
    gain: float
    evidence: float
    template: FloatArray
    select: float = np.nan
    share: float = 0.0
    law: float = 0.0

    @property
    def refuted(self) -> bool:
        """Whether the fold 'select' rejects the candidate, at three standard deviations.

        With the share s of a gain G expected there, noise gives s G +- 2 (s G)^(1/2).  The
        candidate is rejected if the chi-square rises in that fold and is below that by 3 sigma.
        """
        due = self.share * self.gain
        return self.select < min(0.0, due - 3 * 2 * float(np.sqrt(max(due, 0.0))))

    @property
    def word(self) -> str:
        """Name of the effect's class."""
        return self.effect.word


class Screen:
    """Compares candidates with the residuals of one fit.

    The span of the fit's parameters is projected out of residuals and templates, so that these
    parameters are refitted to first order; the candidates themselves are not linearised.

    Parameters
    ----------
    predictor : Predictor
        Predictor of the fit, with the effects that are in it.
    fit : BaselineFit
        The fit whose residuals are explained.
    seen : sequence of mapping
        Findings of the scans, from which some candidates take their starting points (place,
        period): see :func:`bfsensor.diagnose.detect.candidates.seen_of`.
    before : mapping of type to Effect, optional
        Candidates as they were fitted to residuals of fewer effects: further starting points.
    """

    def __init__(
        self,
        predictor: Predictor,
        fit: BaselineFit,
        seen: Sequence[Mapping[str, Any]] = (),
        before: Mapping[EffectFamily, Effect] | None = None,
    ) -> None:
        self.fit, self.seen, self.before = fit, tuple(seen), before or {}
        self.point = fit.values[: len(predictor.names)]
        self.predictor = predictor.with_effects(
            predictor.effects_at(self.point), self.point
        )
        self._here: list[FloatArray | None] = [None] * len(fit.channels)
        select = [np.full(len(c), c.fold == "select") for c in fit.channels]
        priors = np.zeros(len(fit.left) - len(fit.residuals), bool)
        self._select = np.concatenate([*select, priors])
        # Templates at starting points hardly depend on the effects in the fit: cached for all fits.
        self._starts = predictor.kept.get(("starts", *fit.channels), Cache)
        self.passed_over: dict[str, str] = {}
        """Candidates that could not be predicted at a start or during a fit, with the reason."""
        self._scaled_templates: dict[Effect, FloatArray] = {}
        self._scattered: set[Effect] = set()

    def change(self, effect: Effect, among: Collection[int] | None = None) -> FloatArray:
        """Template of an effect, shape (n + priors,): whitened, the fit's parameters projected out.

        ``among`` are the numbers of the channels that are predicted, by default all.
        """
        return self._projected(self._change(effect, among))

    def _projected(self, change: NDArray[np.floating]) -> FloatArray:
        out = np.zeros(len(self.fit.left))
        out[: len(change)] = change
        touched = np.flatnonzero(out)
        if not len(touched):
            return out
        # Most effects change few channels.
        own = slice(touched[0], touched[-1] + 1)
        return np.asarray(out - self.fit.basis @ (self.fit.basis[own].T @ out[own]))

    def _change_of_start(self, effect: Effect) -> FloatArray:
        """Template as :meth:`change` gives it, cached for all screens of an attribution."""
        change = self._starts.get(effect, lambda: self._change(effect).astype(np.float32))
        return self._projected(change)

    def _change(self, effect: Effect, among: Collection[int] | None = None) -> FloatArray:
        """Whitened change of all values by an effect, shape (n,); 0 in channels not ``among`` some."""
        both = self.predictor.with_effects((*self.predictor.effects, effect), self.point)
        more = both.start[len(both.names) - len(fitted(effect)) :]
        # Effects that are in the fit keep their fitted parameters.
        point = np.concatenate([self.point, more])
        out = np.zeros(len(self.fit.residuals))
        for n, (channel, start) in enumerate(
            zip(self.fit.channels, self.fit.starts, strict=False)
        ):
            if channel.word not in effect.touches or (among is not None and n not in among):
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

    def tried(self, kind: EffectFamily) -> list[tuple[float, Effect]]:
        """Starting points of a kind of effect at their best amplitudes, by decreasing gain.

        The change by the effect is linear, or quadratic, in the amplitude, which is fitted.

        Parameters
        ----------
        kind : type
            Class of effect.

        Returns
        -------
        tried : list of (float, Effect)
            Decrease of the chi-square and starting point; empty if none changes any value.
        """
        starts = [_inside(kind(v)) for v in kind.starts(self.predictor.layout, self.seen)]
        tried = []
        before = [self.before[kind]] if kind in self.before else []
        for effect in (*self._likely(kind, starts), *before):
            try:
                tried.append(self._scaled(effect))
            except BFSensorError as error:
                # So strong an effect that a channel, such as widths of spots, is not defined.
                self.passed_over[effect.name] = str(error)
        return sorted((t for t in tried if t is not None), key=lambda t: -t[0])

    def shapes(self, kind: EffectFamily, layout: Layout) -> list[FloatArray]:
        """Unit templates of a kind of effect at its starting points (matched filters).

        With more than :data:`MANY` starting points, templates of one channel only.

        Parameters
        ----------
        kind : type
            Class of effect.
        layout : Layout
            Layout from which the starting points are taken.

        Returns
        -------
        shapes : list of ndarray, shape (n + priors,)
            Whitened, the fit's parameters projected out, of unit length.
        """
        starts = [_inside(kind(v)) for v in kind.starts(layout)]
        # Templates of all channels at dozens of places take long; a template of one channel is a
        # weaker filter, with the same false-alarm rate.
        telling = next(iter(self._telling(kind)), None) if len(starts) > MANY else None
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

    def _telling(self, kind: EffectFamily) -> list[tuple[Channel, int]]:
        """Channels that separate starting points, and the indices of their first values."""
        words = [w for w in TELLING if w in kind.touches]
        found = [
            (c, int(start)) for c, start in zip(self.fit.channels, self.fit.starts, strict=False)
            if c.word in words and c.fold == "fit"
        ]  # fmt: skip
        return sorted(found, key=lambda t: words.index(t[0].word))

    def _told(self, effect: Effect, channel: Channel) -> FloatArray:
        """Whitened change by an effect in one channel, without the other effects of the fit."""
        if channel.word == "flat_map":
            return channel.whiten(lines_of_map(effect, channel, self.predictor.layout))
        plain = self.predictor.with_effects((), self.point)
        chain = self.predictor.with_effects((effect,), self.point)
        more = chain.start[len(chain.start) - len(fitted(effect)) :]
        change = chain.predict(channel, np.append(plain.start, more))
        return channel.whiten(change - plain.predict(channel, plain.start))

    def _scaled(self, effect: Effect) -> tuple[float, Effect] | None:
        """Gain of an effect at its best amplitude, and that effect; None if it changes nothing."""
        template = self._change_of_start(effect)
        length = float(template @ template)
        if length <= 0:
            return None
        if effect.response == "rough":
            self._scaled_templates[effect] = template
            return max(float(template @ (2 * self.fit.left - template)), 0.0), effect
        factor = float(template @ self.fit.left) / length
        if effect.scatters:
            found = self._by_scatter(effect, template)
            if found is not None:
                return found
        signed = any(p.signed for p in effect.parameters if p.amplitude)
        if factor <= 0 and not signed:
            self._scaled_templates[effect] = template
            return 0.0, effect
        if effect.response == "linear" or abs(factor - 1) < ASTRAY:
            best = _inside(effect.scaled(factor))
            self._scaled_templates[best] = factor * template
            return factor**2 * length, best
        # With t(f) = f t1 + f^2 t2, the templates at f = 1 and 1/2 give t1 and t2.
        other = self._change_of_start(effect.scaled(0.5))
        one, two = 4 * other - template, 2 * template - 4 * other
        factor = _best_factor((one, two), self.fit.left, signed=signed)
        best = _inside(effect.scaled(factor)) if factor else effect
        template = self.change(best)
        self._scaled_templates[best] = template
        # From the template at the best amplitude: the quadratic law may not hold as far as that.
        return max(float(template @ (2 * self.fit.left - template)), 0.0), best

    def _by_scatter(
        self, effect: Effect, template: FloatArray
    ) -> tuple[float, Effect] | None:
        """Gain at the amplitude of greatest likelihood by scatter; None if below SCATTERED."""
        fit = self.fit
        scatter = scatter_of(self.predictor, fit, effect, self.point)
        nothing = np.zeros(len(fit.left))
        if scatter.likeliest(fit.left, nothing, nothing)[0] < SCATTERED:
            return None
        other = self._change_of_start(effect.scaled(0.5))
        one, two = 4 * other - template, 2 * template - 4 * other
        gain, factor = scatter.likeliest(fit.left, one, two)
        best = _inside(effect.scaled(factor))
        self._scaled_templates[best] = factor * one + factor**2 * two
        self._scattered.add(best)
        return max(gain, 0.0), best

    def _likely(self, kind: EffectFamily, starts: list[Effect]) -> list[Effect]:
        """The LIKELY starting points of greatest gain in quick channels; all if they are few."""
        telling = self._telling(kind)
        if len(starts) <= MANY or not telling:
            return starts
        found, length = np.zeros(len(starts)), np.zeros(len(starts))
        for channel, first in telling:
            own = slice(first, first + len(channel))
            basis, left = self.fit.basis[own], self.fit.left[own]
            for n, effect in enumerate(starts):
                template = self._told(effect, channel)
                along = basis.T @ template
                # One amplitude in all channels.
                found[n] += float(template @ left)
                length[n] += max(float(template @ template) - float(along @ along), 0.0)
        # A change that is not in proportion to an amplitude is taken as it is.
        rough = np.array([effect.response == "rough" for effect in starts])
        best = found**2 / np.where(length > 0, length, np.inf)
        gains = np.where(rough, 2 * found - length, best)
        order = np.argsort(gains)[::-1][:LIKELY]
        return [starts[n] for n in order]

    def best(
        self, tried: Sequence[tuple[float, Effect]], *, least: float = 0.0
    ) -> Rival | None:
        """Fit all parameters of a kind of effect from its best starting points.

        Parameters
        ----------
        tried : sequence of (float, Effect)
            Starting points from :meth:`tried`.
        least : float
            Gain of a starting point below which it is not fitted: its evidence is then half its
            gain less :data:`OCCAM`.

        Returns
        -------
        rival : Rival or None
            The fit of greatest gain; None if no starting point changes any value.
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
                # The fit reached parameters at which a channel is not defined.
                self.passed_over[effect.name] = str(error)
        return max(rivals, key=lambda r: r.gain, default=None)

    def _refine(self, effect: Effect) -> Rival:
        """Fit all parameters of a candidate from where it is."""
        names = fitted(effect)
        scales = np.array([_scale(effect, p) for p in names])
        low, high = np.array([p.widest for p in names]).T
        start = np.array([effect[p.name] for p in names])
        start = np.clip(start, low + 1e-9 * scales, high - 1e-9 * scales)
        # least_squares steps by 2 % of a value.  A parameter with a step of its own is scaled by
        # step / 2 % and counted from its start, so that 2 % of 1 is its own step.
        origin = np.array([
            x - s if p.step else 0.0 for p, x, s in zip(names, start, scales, strict=True)
        ])  # fmt: skip

        def at(x: FloatArray) -> Effect:
            values = origin + x * scales
            return effect.with_values(**{
                p.name: float(v) for p, v in zip(names, values, strict=True)
            })  # fmt: skip

        among = self._shown(effect)

        def left(x: FloatArray) -> FloatArray:
            return self.fit.left - self.change(at(x), among)

        first, lowest, highest = ((v - origin) / scales for v in (start, low, high))
        found = least_squares(
            left, first, bounds=(lowest, highest), diff_step=STEP,
            xtol=1e-3, ftol=1e-4, max_nfev=MOST_CALLS,
        )  # fmt: skip
        best = at(found.x)
        template = self.change(best)
        gain = float(template @ (2 * self.fit.left - template))
        return Rival(
            best, gain, evidence(best, names, gain, found.jac / scales), template,
            *self._select_gain(best, template),
        )  # fmt: skip

    def _shown(self, effect: Effect) -> set[int]:
        """Numbers of the channels that hold more than :data:`HIDDEN` of a template's square."""
        change = self._change(effect)
        squares = [float(change[a:b] @ change[a:b]) for a, b in pairwise(self.fit.starts)]
        least = HIDDEN * sum(squares)
        return {n for n, square in enumerate(squares) if square > least}

    def _select_gain(self, effect: Effect, template: FloatArray) -> tuple[float, float]:
        """Gain in the fold 'select' with the amplitude of the others, and its expected share.

        What differs at random from flat to flat, such as the rows of a tear, is not held against it.
        """
        own = self._select
        inside = float(template[own] @ template[own])
        outside = float(template[~own] @ template[~own])
        # Chosen, to be derived: a fold that holds less than 5 % of the template's square says
        # nothing; with 10 % fewer candidates can be rejected.
        if inside < 0.05 * (inside + outside) or outside == 0:
            return float("nan"), 0.0
        factor = float(template[~own] @ self.fit.left[~own]) / outside
        residuals = self.fit.left[own]
        left = self.fit.left - factor * template
        gain = float(residuals @ residuals - left[own] @ left[own])
        if gain < 0:
            gain += self._at_random(effect, left)
        return gain, inside / (inside + outside)

    def _at_random(self, effect: Effect, left: FloatArray) -> float:
        """Chi-square of residuals in the fold 'select' that an effect's random part takes."""
        alone = self.predictor.with_effects((effect,), self.point)
        taken = 0.0
        for channel, start in zip(self.fit.channels, self.fit.starts, strict=False):
            if channel.fold != "select":
                continue
            modes = channel.whiten(alone.modes(channel, alone.start))
            if modes.shape[1]:
                shapes, sizes, _ = np.linalg.svd(modes, full_matrices=False)
                along = shapes.T @ left[int(start) : int(start) + len(channel)]
                taken += float(np.sum(along**2 * sizes**2 / (1 + sizes**2)))
        return taken


def evidence(
    effect: Effect, names: Sequence[Parameter], gain: float, slopes: FloatArray
) -> float:
    r"""Natural logarithm of the Bayes factor of an effect against none, by Laplace's approximation.

    .. math::
        \tfrac12 \Delta\chi^2 + \sum_p \ln \pi(p) + \tfrac{k}{2} \ln 2\pi
        - \tfrac12 \ln |J^T J + W^{-2}|

    with priors :math:`\pi` flat in the parameter, or in its logarithm, over the plausible range.
    Beyond it they fall off as a Gaussian: of the logarithm, with a width of a factor of two, or
    of a quarter of the range.  :math:`W` is diagonal with 0.3 of each prior's range (a flat
    prior's standard deviation is 12^(-1/2) = 0.29 of it), so that no posterior is wider than its
    prior.

    Parameters
    ----------
    effect : Effect
        With its best parameters.
    names : sequence of Parameter
        The k parameters that were fitted.
    gain : float
        Decrease of the chi-square, :math:`\Delta\chi^2`.
    slopes : ndarray, shape (n, k)
        Derivatives :math:`J` of the whitened prediction.

    Returns
    -------
    evidence : float
    """
    out = 0.5 * gain
    for p in effect.parameters:
        if p.law == "whole" and effect[p.name] != p.plain:
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
    # A direction that the data do not constrain is as wide as its prior and costs no evidence.
    matrix = matrix + np.diag(1.0 / widths**2)
    sign, logarithm = np.linalg.slogdet(matrix)
    del sign
    return float(out + prior + 0.5 * len(names) * np.log(2 * np.pi) - 0.5 * logarithm)


def _scale(effect: Effect, p: Parameter) -> float:
    """Unit in which the minimiser varies a parameter."""
    if p.step:
        return p.step / STEP
    if p.law != "log":
        return p.high - p.low
    return max(abs(effect[p.name] - p.neutral), p.low)


def _inside(effect: Effect) -> Effect:
    """Copy with all parameters clipped to the range of fits."""
    values = {}
    for p in fitted(effect):
        low, high = p.widest
        values[p.name] = float(np.clip(effect[p.name], low, high))
    return effect.with_values(**values)


def _best_factor(
    parts: tuple[FloatArray, FloatArray],
    left: FloatArray,
    *,
    signed: bool,
) -> float:
    """Factor f for which the template f t1 + f^2 t2 gains most; 0 if none gains."""
    one, two = parts
    p = 2 * float(one @ left), 2 * float(two @ left) - float(one @ one)
    q = -2 * float(one @ two), -float(two @ two)
    # Gain p0 f + p1 f^2 + q0 f^3 + q1 f^4, whose slope is a cubic; a straight line where the second
    # template is rounding alone, whose roots would be lost in it: templates are kept in single
    # precision, so that rounding gives four times 6e-8 of the first, squared 6e-14.
    straight = float(two @ two) < 1e-12 * float(one @ one)
    roots = np.roots([2 * p[1], p[0]] if straight else [4 * q[1], 3 * q[0], 2 * p[1], p[0]])
    best, most = 0.0, 0.0
    for f in roots[np.abs(roots.imag) < 1e-6 * (1 + np.abs(roots))].real:
        gain = float(f * (p[0] + f * (p[1] + f * (q[0] + f * q[1]))))
        if gain > most and (f > 0 or signed):
            best, most = float(f), gain
    return best
