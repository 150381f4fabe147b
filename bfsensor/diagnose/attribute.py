"""Attribution: which effects explain a mismatch, which others would, and how well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.baseline import Baseline
from bfsensor.diagnose.channels import Channel
from bfsensor.diagnose.locate import ALARM, Mismatch, locate_mismatch
from bfsensor.diagnose.mismatch import BaselineFit, fit_baseline
from bfsensor.diagnose.predict import Predictor, fitted, used_channels
from bfsensor.diagnose.screen import Rival, Screen
from bfsensor.effects.device_parameter import device_parameters
from bfsensor.effects.effect import Effect, Parameter
from bfsensor.effects.library import LIBRARY
from bfsensor.errors import ConvergenceError

MOST = 4
"""Effects that are looked for at once."""

WEAK = 6.0
"""Increase of the chi-square when it is left out, below which an effect is dropped again."""

TIED = 3.0
"""Difference of the log-likelihood from the best within which a rival cannot be told apart."""

ALIKE = 0.95
"""Cosine between templates from which on rivals are of one class."""

CLOSE = 40.0
"""Difference in gain from the best up to which rivals are fitted again with all parameters."""

REMAINDER = 0.02
"""Part of the chi-square that effects explain up to which what is left is laid to their closed
forms: seven standard deviations of fifty."""

HOPELESS, FAR = 3.0, 0.05
"""Gain of a candidate's best start below which it is not fitted on, and as a part of the best of
all starts: a fit of its shape makes it a few times as much, not twenty times."""

REFITTED = 5
"""Most rivals that are."""

OUTSIDE = 0.02
"""Prior probability that what a clean fit explains is none of the library after all (assumed)."""

FOLDS = ("fit", "select")


@dataclass(frozen=True, eq=False)
class Found:
    """One effect of an attribution.

    Attributes
    ----------
    effect : Effect
        With its best parameters.
    gain : float
        Increase of the chi-square when it is left out.
    errors : dict of str to float
        Standard errors of the fitted parameters.
    probability : dict of str to float
        Of each class word in its place.
    tied : tuple of str
        Classes that cannot be told from it, its own first.
    rivals : tuple of Rival
        Best of each kind in its place, best first.
    """

    effect: Effect
    gain: float
    errors: dict[str, float]
    probability: dict[str, float]
    tied: tuple[str, ...]
    rivals: tuple[Rival, ...] = ()

    def intervals(self, scale: float = 1.0) -> dict[str, dict[str, float]]:
        """Values with intervals of 68 and 95 %, as report.json has them.

        Of positive shape parameters and amplitudes that are badly known the logarithm is taken
        for Gaussian, of all others the parameter.

        Parameters
        ----------
        scale : float
            Factor on errors, from calibration.
        """
        out = {}
        for p in self.effect.parameters:
            value = self.effect[p.name]
            told = {"value": value}
            if p.name in self.errors:
                for level, width in (("68", 1.0), ("95", 1.96)):
                    told[f"lo{level}"], told[f"hi{level}"] = _interval(
                        value, scale * width * self.errors[p.name], p
                    )
            out[p.name] = told
        return out


@dataclass(frozen=True, eq=False)
class Attribution:
    """What explains a mismatch.

    Attributes
    ----------
    found : tuple of Found
        Effects, the one that explains most first; empty where none does.
    fit : BaselineFit
        With them.
    predictor : Predictor
        Of that fit.
    mismatch : Mismatch
        What is left with them.
    open_world : bool
        Whether something is left that no effect of the library explains.
    heldout : dict of str to (float, float, int)
        Chi-square before and after, and number of values, by channel, of what was not fitted.
    notes : tuple of str
        How it went.
    """

    found: tuple[Found, ...]
    fit: BaselineFit
    predictor: Predictor
    mismatch: Mismatch
    open_world: bool
    heldout: dict[str, tuple[float, float, int]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def probability(self) -> dict[str, float]:
        """Of each class to be among what was left out, most probable first."""
        out: dict[str, float] = {}
        for found in self.found:
            for word, p in found.probability.items():
                out[word] = 1 - (1 - out.get(word, 0.0)) * (1 - p)
        outside = 0.9 if self.open_world else OUTSIDE
        if not self.found:
            return {"outside_library": 1.0} if self.open_world else {}
        scaled = {w: p * (1 - outside) for w, p in out.items()}
        scaled["outside_library"] = outside
        return dict(sorted(scaled.items(), key=lambda t: -t[1]))

    @property
    def tied(self) -> list[str]:
        """Classes that may be what was left out."""
        words = [w for f in self.found for w in f.tied]
        if self.open_world:
            words.append("outside_library")
        return list(dict.fromkeys(words))

    def chi2dof(self) -> tuple[float, float]:
        """Chi-square over number of all values that were not fitted, before and after."""
        count = sum(n for *_, n in self.heldout.values())
        if not count:
            return np.nan, np.nan
        before, after = (sum(v[k] for v in self.heldout.values()) for k in (0, 1))
        return before / count, after / count


class Model:
    """The baseline with some effects, fitted."""

    def __init__(self, predictor: Predictor, fit: BaselineFit) -> None:
        self.predictor, self.fit = predictor, fit

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects with their fitted parameters."""
        return self.predictor.effects_at(self.fit.values[: len(self.predictor.names)])

    def with_effects(self, effects: Sequence[Effect]) -> Model:
        """Fit again, with these effects."""
        predictor = self.predictor.with_effects(effects, self.fit.values)
        return Model(predictor, fit_baseline(predictor, self.fit.channels, like=self.fit))

    def errors(self, n: int) -> dict[str, float]:
        """Standard errors of the parameters of the n-th effect."""
        start = f"effect {n} "
        return {
            name.split()[-1]: float(e)
            for name, e in zip(self.fit.names, self.fit.errors, strict=True)
            if name.startswith(start)
        }


