"""Nonparametric models of a mismatch that no effect of the library explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.detect.candidate_screen import Rival
from bfsensor.diagnose.detect.locate import Mismatch, locate_mismatch
from bfsensor.diagnose.detect.model_error import explained_by_word, stands_out
from bfsensor.diagnose.explain.edge_terms import kernel_families
from bfsensor.diagnose.explain.gaussian_process import process_choice
from bfsensor.diagnose.explain.map_terms import map_families, refine_ripple
from bfsensor.diagnose.explain.mean_terms import mean_families, refine_wave
from bfsensor.diagnose.explain.pursuit import Choice, Dictionary
from bfsensor.diagnose.explain.readout_terms import filter_family
from bfsensor.diagnose.explain.shift_constraints import test_constraints
from bfsensor.diagnose.explain.terms import Family, Scene, Term, lag_family
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.fit.fitted_model import Model, compare_held_out
from bfsensor.files import Cache
from bfsensor.typing import FloatArray

MOST_GROUPS = 3
"""Largest number of groups of terms in one model.  Chosen, to be derived: twice as many describe more
independent causes and take twice as long; campaigns with one cause need one or two."""

SHORTLIST = 8
"""Number of terms of boundary shifts whose exact change of spots is calculated after a search in flats
alone.  Chosen: twice as many double the time, and terms that rank ninth are hardly chosen."""

PREFIX = "free "
"""Prefix of the coefficients' names among the fit's parameters."""

FILTER = "readout filter"
"""Group of echoes in readout order."""

WITH_TESTS = (
    "boundary shifts", "odd boundary shifts", "covariances by lag",
    "smooth covariances over lag and level",
)  # fmt: skip
"""Groups for which the physical constraints on boundary shifts are tested."""

HIDDEN = ("edges", "wave")
"""Keys of a term's ``where`` that hold arrays or functions, which the report leaves out."""

By = dict[str, tuple[float, float, int]]
"""Chi-square before and after, and number of values, by channel."""


@dataclass(frozen=True, eq=False)
class Coefficient:
    """One fitted coefficient of a nonparametric model.

    Attributes
    ----------
    name : str
        Name of its term.
    value, error : float
        Value and standard error, in the unit of the term: see the module of its group.
    where : mapping
        Numbers that define the term, such as 'lags', 'power' or 'period'.
    """

    name: str
    value: float
    error: float
    where: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class OpenWorld:
    """A nonparametric model of a mismatch outside the library.

    Attributes
    ----------
    groups : tuple of str
        Groups of terms that were needed, the one that explains most first.
    coefficients : tuple of Coefficient
        Coefficients, refitted together with all other parameters without a penalty.
    by_group : mapping of str to tuple of str
        Names of each group's coefficients.
    folds : mapping of str to dict
        By fold ('fit', 'select', 'held-out'): chi-square before and after, and number of
        values, by channel; 'before' is without the nonparametric terms.
    scores : mapping of str to float
        By group that competed: decrease of the chi-square less what chance gives.
    tests : mapping of str to mapping
        Results of :func:`~bfsensor.diagnose.explain.shift_constraints.test_constraints`.
    nearest : tuple of (str, float)
        Candidates of the library with the angle [degrees] between their template and the terms'.
    alike : mapping of str to tuple of (str, float)
        By group: terms that explain as much in place of its first, with their coefficients.
    mismatch : Mismatch
        Residuals with the model that stand out.
    """

    groups: tuple[str, ...]
    coefficients: tuple[Coefficient, ...]
    by_group: Mapping[str, tuple[str, ...]]
    folds: Mapping[str, By]
    scores: Mapping[str, float]
    tests: Mapping[str, Mapping[str, float]]
    nearest: tuple[tuple[str, float], ...]
    alike: Mapping[str, tuple[tuple[str, float], ...]]
    mismatch: Mismatch

    @property
    def group(self) -> str:
        """Group that explains most."""
        return self.groups[0]

    def of_group(self, group: str) -> list[Coefficient]:
        """Coefficients of one group."""
        names = self.by_group[group]
        return [c for c in self.coefficients if c.name in names]

    def chi2dof(self, fold: str = "held-out") -> tuple[float, float]:
        """Chi-square per value of a fold, without and with the terms; nan where the fold is empty."""
        held = self.folds.get(fold, {})
        n = sum(v[2] for v in held.values())
        if not n:
            return np.nan, np.nan
        return sum(v[0] for v in held.values()) / n, sum(v[1] for v in held.values()) / n


