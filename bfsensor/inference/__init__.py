"""Statistics without physics, on numpy and scipy only: bounded least squares, profile bounds."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.inference.bounded_lsq import BoundedSolution, solve_within
    from bfsensor.inference.profile_bounds import Bounds
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "bounded_lsq": ["BoundedSolution", "solve_within"],
            "profile_bounds": ["Bounds"],
        },
    )

__all__ = [
    "BoundedSolution",
    "Bounds",
    "solve_within",
]
