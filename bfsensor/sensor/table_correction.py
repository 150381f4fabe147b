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

import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import galsim
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from bfsensor._kernels import correction as kernels
from bfsensor.device.silicon import absorption_length
from bfsensor.errors import MeasurementError, SensorError
from bfsensor.measure.arrays import to_floats
from bfsensor.response.light import conversion_weights
from bfsensor.sensor.charge_response import EffectiveCharge, factor_table
from bfsensor.sensor.options import (
    check_surroundings,
    check_table,
    check_threads,
    check_word,
    find_table,
    load_table,
    outside_charge,
    read_device,
    shown,
)
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray

PASSES = 2
"""Number of times that the light is found from the charge, always the same.

Measured on stars of 120,000 e- in the peak: the first pass takes off 0.2 to 0.6 % of their growth
too much, which the second gives back; a third changes less than 0.02 %, and four take twice the time."""

STENCIL = 20
"""Pixels across a boundary whose charges give the light on it.

Measured on Gaussians with a sigma of 0.95 pixel, which is a FWHM of 2 pixels with diffusion: light that
crosses boundaries comes out 1.4 % too large with 8 pixels, 0.7 % with 12, 0.4 % with 20, 0.3 % with 24,
as the mean over places within a pixel; with a sigma of 1.3 pixel 0.1 % with 12.  Twice as many take a
fifth more time and ring around single bright pixels."""

TIMES = 2
"""Parts of an exposure at which effective charges are taken (Gauss and Legendre's).

Derived: they are exact for what grows as the third power of the time; charges that shift boundaries grow
as the first and, by the change of the response, the second."""

BAND = 256
"""Rows that are corrected together.

Chosen: with their surroundings they take 15 arrays of 1.3 million numbers, 80 MB, in a sensor of 4096
columns; twice as many take twice the memory and a tenth less time."""

MASK_REACH = 64
"""Largest distance [pixel] at which a good pixel suggests the light in a masked one.

Chosen: wider than bled columns and cosmic rays; beyond it masked pixels hold no light, and with twice as
much a masked quarter of a sensor takes twice the time."""

_FACTORED: list[tuple[DistortionTable, bool, bool, EffectiveCharge]] = []
"""Factors of the last tables by their options, latest first: they take a second."""

_MOST_FACTORED = 4
"""Number of tables whose factors are kept.  Chosen: tables of two devices with and without their level;
twice as many take 30 MB more."""

Single = NDArray[np.float32]
"""Field of single precision, in which light and shifts are computed: 0.01 e- in a full pixel."""


class _Patterns:
    """Patterns of shifts around one charge, by mode, as convolutions; single precision serves."""

    def __init__(self, patterns: list[tuple[FloatArray, ...]]) -> None:
        self._patterns = patterns
        self.reach = (patterns[0][0].shape[0] - 1) // 2
        self._transforms: dict[tuple[int, int], list[list[NDArray[np.complex64]]]] = {}

    def convolved(self, charges: Single) -> Iterator[Single]:
        """Sum the patterns around all charges (modes, y, x), one after another.

        Within the reach of the borders they hold charges from the opposite ones.
        """
        _, ny, nx = charges.shape
        shape = fft.next_fast_len(ny, real=True), fft.next_fast_len(nx, real=True)
        # Two threads may both compute the same transforms: no harm.
        if shape not in self._transforms:
            self._transforms[shape] = [
                [self._transformed(p, shape) for p in m] for m in self._patterns
            ]
        spectra = [fft.rfft2(charges[n], shape) for n in range(len(self._patterns))]
        for parts in zip(*self._transforms[shape], strict=True):
            whole = spectra[0] * parts[0]
            for spectrum, part in zip(spectra[1:], parts[1:], strict=True):
                whole += spectrum * part
            yield fft.irfft2(whole, shape, overwrite_x=True)[:ny, :nx]

    def _transformed(
        self, pattern: FloatArray, shape: tuple[int, int]
    ) -> NDArray[np.complex64]:
        whole = np.zeros(shape, np.float32)
        rows, columns = (np.arange(n) - self.reach for n in pattern.shape)
        np.add.at(whole, np.ix_(rows % shape[0], columns % shape[1]), pattern)
        return np.asarray(fft.rfft2(whole))


