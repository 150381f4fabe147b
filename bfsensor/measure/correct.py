r"""Correction of images for the brighter-fatter effect, by a scalar kernel or by edge shifts.

While a pixel fills, the charge around it shifts its boundaries in proportion to that charge.
Averaged over an exposure the shift is half of that at its end.  A boundary that is shifted by s
pixels moves s times the light that falls on it from one pixel to the other.  Both corrections
take the light on a boundary to be the mean of the two pixels that share it, and move it back.
They differ in their model of the shifts: for the scalar kernel K they are the gradient of a
potential, :math:`s = -\nabla (K \otimes F)`; the edge model has a shift for every edge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import fftconvolve

from bfsensor.errors import ConvergenceError, MeasurementError
from bfsensor.measure.arrays import to_floats
from bfsensor.typing import FloatArray


def correct_kernel(
    image: ArrayLike,
    kernel: ArrayLike,
    *,
    conserving: bool = True,
    threshold: float = 10.0,
    iterations: int = 20,
) -> FloatArray:
    r"""Correct an image with a scalar kernel.

    .. math::
        \hat F = F + \tfrac12 \nabla \cdot [\hat F\, \nabla (K \otimes \hat F)],

    iterated from :math:`\hat F = F`.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Charge of one exposure without bias [e-], every pixel finite.
    kernel : array_like, shape (odd, odd)
        K by lag [j, i] [1/e-], with the centre in the middle; minus its Laplacian is a_ij.
    conserving : bool
        Compute the charge that crosses each edge from the mean of its two pixels, so that the
        sum of all charge is kept.  If False, compute :math:`\tfrac12 (\nabla F \cdot \nabla
        \phi + F \nabla^2 \phi)` by central differences, as first published, which keeps the sum
        only where gradients are small.
    threshold : float
        Sum of the absolute changes of all pixels in a step [e-] below which the iteration
        ends; inf ends it after the first step.
    iterations : int
        Largest number of steps, 1 or more.

    Returns
    -------
    corrected : ndarray, shape (ny, nx)
        Charge as it would have been collected without the effect [e-].

    Raises
    ------
    MeasurementError
        The image or the kernel has values that are not finite or another shape, or
        ``threshold`` or ``iterations`` is out of range.
    ConvergenceError
        The threshold was not reached; ``history`` has the sum of changes by step.

    Notes
    -----
    Charge outside the image is taken to be that of its nearest pixel: the correction is not
    reliable closer to the border than the kernel reaches.  No charge crosses the border if
    ``conserving`` is True.

    References
    ----------
    Coulton et al. 2018, AJ 155, 258, sections 2 and 3.

    Examples
    --------
    >>> kernel = np.zeros((3, 3))
    >>> kernel[1, 1] = -3e-7
    >>> flat = np.full((9, 9), 5e4)
    >>> bool(np.allclose(correct_kernel(flat, kernel), flat))
    True
    """
    given = check_image(image)
    k = to_floats(kernel, "kernel")
    if k.ndim != 2 or not all(side % 2 for side in k.shape):
        raise MeasurementError(f"kernel of shape {k.shape} must have two odd sides")
    if not np.all(np.isfinite(k)):
        raise MeasurementError("kernel holds values that are not finite")
    if not threshold > 0:
        raise MeasurementError(f"threshold = {threshold} e- must be above 0 e-")
    if not iterations >= 1:
        raise MeasurementError(f"iterations = {iterations} must be 1 or more")
    move = _move_conserving if conserving else _move_expanded
    history: list[float] = []
    found = given
    while len(history) < iterations:
        # The potential is needed one pixel beyond the border, for gradients there.
        pad = tuple((side // 2 + 1,) * 2 for side in k.shape)
        potential = fftconvolve(np.pad(found, pad, mode="edge"), k, mode="valid")
        new = given + move(found, potential)
        history.append(float(np.abs(new - found).sum()))
        found = new
        if history[-1] < threshold:
            return found
    raise ConvergenceError(
        f"after {iterations} steps the correction still changes by {history[-1]:.3g} e- in sum, "
        f"not below threshold = {threshold:g} e-: raise iterations or threshold; growing changes "
        "mean that the kernel is too strong for this charge",
        history,
    )


def correct_edges(image: ArrayLike, north: ArrayLike, east: ArrayLike) -> FloatArray:
    r"""Correct an image with the shifts of pixel edges.

    With :math:`s` the shift of the edge between pixels 1 and 2 by the charge at the end of the
    exposure, :math:`\tfrac12 s` on average, the charge

    .. math:: \delta = \tfrac12 s\, \tfrac12 (F_1 + F_2)

    was collected on the wrong side of it.  This takes two convolutions and no iteration,
    because shifts follow the stored charge, which is what the image shows.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Charge of one exposure without bias [e-], every pixel finite.
    north, east : array_like, shape (n, n)
        Shift of the upper and of the right edge [pixel/e-], outward positive, of the pixel at
        lag i in x and j in y, ``[j, i]`` from (0, 0), by charge at (0, 0).  All other edges
        follow by mirror symmetry; edges beyond the last lag do not move.

    Returns
    -------
    corrected : ndarray, shape (ny, nx)
        Charge as it would have been collected without the effect [e-]; its sum is that of
        the image to round-off.

    Raises
    ------
    MeasurementError
        The image or the shifts have values that are not finite, or another shape.

    Notes
    -----
    Shifts are antisymmetric about the charge, edge by edge, so that uniform charge shifts no
    edge.  Charge outside the image is taken to be that of its nearest pixel.

    References
    ----------
    Astier & Regnault 2023, A&A 670, A118; normalisation of Guyonnet et al. 2015, A&A 575,
    A41.

    Examples
    --------
    >>> north = np.array([[-5e-7, -1e-7], [-1e-7, -5e-8]])
    >>> image = np.zeros((9, 9))
    >>> image[4, 4] = 1e5
    >>> corrected = correct_edges(image, north, north.T)
    >>> bool(corrected[4, 4] > 1e5), bool(abs(corrected.sum() - 1e5) < 1e-6)
    (True, True)
    """
    given = check_image(image)
    n, e = to_floats(north, "north"), to_floats(east, "east")
    if n.ndim != 2 or n.shape != e.shape or n.shape[0] != n.shape[1]:
        raise MeasurementError(
            f"north and east have the shapes {n.shape} and {e.shape}, not (n, n) both"
        )
    if not (np.all(np.isfinite(n)) and np.all(np.isfinite(e))):
        raise MeasurementError("north or east holds values that are not finite")
    moved_y = 0.25 * (given[1:] + given[:-1]) * _shifts(given, n)
    moved_x = 0.25 * (given[:, 1:] + given[:, :-1]) * _shifts(given.T, e.T).T
    return given - _gains(moved_y, moved_x, given.shape)


def check_image(image: ArrayLike) -> FloatArray:
    """Image as floats, checked to be two-dimensional and finite."""
    array = to_floats(image, "image")
    if array.ndim != 2 or min(array.shape) < 2:
        raise MeasurementError(
            f"image of shape {array.shape} must have two sides of 2 pixels or more"
        )
    bad = np.count_nonzero(~np.isfinite(array))
    if bad:
        # The convolution by Fourier transform would spread them over all pixels.
        raise MeasurementError(
            f"image holds {bad} values that are not finite: fill them, for instance from their "
            "neighbours, before a correction"
        )
    return array


def _shifts(image: FloatArray, upper: FloatArray) -> FloatArray:
    """Shifts of the edges between the rows of an image [pixel], shape (ny - 1, nx)."""
    n = len(upper)
    half = np.concatenate([upper[:, :0:-1], upper], axis=1)
    # Rows of edges from -n to n - 1 about the charge; those below it shift the other way.
    whole = np.concatenate([-half[::-1], half])
    padded = np.pad(image, ((n, n), (n - 1, n - 1)), mode="edge")
    return np.asarray(fftconvolve(padded, whole, mode="valid")[1:-1])


def _gains(up: FloatArray, right: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Gain of each pixel: of two neighbours the lower or left one gains what the other loses."""
    gain = np.zeros(shape)
    gain[:-1] += up
    gain[1:] -= up
    gain[:, :-1] += right
    gain[:, 1:] -= right
    return gain


