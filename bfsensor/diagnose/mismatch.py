"""The baseline fitted with all that may float, and what is left of the channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular

from bfsensor.diagnose.channels import Channel
from bfsensor.diagnose.predict import Predictor
from bfsensor.errors import ConvergenceError

ROUNDS = 20
HALVINGS = 4
"""Of a step that does harm, before it is given up and the fit taken for arrived."""

STALLED = 4
"""Rounds without gain after which a fit with effects has arrived, whatever their steps."""

REFRESHED = 2, 4
"""Rounds in which what is left to chance is taken as strong as the effects then are."""

UNSETTLED = (
    "the recordings are so unlike the baseline that its parameters did not settle: what is left is "
    "of the best that was found"
)
"""Note of fits whose free steps led away."""

SMALL = 0.05
"""Largest step of a parameter [of its error] at which the fit has arrived."""


@dataclass(frozen=True, eq=False)
class BaselineFit:
    """A joint fit of all channels by the baseline.

    Attributes
    ----------
    channels : tuple of Channel
        What was fitted.
    names : tuple of str
        Non-linear parameters, then linear ones, then strengths of what effects leave to chance.
    values, errors : ndarray
        Of the parameters.
    residuals : ndarray, shape (n,)
        Whitened, all channels one after another.
    basis : ndarray, shape (n + priors, p)
        Orthonormal columns that the parameters span, priors' rows last: noise in them is
        fitted away.
    starts : ndarray of int, shape (channels + 1,)
        Where each channel's residuals begin.
    pulls : dict of str to float
        Device parameters in units of their spread.
    covariance : ndarray, shape (p, p)
        Of the parameters, in the order of ``names``.
    slopes : ndarray, shape (n, non-linear parameters)
        Whitened derivatives.
    left : ndarray, shape (n + priors,)
        Residuals with those of the priors after them, what the basis spans taken off.
    chance : float
        Logarithm by which what effects leave to chance widens the errors of all values together
        (of the determinant of their covariance).
    notes : tuple of str
        What the prediction had to assume.
    """

    channels: tuple[Channel, ...]
    names: tuple[str, ...]
    values: NDArray[np.float64]
    errors: NDArray[np.float64]
    residuals: NDArray[np.float64]
    basis: NDArray[np.float64] = field(repr=False)
    starts: NDArray[np.int64] = field(repr=False)
    pulls: dict[str, float]
    covariance: NDArray[np.float64] = field(
        repr=False, default_factory=lambda: np.zeros((0, 0))
    )
    left: NDArray[np.float64] = field(repr=False, default_factory=lambda: np.zeros(0))
    slopes: NDArray[np.float64] = field(
        repr=False, default_factory=lambda: np.zeros((0, 0))
    )
    chance: float = 0.0
    notes: tuple[str, ...] = ()

    def of(self, word: str) -> NDArray[np.bool_]:
        """Which residuals belong to a channel word."""
        out = np.zeros(len(self.residuals), bool)
        for channel, start in zip(self.channels, self.starts, strict=False):
            if channel.word == word:
                out[start : start + len(channel)] = True
        return out

    def chi2(self) -> dict[str, tuple[float, float]]:
        """Chi-square and degrees of freedom of each channel word.

        The parameters' degrees are shared out as the basis lies in the channels.
        """
        leverage = (self.basis[: len(self.residuals)] ** 2).sum(1)
        out = {}
        for word in dict.fromkeys(c.word for c in self.channels):
            rows = self.of(word)
            out[word] = (
                float(self.residuals[rows] @ self.residuals[rows]),
                float(rows.sum() - leverage[rows].sum()),
            )
        return out

    @property
    def total(self) -> float:
        """Chi-square of the residuals and of the priors; wider errors cost their logarithm."""
        return float(self.left @ self.left) + self.chance

    def draw(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Residuals that noise alone leaves, shape (count, n), the fit linear about its end."""
        return self.draw_all(rng, count)[:, : len(self.residuals)]

    def draw_all(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """As :meth:`draw`, those of the priors after them."""
        noise = rng.standard_normal((count, len(self.basis)))
        noise -= (noise @ self.basis) @ self.basis.T
        return noise


def fit_baseline(
    predictor: Predictor, channels: Sequence[Channel], *, like: BaselineFit | None = None
) -> BaselineFit:
    """Fit the baseline to channels: Gauss-Newton, device parameters held by their spread.

    Recordings that are nothing like the baseline may lead such steps ever farther away.  Without
    effects the fit is then made again by steps that may do no harm, and ends where they end:
    what is left is large, and told; ``notes`` say so.

    Parameters
    ----------
    predictor : Predictor
        Predicts them.
    channels : sequence of Channel
        What to fit.
    like : BaselineFit, optional
        A fit of the same channels by the same baseline, with other effects: its derivatives,
        which hardly change, are taken over.

    Raises
    ------
    ConvergenceError
        The parameters still move after :data:`ROUNDS` rounds.
    """
    try:
        return _fit(predictor, channels, like=like, careful=bool(predictor.effects))
    except ConvergenceError:
        if predictor.effects:
            raise
        found = _fit(predictor, channels, like=like, careful=True)
        return replace(found, notes=(*found.notes, UNSETTLED))


def _fit(
    predictor: Predictor,
    channels: Sequence[Channel],
    *,
    like: BaselineFit | None,
    careful: bool,
) -> BaselineFit:
    """As :func:`fit_baseline`; careful steps do no harm, and need derivatives of each round."""
    starts = np.concatenate([[0], np.cumsum([len(c) for c in channels])])
    total = int(starts[-1])
    columns: dict[str, NDArray[np.float64]] = {}
    for channel, start in zip(channels, starts, strict=False):
        for name, column in predictor.linear(channel).items():
            whole = columns.setdefault(name, np.zeros(total))
            whole[start : start + len(channel)] += channel.whiten(column)
    # A parameter that no value depends on is none.
    columns = {k: v for k, v in columns.items() if np.abs(v).max() > 0}
    linear = np.array(list(columns.values())).T.reshape(total, len(columns))
    scales = np.sqrt((linear**2).sum(0))
    count, priors = len(predictor.names), len(predictor.prior_rows)
    point = predictor.start.astype(float).copy()
    low, high = predictor.bounds()
    effect = np.char.startswith(np.array(predictor.names, str), "effect ")
    modes = _modes(predictor, channels, point)
    span = _span(linear / scales, modes) if careful else linear[:, :0]
    before, least, halved, arrived = point.copy(), np.inf, 0, False
    moved = np.inf
    history: list[float] = []
    squares: list[float] = []
    slopes = np.zeros((total, count))
    plain = int((~effect).sum())
    if like is not None:
        slopes[:, :plain] = like.slopes[:, :plain]
    for turn in range(ROUNDS):
        try:
            predicted = [predictor.predict(c, point) for c in channels]
        except ConvergenceError:
            # So far off that spots have no shape any more: a step that does harm.
            if not (careful and turn and halved < HALVINGS):
                raise
            halved += 1
            point = 0.5 * (point + before) if halved < HALVINGS else before
            history.append(np.nan)
            continue
        residuals = np.concatenate([
            c.whiten(c.values - p) for c, p in zip(channels, predicted, strict=True)
        ])  # fmt: skip
        if turn in REFRESHED and modes.shape[1] and not halved:
            modes, least = _modes(predictor, channels, point), np.inf
            span = _span(linear / scales, modes)
        if careful:
            # Of what is left with the linear parameters at their best.
            given = span[:total].T @ residuals
            square = float(residuals @ residuals) - float(given @ given)
            square += float(point[predictor.prior_rows] @ point[predictor.prior_rows])
            # Effects bend: a step that does harm is taken back by half, at last altogether.
            if square > least + 0.01 and halved < HALVINGS:
                halved += 1
                point = 0.5 * (point + before) if halved < HALVINGS else before
                history.append(np.nan)
                continue
            squares.append(square)
            # Steps that gain nothing any more, of derivatives that are not quite those here.
            stalled = len(squares) > STALLED + 1 and np.ptp(squares[-STALLED:]) < 0.02
            arrived = halved == HALVINGS or stalled
            least, halved = square, 0
        # Derivatives hardly change: those of the second round serve all later ones; effects
        # with a shape are not as straight.
        fresh = (turn < 2 or (careful and not effect.any())) and like is None
        if fresh or effect.any():
            for n in map(int, np.flatnonzero(fresh | effect)):
                for channel, start, here in zip(channels, starts, predicted, strict=False):
                    if predictor.depends(channel)[n]:
                        try:
                            change = predictor.slope(channel, point, n, here)
                        except ConvergenceError:
                            # At the end of where spots have a shape: that of the last round.
                            if not (careful and turn):
                                raise
                            continue
                        slopes[start : start + len(channel), n] = channel.whiten(change)
        plainly, chance = count + linear.shape[1], modes.shape[1]
        design = np.zeros((total + priors + chance, plainly + chance))
        design[:total, :count] = slopes
        design[:total, count:plainly] = linear / scales
        design[:total, plainly:] = modes
        design[total + np.arange(priors), predictor.prior_rows] = 1.0
        design[total + priors + np.arange(chance), plainly + np.arange(chance)] = 1.0
        target = np.concatenate([residuals, -point[predictor.prior_rows], np.zeros(chance)])
        norms = np.sqrt((design**2).sum(0))
        used = norms > 0
        q, r = np.linalg.qr(design[:, used] / norms[used])
        # Directions that the data do not hold are left where they are.
        singular = np.abs(np.diag(r)) > 1e-10
        q = (
            q
            if singular.all()
            else np.linalg.svd(design[:, used] / norms[used], full_matrices=False)[0][
                :, : np.linalg.matrix_rank(r)
            ]
        )
        solution = np.zeros(design.shape[1])
        if singular.all():
            solution[used] = solve_triangular(r, q.T @ target) / norms[used]
            inverse = solve_triangular(r, np.eye(len(r)))
        else:
            inverse = np.linalg.pinv(design[:, used] / norms[used], rcond=1e-10)
            solution[used] = (inverse @ target) / norms[used]
        errors = np.zeros(design.shape[1])
        errors[used] = np.sqrt((inverse**2).sum(1)) / norms[used]
        before = point
        point = np.clip(point + solution[:count], low, high)
        moved = float(
            np.max(
                np.abs(point - before) / np.maximum(errors[:count], 1e-300),
                where=errors[:count] > 0,
                initial=0.0,
            )
        )
        history.append(moved)
        if moved < SMALL or arrived:
            point = before if arrived else point
            break
    else:
        if careful and not effect.any():
            point = before
        else:
            raise ConvergenceError(
                f"the baseline's parameters still move by {moved:.2g} of their errors after {ROUNDS} "
                f"rounds (steps {', '.join(f'{h:.2g}' for h in history)})"
            )
    left = target - q @ (q.T @ target)
    unit = np.concatenate([np.ones(count), scales, np.ones(chance)])
    values = np.concatenate([point, solution[count:] / unit[count:]])
    errors[count:] /= unit[count:]
    covariance = np.zeros((len(unit), len(unit)))
    covariance[np.ix_(used, used)] = (inverse @ inverse.T) / np.outer(
        norms[used] * unit[used], norms[used] * unit[used]
    )
    return BaselineFit(
        channels=tuple(channels),
        names=(*predictor.names, *columns, *(f"chance {n}" for n in range(chance))),
        values=values,
        errors=errors,
        residuals=left[:total],
        basis=q,
        starts=starts,
        pulls={
            predictor.names[n].removeprefix("device "): float(point[n])
            for n in predictor.prior_rows
        },
        covariance=covariance,
        left=left,
        slopes=slopes,
        chance=float(np.linalg.slogdet(np.eye(chance) + modes.T @ modes)[1]),
        notes=tuple(predictor.notes),
    )


def _modes(
    predictor: Predictor, channels: Sequence[Channel], point: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What effects leave to chance, whitened, shape (values, modes)."""
    found = [predictor.modes(c, point) for c in channels]
    found = [c.whiten(m) if m.shape[1] else m for c, m in zip(channels, found, strict=True)]
    return (
        block_diag(*found)
        if any(m.shape[1] for m in found)
        else np.zeros((sum(map(len, found)), 0))
    )


def _span(linear: NDArray[np.float64], modes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthonormal columns of linear parameters and of chance, whose priors' rows are the last."""
    chance = modes.shape[1]
    both = np.zeros((len(linear) + chance, linear.shape[1] + chance))
    both[: len(linear)] = np.concatenate([linear, modes], axis=1)
    both[len(linear) :, linear.shape[1] :] = np.eye(chance)
    return np.linalg.qr(both)[0]
