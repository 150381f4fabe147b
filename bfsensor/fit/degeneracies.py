"""What the data can tell of the parameters, and what they cannot tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bfsensor.device.quantities import describe
from bfsensor.typing import FloatArray

ALIKE = 0.9
"""Cosine between the changes that two parameters make, in errors of the data, from which they
are not told apart: of what one does, the other can undo all but 19 % of the square."""

SILENT = 0.2
"""Information on a parameter, the others known [1 / prior variance], below which the data are
said to be silent on it: they would take less than a tenth off its spread."""

PART = 0.3
"""Weight in a combination from which a parameter is named."""


class Combination(NamedTuple):
    """A direction in the space of parameters, in units of their priors.

    ``remains``: its posterior width over its prior's; ``weights``, shape (p,), of length 1.
    """

    remains: float
    weights: FloatArray


def principal(covariance: FloatArray) -> tuple[Combination, ...]:
    """Combinations whose errors are independent, the best known first.

    Parameters
    ----------
    covariance : ndarray, shape (p, p)
        Of the posterior, in units of the priors.

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
    """Name a combination by its larger parts.

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
    """Groups of parameters that the data cannot tell apart, and those they are silent on.

    Parameters
    ----------
    names : sequence of str
        Of the parameters.
    sensitivity : ndarray, shape (n, p)
        Change of each number, in its error, for one prior spread of each parameter.

    Returns
    -------
    ties, silent : tuple of str
        A sentence for each group; names.

    Examples
    --------
    >>> j = np.array([[2.0, -1.0, 0.0, 0.1], [1.0, -0.5, 3.0, 0.0]])
    >>> ties, silent = find_ties(["silicon.background_doping", "silicon.thickness", "gates.gate_oxide",
    ...                           "gates.field_oxide"], j)
    >>> ties
    ('background doping and thickness (the other way) together: alike to 1.00',)
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
    # The most informative of what is left gathers all that are like it.
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
                turned = " (the other way)" if cosine[first, k] < 0 else ""
                words.append(describe(names[heard[k]]) + turned)
        least = min(abs(cosine[first, k]) for k in like)
        ties.append(
            f"{', '.join(words[:-1])} and {words[-1]} together: alike to {least:.2f}"
        )
    return tuple(ties), silent
