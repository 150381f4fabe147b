r"""Correction of images with a whole distortion table: any charge, background and colour.

While a pixel fills, the charge in it and around it shifts boundaries, and what falls on the silicon
between a boundary's old and new place is collected in the neighbour.  With the electrons that have
come down per unit of area, :math:`\ell`, and the mean shift :math:`s` of a boundary over the exposure,
the light that crossed it is

.. math::

    \delta = \langle s \rangle \ell + \tfrac23 \langle s \rangle^2 \ell' + \tfrac12 s_1 \Delta \ell
        + \tfrac43 \ell\, [\langle s \rangle\, \Delta \tau - \tfrac12 \Delta (s_c \tau)],

with the change :math:`\ell'` of the light across the boundary, its change :math:`\Delta \ell` along it,
which goes with the first Legendre moment :math:`s_1` of the shift, and the shifts :math:`s_c` across and
:math:`\tau` along it of the corners: the boundary that sweeps is longer or shorter than a pixel, and
areas of polygons are of second order.

Shifts are those of :class:`~bfsensor.BrighterFatterSensor`: two patterns times effective charges, which
depend on a pixel's charge and on that around it, here averaged over the exposure.  Light between the
centres of pixels is the polynomial through the charges of :data:`STENCIL` of them, so that stars of two
pixels are right.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.ndimage import correlate1d

from bfsensor._kernels import correction as kernels
from bfsensor.errors import SensorError
from bfsensor.measure.arrays import to_floats
from bfsensor.measure.correct import check_image
from bfsensor.response.light import conversion_weights
from bfsensor.sensor.charge_response import EffectiveCharge, factor_table
from bfsensor.sensor.options import check_surroundings, outside_charge, read_device
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray

PASSES = 2
"""Number of times that the light is found from the charge, always the same.

Measured on stars of 120,000 e- in the peak: the first pass takes off 0.2 to 0.6 % of their growth
too much, which the second gives back; a third changes less than 0.02 %, and four take twice the time."""

STENCIL = 12
"""Pixels across a boundary whose charges give the light on it.

