"""Positions where light sets electrons free: spots, flats, fringes, beams and photon lists.

A photon's number selects its random numbers: any part of an exposure can be drawn by itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor._kernels.counter_rng import deviates, uniforms
from bfsensor.device import silicon
from bfsensor.errors import SimulationError
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

LOWEST = 2.0
"""Smallest height above the gates at which electrons are set free [um]; photons that come further
are not converted.

Chosen: twice the height of the highest silicon surface of shipped devices, that under the channel
stops of ITL's; twice as high, light that converts in 2 um more is lost, 2 % of it in 100 um of
silicon where it is absorbed evenly."""

_PLACES, _SLOPES = 11, 12
"""Streams of the counted random numbers for positions and for slopes.

Chosen: any that the transport of the same electrons does not use, which has 1 to 3."""


def spot(
    numbers: ArrayLike, *, seed: int, centre: tuple[float, float], sigma: float
) -> FloatArray:
    """Draw the positions of the photons of a Gaussian spot at the back surface.

    Parameters
    ----------
    numbers : array_like of int, shape (n,)
        The photons' numbers in the exposure, consecutive.
    seed : int
        Seed of the random numbers, 0 to 2^64 - 1.
    centre : tuple of float
        Centre (x, y) of the spot [um].
    sigma : float
        Standard deviation of the spot along an axis [um], above 0.

    Returns
    -------
    places : ndarray, shape (n, 2)
        Positions (x, y) [um].

    Raises
    ------
    SimulationError
        ``sigma`` is not above 0, or the numbers are not consecutive.

    Examples
    --------
    >>> places = spot(range(1000), seed=6, centre=(2.0, -1.0), sigma=10.0)
    >>> places.shape, bool(abs(places.std() / 10.0 - 1) < 0.1)
    ((1000, 2), True)
    """
    if not (np.isfinite(sigma) and sigma > 0):
        raise SimulationError(f"sigma = {sigma} um of a spot must be above 0")
    x, y, _ = _deviates(numbers, seed)
    return np.column_stack([
        np.float64(centre[0]) + sigma * x, np.float64(centre[1]) + sigma * y
    ])  # fmt: skip


def flat(
    numbers: ArrayLike, *, seed: int, box: tuple[float, float, float, float]
) -> FloatArray:
    """Draw the positions of photons that fall evenly on a rectangle.

    Parameters
    ----------
    numbers, seed
        As for :func:`spot`.
    box : tuple of float
        Lowest x, highest x, lowest y, highest y [um].

    Returns
    -------
    places : ndarray, shape (n, 2)
        Positions (x, y) [um].
    """
    u = _uniforms(numbers, seed, _PLACES)
    _check_box(box)
    return np.column_stack(
        [box[0] + (box[1] - box[0]) * u[:, 0], box[2] + (box[3] - box[2]) * u[:, 1]]
    )


def fringes(
    numbers: ArrayLike,
    *,
    seed: int,
    box: tuple[float, float, float, float],
    period: float,
    angle: float = 0.0,
    contrast: float = 1.0,
    phase: float = 0.0,
) -> FloatArray:
    r"""Draw the positions of photons of a fringe pattern, :math:`1 + c \cos(2 \pi s / p + \phi)`.

    Parameters
    ----------
    numbers, seed, box
        As for :func:`flat`.
    period : float
        Period p of the fringes [um], above 0.
    angle : float
        Angle from the x axis to the direction s across the fringes [rad].
    contrast : float
        Contrast c of the fringes, 0 to 1.
    phase : float
        Phase :math:`\phi` at the origin [rad].

    Returns
    -------
    places : ndarray, shape (n, 2)
        Positions (x, y) [um]; all photons are kept, those on dark fringes are moved to bright ones.

    Notes
    -----
    A photon at phase t of even light is moved to the phase where the cumulated light of the
    pattern equals t; at the ends of the box it may leave the box by less than half a period.
    """
    if not (np.isfinite(period) and period > 0):
        raise SimulationError(f"period = {period} um of fringes must be above 0")
    if not 0 <= contrast <= 1:
        raise SimulationError(f"contrast = {contrast} of fringes must be from 0 to 1")
    places = flat(numbers, seed=seed, box=box)
    across = np.array([np.cos(angle), np.sin(angle)])
    t = 2 * np.pi * (places @ across) / period + phase
    # Kepler's equation u + c sin u = t, by Newton's method with a bisection's safety.
    whole = 2 * np.pi * np.round(t / (2 * np.pi))
    rest = t - whole
    low, high = np.full_like(rest, -np.pi), np.full_like(rest, np.pi)
    u = rest.copy()
    for _ in range(60):
        value = u + contrast * np.sin(u) - rest
        low, high = np.where(value < 0, u, low), np.where(value < 0, high, u)
        new = u - value / np.maximum(1 + contrast * np.cos(u), 1e-12)
        u = np.where((new > low) & (new < high), new, 0.5 * (low + high))
    return places + ((u - rest) * period / (2 * np.pi))[:, None] * across


def beam_slopes(
    numbers: ArrayLike,
    *,
    seed: int,
    f_number: float,
    obscuration: float = 0.0,
    index: float,
) -> FloatArray:
    """Draw the slopes in the silicon of the photons of a converging beam.

    Parameters
    ----------
    numbers, seed
        As for :func:`spot`.
    f_number : float
        Focal length over diameter of the pupil, above 0.5; 1.2 for the Rubin telescope.
    obscuration : float
        Diameter of the dark middle of the pupil over that of the pupil, 0 to below 1.
    index : float
        Refractive index of silicon at the wavelength, 1 or more.

    Returns
    -------
    slopes : ndarray, shape (n, 2)
        Slopes dx/dz and dy/dz of the path into the silicon.
    """
    if not f_number > 0.5:
        raise SimulationError(f"f_number = {f_number} must be above 0.5")
    if not 0 <= obscuration < 1:
        raise SimulationError(f"obscuration = {obscuration} must be from 0 to 1")
    if not index >= 1:
        raise SimulationError(f"index = {index} of refraction must be 1 or more")
    u = _uniforms(numbers, seed, _SLOPES)
    inner = obscuration**2
    # A pupil of even light obeys Abbe's sine condition.
    sine = np.sqrt(inner + (1 - inner) * u[:, 0]) / (2 * f_number) / index
    tangent = sine / np.sqrt(1 - sine**2)
    turn = 2 * np.pi * u[:, 1]
    return np.column_stack([tangent * np.cos(turn), tangent * np.sin(turn)])


def convert(
    device: Device,
    places: ArrayLike,
    *,
    seed: int,
    numbers: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    height: float | None = None,
    slopes: ArrayLike | None = None,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Convert photons that enter through the back surface to electrons in the silicon.

    Parameters
    ----------
    device : Device
        Device whose thickness and temperature are used.
    places : array_like, shape (n, 2)
        Positions (x, y) at which photons enter the back surface [um].
    seed : int
        Seed of the random numbers, 0 to 2^64 - 1.
    numbers : array_like of int, shape (n,), optional
        The photons' numbers in the exposure, consecutive (default: 0, 1, ...).
    wavelengths : array_like, shape (n,) or (), optional
        Wavelengths [nm]; path lengths are drawn from the absorption length.
    height : float, optional
        Height above the gates at which all photons convert [um], in place of wavelengths; from
        2 um to the thickness.
    slopes : array_like, shape (n, 2), optional
        Slopes dx/dz and dy/dz in the silicon; by default light falls straight.

    Returns
    -------
    starts : ndarray, shape (n, 3)
        Positions (x, y, z) where electrons are set free [um].
    converted : ndarray of bool, shape (n,)
        False for photons that reach the lowest 2 um of the silicon.

    Raises
    ------
    SimulationError
        Neither wavelengths nor a height are given, or both; or an array does not fit.
    """
    places = np.atleast_2d(np.asarray(places, float))
    count = len(places)
    if places.shape != (count, 2) or not np.isfinite(places).all():
        raise SimulationError("places must be finite numbers of shape (n, 2)")
    if (wavelengths is None) == (height is None):
        raise SimulationError(
            "give either wavelengths or a height of conversion of the photons"
        )
    thickness = float(device.silicon.thickness)
    tilt = np.zeros((count, 2))
    if slopes is not None:
        tilt = np.broadcast_to(np.asarray(slopes, float), (count, 2))
    if height is not None:
        if not LOWEST <= height <= thickness:
            raise SimulationError(
                f"height = {height:g} um of conversion must be from {LOWEST:g} to {thickness:g} um"
            )
        depth = np.full(count, thickness - height)
    else:
        lengths = silicon.absorption_length(
            np.broadcast_to(np.asarray(wavelengths, float), (count,)),
            device.operating_point.temperature,
        )
        path = paths(np.arange(count) if numbers is None else numbers, seed=seed)
        depth = lengths * path / np.sqrt(1 + (tilt**2).sum(1))
    converted = depth <= thickness - LOWEST
    depth = np.minimum(depth, thickness - LOWEST)
    starts = np.column_stack([places + tilt * depth[:, None], thickness - depth])
    return starts, converted


