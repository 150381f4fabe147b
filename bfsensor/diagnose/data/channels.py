"""Channels: measured values of one kind, the covariance of their errors, and their coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import block_diag, csr_array, diags_array

from bfsensor.errors import DiagnosisError
from bfsensor.typing import FloatArray

WORDS = (
    "flat_cov", "flat_mean", "flat_map", "serial_overscan", "parallel_overscan", "bias_cov",
    "bias_level", "dark_map", "spot", "amp_cross", "code_hist",
)  # fmt: skip
"""Names of all channels."""

PER_ELECTRON = "1/e-"
"""Unit of 'flat_cov' where its values are a_ij: relative area changes per electron, which have no
signal level, gain or read noise."""

FOLDS = ("fit", "select", "held-out")
"""Parts of a campaign: fits use the first two; the second also rejects candidates, and the third is
compared with predictions only."""


@dataclass(frozen=True, eq=False)
class Common:
    """Linear part of some values' errors that follows from others': ``spread @ gather`` times them.

    Means of columns and rows and of blocks of the same pixels share noise.  Whitening subtracts
    from blocks the part that columns and rows determine; the rest is independent of these.

    Attributes
    ----------
    spread : csr_array, shape (n, m)
        Weights of m combinations in each of n values (targets).
    gather : csr_array, shape (m, n)
        Weights of the n values in these combinations (sources); no value may be both a source
        and a target.

    Raises
    ------
    DiagnosisError
        Shapes do not match, or a value is both a source and a target.

    Examples
    --------
    The last of three values is the mean of the first two plus noise of its own:

    >>> both = Common(csr_array([[0.0], [0.0], [1.0]]), csr_array([[0.5, 0.5, 0.0]]))
    >>> c = Channel("flat_map", np.zeros(3), (np.eye(1),) * 3, {"x": np.arange(3)}, "", common=both)
    >>> c.whiten(np.array([2.0, 4.0, 3.0]))
    array([2., 4., 0.])
    """

    spread: csr_array
    gather: csr_array

    def __post_init__(self) -> None:
        if self.spread.shape != self.gather.shape[::-1]:
            raise DiagnosisError(
                f"noise in common: {self.spread.shape} and {self.gather.shape} do not match"
            )
        if (self.gather @ self.spread).count_nonzero():
            raise DiagnosisError(
                "noise in common: a value is both a source and a target of shared noise"
            )

    @classmethod
    def none(cls, n: int) -> Common:
        """No shared noise among ``n`` values."""
        return cls(csr_array((n, 0)), csr_array((0, n)))

    @property
    def size(self) -> int:
        """Number of values."""
        return int(self.spread.shape[0])

    @property
    def tells(self) -> NDArray[np.bool_]:
        """Mask of the sources, shape (n,)."""
        out = np.zeros(self.size, bool)
        out[self.gather.indices] = True
        return out

    def told(self, errors: FloatArray) -> FloatArray:
        """Part of residuals of shape (n, ...) that follows from their sources, same shape."""
        return np.asarray(self.spread @ (self.gather @ errors))

    def variance(self, own: FloatArray) -> FloatArray:
        """Variance of that part, shape (n,), from the variances of the sources' own noise."""
        middle = (self.gather * own) @ self.gather.T
        return np.asarray((self.spread @ middle).multiply(self.spread).sum(1)).ravel()