Measured on stars of a FWHM of 2 pixels, beside 12: with 6 pixels another 2 % of their growth is taken
off, with 8 0.8 %, with 10 0.3 %; wider stars need 8.  Twice as many ring around single bright pixels."""

TIMES = 2
"""Parts of an exposure at which effective charges are taken (Gauss and Legendre's).

Derived: they are exact for what grows as the third power of the time; charges that shift boundaries grow
as the first and, by the change of the response, the second."""

BAND = 512
"""Rows that are corrected together.

Chosen: with their surroundings they take 12 arrays of 2.3 million numbers, 0.2 GB, in a sensor of 4096
columns; twice as many take twice the memory and hardly less time."""


class _Patterns:
    """Patterns of shifts around one charge, by mode, as convolutions; single precision serves."""

    def __init__(self, patterns: list[tuple[FloatArray, ...]]) -> None:
        self._patterns = patterns
        self.reach = (patterns[0][0].shape[0] - 1) // 2
        self._shape = 0, 0
        self._transforms: list[list[NDArray[np.complex64]]] = []

    def convolved(
        self, charges: NDArray[np.float32], workers: int
    ) -> Iterator[NDArray[np.float32]]:
        """Sum the patterns around all charges (modes, y, x), one after another.

        Within the reach of the borders they hold charges from the opposite ones.
        """
        _, ny, nx = charges.shape
        shape = fft.next_fast_len(ny, real=True), fft.next_fast_len(nx, real=True)
        if shape != self._shape:
            self._shape = shape
            self._transforms = [[self._transformed(p) for p in m] for m in self._patterns]
        spectra = [
            fft.rfft2(charges[n], shape, workers=workers)
            for n in range(len(self._patterns))
        ]
        for parts in zip(*self._transforms, strict=True):
            whole = spectra[0] * parts[0]
            for spectrum, part in zip(spectra[1:], parts[1:], strict=True):
                whole += spectrum * part
            yield fft.irfft2(whole, shape, workers=workers, overwrite_x=True)[:ny, :nx]

    def _transformed(self, pattern: FloatArray) -> NDArray[np.complex64]:
        whole = np.zeros(self._shape, np.float32)
        rows, columns = (np.arange(n) - self.reach for n in pattern.shape)
        whole[np.ix_(rows % self._shape[0], columns % self._shape[1])] = pattern
        return np.asarray(fft.rfft2(whole))


def correct_table(
    image: ArrayLike,
    table: DistortionTable | str,
    *,
    wavelengths: ArrayLike | None = None,
    photons: ArrayLike | None = None,
    temperature: float | None = None,
    surroundings: float | str = "mirrored",
    charge_response: bool = True,
    background: bool = True,
    threads: int = 1,
) -> FloatArray:
    """Take the brighter-fatter effect out of an image, with a whole distortion table.

    The number of operations depends on the size of the image alone.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Charge of one exposure without bias [e-], every pixel finite, both sides 2 or more.
    table : DistortionTable or str
        Table, or the name of a built-in device.
    wavelengths, photons : array_like, shape (n,), optional
        Wavelengths of the light [nm] and how many photons have each, by default equally many; without
        wavelengths light converts at the back surface.
    temperature : float, optional
        Temperature of the silicon [K], for the depth in which light is absorbed; by default the
        device's.
    surroundings : float, 'none' or 'mirrored'
        Charge of the pixels beyond the image [e-], none, or that of those inside.  No light crosses the
        border of the image.
    charge_response, background : bool
        Whether the response depends on the charge of a pixel and on that around it, as in
        :class:`~bfsensor.BrighterFatterSensor`.
    threads : int
        Threads of the convolutions, 1 or more; 4096 x 4096 pixels take 8 CPU s and 1.2 GB.

    Returns
    -------
    corrected : ndarray, shape (ny, nx)
        Charge as it would have been collected without the effect [e-]; its sum is that of the image to
        round-off.

    Raises
    ------
    MeasurementError
        The image is not two-dimensional or holds values that are not finite.
    SensorError
        The surroundings are none of the above; wavelengths and photons do not belong together; the
        table holds no device and no temperature is given.

    Notes
    -----
    Beyond the table's charges and backgrounds, or its full well, the last response is held; charges
    below 0 respond like 0.  Charge that blooming moved, or that cosmic rays left, is taken for light:
    there the correction is that of a star in its place.

    Examples
    --------
    >>> star = 9e4 * np.exp(-0.5 * np.hypot(*np.indices((41, 41)) - 20) ** 2 / 1.5**2)
    >>> corrected = correct_table(star, "itl_sta3800c", surroundings=0.0)
    >>> bool(corrected[20, 20] > star[20, 20]), bool(abs(corrected.sum() - star.sum()) < 1e-4)
    (True, True)
    """
    given = check_image(image)
    around = check_surroundings(surroundings)
    if isinstance(table, str):
        table = DistortionTable.load(table)
    if temperature is None:
        temperature = read_device(table, "the correction").operating_point.temperature
    factors = factor_table(table, linear=not charge_response, background=background)
    weights = _weights(factors, table, wavelengths, photons, temperature)
    patterns = _Patterns(
        [
            _patterns(sides, factors.points, weights)
            for sides in (factors.first, factors.second)
            if sides is not None
        ]
    )
    margin = PASSES * (patterns.reach + STENCIL // 2 + 2)
    padded = _padded(given, margin, around)
    out = np.empty_like(given)
    for top in range(0, len(given), BAND):
        rows = slice(top, min(top + BAND, len(given)))
        field = padded[rows.start : rows.stop + 2 * margin]
        edges = (margin - rows.start, margin - rows.start + len(given))
        inside = (*edges, margin, margin + given.shape[1])
        found = _corrected(field, factors, patterns, inside, threads)
        out[rows] = found[margin : len(field) - margin, margin:-margin]
    return out


def _weights(
    factors: EffectiveCharge,
    table: DistortionTable,
    wavelengths: ArrayLike | None,
    photons: ArrayLike | None,
    temperature: float,
) -> FloatArray:
    """Weights of the layers in which light converts; without wavelengths that of the topmost."""
    heights = np.asarray(factors.heights, float)
    if wavelengths is None:
        if photons is not None:
            raise SensorError("photons need wavelengths")
        return np.eye(len(heights))[-1]
    colours = np.atleast_1d(to_floats(wavelengths, "wavelengths"))
    counts = np.ones(len(colours)) if photons is None else to_floats(photons, "photons")
    if counts.shape != colours.shape or colours.ndim != 1:
        raise SensorError(
            f"wavelengths and photons have the shapes {colours.shape} and {counts.shape}, not (n,) "
            "both"
        )
    if not (np.all(counts >= 0) and counts.sum() > 0 and np.all(np.isfinite(counts))):
        raise SensorError("photons must be finite, none below 0 and some above")
    each = [
        conversion_weights(heights, w, temperature, thickness=table.thickness)
        for w in colours.tolist()
    ]
    return np.asarray(counts @ np.array(each) / counts.sum())


def _patterns(
    sides: tuple[FloatArray, FloatArray], points: FloatArray, weights: FloatArray
) -> tuple[FloatArray, ...]:
    """Shifts around a charge: means and tilts of left and lower boundaries, corners in x and y."""
    upright, flat = (np.tensordot(weights, side, 1) for side in sides)
    width, u = np.diff(points), 2 * points - 1
    middle = 0.5 * (u[1:] + u[:-1])
    mean, tilt = np.zeros((2, len(points)))
    mean[:-1] += 0.5 * width
    mean[1:] += 0.5 * width
    # Shifts are linear between points: Simpson's rule is exact for them times another line.
    tilt[:-1] += width / 6 * (u[:-1] + 2 * middle)
    tilt[1:] += width / 6 * (u[1:] + 2 * middle)
    corners = np.concatenate([upright[:, :, 0], upright[-1:, :, -1]])
    return (
        upright[..., 0] @ mean, flat[..., 1] @ mean, upright[..., 0] @ tilt, flat[..., 1] @ tilt,
        corners[..., 0], corners[..., 1],
    )  # fmt: skip


def _padded(image: FloatArray, margin: int, surroundings: float | str) -> FloatArray:
    """Image with a margin of the charge beyond it."""
    if surroundings == "mirrored":
        return np.pad(image, margin, mode="symmetric")
    return np.pad(image, margin, constant_values=outside_charge(surroundings))


def _corrected(
    image: FloatArray,
    factors: EffectiveCharge,
    patterns: _Patterns,
    inside: tuple[int, int, int, int],
    workers: int,
) -> FloatArray:
    """Correct a field; no light crosses the borders of the image, rows and columns ``inside``."""
    response = factors.response
    times, weights = np.polynomial.legendre.leggauss(TIMES)
    charges = np.zeros((2, *image.shape), np.float32)
    light = image
    for _ in range(PASSES):
        kernels.mean_charges(
            light, image, response.first, response.second, response.charge_step,
            response.background_step, 0.5 * (times + 1), 0.5 * weights, charges,
        )  # fmt: skip
        shifts = list(patterns.convolved(charges, workers))
        means, tilts, corners = (shifts[2 * n : 2 * n + 2] for n in range(3))
        gain = np.zeros_like(image)
        moved = np.empty_like(image)
        for k, across in ((0, 1), (1, 0)):  # left boundaries, and lower ones
            value, slope = (_on_boundaries(light, w, across) for w in _stencils())
            ends = _on_boundaries(value, _stencils()[0], 1 - across)
            kernels.moved_light(
                means[k], tilts[k], corners[k], corners[1 - k], value, slope, ends, k == 0, moved,
            )  # fmt: skip
            _close(moved, across, inside)
            gain -= moved
            if across == 1:
                gain[:, :-1] += moved[:, 1:]
            else:
                gain[:-1] += moved[1:]
        light = image - gain
    return light


def _close(moved: FloatArray, axis: int, inside: tuple[int, int, int, int]) -> None:
    """Let no light cross the borders of the image, in place."""
    for border in inside[:2] if axis == 0 else inside[2:]:
        if 0 <= border < moved.shape[axis]:
            np.moveaxis(moved, axis, 0)[border] = 0.0


def _stencils() -> tuple[FloatArray, FloatArray]:
    """Weights of the pixels around a boundary for the light on it, and for its change across it.

    The polynomial's integral over each pixel is the charge in it.
    """
    edge = np.arange(STENCIL + 1.0) - STENCIL // 2
    power = np.arange(1, STENCIL + 1)
    integrals = (edge[1:, None] ** power - edge[:-1, None] ** power) / power
    inverse = np.linalg.inv(integrals)
    return inverse[0], inverse[1]


def _on_boundaries(field: FloatArray, weights: FloatArray, axis: int) -> FloatArray:
    """Sum of the fields around the left or lower boundaries; beyond the ends the last one counts."""
    return np.asarray(correlate1d(field, weights, axis=axis, mode="nearest"))
