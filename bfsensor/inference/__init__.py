"""Statistics without physics, on NumPy and SciPy: the engine of the diagnosis's and of device fits.

SciPy's :func:`~scipy.optimize.least_squares` (trust region with bounds) and
:func:`~scipy.optimize.lsq_linear` do the work.  What they lack, and is added here:

* a first radius of the trust region in standard errors, points at which nothing can be computed, and
  an answer with its quality in place of an exception (:mod:`~bfsensor.inference.trust_region`);
* linear parameters and random effects projected out once, and variance parameters that the scatter
  constrains (:mod:`~bfsensor.inference.mixed_model`, :mod:`~bfsensor.inference.random_effects`);
* linear least squares with bounds, errors and a basis of what the fit absorbs
  (:mod:`~bfsensor.inference.bounded_lsq`);
* likelihood profiles (:mod:`~bfsensor.inference.likelihood_profile`,
  :mod:`~bfsensor.inference.profile_bounds`);
* the charge for what was tried (:mod:`~bfsensor.inference.evidence`).
"""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.inference.bounded_lsq import BoundedSolution, solve_within
    from bfsensor.inference.evidence import chance_gain
    from bfsensor.inference.likelihood_profile import Profile
    from bfsensor.inference.profile_bounds import Bounds
    from bfsensor.inference.trust_region import Minimum, minimise
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "bounded_lsq": ["BoundedSolution", "solve_within"],
            "evidence": ["chance_gain"],
            "likelihood_profile": ["Profile"],
            "profile_bounds": ["Bounds"],
            "trust_region": ["Minimum", "minimise"],
        },
    )

__all__ = [
    "BoundedSolution",
    "Bounds",
    "Minimum",
    "Profile",
    "chance_gain",
    "minimise",
    "solve_within",
]