def attribute(
    predictor: Predictor,
    fit: BaselineFit,
    mismatch: Mismatch,
    *,
    kinds: Sequence[type[Effect]] | None = None,
    seed: int = 1,
) -> Attribution:
    """Say which effects explain what a baseline leaves.

    Forward steps: the candidate with the greatest evidence among those whose gain noise does not
    reach (:data:`~bfsensor.diagnose.locate.ALARM`, the largest of all candidates), if the fold
    that selects agrees; a full refit; scans of what is then left; again, until nothing stands
    out.  Then each effect is taken out once and held against all others in its place: a better
    one replaces it, those as good are its class.

    Parameters
    ----------
    predictor, fit, mismatch
        The baseline, fitted, and what it leaves.
    kinds : sequence of type, optional
        Candidates; by default :func:`candidates_of` the baseline.
    seed : int
        Of the noise that thresholds come from.
    """
    kinds = candidates_of(predictor.baseline) if kinds is None else kinds
    model = Model(predictor, fit)
    notes: list[str] = []
    open_world = False
    rankings: dict[int, list[Rival]] = {}
    while mismatch.detected and len(model.effects) < MOST:
        screen = Screen(model.predictor, model.fit, _seen(mismatch))
        there = {e.name for e in model.effects}
        ranking = rank(screen, [k for k in kinds if name_of(k) not in there])
        critical = threshold(screen, ranking, seed=seed)
        good = [r for r in ranking if r.gain > critical and not r.select < 0]
        if not good:
            open_world = True
            break
        ranking = refine(model, ranking)
        best = next((r for r in ranking if r.gain > critical and not r.select < 0), good[0])
        try:
            model = model.with_effects((*model.effects, best.effect))
        except ConvergenceError as error:
            notes.append(f"{best.effect.name}: {error}")
            open_world = True
            break
        rankings[len(model.effects) - 1] = ranking
        mismatch = locate_mismatch(model.fit, seed=seed)
    else:
        open_world = mismatch.detected
    found, model, mismatch = _judge(model, rankings, mismatch, kinds, seed)
    if open_world and mismatch.detected and found:
        rest = remainder(mismatch)
        if rest < REMAINDER * (fit.total - model.fit.total):
            # Closed forms of effects are good to a per cent: what is seen at a hundred standard
            # deviations leaves some.
            open_world = False
            notes.append(
                f"{np.sqrt(rest):.1f} standard deviations are left in "
                f"{', '.join(dict.fromkeys(p.word for p in mismatch.parts))}: laid to the effects' "
                "closed forms"
            )
    return Attribution(
        found=tuple(sorted(found, key=lambda f: -f.gain)),
        fit=model.fit,
        predictor=model.predictor,
        mismatch=mismatch,
        open_world=open_world and mismatch.detected,
        heldout=compare_held_out(Model(predictor, fit), model),
        notes=tuple(notes),
    )