def explain_outside(
    base: Model,
    mismatch: Mismatch,
    rivals: Sequence[Rival] = (),
    *,
    free: FreeFit | None = None,
    seed: int = 1,
) -> tuple[OpenWorld, Model] | None:
    """Describe a mismatch outside the library by nonparametric terms.

    Parameters
    ----------
    base : Model
        Model with the effects that stay.
    mismatch : Mismatch
        Its residuals that stand out.
    rivals : sequence of Rival
        Candidates of the library, screened against the same fit, to list the most similar ones.
    free : FreeFit, optional
        Result of :func:`fit_free_form` for this model, if it was calculated before.
    seed : int
        Seed of the noise draws that p-values come from.

    Returns
    -------
    OpenWorld, Model
        The description, and the model with its terms; None in place of both where no group
        of terms explains the mismatch.
    """
    free = fit_free_form(base, mismatch, seed=seed) if free is None else free
    if not free.choices:
        return None
    fit = free.model.fit
    relative = _gain_error(fit)
    values = dict(zip(fit.names, zip(fit.values, fit.errors, strict=True), strict=True))
    coefficients: list[Coefficient] = []
    members: dict[str, tuple[str, ...]] = {}
    found: list[tuple[Term, float]] = []
    for choice in free.choices:
        names = []
        for term in [each for t in choice.terms for each in (t, *t.more)]:
            if PREFIX + term.name not in values:
                continue
            value, error = (float(v) for v in values[PREFIX + term.name])
            if choice.family.group == FILTER:
                # Columns hold the gains fixed at their fitted values: add the gains' error.
                error = float(np.hypot(error, abs(value) * relative))
            coefficients.append(Coefficient(term.name, value, error, _plain(term.where)))
            names.append(term.name)
            found.append((term, value))
        members[choice.family.group] = tuple(
            dict.fromkeys([*members.get(choice.family.group, ()), *names])
        )
    seen = {c.word for c in fit.channels}
    kernel = any(g in WITH_TESTS for g in members)
    tests = (
        test_constraints(free.model, dict(found))
        if kernel and seen & {"flat_cov", "spot"}
        else {}
    )
    folds = compare_folds(base, free.model)
    nearest = nearest_of(free.choices[0].template, rivals)
    groups = tuple(dict.fromkeys(c.family.group for c in free.choices))
    out = OpenWorld(
        groups, tuple(coefficients), members, folds, free.scores, tests, tuple(nearest[:5]),
        {c.family.group: tuple((t.name, v) for t, v in c.alike) for c in free.choices},
        free.mismatch,
    )  # fmt: skip
    return out, free.model


def _gain_error(fit: BaselineFit) -> float:
    """Mean relative error of the fitted gains."""
    own = [
        e / v
        for n, v, e in zip(fit.names, fit.values, fit.errors, strict=True)
        if n.startswith("gain ")
    ]
    return float(np.mean(own)) if own else 0.0


def _plain(where: Mapping[str, Any]) -> dict[str, Any]:
    """Copy of ``where`` without arrays and functions, for the report."""
    return {
        k: v for k, v in where.items() if not isinstance(v, np.ndarray) and k not in HIDDEN
    }


@dataclass(frozen=True, eq=False)
class FreeFit:
    """A model with the columns of nonparametric terms, and the choices that led to them."""

    model: Model
    choices: tuple[Choice, ...]
    scores: Mapping[str, float]
    mismatch: Mismatch


def fit_free_form(model: Model, mismatch: Mismatch, *, seed: int = 1) -> FreeFit:
    """Add the group of terms that explains most, refit everything, and repeat while residuals stand out.

    Parameters
    ----------
    model : Model
        Model with or without effects.
    mismatch : Mismatch
        Its residuals that stand out.
    seed : int
        Seed of the noise draws that p-values come from.
    """
    before = model.fit
    choices: list[Choice] = []
    scores: dict[str, float] = {}
    while len(choices) < MOST_GROUPS and stands_out(
        mismatch, explained_by_word(before, model.fit)
    ):
        found = compete(Scene(model), mismatch)
        if not found:
            break
        if not choices:
            scores = {c.family.group: c.score for c in reversed(found)}
        best = found[0]
        taken = {t.name for c in choices for t in c.terms}
        terms = [t for t in best.terms if t.name not in taken]
        if not terms:
            break
        model = model.with_columns(Columns(terms))
        choices.append(best)
        mismatch = locate_mismatch(model.fit, seed=seed)
    return FreeFit(model, tuple(choices), scores, mismatch)


