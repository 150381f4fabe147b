"""Result of an attribution: effects found, their rivals, class probabilities and intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import chi2

from bfsensor.diagnose.detect.candidate_screen import Rival
from bfsensor.diagnose.detect.candidates import candidates_of, tellable
from bfsensor.diagnose.detect.locate import ALARM, Mismatch
from bfsensor.diagnose.detect.model_error import SAME, charge
from bfsensor.diagnose.explain.nonparametric import OpenWorld
from bfsensor.diagnose.explain.solved_again import last_solved
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.fit.likelihood_profile import Profile, linear_interval
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.changed_device import ChangedDevice
from bfsensor.effects.effect import Effect, Parameter

TIED = 3.0
"""Difference of the log-likelihood within which a rival is listed as not distinguished from the effect.
Chosen, to be derived: a rival may be exp(3) = 20 times less likely; twice as large, 400 times, and
more classes are listed as tied."""

ALIKE = 0.95
"""Cosine between two whitened templates above which a rival is listed as not distinguished up to a
log-likelihood difference of 2 :data:`TIED`.  Chosen, to be derived: at 0.95 a tenth of the template's
square differs; with (1 - cosine) twice as large, rivals that differ in a fifth are listed."""

OUTSIDE_WORD = "outside_library"
"""Class, in report.json, of a mismatch that no effect of the library explains."""

RELIABLE = 0.75
"""Probability that a class named first is true where, by its evidence, it is certain.  Measured on
campaigns of the independent bench that the diagnosis at 6f05a7c detected, with one effect or none, which
this code is not scored on: 54 of 74, alike where a mismatch is left outside the library (9 of 12) and
where none is."""

OUTSIDE_TRUE = {True: 0.11, False: 0.55}
"""Probability that the physics is outside the library where a mismatch is left that no effect explains:
with an effect named beside it (True), and with none (False).  Measured on the same campaigns, those of
several effects too: what was left was outside in 2 of 18, and in 6 of 11.  In the other 16 of the 18 it
came of another law of the named effect, or of another effect of the library."""

WIDENED = 1.12
"""Factor on standard errors in all intervals.  Measured on 141 parameters of concealed trials (commit
a6e672b): 68 % of the true values lie within 1.12 standard errors, 63 % within 1, for linear errors
leave out the closed forms' errors, curvature and tails."""


TYPICAL = 0.001
"""Relative error of an effect's prediction (one standard deviation).  Measured on 123 parameters of
campaigns of the independent bench that this code is not scored on: 76 and 94 % of their true values
lie in intervals of 68 and 95 %; with 0.002, 77 and 95 %, with 0, 70 and 94 %.  None of these covers
five parameters of effects above 300 sigma, which depart by 3 to 12 standard errors."""


def scale_of(gain: float) -> float:
    """Factor on the standard errors of an effect that explains a chi-square of ``gain``.

    A prediction that is wrong by a part of itself moves a parameter by up to that part of the effect's
    signal-to-noise ratio, in standard errors.

    Examples
    --------
    >>> round(scale_of(100.0), 3), round(scale_of(1e6), 2)
    (1.12, 1.58)
    """
    return float(WIDENED * np.sqrt(1 + TYPICAL**2 * max(gain, 0.0)))


LEVELS = {"68": 1.0, "95": 1.96}
"""Half widths of the intervals [standard errors], exact for a Gaussian: 68.3 % and 95.0 %."""