def paths(numbers: ArrayLike, *, seed: int) -> FloatArray:
    """Draw the path lengths of photons to their conversion, exponential deviates.

    Parameters
    ----------
    numbers, seed
        As for :func:`spot`.

    Returns
    -------
    paths : ndarray, shape (n,)
        Path lengths in units of the absorption length, above 0.
    """
    return _deviates(numbers, seed)[2].astype(float)


def _check_box(box: tuple[float, float, float, float]) -> None:
    if not (np.isfinite(box).all() and box[0] < box[1] and box[2] < box[3]):
        raise SimulationError(
            f"box = {tuple(box)} must be lowest x, highest x, lowest y, highest y [um]"
        )


def _numbers(numbers: ArrayLike) -> tuple[int, int]:
    """First number and count of consecutive photons."""
    given = np.asarray(numbers)
    if given.ndim != 1 or (given.size and not np.array_equal(
        given, given[0] + np.arange(given.size)
    )):  # fmt: skip
        raise SimulationError("numbers of photons must be consecutive")
    return (int(given[0]) if given.size else 0), given.size


def _deviates(numbers: ArrayLike, seed: int) -> tuple[NDArray[np.float32], ...]:
    """Two normal deviates and an exponential one for each photon, in single precision."""
    first, count = _numbers(numbers)
    x, y, path = (np.empty(count, np.float32) for _ in range(3))
    deviates(
        first, np.uint32(seed & 0xFFFFFFFF), np.uint32(seed >> 32 & 0xFFFFFFFF), x, y, path,
        np.empty(count, np.uint32),
    )  # fmt: skip
    return x, y, path


def _uniforms(numbers: ArrayLike, seed: int, stream: int) -> FloatArray:
    """Two uniform deviates for each photon."""
    first, count = _numbers(numbers)
    out = np.empty((count, 2))
    uniforms(
        first, stream, np.uint32(seed & 0xFFFFFFFF), np.uint32(seed >> 32 & 0xFFFFFFFF), out
    )
    return out
