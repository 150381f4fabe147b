"""Model of flats' covariances whose pixel areas follow the charge, as a series in the level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.errors import MeasurementError
from bfsensor.measure.bartlett import unfold
from bfsensor.typing import FloatArray


def model_covariances(
    levels: ArrayLike,
    a: ArrayLike,
    *,
    b: ArrayLike | None = None,
    noise: ArrayLike | None = None,
    gain: float = 1.0,
    powers: int = 8,
) -> FloatArray:
    r"""Evaluate the covariance model of Astier et al. (2019), equation 20.

    With m the level in electrons, c = a b, and \* the convolution over the whole plane,

    .. math::
        g^2 C_{ij} = n_{ij} + \delta_{ij} m + a_{ij} m^2
            + \tfrac23 [a * a + c]_{ij} m^3
            + [\tfrac13 a * a * a + \tfrac56 a * c]_{ij} m^4 + \dots,

    the solution of :math:`d\tilde C / dm = 1 + 2 (\tilde a + \tilde c m) \tilde C` in every
    Fourier mode.

    Parameters
    ----------
    levels : array_like, shape (n,)
        Mean levels [unit], in electrons or ADU.
    a : array_like, shape (lags + 1, lags + 1)
        Relative change of the area of the pixel at lag (i, j) for each electron [1/e-],
        indexed [j, i]; the centre's is negative.
    b : array_like, same shape, optional
        Growth of ``a`` with the level, b_ij [1/e-]; 0 by default.
    noise : array_like, same shape, optional
        Covariance of the noise, n_ij [e-^2]; 0 by default.
    gain : float
        Gain g [e-/unit], above 0.
    powers : int
        Highest power of the level.  The published equation stops at 4, which leaves out
        about (a m)^4 / 7.5 of a Fourier mode's variance: 1e-5 at a m = 0.1, 1e-3 at 0.3.

    Returns
    -------
    covariances : ndarray, shape (n, lags + 1, lags + 1)
        C_ij of one flat [unit^2], indexed [pair, j, i].

    Raises
    ------
    MeasurementError
        Shapes do not match, the gain is not above 0, or ``powers`` is out of range.

    Examples
    --------
    >>> a = np.array([[-1e-6, 2e-7], [2e-7, 5e-8]])
    >>> model_covariances([1e4], a)[0, 0].round(1)
    array([9900.8,   19.8])
    """
    quadrant, mu = np.asarray(a, float), np.asarray(levels, float)
    if mu.ndim != 1:
        raise MeasurementError(f"levels of shape {mu.shape} must have one axis, (n,)")
    if quadrant.ndim != 2 or quadrant.shape[0] != quadrant.shape[1]:
        raise MeasurementError(f"a of shape {quadrant.shape} is not (lags + 1, lags + 1)")
    for name, other in (("b", b), ("noise", noise)):
        if other is not None and np.shape(other) != quadrant.shape:
            raise MeasurementError(
                f"{name} has the shape {np.shape(other)}, a {quadrant.shape}"
            )
    c = np.zeros_like(quadrant) if b is None else quadrant * np.asarray(b, float)
    n = np.zeros_like(quadrant) if noise is None else np.asarray(noise, float)
    if not gain > 0:
        raise MeasurementError(f"gain = {gain} e-/unit must be above 0")
    m = gain * mu
    return (expand(quadrant, c, powers).at(m) + n) / gain**2


@dataclass(frozen=True)
class Series:
    """Coefficients of the powers 1, 2, ... of the level in electrons, with derivatives.

    ``value[p - 1]`` are those of the power p at the lags [j, i] of the quadrant; ``by_a`` and
    ``by_c`` [p - 1, L, M] their derivatives at the lag L by a and c at the lag M, lags flattened.
    """

    value: FloatArray
    by_a: FloatArray
    by_c: FloatArray

    def at(self, m: FloatArray) -> FloatArray:
        """Sum of the series at levels m [e-], shape (n, lags + 1, lags + 1) [e-^2]."""
        return np.asarray(np.tensordot(self.monomials(m), self.value, 1))

    def monomials(self, m: FloatArray) -> FloatArray:
        """Powers of the levels, shape (n, powers)."""
        return np.asarray(m[:, None] ** np.arange(1, len(self.value) + 1))


def expand(a: FloatArray, c: FloatArray, powers: int, *, slopes: bool = False) -> Series:
    """Coefficients of the series for a [1/e-] and c [1/e-^2] with the given lags.

    From dC/dm = 1 + 2 (a + c m) C, power by power in Fourier space:
    (p + 1) P_(p+1) = 2 a P_p + 2 c P_(p-1), with P_1 = 1.
    """
    if not 1 <= powers <= 12:
        raise MeasurementError(f"powers = {powers} must be from 1 to 12")
    if int(powers) != powers:
        raise MeasurementError(f"powers = {powers} must be a whole number")
    lags = a.shape[0] - 1
    # The plane is so wide that no product of the series wraps around into the lags that are read.
    reach = max(powers, 2) * lags
    a_k, c_k = (np.fft.fft2(np.fft.ifftshift(unfold(q, reach))).real for q in (a, c))
    zero = np.zeros_like(a_k)
    p_k, q_k, r_k = [zero, zero + 1], [zero, zero], [zero, zero]
    for p in range(1, powers):
        two = 2.0 / (p + 1)
        p_k.append(two * (a_k * p_k[p] + c_k * p_k[p - 1]))
        q_k.append(two * (p_k[p] + a_k * q_k[p] + c_k * q_k[p - 1]))
        r_k.append(two * (a_k * r_k[p] + p_k[p - 1] + c_k * r_k[p - 1]))
    value, by_a, by_c = (np.fft.ifft2(np.array(x[1:])).real for x in (p_k, q_k, r_k))
    side = slice(0, lags + 1)
    if not slopes:
        empty = np.empty(0)
        return Series(value[:, side, side], empty, empty)
    return Series(value[:, side, side], _spread(by_a, lags), _spread(by_c, lags))


def _spread(response: FloatArray, lags: int) -> FloatArray:
    """Change at the lag L by a unit at the lag M and its mirror images, shape (powers, L, M)."""
    j, i = (index.ravel() for index in np.indices((lags + 1, lags + 1)))
    total = np.zeros((len(response), len(j), len(j)))
    for sign_j in (1, -1):
        for sign_i in (1, -1):
            # A lag on an axis is its own mirror image and counts once.
            distinct = ((sign_j == 1) | (j > 0)) & ((sign_i == 1) | (i > 0))
            at = response[:, j[:, None] - sign_j * j, i[:, None] - sign_i * i]
            total += at * distinct
    return total