@dataclass(frozen=True, eq=False)
class _Scene:
    """An image and what its masked pixels stand for.

    ``charge`` is what moves boundaries, ``light`` what falls on them: both are the image but for masked
    pixels, and None without any.
    """

    image: NDArray[Any]
    charge: Single | None
    light: Single | None
    surroundings: float | str

    def field(self, source: NDArray[Any], rows: slice, margin: int) -> Single:
        """Rows of an array with a margin of what lies beyond them, or beyond the image."""
        first, last, size = rows.start - margin, rows.stop + margin, len(source)
        wide = ((margin, margin),)
        if self.surroundings == "mirrored":
            if first >= 0 and last <= size:
                part = np.asarray(source[first:last], np.float32)
            else:
                at = np.arange(first, last) % (2 * size)
                part = np.asarray(
                    source[np.where(at < size, at, 2 * size - 1 - at)], np.float32
                )
            return np.pad(part, ((0, 0), *wide), mode="symmetric")
        part = np.asarray(source[max(first, 0) : min(last, size)], np.float32)
        beyond = max(-first, 0), max(last - size, 0)
        return np.pad(
            part, (beyond, *wide), constant_values=outside_charge(self.surroundings)
        )


def correct_table(
    image: ArrayLike,
    table: DistortionTable | str,
    *,
    mask: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    photons: ArrayLike | None = None,
    temperature: float | None = None,
    surroundings: float | str = "mirrored",
    charge_response: bool = True,
    background: bool = True,
    beyond: str = "hold",
    threads: int = 1,
    out: NDArray[Any] | None = None,
) -> NDArray[Any]:
    """Take the brighter-fatter effect out of an image, with a whole distortion table.

    The number of operations depends on the size of the image alone.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Charge of one exposure without bias, with its sky [e-]; numbers of any real type, both sides 2
        or more.  Pixels that are not finite, or hidden in a masked array, count as masked, and their
        charge as unknown.
    table : DistortionTable or str
        Table, its .fits file, or the name of a built-in device.
    mask : array_like of bool, shape (ny, nx), optional
        True for pixels whose charge light did not bring in this place, or not all of it: saturated and
        bled ones, bad columns, cosmic rays.  Their charge moves boundaries; as the light in them counts
        what the nearest good pixels of their row and column suggest, so that what they hold does not
        spread.
    wavelengths, photons : array_like, shape (n,), optional
        Wavelengths of the light [nm] and how many photons that enter the silicon have each, by default
        equally many; without wavelengths light converts at the back surface.
    temperature : float, optional
        Temperature of the silicon [K], for the depth in which light is absorbed; by default the
        device's.
    surroundings : float, 'none' or 'mirrored'
        Charge of the pixels beyond the image [e-], none, or that of those inside.  No light crosses the
        border of the image.
    charge_response, background : bool
        Whether the response depends on the charge of a pixel and on that around it, as in
        :class:`~bfsensor.BrighterFatterSensor`.
    beyond : {'hold', 'error'}
        Behaviour where pixels that are not masked hold more charge than the table, or have more around
        them: the response of the last level and a warning, or an error.
    threads : int
        Threads, 1 or more, which correct bands of the image side by side; the result does not depend
        on their number.
    out : ndarray, shape (ny, nx), optional
        Array to write to, such as a memory map; of single precision, electrons are conserved to 1e-7.
        Where the image is a memory map as well, only bands of it are held in memory.

    Returns
    -------
    corrected : ndarray, shape (ny, nx)
        Charge as it would have been collected without the effect [e-], double precision or ``out``; its
        sum is that of the image to round-off.  Not finite where the image is not.

    Raises
    ------
    MeasurementError
        The image is not two-dimensional or holds no good pixel; mask or ``out`` has another shape.
    SensorError
        A surrounding charge, ``beyond`` or ``threads`` is none of the above; wavelengths and photons do
        not belong together; the table holds no device and no temperature is given; with
        ``beyond='error'``, pixels lie beyond the table.

    Notes
    -----
    Charges below 0 respond like 0.  Between masked and good pixels as much light crosses as the boundary
    between them swept: masked pixels change too, but for those that are not finite.  A charge that is
    unknown counts as the light that its neighbours suggest.

    Examples
    --------
    >>> star = 9e4 * np.exp(-0.5 * np.hypot(*np.indices((41, 41)) - 20) ** 2 / 1.5**2)
    >>> corrected = correct_table(star, "itl_sta3800c", surroundings=0.0)
    >>> bool(corrected[20, 20] > star[20, 20]), bool(abs(corrected.sum() - star.sum()) < 1e-4)
    (True, True)
    """
    given = _checked(image)
    around = check_surroundings(surroundings)
    check_word("beyond", beyond, ("hold", "error"))
    workers = check_threads(threads) or 1
    table = load_table(*find_table(table)) if isinstance(table, str) else check_table(table)
    if temperature is None:
        temperature = read_device(table, "the correction").operating_point.temperature
    factors = _factored(table, charge_response, background)
    weights = _weights(factors, table, wavelengths, photons, temperature)
    patterns = _Patterns(
        [_patterns(sides, factors.points, weights) for sides in factors.modes]
    )
    bad = _masked(given, mask)
    scene = _Scene(given, *_without_masked(given, bad), around)
    if charge_response:
        _check_beyond(scene, bad, table, beyond, background=background)
    if out is None:
        out = np.empty(given.shape)
    elif out.shape != given.shape:
        raise MeasurementError(f"out has the shape {out.shape}, not {given.shape}")
    work = _bands(scene, factors, patterns, out)
    tops = range(0, len(given), BAND)
    if workers == 1:
        for top in tops:
            work(top)
    else:
        with ThreadPoolExecutor(workers) as executor:
            list(executor.map(work, tops))
    return out


