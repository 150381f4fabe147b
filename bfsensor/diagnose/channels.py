"""Channels: what recordings say, as numbers with errors and where each belongs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import block_diag, csr_array, diags_array
from scipy.sparse.linalg import spsolve_triangular

from bfsensor.errors import DiagnosisError

WORDS = (
    "flat_cov", "flat_mean", "flat_map", "serial_overscan", "parallel_overscan", "bias_cov",
    "bias_level", "dark_map", "spot", "amp_cross", "code_hist", "time",
)  # fmt: skip
"""The channels there are."""

FOLDS = ("fit", "select", "held-out")


@dataclass(frozen=True, eq=False)
class Channel:
    """Numbers of one kind, the covariance of their errors, and where each belongs.

    Attributes
    ----------
    word : str
        Which channel, of :data:`WORDS`.
    values : ndarray, shape (n,)
        What was measured, in ``unit``.
    blocks : tuple of ndarray
        Covariance matrices of consecutive values [unit^2]; values of different blocks are
        independent.
    axes : mapping of str to ndarray, shape (n,)
        Coordinates of each value: 'amp', 'level' [e- or ADU], 'i', 'j', 'wavelength' [nm], ...
    unit : str
        Of the values.
    fold : str
        Which exposures they come from: 'fit', 'select' or 'held-out'.

    Examples
    --------
    >>> c = Channel("bias_cov", np.zeros(3), (np.eye(2), 4 * np.eye(1)), {"lag": np.arange(3)}, "adu2")
    >>> c.whiten(np.array([1.0, 2.0, 2.0]))
    array([1., 2., 1.])
    """

    word: str
    values: NDArray[np.float64]
    blocks: tuple[NDArray[np.float64], ...]
    axes: Mapping[str, NDArray]
    unit: str
    fold: str = "fit"
    _whitener: csr_array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.word not in WORDS:
            raise DiagnosisError(f"channel {self.word!r} is not one of {', '.join(WORDS)}")
        if self.fold not in FOLDS:
            raise DiagnosisError(f"fold {self.fold!r} is not one of {', '.join(FOLDS)}")
        values = np.array(self.values, float)
        sizes = [len(b) for b in self.blocks]
        if values.ndim != 1 or sum(sizes) != len(values):
            raise DiagnosisError(
                f"{self.word}: {values.shape} values and blocks of {sum(sizes)} do not match"
            )
        axes = {name: np.asarray(column) for name, column in self.axes.items()}
        for name, column in axes.items():
            if column.shape != values.shape:
                raise DiagnosisError(
                    f"{self.word}: axis {name} has the shape {column.shape}, not {values.shape}"
                )
        if not np.all(np.isfinite(values)):
            raise DiagnosisError(
                f"{self.word}: {int((~np.isfinite(values)).sum())} values are not finite"
            )
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "axes", MappingProxyType(axes))
        object.__setattr__(self, "_whitener", self._invert())

    def _invert(self) -> csr_array:
        """Inverse roots of the blocks as one sparse matrix."""
        single = np.array([len(b) == 1 for b in self.blocks], bool)
        if single.all():
            variance = np.array([b[0, 0] for b in self.blocks])
            if not np.all(variance > 0):
                raise DiagnosisError(f"{self.word}: an error is not above 0")
            return csr_array(diags_array(1.0 / np.sqrt(variance)))
        roots = []
        for block in self.blocks:
            try:
                root = np.linalg.cholesky(block)
            except np.linalg.LinAlgError:
                raise DiagnosisError(
                    f"{self.word}: an error matrix of {block.shape} is not positive definite"
                ) from None
            roots.append(solve_triangular(root, np.eye(len(root)), lower=True))
        return csr_array(block_diag(roots, format="csr"))

    def __reduce__(self) -> tuple[Any, ...]:
        given = (self.word, self.values, self.blocks, dict(self.axes), self.unit, self.fold)
        return Channel, given

    def __len__(self) -> int:
        return len(self.values)

    @property
    def errors(self) -> NDArray[np.float64]:
        """Standard error of each value [unit]."""
        if not self.blocks:
            return np.zeros(0)
        return np.sqrt(np.concatenate([np.diag(b) for b in self.blocks]))

    def whiten(self, residuals: ArrayLike) -> NDArray[np.float64]:
        """Divide by the errors: independent numbers of variance 1 where the errors are right.

        Parameters
        ----------
        residuals : array_like, shape (n, ...)
            Differences, or derivatives, in ``unit``.
        """
        return np.asarray(self._whitener @ np.asarray(residuals, float))

    def unwhiten(self, whitened: ArrayLike) -> NDArray[np.float64]:
        """Undo :meth:`whiten` of values, shape (n,)."""
        return np.asarray(spsolve_triangular(self._whitener, np.asarray(whitened, float)))


def join_channels(channels: Sequence[Channel]) -> Channel:
    """Join channels of one word and unit; axes that not all have are left out."""
    first = channels[0]
    names = [n for n in first.axes if all(n in c.axes for c in channels)]
    return Channel(
        first.word,
        np.concatenate([c.values for c in channels]),
        tuple(b for c in channels for b in c.blocks),
        {n: np.concatenate([c.axes[n] for c in channels]) for n in names},
        first.unit,
        first.fold,
    )