@dataclass(frozen=True, eq=False)
class Found:
    """One effect of an attribution.

    Attributes
    ----------
    effect : Effect
        Effect with its fitted parameters.
    gain : float
        Increase of the chi-square when the effect is left out; nan if it was not ranked.
    errors : dict of str to float
        Standard errors of the fitted parameters, in their units.
    probability : dict of str to float
        Probability of each class to be the true one in this effect's place; they sum to 1.
    tied : tuple of str
        Classes that the recordings do not distinguish from this effect, its own first.
    rivals : tuple of Rival
        Best candidate of each kind in the effect's place, best first.
    profiles : mapping of str to Profile
        Likelihood profiles of parameters whose chi-square is not a parabola.
    scale : float
        Factor on standard errors in its intervals: :func:`scale_of`.
    """

    effect: Effect
    gain: float
    errors: dict[str, float]
    probability: dict[str, float]
    tied: tuple[str, ...]
    rivals: tuple[Rival, ...] = ()
    profiles: Mapping[str, Profile] = field(default_factory=dict)
    scale: float = WIDENED

    @property
    def alike(self) -> tuple[str, ...]:
        """Other quantities of the device that these recordings do not distinguish from it."""
        return tied_quantities(self.effect, self.rivals)

    @property
    def quantity(self) -> Rival | None:
        """Quantity of the device that does best in place of a law of the boundary shifts.

        A device says why shifts differ, a law only how, so that the quantity may be the cause where the
        simulation's response to it is wrong.  None where the device's class is tied, or where its change
        is nearer to nothing than to the law's.
        """
        law = self.effect.stage == "collect" and "flat_cov" in self.effect.touches
        devices = [r for r in self.rivals if isinstance(r.effect, ChangedDevice)]
        if not law or not devices or any(r.word in self.tied for r in devices):
            return None
        best = max(devices, key=lambda r: r.gain)
        return best if best.gain >= SAME**2 * self.gain else None

    def intervals(self) -> dict[str, dict[str, Any]]:
        """Values with intervals of 68 and 95 %, as report.json has them.

        The interval of a parameter with a likelihood profile ends where the chi-square has risen by
        ``scale**2`` (68 %) or ``(1.96 * scale)**2`` (95 %).  'open68' and 'open95' list the ends, 'lo'
        or 'hi', at which the chi-square does not rise that far within the range of fits;
        'stopped68' and 'stopped95' list those of them inside the range, where no prediction could
        be made beyond, or the profile became flat.  A quantity of the device whose value is extrapolated
        from the last one that could be solved has an interval from there, open beyond.  All other
        parameters have the intervals of
        :func:`~bfsensor.diagnose.fit.likelihood_profile.linear_interval`.

        Returns
        -------
        dict of str to dict
            By parameter: 'value'; of fitted ones also 'lo68', 'hi68', 'lo95' and 'hi95', in the
            parameter's unit, with the keys above where they apply.
        """
        out = {}
        for p in self.effect.parameters:
            value = self.effect[p.name]
            told = {"value": value}
            if p.name in self.errors:
                for level, width in LEVELS.items():
                    told |= self._interval(p, level, self.scale * width)
            out[p.name] = told
        return out

    def _interval(self, p: Parameter, level: str, width: float) -> dict[str, Any]:
        """Ends of one interval, with the keys 'open..' and 'stopped..' where an end is not reached."""
        keys = f"lo{level}", f"hi{level}"
        solved = last_solved(self.effect)
        if solved is not None:
            value = self.effect[p.name]
            out = "lo" if value < solved else "hi"
            both = dict(zip(keys, sorted((value, solved)), strict=True))
            return {**both, f"open{level}": [out], f"stopped{level}": [out]}
        if p.name not in self.profiles:
            ends = linear_interval(self.effect[p.name], width * self.errors[p.name], p)
            return dict(zip(keys, ends, strict=True))
        low, high, *closed = self.profiles[p.name].interval(width)
        # The fit ends near the minimum of the profile, not at it: the interval must hold both.
        low, high = min(low, self.effect[p.name]), max(high, self.effect[p.name])
        told: dict[str, Any] = dict(zip(keys, (low, high), strict=True))
        open_ = [k for k, c in zip(("lo", "hi"), closed, strict=True) if not c]
        limits = dict(zip(("lo", "hi"), p.widest, strict=True))
        near = 1e-6 * (limits["hi"] - limits["lo"])
        stopped = [k for k in open_ if abs(told[f"{k}{level}"] - limits[k]) > near]
        return (
            told
            | ({f"open{level}": open_} if open_ else {})
            | ({f"stopped{level}": stopped} if stopped else {})
        )