def _factored(
    table: DistortionTable, charge_response: bool, background: bool
) -> EffectiveCharge:
    """Factors of a table, kept for the next image; large tables are compared by identity."""
    for entry in list(_FACTORED):
        if entry[0] is table and entry[1:3] == (charge_response, background):
            return entry[3]
    made = factor_table(table, linear=not charge_response, background=background)
    _FACTORED.insert(0, (table, charge_response, background, made))
    del _FACTORED[_MOST_FACTORED:]
    return made


def _checked(image: ArrayLike) -> NDArray[Any]:
    """Image as an array of real numbers with two sides, not copied if it is one."""
    plain = isinstance(image, np.ndarray) and not isinstance(image, np.ma.MaskedArray)
    array = np.asarray(image) if plain else to_floats(image, "image")
    if array.dtype.kind not in "iuf":
        array = to_floats(array, "image")
    if array.ndim != 2 or min(array.shape) < 2:
        raise MeasurementError(
            f"image of shape {array.shape} must have two sides of 2 pixels or more"
        )
    return array


def _masked(image: NDArray[Any], mask: ArrayLike | None) -> NDArray[np.bool_] | None:
    """Pixels that are masked or not finite; None if there are none."""
    bad = np.zeros(image.shape, bool)
    if mask is not None:
        given = np.asarray(mask)
        if given.shape != image.shape:
            raise MeasurementError(f"mask has the shape {given.shape}, not {image.shape}")
        bad |= given.astype(bool)
    if image.dtype.kind == "f":
        for top in range(0, len(image), BAND):
            bad[top : top + BAND] |= ~np.isfinite(image[top : top + BAND])
    if bad.all():
        raise MeasurementError(
            f"image of {image.shape[0]} x {image.shape[1]} pixels has none that is finite and not "
            "masked"
        )
    return bad if bad.any() else None


def _without_masked(
    image: NDArray[Any], bad: NDArray[np.bool_] | None
) -> tuple[Single | None, Single | None]:
    """Charge and light of an image with masked pixels; None for both without any."""
    if bad is None:
        return None, None
    light = image.astype(np.float32)
    kernels.fill_masked(light, bad, MASK_REACH, light)
    known = np.isfinite(image)
    return np.where(known, image, light).astype(np.float32), light


