"""Charge for what was tried, and tolerance for the errors of the predictions of effects that were found.

Every addition to an explanation, an effect of the library or a group of nonparametric terms, is
judged by one score: its gain in chi-square less :func:`charge`, which the best of all that was
tried gains by chance.

A prediction that is wrong by a part rho of itself in every value gives a template with whitened
unit vector s a deviate of at most rho sum |s| |t|, t being the effect's own whitened change.  What
a second effect gains within that bound is no evidence for it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from bfsensor.diagnose.detect.locate import ALARM, FAMILY, Finding, Mismatch
from bfsensor.diagnose.detect.scans import DEVICE, DEVICE_SEEN
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.inference.evidence import chance_gain
from bfsensor.typing import FloatArray

ACCURACY = 0.02
"""Least relative error of an effect's prediction.  Measured by ``python -m
validation.effects.effect_parity`` (effect_parity.ecsv): the factor on a prediction of more than 10
sigma that fits pixels best, known to 2 % or better, differs from 1 by 0.5 % in the median, by less
than 2 % in all 17 cases beyond 100 sigma."""

SAME = 0.5
"""Relative error of an effect's prediction up to which what it leaves may be the same effect by another
law.  Derived: the prediction is then closer to the recordings than to nothing."""


def charge(parameters: int, tried: int) -> float:
    """Chi-square that the best of several candidates gains by noise with probability ALARM.

    Parameters
    ----------
    parameters : int
        Fitted parameters of each candidate, at least 1.
    tried : int
        Number of candidates, at least 1 (Bonferroni's bound for independent ones).

    Examples
    --------
    >>> round(charge(1, 1), 2), round(charge(1, 100), 2)
    (6.63, 15.14)
    """
    return chance_gain(parameters, tried, ALARM)


def explained_by_word(before: BaselineFit, after: BaselineFit) -> dict[str, float]:
    """Decrease of the chi-square, at least 0, by channel, between two fits of the same channels.

    Where parameters with a prior had taken up what an effect takes now, the chi-square of the priors
    decreases: it counts in the channels whose residuals changed, by the squares of their changes.
    """
    old, new = before.chi2(), after.chi2()
    words = [word for word in old if word in new]
    changed = before.residuals - after.residuals
    squares = {word: float(np.sum(changed[before.of(word)] ** 2)) for word in words}
    pulls = [
        fit.left[len(fit.residuals) : len(fit.left) - fit.scores] for fit in (before, after)
    ]
    whole = sum(squares.values())
    freed = float(pulls[0] @ pulls[0]) - float(pulls[1] @ pulls[1])
    # Where no residual changed, the fits are the same.
    freed = freed / whole if whole else 0.0
    return {
        word: max(old[word][0] - new[word][0] + freed * squares[word], 0.0)
        for word in words
    }


def left_by_word(fit: BaselineFit, left: FloatArray | None = None) -> dict[str, float]:
    """Chi-square above the degrees of freedom by channel; 0 where noise explains it.

    Parameters
    ----------
    fit : BaselineFit
        A fit.
    left : ndarray, optional
        Whitened residuals in place of its own.
    """
    residuals = fit.residuals if left is None else left[: len(fit.residuals)]
    out = {}
    for word, (_, dof) in fit.chi2().items():
        own = residuals[fit.of(word)]
        square = float(own @ own)
        out[word] = square - dof if square > chi2.isf(ALARM, max(dof, 1e-9)) else 0.0
    return out


def overlap(
    fit: BaselineFit, template: FloatArray, change: FloatArray, errors: Mapping[str, float]
) -> float:
    """Largest deviate of a template by relative errors of a prediction: sum of rho |s| |t|.

    Parameters
    ----------
    fit : BaselineFit
        Fit whose values both belong to.
    template, change : ndarray, shape (n + priors,) and (n,)
        Whitened template of any length, and the prediction's own whitened change.
    errors : mapping of str to float
        Relative error of the prediction by channel, 0 to 1; absent ones are 1.
    """
    length = float(np.sqrt(template @ template))
    if not length:
        return 0.0
    product = np.abs(template[: len(change)]) * np.abs(change) / length
    words = [c.word for c in fit.channels]
    return sum(
        errors.get(word, 1.0) * float(product[start:end].sum())
        for word, start, end in zip(words, fit.starts, fit.starts[1:], strict=False)
    )


def counts(
    finding: Finding,
    mismatch: Mismatch,
    explained: Mapping[str, float],
    errors: Mapping[str, float],
) -> bool:
    """Whether a finding exceeds the model error of the effects that were found.

    A deviate :math:`z` counts if :math:`z^2` is above the square of the relative error times the
    chi-square explained in its channel; a chi-square counts if its excess over the degrees of
    freedom is.

    Parameters
    ----------
    finding : Finding
        Finding in the residuals.
    mismatch : Mismatch
        Comparison that it belongs to.
    explained : mapping of str to float
        Decrease of the chi-square of each channel by the effects that were found.
    errors : mapping of str to float
        Relative error of their predictions by channel; absent ones are :data:`ACCURACY`.

    Returns
    -------
    bool
    """
    own = DEVICE_SEEN if finding.word == DEVICE else (finding.word,)
    if finding.word == "bias_cov" and finding.where.get("k") == (0, 0):
        # One read noise is fitted to biases and flats: a model error of flats may show at lag 0.
        own = ("bias_cov", "flat_cov")
    reach = sum(errors.get(w, ACCURACY) ** 2 * explained.get(w, 0.0) for w in own)
    if finding.family != "chi-square":
        return finding.z**2 > reach
    square, dof = mismatch.chi2[finding.word]
    return square - dof > reach


def stands_out(
    mismatch: Mismatch,
    explained: Mapping[str, float],
    errors: Mapping[str, float] | None = None,
    *,
    library: bool = True,
) -> bool:
    """Whether any finding exceeds the model error of the effects that were found.

    Parameters
    ----------
    mismatch : Mismatch
        Comparison of the residuals with noise.
    explained, errors : mapping of str to float
        See :func:`counts`.
    library : bool
        Whether findings by matched filters of the library are considered.

    Returns
    -------
    bool
    """
    return mismatch.detected and any(
        counts(f, mismatch, explained, errors or {})
        for f in mismatch.findings
        if library or f.family != FAMILY
    )


def whole(change: NDArray[np.floating], size: int) -> FloatArray:
    """Copy of whitened values with zeros in the rows of the priors."""
    out = np.zeros(size)
    out[: len(change)] = change
    return out