@dataclass(frozen=True, eq=False)
class Attribution:
    """Effects, or nonparametric terms, that explain a mismatch, and the fit with them.

    Attributes
    ----------
    found : tuple of Found
        Effects, the one with the largest gain first; empty where none was found.
    fit : BaselineFit
        Fit of the baseline, effects and terms together.
    predictor : Predictor
        Model that ``fit`` belongs to.
    mismatch : Mismatch
        Residuals of ``fit`` that stand out, with their family-wise p-values.
    open_world : bool
        Whether a mismatch is left, or modelled, that no effect of the library explains.
    heldout : dict of str to (float, float, int)
        By channel: chi-square of held-out values without and with the effects, and their number.
    notes : tuple of str
        Candidates that could not be fitted, and why.
    free_form : OpenWorld, optional
        Nonparametric model of what the effects leave, part of ``fit``.
    shares : mapping of str to float
        Parts of the chi-square above noise explained by 'effects', by other 'laws' of them, by terms
        'outside' the library, and 'left'; they sum to 1.
    touched : tuple of str
        Channels that the effects change.

    Examples
    --------
    List the effects found by a diagnosis with their 68 % intervals::

        for found in result.attribution.found:
            print(found.effect.word, found.intervals())
    """

    found: tuple[Found, ...]
    fit: BaselineFit
    predictor: Predictor
    mismatch: Mismatch
    open_world: bool
    heldout: dict[str, tuple[float, float, int]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    free_form: OpenWorld | None = None
    shares: Mapping[str, float] = field(default_factory=dict)
    touched: tuple[str, ...] = ()

    @property
    def probability(self) -> dict[str, float]:
        """Probability that the baseline lacks an effect of each class, most probable first.

        Evidences alone hold that one of the library's laws is exact.  The reliability that was measured
        on campaigns with laws of others, :data:`RELIABLE`, multiplies them; what remains is spread over
        all classes that the recordings can constrain and, where a mismatch is left, given to
        'outside_library' first (:data:`OUTSIDE_TRUE`).
        """
        if not self.found and not self.open_world:
            return {}
        named: dict[str, float] = {}
        for found in self.found:
            for word, p in found.probability.items():
                named[word] = 1 - (1 - named.get(word, 0.0)) * (1 - p)
        kinds = candidates_of(self.predictor.baseline)
        asked = {k.word for k in tellable(kinds, self.predictor, self.fit.channels)}
        out = dict.fromkeys([*named, *sorted(asked), OUTSIDE_WORD], 0.0)
        out |= {w: RELIABLE * p for w, p in named.items()}
        if self.open_world:
            out[OUTSIDE_WORD] += OUTSIDE_TRUE[bool(self.found)]
        # Where the named class is wrong, nothing is known of the true one: all asked are alike.
        rest = max(max(len(self.found), 1) - sum(out.values()), 0.0) / len(out)
        told = {w: min(p + rest, 1.0) for w, p in out.items()}
        return dict(sorted(told.items(), key=lambda t: -t[1]))

    @property
    def outside(self) -> bool:
        """Whether physics outside the library is more probable than not."""
        return self.open_world and self.probability[OUTSIDE_WORD] > 0.5

    @property
    def taken(self) -> float:
        """Part of the chi-square above noise that effects take, by their own or another law, 0 to 1."""
        return 1 - self.shares.get("outside", 0.0) - self.shares.get("left", 0.0)

    @property
    def tied(self) -> list[str]:
        """Classes that may be the cause: those found, those tied to them, and outside_library.

        The last only where it is more probable than not.
        """
        words = [w for f in self.found for w in f.tied]
        if self.outside:
            words.append(OUTSIDE_WORD)
        return list(dict.fromkeys(words))

    def chi2dof(self) -> tuple[float, float]:
        """Calculate the chi-square per held-out value.

        Returns
        -------
        before, after : float
            Without and with the effects; nan without held-out values.
        """
        count = sum(n for *_, n in self.heldout.values())
        if not count:
            return np.nan, np.nan
        before, after = (sum(v[k] for v in self.heldout.values()) for k in (0, 1))
        return before / count, after / count

    @property
    def heldout_p(self) -> dict[str, float]:
        """By touched channel with held-out values: probability that noise gives their chi-square."""
        return {
            w: float(chi2.sf(after, n))
            for w, (_, after, n) in self.heldout.items()
            if w in self.touched and n
        }

    @property
    def fails_in(self) -> tuple[str, ...]:
        """Channels whose held-out values the explanation contradicts, or makes worse.

        Touched channels in which noise gives the chi-square with a probability below
        :data:`~bfsensor.diagnose.detect.locate.ALARM`, and channels that are touched or not in which the
        chi-square rises by more than one parameter gains by chance for each part of the explanation.
        """
        parts = max(len(self.found), 1)
        return tuple(
            w
            for w, (before, after, _) in self.heldout.items()
            if self.heldout_p.get(w, 1.0) < ALARM or after - before > charge(parts, 1)
        )


def class_probabilities(
    ranking: Sequence[Rival], temperature: float = 1.0
) -> dict[str, float]:
    """Probability of each class in one effect's place, from the evidences of its candidates.

    Parameters
    ----------
    ranking : sequence of Rival
        Candidates; ``evidence`` is the logarithm of the marginal likelihood.
    temperature : float
        Divisor of the evidences, 1 for probabilities as they are; larger values spread them.

    Returns
    -------
    dict of str to float
        Probabilities above 1e-4 by class; variants of a class share one prior.
    """
    if not ranking:
        return {}
    z = np.array([r.evidence for r in ranking]) / temperature
    counts = {w: sum(r.word == w for r in ranking) for w in {r.word for r in ranking}}
    weights = np.exp(z - z.max()) / np.array([counts[r.word] for r in ranking])
    out: dict[str, float] = {}
    for rival, w in zip(ranking, weights / weights.sum(), strict=True):
        out[rival.word] = out.get(rival.word, 0.0) + float(w)
    return {w: p for w, p in out.items() if p > 1e-4}


def tied_classes(effect: Effect, ranking: Sequence[Rival]) -> tuple[str, ...]:
    """Classes that the recordings do not distinguish from an effect, its own first.

    Parameters
    ----------
    effect : Effect
        Effect that was found.
    ranking : sequence of Rival
        Candidates in its place.
    """
    return tuple(dict.fromkeys([effect.word, *(r.word for r in _tied(effect, ranking))]))


def tied_quantities(effect: Effect, ranking: Sequence[Rival]) -> tuple[str, ...]:
    """Quantities of the device that the recordings do not distinguish from the one that was found.

    Parameters
    ----------
    effect : Effect
        Effect that was found; other effects than quantities of the device have none.
    ranking : sequence of Rival
        Candidates in its place.
    """
    if not isinstance(effect, ChangedDevice):
        return ()
    others = [r.effect for r in _tied(effect, ranking) if r.effect.name != effect.name]
    names = [p.name for e in others if isinstance(e, ChangedDevice) for p in e.parameters]
    return tuple(dict.fromkeys(names))


def _tied(effect: Effect, ranking: Sequence[Rival]) -> list[Rival]:
    """Candidates that the recordings do not distinguish from an effect."""
    own = next((r for r in ranking if r.effect.name == effect.name), None)
    if own is None:
        return []
    out = []
    for rival in ranking:
        close = 0.5 * (own.gain - rival.gain) < TIED
        # Where other laws count, they may hide a tie of the laws that are known.
        close = close or 0.5 * abs(own.gain + own.law - rival.gain - rival.law) < TIED
        if close or (_cosine(own, rival) > ALIKE and own.gain - rival.gain < 4 * TIED):
            out.append(rival)
    return out


def _cosine(one: Rival, other: Rival) -> float:
    a, b = one.template, other.template
    norm = np.sqrt((a @ a) * (b @ b))
    return float(abs(a @ b) / norm) if norm else 0.0