def _move_conserving(charge: FloatArray, potential: FloatArray) -> FloatArray:
    """Half the divergence of F grad(potential), by the charge that crosses each edge."""
    inner = potential[1:-1, 1:-1]
    up = 0.25 * (charge[1:] + charge[:-1]) * (inner[1:] - inner[:-1])
    right = 0.25 * (charge[:, 1:] + charge[:, :-1]) * (inner[:, 1:] - inner[:, :-1])
    return _gains(up, right, charge.shape)


def _move_expanded(charge: FloatArray, potential: FloatArray) -> FloatArray:
    """Half of grad F grad(potential) + F Laplacian(potential), by central differences."""
    f, p = np.pad(charge, 1, mode="edge"), potential
    along_y = (f[2:, 1:-1] - f[:-2, 1:-1]) * (p[2:, 1:-1] - p[:-2, 1:-1])
    along_x = (f[1:-1, 2:] - f[1:-1, :-2]) * (p[1:-1, 2:] - p[1:-1, :-2])
    around = p[2:, 1:-1] + p[:-2, 1:-1] + p[1:-1, 2:] + p[1:-1, :-2]
    laplacian = around - 4 * p[1:-1, 1:-1]
    return np.asarray(0.5 * (0.25 * (along_y + along_x) + charge * laplacian))