def _check_beyond(
    scene: _Scene,
    bad: NDArray[np.bool_] | None,
    table: DistortionTable,
    beyond: str,
    *,
    background: bool,
) -> None:
    """Warn of good pixels beyond the table, or refuse them."""
    if len(table.charges) == 1:
        return
    # A table of one background does not depend on it.
    most, most_around = float(table.charges[-1]), float(table.backgrounds[-1])
    background = background and len(table.backgrounds) > 1
    count = 0
    for top in range(0, len(scene.image), BAND):
        rows = slice(top, min(top + BAND, len(scene.image)))
        source = scene.image if scene.charge is None else scene.charge
        charge = source[rows]
        if not np.max(charge) > (min(most, most_around) if background else most):
            continue
        out = charge > most
        if background:
            wide = scene.field(source, rows, 1)
            sums = wide[:-2] + wide[1:-1] + wide[2:]
            ring = sums[:, :-2] + sums[:, 1:-1] + sums[:, 2:] - wide[1:-1, 1:-1]
            out |= ring > 8 * most_around
        count += int(np.count_nonzero(out if bad is None else out & ~bad[rows]))
    if not count:
        return
    text = f"{count} pixels hold more charge than the table, which ends at {most:.0f} e-"
    if background:
        text += f", or have more around them than its last background, {most_around:.0f} e-"
    if beyond == "error":
        raise SensorError(f"{text}: mask them, or take a table with higher charges")
    warnings.warn(
        f"{text}: the response of the last level is used (beyond='error' refuses)",
        galsim.GalSimWarning,
        stacklevel=3,
    )


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
    # What crosses the silicon makes no charge: of red light the charge is bluer than the photons.
    lengths = np.asarray(absorption_length(colours, temperature), float)
    shares = -counts * np.expm1(-table.thickness / lengths)
    if not shares.sum() > 1e-6 * counts.sum():
        raise SensorError(
            f"wavelengths = {shown(colours.tolist())} nm: none of this light converts in the silicon"
        )
    return np.asarray(shares @ np.array(each) / shares.sum())


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


def _bands(
    scene: _Scene, factors: EffectiveCharge, patterns: _Patterns, out: NDArray[Any]
) -> Callable[[int], None]:
    """Make the function that corrects the rows from one on, in its own arrays."""
    response = factors.response
    times, parts = np.polynomial.legendre.leggauss(TIMES)
    times, parts = 0.5 * (times + 1), 0.5 * parts
    values, slopes = _stencils()
    margin = PASSES * (patterns.reach + STENCIL // 2 + 2)
    ny, nx = scene.image.shape

    def correct(top: int) -> None:
        rows = slice(top, min(top + BAND, ny))
        charge = scene.field(
            scene.image if scene.charge is None else scene.charge, rows, margin
        )
        # In masked pixels this light counts in every pass.
        fixed = None if scene.light is None else scene.field(scene.light, rows, margin)
        given, light = charge, charge
        inside = (margin - top, margin - top + ny), (margin, margin + nx)
        charges = np.zeros((1 + kernels.NEAR_MODES, *charge.shape), np.float32)
        on, across = (np.empty((2, *charge.shape), np.float32) for _ in range(2))
        corners = np.empty_like(charge)
        moved = np.empty((2, *charge.shape), np.float32)
        for n in range(PASSES):
            kernels.mean_charges(
                light, charge, response.first, response.near, response.charge_step,
                response.background_step, times, parts, charges,
            )  # fmt: skip
            bright = light if fixed is None else np.where(fixed == given, light, fixed)
            kernels.light_on_boundaries(bright, values, slopes, on, across, corners)
            shifts = list(patterns.convolved(charges))
            for k in (0, 1):  # left boundaries, and lower ones
                kernels.moved_light(
                    shifts[k], shifts[2 + k], shifts[4 + k], shifts[5 - k], on[k], across[k],
                    corners, k == 0, moved[k],
                )  # fmt: skip
                _close(moved[k], 1 - k, inside[1 - k])
            if n < PASSES - 1:
                light = np.empty_like(charge)
                kernels.give_back(charge, moved[0], moved[1], 0, 0, light)
        found = np.empty((rows.stop - top, nx))
        kernels.give_back(
            np.asarray(scene.image[rows], float), moved[0], moved[1], margin, margin, found
        )
        out[rows] = found

    return correct


def _close(moved: Single, axis: int, inside: tuple[int, int]) -> None:
    """Let no light cross the borders of the image, in place."""
    for border in inside:
        if 0 <= border < moved.shape[axis]:
            np.moveaxis(moved, axis, 0)[border] = 0.0


def _stencils() -> tuple[FloatArray, FloatArray]:
    """Weights of the pixels above or right of a boundary for the light on it, and for its change across.

    The polynomial's integral over each pixel is the charge in it.  Pixels on the other side have the
    same weights, and the opposite ones.
    """
    edge = np.arange(STENCIL + 1.0) - STENCIL // 2
    power = np.arange(1, STENCIL + 1)
    integrals = (edge[1:, None] ** power - edge[:-1, None] ** power) / power
    inverse = np.linalg.inv(integrals)
    above = np.asarray(inverse[:, STENCIL // 2 :], float)
    return above[0].copy(), above[1].copy()
