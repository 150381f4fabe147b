"""Likelihood profiles of an effect's parameters about a fit, and fits continued where one is lower.

The effect's parameters are not linearised; all other parameters of the fit follow to first order:
their columns are projected out of the residuals.  The statistics are in
:mod:`bfsensor.inference.likelihood_profile`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.fit.gauss_newton import Steps
from bfsensor.diagnose.model.effect_parameters import fitted, reach_of
from bfsensor.effects.effect import Parameter
from bfsensor.errors import ConvergenceError
from bfsensor.inference.bounded_lsq import span
from bfsensor.inference.likelihood_profile import Profile, profiles_in
from bfsensor.inference.local_likelihood import LocalLikelihood, Ranged
from bfsensor.typing import FloatArray

__all__ = ["Profile", "find_profiles", "linear_interval", "ranged", "settle", "valley_of"]

LOWER = 0.2
"""Difference by which the lowest chi-square on a profile must be below the fit's for the fit to be
continued from there; it must then gain half of it.  Chosen: a fit that is 0.2 too high ended up to
0.45 errors from its minimum; with 0.4, 0.63 errors."""

RESTARTS = 4
"""Largest number of times that a fit is continued from a lower point of a profile.  Chosen: twice
as many doubles the time of a fit that never settles."""


def ranged(p: Parameter) -> Ranged:
    """Range, scale and largest steps of an effect's parameter in fits."""
    logarithmic = p.law == "log" and not p.signed
    width = p.high - p.low
    return Ranged(
        p.name, *p.widest, logarithmic, p.neutral, p.low, width, partial(reach_of, p)
    )


def linear_interval(value: float, width: float, p: Parameter) -> tuple[float, float]:
    """Ends of the interval ``value`` +- ``width``, or of the log-normal one.

    For a positive parameter on a logarithmic scale with a relative error above 15 % the logarithm
    is taken for Gaussian: a symmetric interval would come near, or cross, its neutral value.

    Parameters
    ----------
    value : float
        Best value, in the parameter's unit.
    width : float
        Standard error, or a multiple of it, in the same unit.
    p : Parameter
        Its law, sign and neutral value decide the scale.

    Returns
    -------
    low, high : float

    Examples
    --------
    >>> p = Parameter("sigma", "um", 0.1, 10.0)
    >>> linear_interval(2.0, 0.2, p)
    (1.8, 2.2)
    >>> [round(v, 3) for v in linear_interval(2.0, 2.0, p)]
    [0.736, 5.437]
    """
    return ranged(p).interval(value, width)


def valley_of(model: Model, n: int) -> LocalLikelihood:
    """Make the chi-square near a fit a function of the parameters of one of its effects.

    The effect is predicted again at each value; all other fitted parameters follow to first
    order, as they are nearly linear over a few errors.  Random effects of other effects keep the
    variances of the fit.

    Parameters
    ----------
    model : Model
        Fitted, with effects.
    n : int
        Index of the effect in ``model.effects``.

    Returns
    -------
    near : object
        The chi-square as a function of ``model.effects[n]``'s fitted parameters.
    """
    predictor, fit, effect = model.predictor, model.fit, model.effects[n]
    point = fit.values[: len(predictor.names)].copy()
    rows = predictor.space.rows("effect", n)
    around = Steps(predictor, fit.channels)
    around.point, around.slopes = point, fit.slopes
    around.linearise_random()
    design, target = around.problem(point)
    used = (design**2).sum(0) > 0
    used[rows] = False
    # A parameter of another effect at the end of its range cannot follow.
    low, high = predictor.space.limits
    used[: len(point)] &= (low < point) & (point < high)
    others = span(design[:, used])

    def free(columns: FloatArray) -> FloatArray:
        return np.asarray(columns - others @ (others.T @ columns))

    channels = [
        (c, int(start), predictor.predict(c, point))
        for c, start in zip(fit.channels, around.starts, strict=False)
        if c.word in effect.touches
    ]
    before = free(target)

    def left(values: FloatArray) -> FloatArray:
        there = point.copy()
        there[rows] = values
        change = np.zeros(len(before))
        for channel, start, here in channels:
            with np.errstate(over="ignore", invalid="ignore"):
                moved = predictor.predict(channel, there) - here
            if not np.isfinite(moved).all():
                raise ConvergenceError(f"predictions of {channel.word} overflow")
            change[start : start + len(channel)] = channel.whiten(moved)
        return before - free(change)

    parameters = [ranged(p) for p in fitted(effect)]
    return LocalLikelihood(
        parameters, point[rows], left, free(design[:, rows]), predictor.space.steps[rows]
    )


def settle(
    model: Model, n: int, widths: Sequence[float]
) -> tuple[Model, dict[str, Profile]]:
    """Profiles as by :func:`find_profiles`, the fit continued where a profile is lower than it.

    Along a curved minimum Gauss-Newton steps gain ever less, and a fit may stop before the
    lowest point; a profile follows the curve and passes it.

    Parameters
    ----------
    model : Model
        Fitted, with effects.
    n : int
        Index of the effect in ``model.effects``.
    widths : sequence of float
        Half-widths of the intervals [standard deviations], increasing.

    Returns
    -------
    model : Model
        The same, or the one fitted again from a lower point.
    profiles : dict of str to Profile
        Profiles of that model by the name of the parameter; none where a fit from their lowest
        point is not lower, which refutes them, so that linear intervals stand.
    """
    for _ in range(RESTARTS):
        if model.effects[n].changes("modes"):
            return model, {}
        valley = valley_of(model, n)
        profiles = profiles_in(valley, widths)
        if valley.square - valley.lowest.square < LOWER:
            return model, profiles
        effects, values = list(model.effects), valley.lowest.values.tolist()
        effects[n] = effects[n].with_values(
            **{p.name: v for p, v in zip(valley.parameters, values, strict=True)}
        )
        try:
            lower = model.with_effects(effects)
        except ConvergenceError:
            return model, profiles
        if lower.fit.total > model.fit.total - 0.5 * LOWER:
            # The whole model is not lower there: moving all others linearly was wrong.
            return model, {}
        model = lower
    return model, find_profiles(model, n, widths)


def find_profiles(model: Model, n: int, widths: Sequence[float]) -> dict[str, Profile]:
    """Profiles of those parameters of one effect for which linear intervals are wrong.

    For each parameter the chi-square at the ends of its linear intervals is evaluated first, all
    others moved linearly: if it has risen as a parabola does, the linear errors stand.  They also
    stand for effects with random effects: their variances change with the parameters, and the
    chi-square at constant variances is no likelihood (for the rms of turbulence its interval
    missed the truth in two of two trials, the linear one in one of them).

    Parameters
    ----------
    model : Model
        Fitted, with effects.
    n : int
        Index of the effect in ``model.effects``.
    widths : sequence of float
        Half-widths of the intervals [standard deviations], increasing.

    Returns
    -------
    dict of str to Profile
        Profiles by the name of the parameter; empty if linear intervals stand for all.
    """
    if model.effects[n].changes("modes"):
        return {}
    return profiles_in(valley_of(model, n), widths)
