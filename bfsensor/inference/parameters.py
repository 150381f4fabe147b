"""Free parameters of a fit as objects: what each belongs to, and where it starts, steps and ends."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.typing import FloatArray


class FreeParameter(NamedTuple):
    """One free parameter of a fit.

    Attributes
    ----------
    name : str
        Name, unique among the parameters of the fit, as reports print it.
    kind : str
        What it is, such as 'gain' or 'effect'.
    owner : int or str
        What it belongs to: the number of an amplifier, for example.
    start, step : float
        Value at which fits start, and step of numerical derivatives, in its unit.
    prior : bool
        Whether it has a Gaussian prior of mean 0 and standard deviation 1.
    low, high : float
        Smallest and largest value that a fit may give it.
    """

    name: str
    kind: str
    owner: int | str
    start: float
    step: float
    prior: bool = False
    low: float = -np.inf
    high: float = np.inf


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """Free parameters of a fit, in the order of the vector of their values.

    Attributes
    ----------
    parameters : tuple of FreeParameter
        Parameters.

    Examples
    --------
    >>> space = ParameterSpace((FreeParameter("gain 0", "gain", 0, 1.5, 1e-3),
    ...                         FreeParameter("device h", "device", "h", 0.0, 0.1, prior=True)))
    >>> space.rows("device"), space.prior_rows, space.start
    (array([1]), array([1]), array([1.5, 0. ]))
    """

    parameters: tuple[FreeParameter, ...] = ()

    def __len__(self) -> int:
        return len(self.parameters)

    def __add__(self, other: ParameterSpace) -> ParameterSpace:
        return ParameterSpace((*self.parameters, *other.parameters))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def start(self) -> FloatArray:
        """Values at which fits start, shape (n,)."""
        return np.array([p.start for p in self.parameters], float)

    @cached_property
    def steps(self) -> FloatArray:
        """Steps of numerical derivatives, shape (n,)."""
        return np.array([p.step for p in self.parameters], float)

    @cached_property
    def limits(self) -> FloatArray:
        """Smallest and largest values that a fit may give the parameters, shape (2, n)."""
        ends = [(p.low, p.high) for p in self.parameters]
        return np.array(ends, float).reshape(-1, 2).T

    @cached_property
    def prior_rows(self) -> NDArray[np.intp]:
        """Indices of the parameters with a Gaussian prior."""
        return np.flatnonzero([p.prior for p in self.parameters])

    def of(self, *kinds: str) -> NDArray[np.bool_]:
        """Mask of the parameters of given kinds, shape (n,)."""
        return np.array([p.kind in kinds for p in self.parameters], bool)

    def rows(self, kind: str, owner: int | str | None = None) -> NDArray[np.intp]:
        """Indices of the parameters of a kind, or of one owner among these."""
        return np.flatnonzero([
            p.kind == kind and owner in (None, p.owner) for p in self.parameters
        ])  # fmt: skip

    def without(self, kind: str) -> ParameterSpace:
        """Space without the parameters of a kind."""
        return ParameterSpace(tuple(p for p in self.parameters if p.kind != kind))

    def started(self, values: Iterable[float]) -> ParameterSpace:
        """Space whose fits start at other values, shape (n,)."""
        return ParameterSpace(
            tuple(
                p._replace(start=float(v))
                for p, v in zip(self.parameters, values, strict=True)
            )
        )