@dataclass(frozen=True, eq=False)
class Channel:
    """Measured values of one kind, the covariance of their errors, and their coordinates.

    Attributes
    ----------
    word : str
        Name of the channel, one of :data:`WORDS`.
    values : ndarray, shape (n,)
        Measured values, in ``unit``; all finite.
    blocks : tuple of ndarray
        Covariance matrices of consecutive values [unit^2], positive definite; values of
        different blocks are independent but for ``common``.
    axes : mapping of str to ndarray, shape (n,)
        Coordinates of each value: 'amp', 'level' [e- or ADU], 'i', 'j', 'wavelength' [nm], ...
    unit : str
        Unit of the values.
    fold : str
        Part of the campaign that they come from: 'fit', 'select' or 'held-out'.
    common : Common, optional
        Noise shared between blocks; ``blocks`` are then covariances of the remaining noise.
    whitener : csr_array, shape (n, n)
        Block-diagonal inverse Cholesky factors of ``blocks``, which :meth:`whiten` applies.

    Raises
    ------
    DiagnosisError
        A name is not known, shapes do not match, a value is not finite, or a block is not
        positive definite.

    Examples
    --------
    >>> c = Channel("bias_cov", np.zeros(3), (np.eye(2), 4 * np.eye(1)), {"lag": np.arange(3)}, "adu2")
    >>> c.whiten(np.array([1.0, 2.0, 2.0]))
    array([1., 2., 1.])
    """

    word: str
    values: FloatArray
    blocks: tuple[FloatArray, ...]
    axes: Mapping[str, NDArray]
    unit: str
    fold: str = "fit"
    common: Common | None = None
    whitener: csr_array = field(init=False, repr=False)

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
        if self.common is not None and self.common.size != len(values):
            raise DiagnosisError(
                f"{self.word}: noise in common of {self.common.size} values, not {len(values)}"
            )
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "axes", MappingProxyType(axes))
        object.__setattr__(self, "whitener", self._invert())

    def _invert(self) -> csr_array:
        """Inverse Cholesky factors of the blocks as one sparse matrix."""
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
        return Channel, (*given, self.common)

    def __len__(self) -> int:
        return len(self.values)

    @property
    def errors(self) -> FloatArray:
        """Standard error of each value [unit]."""
        if not self.blocks:
            return np.zeros(0)
        variance = np.concatenate([np.diag(b) for b in self.blocks])
        if self.common is not None:
            variance += self.common.variance(variance)
        return np.sqrt(variance)

    def whiten(self, residuals: ArrayLike) -> FloatArray:
        """Whiten residuals: noise becomes independent, of variance 1, if the errors are right.

        Parameters
        ----------
        residuals : array_like, shape (n, ...)
            Residuals, or derivatives of a prediction, in ``unit``.

        Returns
        -------
        whitened : ndarray, shape (n, ...)
        """
        given = np.asarray(residuals, float)
        if self.common is not None:
            given = given - self.common.told(given)
        return np.asarray(self.whitener @ given)

    def unwhiten(self, white: ArrayLike) -> FloatArray:
        """Invert :meth:`whiten`: residuals in ``unit``, shape (n,)."""
        given = np.asarray(white, float)
        out, start = np.empty_like(given), 0
        for block in self.blocks:
            part = slice(start, start + len(block))
            out[part] = np.linalg.cholesky(block) @ given[part]
            start += len(block)
        return out if self.common is None else out + self.common.told(out)

    def take(self, chosen: NDArray[np.bool_]) -> Channel:
        """Copy with the values of a mask of shape (n,), without noise in common with others.

        Raises
        ------
        DiagnosisError
            The channel has noise in common between blocks, which a part of it cannot keep.
        """
        if chosen.all():
            return self
        if self.common is not None:
            raise DiagnosisError(
                f"{self.word}: values with noise in common cannot be separated"
            )
        blocks, start = [], 0
        for block in self.blocks:
            part = chosen[start : start + len(block)]
            if part.any():
                blocks.append(block[np.ix_(part, part)])
            start += len(block)
        axes = {k: v[chosen] for k, v in self.axes.items()}
        return replace(self, values=self.values[chosen], blocks=tuple(blocks), axes=axes)


def step_of(axes: Mapping[str, NDArray]) -> NDArray:
    """Level of a ladder that each value of flats belongs to: its usual exposure time [s]."""
    return axes.get("step", axes["time"])


def join_channels(channels: Sequence[Channel]) -> Channel:
    """Join channels of one name and unit; axes that not all of them have are left out."""
    first = channels[0]
    names = [n for n in first.axes if all(n in c.axes for c in channels)]
    return Channel(
        first.word,
        np.concatenate([c.values for c in channels]),
        tuple(b for c in channels for b in c.blocks),
        {n: np.concatenate([c.axes[n] for c in channels]) for n in names},
        first.unit,
        first.fold,
        join_common([c.common or Common.none(len(c)) for c in channels])
        if any(c.common for c in channels)
        else None,
    )


def join_common(parts: Sequence[Common]) -> Common:
    """Join shared noise of consecutive parts that share none with one another."""
    return Common(
        csr_array(block_diag([p.spread for p in parts], format="csr")),
        csr_array(block_diag([p.gather for p in parts], format="csr")),
    )