def remainder(mismatch: Mismatch) -> float:
    """Chi-square beyond noise of all channels that something is left in; infinite of none."""
    out = 0.0
    for word in dict.fromkeys(p.word for p in mismatch.parts):
        square, dof = mismatch.chi2[word]
        parts = sum(p.z**2 for p in mismatch.parts if p.word == word)
        out += max(square - dof, parts)
    return out or np.inf


def candidates_of(baseline: Baseline) -> tuple[type[Effect], ...]:
    """Candidates for what a baseline leaves out: the library, and its card's parameters."""
    own = device_parameters(
        baseline.edges, baseline.derivatives, baseline.spread, baseline.nominal,
        baseline.reference,
    )  # fmt: skip
    return (*LIBRARY, *own)


def name_of(kind: type[Effect]) -> str:
    """Class, and variant where there are several."""
    return f"{kind.word}:{kind.variant}" if kind.variant else kind.word


def rank(screen: Screen, kinds: Sequence[type[Effect]]) -> list[Rival]:
    """Best of each kind, greatest evidence first."""
    starts = [screen.tried(kind) for kind in kinds]
    best = max((t[0][0] for t in starts if t), default=0.0)
    least = max(HOPELESS, FAR * best)
    found = [screen.best(t, least=least) for t in starts]
    return sorted((r for r in found if r is not None), key=lambda r: -r.evidence)


def refine(model: Model, ranking: Sequence[Rival]) -> list[Rival]:
    """Fit the closest of a ranking again with all parameters, beyond the first order."""
    best = max(r.gain for r in ranking)
    out = []
    close = [r for r in ranking if best - r.gain < max(CLOSE, 0.02 * best)][:REFITTED]
    for rival in ranking:
        if any(rival is r for r in close) and len(close) > 1:
            try:
                other = model.with_effects((*model.effects, rival.effect))
            except ConvergenceError:
                out.append(rival)
                continue
            gain = model.fit.total - other.fit.total
            out.append(
                Rival(
                    other.effects[-1], gain, rival.evidence + 0.5 * (gain - rival.gain),
                    rival.template, rival.select,
                )
            )  # fmt: skip
        else:
            out.append(rival)
    return sorted(out, key=lambda r: -r.evidence)


