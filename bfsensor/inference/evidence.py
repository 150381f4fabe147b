"""Gain in chi-square that chance gives the best of what was tried: the one charge for additions."""

from __future__ import annotations

from scipy.stats import chi2


def chance_gain(parameters: int, tried: int, probability: float) -> float:
    """Chi-square that the best of several candidates gains by noise with a given probability.

    Parameters
    ----------
    parameters : int
        Fitted parameters of each candidate, at least 1.
    tried : int
        Number of candidates, at least 1 (Bonferroni's bound for independent ones).
    probability : float
        Probability that noise gains more, between 0 and 1.

    Returns
    -------
    gain : float
        Decrease of the chi-square.

    Examples
    --------
    >>> round(chance_gain(1, 1, 0.01), 2), round(chance_gain(1, 100, 0.01), 2)
    (6.63, 15.14)
    """
    return float(chi2.isf(probability / max(tried, 1), max(parameters, 1)))