class Columns:
    """Columns of terms in the form that a predictor takes; each is calculated once per channel."""

    def __init__(self, terms: Sequence[Term]) -> None:
        self.terms = tuple(each for t in terms for each in (t, *t.more))
        self._kept = Cache()

    def __call__(self, channel: Channel) -> dict[str, FloatArray]:
        """Columns of a channel by name."""
        return self._kept.get(channel, lambda: self._made(channel))

    def _made(self, channel: Channel) -> dict[str, FloatArray]:
        found = {PREFIX + t.name: t.column(channel) for t in self.terms}
        return {k: v for k, v in found.items() if v is not None}


def compete(scene: Scene, mismatch: Mismatch) -> list[Choice]:
    """Choices of all families that change a channel with findings, the best score first."""
    words = {f.word for f in mismatch.findings}
    fit = scene.model.fit
    out: list[Choice] = []
    for family in _families(scene, words):
        positive = family.group == "ripple in readout time"
        choice = Dictionary(family, fit).choose(positive=positive)
        if choice is None:
            continue
        if family.group == "boundary shifts":
            choice = _with_spots(choice, fit) or choice
        if positive:
            refined = refine_ripple(scene, choice.terms[0])
            choice = Dictionary(refined, fit).choose(positive=True)
        if choice is not None and family.group == "mean in time":
            choice = refine_wave(choice, scene)
        if choice is not None:
            out.append(choice)
    if "flat_cov" in words and (process := process_choice(scene)) is not None:
        out.append(process)
    return sorted(out, key=lambda c: -c.score)


def _families(scene: Scene, words: set[str]) -> list[Family]:
    """Families of terms that change any of the channels that stand out."""
    out: list[Family] = []
    if words & {"flat_cov", "spot"}:
        out += kernel_families(scene, spots="spot" in words)
    if words & {"serial_overscan", "flat_cov"}:
        found = filter_family(scene)
        out += [found] if found else []
    if "flat_map" in words:
        out += map_families(scene)
    if words & {"flat_mean", "spot"}:
        out += mean_families(scene)
    if "flat_cov" in words:
        lags = lag_family(scene)
        out += [lags] if lags else []
    return out


def _with_spots(choice: Choice, fit: BaselineFit) -> Choice | None:
    """Choose again among the most significant terms, with spots; None without spots."""
    if not any(c.word == "spot" for c in fit.channels):
        return None
    rough = Dictionary(choice.family, fit)
    z = np.abs(rough.products(fit.left)) / np.sqrt(
        np.where(rough.free > 0, rough.free, np.inf)
    )
    names = {t.name for t in choice.terms}
    order = [choice.family.terms[n] for n in np.argsort(-z)]
    short = [*choice.terms, *(t for t in order if t.name not in names)][:SHORTLIST]
    full = tuple(replace(t, rough=None) for t in short)
    return Dictionary(Family(choice.family.group, full, ("flat_cov", "spot")), fit).choose()


def nearest_of(template: FloatArray, rivals: Sequence[Rival]) -> list[tuple[str, float]]:
    """Angles [degrees] between a whitened template and those of candidates, the smallest first."""
    out = []
    for rival in rivals:
        if rival.template.shape != template.shape:
            continue
        norm = np.sqrt(float(rival.template @ rival.template) * float(template @ template))
        if norm > 0:
            cosine = abs(float(rival.template @ template)) / norm
            out.append((rival.effect.name, float(np.degrees(np.arccos(min(cosine, 1.0))))))
    return sorted(out, key=lambda t: t[1])


def compare_folds(before: Model, after: Model) -> dict[str, By]:
    """Chi-squares of two models by fold and channel: (before, after, number of values)."""
    out: dict[str, By] = {"held-out": compare_held_out(before, after)}
    for n, channel in enumerate(after.fit.channels):
        rows = slice(int(after.fit.starts[n]), int(after.fit.starts[n + 1]))
        squares = [
            float(m.fit.residuals[rows] @ m.fit.residuals[rows]) for m in (before, after)
        ]
        held = out.setdefault(channel.fold, {})
        old = held.get(channel.word, (0.0, 0.0, 0))
        held[channel.word] = (
            old[0] + squares[0],
            old[1] + squares[1],
            old[2] + len(channel),
        )
    return out