def threshold(
    screen: Screen, ranking: Sequence[Rival], *, seed: int, draws: int = 400
) -> float:
    """Gain that noise alone gives the best of all candidates once in a hundred times."""
    templates = np.array([
        r.template / np.sqrt(r.template @ r.template)
        for r in ranking if r.template @ r.template > 0
    ])  # fmt: skip
    extra = max((len(fitted(r.effect)) for r in ranking), default=1) - 1
    if not len(templates):
        return np.inf
    rng = np.random.default_rng(seed)
    largest = []
    for _ in range(draws // 50):
        noise = rng.standard_normal((50, templates.shape[1]))
        largest.append(((noise @ templates.T) ** 2).max(1))
    # Shapes that are fitted follow the noise: each takes about one of it more.
    return float(np.quantile(np.concatenate(largest), 1 - ALARM)) + 2.0 * extra


def _judge(
    model: Model,
    rankings: dict[int, list[Rival]],
    mismatch: Mismatch,
    kinds: Sequence[type[Effect]],
    seed: int,
) -> tuple[list[Found], Model, Mismatch]:
    """Hold each effect against all others in its place; drop and replace."""
    swapped = True
    rounds = 0
    places = dict(rankings)
    while swapped and len(model.effects) > 1 and rounds < 3:
        swapped, rounds = False, rounds + 1
        for n in range(len(model.effects)):
            others = tuple(e for k, e in enumerate(model.effects) if k != n)
            without = model.with_effects(others)
            if without.fit.total - model.fit.total < WEAK:
                model, places, swapped = without, {}, True
                break
            screen = Screen(without.predictor, without.fit, _seen(mismatch))
            there = {e.name for e in others}
            ranking = refine(
                without, rank(screen, [k for k in kinds if name_of(k) not in there])
            )
            places[n] = ranking
            here = next(
                (r for r in ranking if r.effect.name == model.effects[n].name), None
            )
            best = ranking[0]
            if best.effect.name != model.effects[n].name and (
                here is None or best.evidence > here.evidence + 1.0
            ):
                other = without.with_effects((*others, best.effect))
                if other.fit.total < model.fit.total:
                    model, places, swapped = other, {}, True
                    break
    if rounds and model.effects:
        mismatch = locate_mismatch(model.fit, seed=seed)
    out = []
    for n, effect in enumerate(model.effects):
        ranking = places.get(n, [])
        gain = next((r.gain for r in ranking if r.effect.name == effect.name), np.nan)
        out.append(
            Found(
                effect, gain, model.errors(n), class_probabilities(ranking),
                tied_classes(effect, ranking), tuple(ranking),
            )
        )  # fmt: skip
    return out, model, mismatch


def class_probabilities(
    ranking: Sequence[Rival], temperature: float = 1.0
) -> dict[str, float]:
    """Of each class in one place: evidence over the sum of all, variants of a class together."""
    if not ranking:
        return {}
    z = np.array([r.evidence for r in ranking]) / temperature
    # Variants share their class's prior.
    counts = {w: sum(r.word == w for r in ranking) for w in {r.word for r in ranking}}
    weights = np.exp(z - z.max()) / np.array([counts[r.word] for r in ranking])
    out: dict[str, float] = {}
    for rival, w in zip(ranking, weights / weights.sum(), strict=True):
        out[rival.word] = out.get(rival.word, 0.0) + float(w)
    return {w: p for w, p in out.items() if p > 1e-4}


def tied_classes(effect: Effect, ranking: Sequence[Rival]) -> tuple[str, ...]:
    """Classes that cannot be told from an effect, its own first."""
    own = next((r for r in ranking if r.effect.name == effect.name), None)
    words = [effect.word]
    if own is not None:
        for rival in ranking:
            close = 0.5 * (own.gain - rival.gain) < TIED
            if close or (_cosine(own, rival) > ALIKE and own.gain - rival.gain < 4 * TIED):
                words.append(rival.word)
    return tuple(dict.fromkeys(words))


def compare_held_out(before: Model, after: Model) -> dict[str, tuple[float, float, int]]:
    """Chi-squares of what was not fitted, by channel, without and with effects."""
    out: dict[str, tuple[float, float, int]] = {}
    channels = used_channels(before.predictor.measured.channels, ("held-out",))
    for channel in channels:
        if not len(channel):
            continue
        squares = []
        for model in (before, after):
            left = _left(model, channel)
            squares.append(float(left @ left))
        old = out.get(channel.word, (0.0, 0.0, 0))
        out[channel.word] = (
            old[0] + squares[0], old[1] + squares[1], old[2] + len(channel)
        )  # fmt: skip
    return out


def _left(model: Model, channel: Channel) -> NDArray[np.float64]:
    """Residuals of a channel over errors and chance, all parameters as fitted."""
    values = dict(zip(model.fit.names, model.fit.values, strict=True))
    point = model.fit.values[: len(model.predictor.names)]
    predicted = model.predictor.predict(channel, point)
    for name, column in model.predictor.linear(channel).items():
        predicted = predicted + values.get(name, 0.0) * column
    left = channel.whiten(channel.values - predicted)
    modes = model.predictor.modes(channel, point)
    if not modes.shape[1]:
        return left
    shapes, sizes, _ = np.linalg.svd(channel.whiten(modes), full_matrices=False)
    wider = 1 - 1 / np.sqrt(1 + sizes**2)
    return np.asarray(left - shapes @ (wider * (shapes.T @ left)))


def _seen(mismatch: Mismatch) -> list[dict[str, Any]]:
    """What the scans found, farthest first, as effects take it."""
    parts = [*mismatch.parts, *mismatch.findings[:200]]
    return [{**p.where, "word": p.word, "z": p.z, "family": p.family} for p in parts]


def _cosine(one: Rival, other: Rival) -> float:
    a, b = one.template, other.template
    norm = np.sqrt((a @ a) * (b @ b))
    return float(abs(a @ b) / norm) if norm else 0.0


def _interval(value: float, width: float, p: Parameter) -> tuple[float, float]:
    """Ends of an interval."""
    away = value - p.neutral if p.law == "log" else value
    if p.law == "log" and not p.signed and away > 0 and width > 0.15 * away:
        factor = float(np.exp(min(width / away, 50.0)))
        return p.neutral + away / factor, p.neutral + away * factor
    return value - width, value + width
