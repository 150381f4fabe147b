"""Base class of both sensors: GalSim's sensor interface on bfsensor's kernels."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import galsim
import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels.photons import Light
from bfsensor.errors import SensorError, SensorTypeError
from bfsensor.sensor.applied_effects import AppliedEffects
from bfsensor.sensor.area_kernels import AreaKernels, Convolution, area_kernels
from bfsensor.sensor.image_exposure import ImageExposure, Physics
from bfsensor.sensor.options import check_flag, check_instance, check_threads, shown
from bfsensor.sensor.pattern_areas import times_pattern_areas
from bfsensor.sensor.shift_maps import ShiftMap, make_pattern, sample_rings
from bfsensor.sensor.threads import count_threads
from bfsensor.typing import FloatArray

_EMPTY = np.zeros(0)
"""Array in place of slopes or wavelengths that photons do not carry (by definition empty)."""

MOST_FLUX = 1e15
"""Largest flux of one photon [e-].  Chosen: ten orders of magnitude above full wells, and far below what
overflows single precision; with 2e15 images of such photons are still finite."""

_BAND = 512 * 512
"""Number of pixels whose areas are computed together, in double precision.

Chosen: 2 MB, a sixteenth of what 4 million pixels would take; twice as large takes twice that."""


class EngineSensor(galsim.SiliconSensor):
    """GalSim's sensor interface on bfsensor's kernels, the base of both sensors.

    A subclass sets the attributes of ``galsim.SiliconSensor`` and defines
    :meth:`_make_physics` and :meth:`_key`.
    """

    _threads: int | None = None
    surroundings: str | float = "none"
    shift_map: ShiftMap | None = None
    _applied: AppliedEffects | None = None
    treering_func: Any
    rng: Any

    # -- for subclasses ----------------------------------------------------------------

    def _make_physics(self) -> tuple[Physics, FloatArray]:
        """Return the sensor for the kernels and the factor of fixed shifts by height."""
        raise NotImplementedError

    def _key(self) -> tuple[Any, ...]:
        """Return the values that equal sensors share, apart from the random generator."""
        raise NotImplementedError

    def _check_charge(self, image: NDArray[np.floating]) -> None:
        """Refuse charge beyond the sensor's range; by default any charge is allowed."""

    def _check_light(self, light: Light) -> None:
        """Warn of light beyond the sensor's range, or refuse it; by default any is allowed."""

    def _change_light(self, light: Light) -> Light:
        """Change light before it enters the silicon."""
        return light

    # -- set up ------------------------------------------------------------------------

    def _init_silicon(self) -> None:
        """Build the parts that are not pickled because they follow from the others."""
        self._physics, self._factor = self._make_physics()
        self._rings = None
        if self._has_rings():
            self._rings = sample_rings(self.treering_func)
            if not np.isfinite(self._rings[0]).all():
                raise SensorError("treering_func holds shifts that are not finite")
        self._kernels: AreaKernels | None = None
        self._exposure: ImageExposure | None = None
        self._last_image = None

    def _has_rings(self) -> bool:
        """Whether the user gave a radial pattern of tree rings."""
        return self.treering_func is not None

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        for name in ("_physics", "_factor", "_rings", "_kernels"):
            state.pop(name, None)
        state["_last_image"] = None
        state["_exposure"] = None
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state
        self._init_silicon()

    def __eq__(self, other: object) -> bool:
        return self is other or (
            type(self) is type(other)
            and self._key() == other._key()
            and self.rng == other.rng
        )

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = None  # type: ignore[assignment]

    def updateRNG(self, rng: galsim.BaseDeviate) -> None:  # noqa: N802
        """Restart the sensor's random generator from another one.

        Parameters
        ----------
        rng : galsim.BaseDeviate
            Source of the new seed.

        Raises
        ------
        SensorError
            Nothing that a generator can be made from, a SensorTypeError by its type.
        """
        with _named_rng(rng):
            self.rng.reset(rng)

    @property
    def threads(self) -> int | None:
        """Largest number of threads of a call; None: as many as ``galsim.get_omp_threads()`` says."""
        return self._threads

    @threads.setter
    def threads(self, threads: int | None) -> None:
        self._threads = check_threads(threads)

    @property
    def diagnostics(self) -> dict[str, float]:
        """Counts since the last call of :meth:`accumulate` without ``resume``; empty before it.

        ``photons``: number of photons; ``spilled``: electrons that spilled along the column
        beyond the full well; ``spilled_off_image``: those of them that left the image;
        ``off_image``: flux that landed beside the image; ``crossed``: flux that crossed the
        silicon without converting; ``lost``: flux that an effect removed where electrons meet
        charge; ``beyond_table``: renewals of a pixel whose charge exceeded both the table and
        the full well, for which the response of the last level was used; ``dropped``: photons
        without flux whose position, slope or wavelength is not finite, which fall nowhere.
        """
        if self._exposure is None:
            return {}
        return self._exposure.diagnostics

    # -- photons -----------------------------------------------------------------------

    def accumulate(
        self,
        photons: galsim.PhotonArray,
        image: galsim.Image,
        orig_center: galsim.PositionI = galsim.PositionI(0, 0),  # noqa: B008
        resume: bool = False,
        recalc: bool = False,
    ) -> float:
        """Collect photons in an image.

        Parameters
        ----------
        photons : galsim.PhotonArray
            Photons with positions [pixel] and flux [e-]; wavelengths [nm] and slopes in the
            silicon are used where they are allocated.
        image : galsim.Image
            Image of float32 or float64 [e-], changed in place; charge that is in it already moves
            the boundaries.
        orig_center : galsim.PositionI
            Position of (0, 0) in original image coordinates, for rings and maps; with ``resume``
            that of the first call holds.
        resume : bool
            Continue with the pixels of the last call, as the same image or a view of them with the
            same bounds; the result is the same bit for bit as that of one call with all photons.
            Values that something else changed in between act where electrons land later, from the
            next renewal there; those of other pixels act only after a call without ``resume``.
        recalc : bool
            With ``resume``: renew the boundaries first.

        Returns
        -------
        added_flux : float
            Flux that was collected in the image [e-].

        Raises
        ------
        galsim.GalSimError
            ``resume`` without a previous call, with other pixels, or with bounds that were moved.
        galsim.GalSimUndefinedBoundsError
            The image has no bounds.
        SensorTypeError
            The image is not of float32 or float64, or an argument has another type.
        SensorError
            Photons with flux, or an image at a call without ``resume``, with values that are not
            finite; photons of negative wavelength.  The image is unchanged after any error.
        """
        resume, recalc = check_flag("resume", resume), check_flag("recalc", recalc)
        check_instance("photons", photons, galsim.PhotonArray, "a galsim.PhotonArray")
        _check_position("orig_center", orig_center)
        if resume:
            self._check_resumed(image)
        array = pixels_of(image)
        light, dropped = _light(photons)
        self._check_light(light)
        if not resume:
            self._check_finite(array)
            self._check_charge(array)
            self._exposure = self._expose(image, array, orig_center)
            self._last_image = image
        assert self._exposure is not None
        self._exposure.threads = count_threads(self.threads, len(photons))
        self._exposure.dropped += dropped
        return self._exposure.add(array, self._change_light(light), renew=resume and recalc)

    def _check_resumed(self, image: galsim.Image) -> None:
        """Refuse to continue with an image whose pixels or place are not those of the last call."""
        if self._last_image is None or self._exposure is None:
            raise galsim.GalSimError(
                "accumulate was called with resume, but not without it before"
            )
        check_instance("image", image, galsim.Image, "a galsim.Image")
        if not _same_pixels(image.array, self._exposure.pixels):
            raise galsim.GalSimError(
                "accumulate was called with resume, but with an image other than that of the "
                "call before"
            )
        if image.bounds != self._exposure.bounds:
            raise galsim.GalSimError(
                f"accumulate was called with resume, but the image was moved: its bounds are "
                f"{image.bounds}, at the call before {self._exposure.bounds}"
            )

    def _expose(
        self,
        image: galsim.Image,
        array: NDArray[np.floating],
        orig_center: galsim.PositionI,
    ) -> ImageExposure:
        """Begin the exposure of an image."""
        origin = (image.bounds.xmin - 0.5, image.bounds.ymin - 0.5)
        # Drawn once an exposure; photons are numbered within it, so that resumed calls
        # continue the same random numbers.
        key = (int(self.rng.raw()) & 0xFFFFFFFF, int(self.rng.raw()) & 0xFFFFFFFF)
        pattern = self._place_pattern(image, orig_center)
        # The last exposure is over, and a stamp of the same size takes its arrays over.
        exposure = self._exposure
        if exposure is None or not exposure.begin_again(
            array, self._physics, pattern, origin, key
        ):
            exposure = ImageExposure(
                array, self._physics, pattern, origin, key, taken=False
            )
        exposure.pixels, exposure.bounds = array, image.bounds
        return exposure

    def _place_pattern(self, image: galsim.Image, orig_center: galsim.PositionI) -> Any:
        """Fixed shifts (rings and map) in the frame of an image."""
        corner = (
            image.bounds.xmin - 0.5 + orig_center.x,
            image.bounds.ymin - 0.5 + orig_center.y,
        )
        centre = (self.treering_center.x, self.treering_center.y)
        return make_pattern(self._rings, centre, self._factor, self.shift_map, corner)

    @staticmethod
    def _check_finite(array: NDArray[np.floating]) -> None:
        """Refuse an image with nan or inf."""
        # The sum of finite numbers may overflow; only then is each one looked at.
        with np.errstate(all="ignore"):
            total = np.add.reduce(array, axis=None)
        if not math.isfinite(total) and not np.isfinite(array).all():
            raise SensorError("the image holds values that are not finite")

    # -- areas -------------------------------------------------------------------------

    def calculate_pixel_areas(
        self,
        image: galsim.Image,
        orig_center: galsim.PositionI = galsim.PositionI(0, 0),  # noqa: B008
        use_flux: bool = True,
    ) -> galsim.Image:
        """Compute the areas of the pixels for photons that convert at the back surface.

        Parameters
        ----------
        image : galsim.Image
            Charge [e-], float32 or float64.
        orig_center : galsim.PositionI
            Position of (0, 0) in original image coordinates.
        use_flux : bool
            Whether the charge moves boundaries; otherwise only rings and maps do.

        Returns
        -------
        areas : galsim.Image
            Areas relative to the nominal area, with the image's bounds and type.

        Raises
        ------
        SensorTypeError
            The image is not of float32 or float64, or an argument has another type.
        SensorError
            An image that holds values that are not finite.
        """
        _check_position("orig_center", orig_center)
        use_flux = check_flag("use_flux", use_flux)
        array = pixels_of(image, write=False)
        self._check_finite(array)
        pattern = self._place_pattern(image, orig_center)
        convolution = None
        if use_flux:
            if self._kernels is None:
                self._kernels = area_kernels(self._physics.edges)
            exposure = ImageExposure(array, self._physics, pattern, (0.0, 0.0), (0, 0))
            outside = float(exposure.ledger.outside[0])
            if self.surroundings == "mirrored":
                outside = math.nan
            convolution = Convolution(self._kernels, exposure.charges, outside)
        areas = np.empty(array.shape, array.dtype)
        # A few rows at a time are in double precision: memory that is touched for the first time takes
        # as long as what is computed in it.
        ny, nx = array.shape
        rows = max(_BAND // nx, 1)
        band = np.empty((min(rows, ny), nx))
        for first in range(0, ny, rows):
            out = band[: min(rows, ny - first)]
            if convolution is None:
                out[...] = 1.0
            else:
                convolution.write(first, out)
            # Electrons meet rings and maps on their way, the charge's shifts above the wells: what
            # lands in a pixel comes from its area as the charge has it, stretched by the pattern.
            moved = pattern._replace(
                ring_y=pattern.ring_y - first, map_0y=pattern.map_0y - first,
                edge_0y=pattern.edge_0y - first,
            )  # fmt: skip
            times_pattern_areas(moved, self._physics.edges, out)
            areas[first : first + len(out)] = out
        if areas.size and not areas.min() > 0:
            y, x = np.unravel_index(int(np.argmin(areas)), areas.shape)
            warnings.warn(
                f"areas: pixel ({x + image.xmin}, {y + image.ymin}) has the area {areas[y, x]:g}: "
                f"charge of {np.abs(array).max():g} e- displaces a boundary beyond the opposite one, "
                "where shifts in proportion to charge mean nothing",
                galsim.GalSimWarning,
                stacklevel=2,
            )
        return galsim.Image(
            areas,
            xmin=image.bounds.xmin,
            ymin=image.bounds.ymin,
            wcs=galsim.PixelScale(1.0),
        )


def pixels_of(image: galsim.Image, *, write: bool = True) -> NDArray[np.floating]:
    """Return the array of an image after checks.

    Parameters
    ----------
    image : galsim.Image
        Image with defined bounds, of float32 or float64.
    write : bool
        Whether the image must be writeable.

    Returns
    -------
    array : ndarray
        The image's own array.

    Raises
    ------
    galsim.GalSimUndefinedBoundsError, galsim.GalSimImmutableError, SensorTypeError
        Undefined bounds; an image that is not writeable; no image, or another type of numbers.
    """
    check_instance("image", image, galsim.Image, "a galsim.Image")
    if not image.bounds.isDefined():
        raise galsim.GalSimUndefinedBoundsError(
            "the image of a sensor must have defined bounds"
        )
    array: NDArray[np.floating] = image.array
    if array.dtype not in (np.float32, np.float64):
        raise SensorTypeError(
            f"the image of a sensor must be float32 or float64, not {array.dtype}"
        )
    if write and image.isconst:
        raise galsim.GalSimImmutableError("the image of a sensor must be writeable", image)
    return array


def make_rng(rng: Any) -> galsim.UniformDeviate:
    """Make a sensor's generator from what GalSim takes; refuse anything else."""
    with _named_rng(rng):
        return galsim.UniformDeviate(rng)


@contextmanager
def _named_rng(rng: Any) -> Iterator[None]:
    """Name the argument where GalSim cannot make a generator from it."""
    try:
        yield
    except (TypeError, ValueError, OverflowError) as error:
        kind = SensorTypeError if isinstance(error, TypeError) else SensorError
        raise kind(
            f"rng = {shown(rng)} must be a galsim.BaseDeviate, a whole number as its seed, or None"
        ) from None


def check_rings(function: Any, centre: Any) -> None:
    """Refuse rings that are no LookupTable and centres that are no PositionD, as GalSim does."""
    if function is not None and not isinstance(function, galsim.LookupTable):
        raise SensorTypeError(
            f"treering_func must be a galsim.LookupTable or None, not {shown(function)}"
        )
    if not isinstance(centre, galsim.PositionD):
        raise SensorTypeError(
            f"treering_center must be a galsim.PositionD, not {shown(centre)}"
        )
    _check_position("treering_center", centre)


def _check_position(name: str, position: Any) -> None:
    """Refuse what is no finite position."""
    check_instance(name, position, galsim.Position, "a finite galsim.Position")
    if not (math.isfinite(position.x) and math.isfinite(position.y)):
        raise SensorError(f"{name} = {shown(position)} must be a finite galsim.Position")


def _same_pixels(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether two arrays are the same numbers at the same places in memory."""
    a, b = one.__array_interface__, other.__array_interface__
    return (
        a["data"][0] == b["data"][0]
        and a["typestr"] == b["typestr"]
        and (one.shape, one.strides) == (other.shape, other.strides)
    )


@np.errstate(all="ignore")
def _light(photons: galsim.PhotonArray) -> tuple[Light, int]:
    """Arrays of photons, and how many were dropped.

    Photons that are not finite are dropped without flux and refused with it.
    """
    has_angles = photons.hasAllocatedAngles()
    arrays = {
        "x": photons.x,
        "y": photons.y,
        "flux": photons.flux,
        "slope_x": photons.dxdz if has_angles else _EMPTY,
        "slope_y": photons.dydz if has_angles else _EMPTY,
        "wavelength": photons.wavelength if photons.hasAllocatedWavelengths() else _EMPTY,
    }
    kept: NDArray[np.bool_] | None = None
    lowest = 0.0
    for name, array in arrays.items():
        arrays[name] = np.ascontiguousarray(array, float)
        # A finite sum means that all are finite, and costs a tenth of looking at each.
        # So does a finite minimum where infinite values are allowed, and the minimum is needed.
        if name == "wavelength":
            total = lowest = arrays[name].min(initial=0.0)
        else:
            total = np.add.reduce(arrays[name])
        if math.isfinite(total):
            continue
        # An infinite wavelength is allowed: such light is not absorbed.
        good = ~np.isnan(array) if name == "wavelength" else np.isfinite(array)
        # GalSim's photon operators mark photons as lost by no flux, such as Refraction at total
        # reflection, whose slope is nan.
        wrong = ~good & (photons.flux != 0)
        if wrong.any():
            first = int(np.argmax(wrong))
            raise SensorError(
                f"photon {first}: {name} = {array[first]} is not a finite number, with flux = "
                f"{photons.flux[first]} ({np.count_nonzero(wrong)} of {len(array)} photons)"
            )
        kept = good if kept is None else kept & good
    flux = arrays["flux"]
    # One product of a vector with itself costs less than a search for its largest value.
    if not float(flux @ flux) < MOST_FLUX**2 and np.abs(flux).max(initial=0.0) > MOST_FLUX:
        first = int(np.argmax(np.abs(flux)))
        raise SensorError(
            f"photon {first}: flux = {flux[first]:g} e- must be at most {MOST_FLUX:g} e-, which no "
            "pixel holds"
        )
    dropped = 0
    if kept is not None:
        dropped = int(np.count_nonzero(~kept))
        arrays = {name: a[kept] if a.size else a for name, a in arrays.items()}
        lowest = arrays["wavelength"].min(initial=0.0)
    if lowest < 0:
        wrong = (photons.wavelength < 0) & (photons.flux != 0)
        if wrong.any():
            first = int(np.argmax(wrong))
            raise SensorError(
                f"photon {first}: wavelength = {photons.wavelength[first]} nm must not be negative "
                f"({np.count_nonzero(wrong)} of {len(photons)} photons)"
            )
    return Light(**arrays), dropped


def read_numbers(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a configuration of ``key = value`` lines.

    Parameters
    ----------
    path : path-like
        A .cfg file.

    Returns
    -------
    values : dict
        Values by key: int or float where the text is a number, otherwise the text without quotes.
    """
    from bfsensor.device.poisson_ccd import read_configuration

    out: dict[str, Any] = {}
    for key, text in read_configuration(path).items():
        out[key] = _number(text)
    return out


def _number(text: str) -> Any:
    """Convert a text to int or float, or strip its quotes."""
    try:
        number = float(text)
        # A whole number of hundreds of digits is no float.
        return (
            int(text) if math.isfinite(number) and text.lstrip("+-").isdecimal() else number
        )
    except ValueError:
        pass
    return text.strip("'\"")
