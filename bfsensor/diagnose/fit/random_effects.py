"""Effects that are told by how far values scatter: their score in a fit, their gain before one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect
from bfsensor.typing import FloatArray

FACTORS = np.geomspace(0.05, 20.0, 61)
"""On an amplitude, of which the likeliest is taken where a fit begins."""

SURE = 1e-8
"""Of the largest information: directions that hold less hold none."""


class Score(NamedTuple):
    """Rows of a least-squares problem that stand for what the scatter of values tells.

    Attributes
    ----------
    origin : ndarray, shape (p,)
        Parameters at which it was found.
    rows : ndarray, shape (k, p)
        Whose squares are Fisher's information.
    target : ndarray, shape (k,)
        What steps of the parameters from the origin should make of the rows.
    """

    origin: FloatArray
    rows: FloatArray
    target: FloatArray

    def left(self, point: FloatArray) -> FloatArray:
        """What a point leaves of the target."""
        return np.asarray(self.target - self.rows @ (point - self.origin))


def no_score(point: FloatArray) -> Score:
    """Of a fit without such effects."""
    return Score(point, np.zeros((0, len(point))), np.zeros(0))


def scored(predictor: Predictor) -> dict[int, tuple[str, ...]]:
    """Parameters that the scatter of some channels tells, by place, and those channels."""
    out = {}
    for n, name in enumerate(predictor.names):
        if name.startswith("effect "):
            number = int(name.split()[1])
            some = predictor.effects[number : number + 1]
            words = some[0].told_by_scatter if some else ()
            if words:
                out[n] = words
    return out


def score_of(
    predictor: Predictor,
    channels: Sequence[Channel],
    point: FloatArray,
    modes: FloatArray,
    span: FloatArray,
    residuals: FloatArray,
) -> Score:
    r"""Score and information that a scatter holds, linear parameters being unknown.

    Of values :math:`r` whose covariance is :math:`1 + M M^T`, what linear parameters span
    projected out by :math:`P`, the restricted likelihood has by a parameter :math:`a`

    .. math::
        S_a = (P r)^T M_a M^T (P r) - \mathrm{tr}\,P M_a M^T, \quad
        I_{ab} = \tfrac12 \mathrm{tr}\,P C_a P C_b, \quad C_a = M_a M^T + M M_a^T

    Parameters
    ----------
    predictor : Predictor
        Of the values.
    channels : sequence of Channel
        All of them, in the order of the rows of ``modes``.
    point : ndarray, shape (p,)
        Non-linear parameters.
    modes : ndarray, shape (n, m)
        :math:`M` there, whitened.
    span : ndarray, shape (n, q)
        With which :math:`P = 1 - {}` ``span @ span.T``.
    residuals : ndarray, shape (n,)
        Whitened.

    References
    ----------
    Patterson & Thompson 1971, Biometrika 58, 545 (restricted likelihood); Fisher scoring.
    """
    which = scored(predictor)
    score = no_score(point)
    if not which or not modes.shape[1]:
        return score
    moved = {n: _slope(predictor, channels, point, n, words) for n, words in which.items()}
    moved = {n: m for n, m in moved.items() if m.any()}
    if not moved:
        return score

    def free(columns: FloatArray) -> FloatArray:
        return np.asarray(columns - span @ (span.T @ columns))

    apart, left = free(modes), free(residuals)
    slopes = [free(m) for m in moved.values()]
    strengths = modes.T @ left
    told = np.array([
        float(left @ (m @ strengths)) - float((s * modes).sum())
        for m, s in zip(moved.values(), slopes, strict=True)
    ])  # fmt: skip
    own = modes.T @ apart
    mixed = [m.T @ apart for m in moved.values()]
    information = np.array([
        [float((one.T * other).sum()) + float(((m.T @ s) * own).sum())
         for other, s in zip(mixed, slopes, strict=True)]
        for one, m in zip(mixed, moved.values(), strict=True)
    ])  # fmt: skip
    sizes, shapes = np.linalg.eigh(0.5 * (information + information.T))
    some = sizes > SURE * max(float(sizes.max()), 1e-300)
    root = np.sqrt(sizes[some])
    rows = np.zeros((int(some.sum()), len(point)))
    rows[:, list(moved)] = root[:, None] * shapes[:, some].T
    return Score(point.copy(), rows, shapes[:, some].T @ told / root)


def _slope(
    predictor: Predictor,
    channels: Sequence[Channel],
    point: FloatArray,
    n: int,
    words: tuple[str, ...],
) -> FloatArray:
    """Derivative of the whitened modes of some channels by a parameter, 0 in all others."""
    there = point.copy()
    there[n] += predictor.steps[n]
    parts = []
    for channel in channels:
        here = predictor.modes(channel, point)
        if channel.word in words and here.shape[1]:
            change = predictor.modes(channel, there) - here
            parts.append(channel.whiten(change) / predictor.steps[n])
        else:
            parts.append(np.zeros_like(here))
    out = np.zeros((sum(len(p) for p in parts), sum(p.shape[1] for p in parts)))
    row = column = 0
    for part in parts:
        rows, columns = part.shape
        out[row : row + rows, column : column + columns] = part
        row, column = row + rows, column + columns
    return out


def likeliest(
    modes: FloatArray, left: FloatArray, one: FloatArray, two: FloatArray
) -> tuple[float, float]:
    """Gain of the likelihood by an effect that changes values and their scatter, and its factor.

    Parameters
    ----------
    modes : ndarray, shape (n, m)
        What it leaves to chance, whitened, a fit's parameters projected out.
    left : ndarray, shape (n,)
        What the fit leaves.
    one, two : ndarray, shape (n,)
        A factor f on its amplitude changes the values by ``f one + f^2 two``, and makes f times
        the modes.

    Returns
    -------
    gain, factor : float
        Twice the logarithm of the likelihood over that without the effect, at the best of
        :data:`FACTORS`.

    Examples
    --------
    >>> noise = np.random.default_rng(2).normal(0, 5.0, 400)
    >>> gain, factor = likeliest(np.eye(400), noise, 0 * noise, 0 * noise)
    >>> gain > 1000, round(factor)
    (True, 5)
    """
    sizes, shapes = np.linalg.eigh(modes.T @ modes)
    sizes = np.maximum(sizes, 0.0)
    along = [shapes.T @ (modes.T @ v) for v in (left, one, two)]
    products = np.array([left, one, two]) @ np.array([left, one, two]).T
    gains = []
    for f in FACTORS:
        weights = np.array([1.0, -f, -(f**2)])
        inner = f * (weights @ np.array(along))
        wide = 1 + f**2 * sizes
        square = weights @ products @ weights - float((inner**2 / wide).sum())
        gains.append(products[0, 0] - square - float(np.log(wide).sum()))
    best = int(np.argmax(gains))
    return float(gains[best]), float(FACTORS[best])


def scatter_of(
    predictor: Predictor,
    channels: Sequence[Channel],
    starts: NDArray[np.int64],
    effect: Effect,
    values: FloatArray,
) -> FloatArray:
    """What an effect leaves to chance in the channels that tell it, whitened, of all values.

    Parameters
    ----------
    predictor : Predictor
        With the effect as its last one.
    channels, starts
        All channels and where their values begin.
    effect : Effect
        Told by scatter.
    values : ndarray
        Of all non-linear parameters.
    """
    total = int(starts[-1])
    parts = [np.zeros((total, 0))]
    alone = predictor.with_effects((effect,), values)
    point = alone.start
    for channel, start in zip(channels, starts, strict=False):
        if channel.word in effect.told_by_scatter:
            own = channel.whiten(alone.modes(channel, point))
            whole = np.zeros((total, own.shape[1]))
            whole[start : start + len(channel)] = own
            parts.append(whole)
    return np.concatenate(parts, axis=1)
