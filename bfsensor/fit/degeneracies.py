"""Degeneracies of a fit: combinations that the data constrain, and parameters that they do not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bfsensor.device.quantities import describe
from bfsensor.typing import FloatArray

ALIKE = 0.9
"""Cosine between the effects of two parameters on the data, in errors, from which they are reported
as degenerate.

Chosen: one parameter then undoes all but 1 - 0.9^2 = 19 % of the squared effect of the other; at 0.95
all but 10 %, and fewer parameters are grouped."""

SILENT = 0.2
"""Information of the data on a parameter, the others known, below which they are reported not to
constrain it [1 / prior variance].

Chosen: with less, the posterior width is above 1 / sqrt(1.2) = 91 % of the prior's; twice as large,
above 85 %."""

PART = 0.3
"""Weight in a combination, of unit length, from which a parameter is named.

Chosen: at most eleven parameters are named; twice as large, at most two."""


class Combination(NamedTuple):
    """Combination of parameters with a posterior error independent of the others.

    Parameters
    ----------
    remains : float
        Posterior width of the combination over its prior width, about 0 to 1.
    weights : ndarray, shape (p,)
        Weights of the parameters in units of their prior widths, a vector of length 1.

    Examples
    --------
    >>> Combination(0.2, np.array([0.8, -0.6])).remains
    0.2
    """

    remains: float
    weights: FloatArray


def principal(covariance: FloatArray) -> tuple[Combination, ...]:
    """Give the combinations of parameters with independent errors, the best constrained first.

    Parameters
    ----------
    covariance : ndarray, shape (p, p)
        Posterior covariance in units of the prior widths.

    Returns
    -------
    combinations : tuple of Combination
        The p eigenvectors, signed so that the largest weight is positive.

    Examples
    --------
    >>> [round(one.remains, 3) for one in principal(np.diag([1.0, 0.04]))]
    [0.2, 1.0]
    """
    values, vectors = np.linalg.eigh(covariance)
    out = []
    for value, vector in zip(values, vectors.T, strict=True):
        sign = np.sign(vector[np.argmax(np.abs(vector))])
        out.append(Combination(float(np.sqrt(max(value, 0.0))), sign * vector))
    return tuple(out)


def name_combination(names: Sequence[str], weights: FloatArray) -> str:
    """Name a combination by the parameters with weights of at least :data:`PART`.

    Examples
    --------
    >>> name_combination(["silicon.thickness", "gates.gate_oxide"], np.array([0.8, -0.6]))
    'thickness up with gate oxide down'
    """
    order = np.argsort(-np.abs(weights))
    named = [k for k in order.tolist() if abs(weights[k]) >= PART] or [int(order[0])]
    if len(named) == 1:
        return describe(names[named[0]])
    words = [f"{describe(names[k])} {'up' if weights[k] > 0 else 'down'}" for k in named]
    return " with ".join(words)


def find_ties(
    names: Sequence[str], sensitivity: FloatArray
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Find groups of degenerate parameters, and parameters that the data do not constrain.

    Parameters
    ----------
    names : sequence of str
        Dotted names of the parameters.
    sensitivity : ndarray, shape (n, p)
        Change of each number, in units of its error, for one prior width of each parameter.

    Returns
    -------
    ties : tuple of str
        A text for each group of parameters with nearly proportional effects on the data.
    silent : tuple of str
        Dotted names of parameters that the data do not constrain.

    Examples
    --------
    >>> j = np.array([[2.0, -1.0, 0.0, 0.1], [1.0, -0.5, 3.0, 0.0]])
    >>> ties, silent = find_ties(["silicon.background_doping", "silicon.thickness", "gates.gate_oxide",
    ...                           "gates.field_oxide"], j)
    >>> ties
    ('background doping and thickness (opposite sign): cosine of their effects 1.00',)
    >>> silent
    ('gates.field_oxide',)
    """
    size = np.sqrt((sensitivity**2).sum(0))
    heard = np.flatnonzero(size**2 >= SILENT)
    silent = tuple(names[k] for k in np.flatnonzero(size**2 < SILENT).tolist())
    unit = sensitivity[:, heard] / size[heard]
    cosine = unit.T @ unit
    left = set(range(len(heard)))
    ties = []
    # Greedy groups: the best constrained parameter left gathers all with a similar effect.
    for first in np.argsort(-size[heard]).tolist():
        if first not in left:
            continue
        like = [k for k in left if abs(cosine[first, k]) >= ALIKE]
        like.sort(key=lambda k: -size[heard[k]])
        left -= set(like)
        if len(like) < 2:
            continue
        words = [describe(names[int(heard[first])])]
        for k in like:
            if k != first:
                turned = " (opposite sign)" if cosine[first, k] < 0 else ""
                words.append(describe(names[heard[k]]) + turned)
        least = min(abs(cosine[first, k]) for k in like)
        ties.append(
            f"{', '.join(words[:-1])} and {words[-1]}: cosine of their effects {least:.2f}"
        )
    return tuple(ties), silent
