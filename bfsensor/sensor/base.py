"""What both sensors share: GalSim's calls, on our engine."""

from __future__ import annotations

import os
from typing import Any

import galsim
import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels.areas import convolved_areas, pixel_areas, times_ring_areas
from bfsensor._kernels.photons import Light, Pattern
from bfsensor._kernels.shifts import Charges
from bfsensor.errors import SensorError
from bfsensor.sensor.applied_effects import AppliedEffects
from bfsensor.sensor.area_kernels import AreaKernels, area_kernels
from bfsensor.sensor.image_exposure import ImageExposure, Physics
from bfsensor.sensor.shift_maps import ShiftMap, make_pattern, sample_rings
from bfsensor.typing import FloatArray

_EMPTY = np.zeros(0)
_LARGE = 512 * 512
_SMALL_AREA = 2e-8
"""Kernels are left out that matter less [nominal area]; single precision ends at 6e-8."""
_RING_AREA = 1e-6
"""Largest error of an area [nominal area] by two points a side; above it polygons are drawn.  Chosen: a
hundredth of the photon noise of 1e8 electrons; rings of 0.26 pixel a period of 47 leave 4e-8."""
_FROM_CENTRE = 30.0
"""Distance of the rings' centre from an image [pixel] from which a pixel's area follows from the mean
shifts of its sides.  Derived: with the shift g by radius the stretches across and along the rings vary
together within a pixel by g' g'' / (12 distance), 5e-7 for rings of 0.26 pixel a period of 47; at twice
the distance half of that."""


class EngineSensor(galsim.SiliconSensor):
    """GalSim's sensor calls on bfsensor's engine; see the two sensors made of it.

    A subclass sets the attributes of ``galsim.SiliconSensor`` and gives
    :meth:`_make_physics` and :meth:`_key`.
    """

    threads: int = 1
    shift_map: ShiftMap | None = None
    _applied: AppliedEffects | None = None
    treering_func: Any
    rng: Any

    # -- what a subclass gives ---------------------------------------------------------

    def _make_physics(self) -> tuple[Physics, FloatArray]:
        """Give the sensor for the engine and the factor of fixed shifts by height."""
        raise NotImplementedError

    def _key(self) -> tuple[Any, ...]:
        """Give what tells one sensor from another, apart from the generator."""
        raise NotImplementedError

    def _check_charge(self, image: NDArray[np.floating]) -> None:
        """Refuse charge that the sensor was told to refuse."""

    def _change_light(self, light: Light) -> Light:
        """Change light before it enters the silicon."""
        return light

    # -- set up ------------------------------------------------------------------------

    def _init_silicon(self) -> None:
        """Build what is not pickled."""
        self._physics, self._factor = self._make_physics()
        self._rings = None
        if self._has_rings():
            self._rings = sample_rings(self.treering_func)
        self._kernels: AreaKernels | None = None
        self._exposure: ImageExposure | None = None
        self._last_image = None

    def _has_rings(self) -> bool:
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
        """Restart the sensor's generator from another one."""
        self.rng.reset(rng)

    @property
    def diagnostics(self) -> dict[str, float]:
        """What happened since the last call of :meth:`accumulate` without ``resume``.

        ``photons``: their number; ``spilled`` electrons beyond the full well,
        ``spilled_off_image`` those of them that left along the column; ``off_image``: flux
        beside the image; ``crossed``: flux that crossed the silicon unconverted;
        ``lost``: flux that an effect takes from where charge is;
        ``beyond_table``: renewals of a pixel with more charge than table and full well
        reach, for which the response of the last level was held.
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
            Positions [pixel], flux [e-]; wavelengths [nm] and slopes in the silicon count
            where they are allocated.
        image : galsim.Image
            float32 or float64 [e-]; the charge in it acts.
        orig_center : galsim.PositionI
            Position of (0, 0) in original image coordinates, for rings and maps.
        resume : bool
            Go on with the image of the last call: the same bits as one call with all
            photons.
        recalc : bool
            With ``resume``: renew the boundaries first.

        Returns
        -------
        added_flux : float
            Flux that stays in the image.

        Raises
        ------
        galsim.GalSimError
            ``resume`` without a previous call, or with another image.
        galsim.GalSimUndefinedBoundsError
            The image has no bounds.
        TypeError
            An image of integers.
        SensorError
            Photons that are not finite.  The image is unchanged after any error.
        """
        if resume:
            if self._last_image is None or self._exposure is None:
                raise galsim.GalSimError(
                    "accumulate was called with resume, but not without it before"
                )
            if image is not self._last_image:
                raise galsim.GalSimError(
                    "accumulate was called with resume, but with an image other than that of "
                    "the call before"
                )
        array = pixels_of(image)
        light = _light(photons)
        if resume and array.shape != (self._exposure.charges.ny, self._exposure.charges.nx):
            raise galsim.GalSimError(
                "accumulate was called with resume, but the image has another shape now"
            )
        if not resume:
            self._check_finite(array)
            self._check_charge(array)
            self._exposure = self._expose(image, array, orig_center)
            self._last_image = image
        assert self._exposure is not None
        if resume and recalc:
            self._exposure.renew(array)
        return self._exposure.add(array, self._change_light(light))

    def _expose(
        self,
        image: galsim.Image,
        array: NDArray[np.floating],
        orig_center: galsim.PositionI,
    ) -> ImageExposure:
        origin = (image.bounds.xmin - 0.5, image.bounds.ymin - 0.5)
        # Drawn once an exposure: chunks of photons continue by count.
        key = (int(self.rng.raw()) & 0xFFFFFFFF, int(self.rng.raw()) & 0xFFFFFFFF)
        return ImageExposure(
            array, self._physics, self._place_pattern(image, orig_center), origin, key,
            self.threads,
        )  # fmt: skip

    def _place_pattern(self, image: galsim.Image, orig_center: galsim.PositionI) -> Any:
        corner = (
            image.bounds.xmin - 0.5 + orig_center.x,
            image.bounds.ymin - 0.5 + orig_center.y,
        )
        centre = (self.treering_center.x, self.treering_center.y)
        return make_pattern(self._rings, centre, self._factor, self.shift_map, corner)

    @staticmethod
    def _check_finite(array: NDArray[np.floating]) -> None:
        with np.errstate(all="ignore"):
            total = array.sum(dtype=float)
        if not np.isfinite(total) and not np.isfinite(array).all():
            raise SensorError("the image holds values that are not finite")

    # -- areas -------------------------------------------------------------------------

    def calculate_pixel_areas(
        self,
        image: galsim.Image,
        orig_center: galsim.PositionI = galsim.PositionI(0, 0),  # noqa: B008
        use_flux: bool = True,
    ) -> galsim.Image:
        """Areas of the pixels for photons that convert at the back surface.

        Parameters
        ----------
        image : galsim.Image
            Charge [e-].
        orig_center : galsim.PositionI
            Position of (0, 0) in original image coordinates.
        use_flux : bool
            Let the charge act; otherwise only rings and maps do.

        Returns
        -------
        areas : galsim.Image
            In units of the nominal area, same bounds and type.
        """
        array = pixels_of(image, write=False)
        self._check_finite(array)
        pattern = self._place_pattern(image, orig_center)
        out = np.empty(array.shape)
        fixed = any(p.size > 0 for p in (pattern.rings, pattern.map_x, pattern.edge_x))
        if use_flux:
            exposure = ImageExposure(array, self._physics, pattern, (0.0, 0.0), (0, 0))
            self._convolve(exposure.charges, out)
        else:
            out[...] = 1.0
        # Electrons meet rings and maps on their way, the charge's shifts above the wells: what
        # lands in a pixel comes from its area as the charge has it, stretched by the pattern.
        if fixed and self._rings_only(pattern, array.shape):
            times_ring_areas(pattern, out)
        elif fixed:
            stretch = np.empty(array.shape)
            pixel_areas(
                self._physics.edges, _no_charges(array.shape, self._physics), pattern, False,
                np.float32(0), np.float32(0), 0, array.shape[0], stretch,
            )  # fmt: skip
            out *= stretch
        return galsim.Image(
            out.astype(array.dtype, copy=False), xmin=image.bounds.xmin,
            ymin=image.bounds.ymin, wcs=galsim.PixelScale(1.0),
        )  # fmt: skip

    def _rings_only(self, pattern: Pattern, shape: tuple[int, int]) -> bool:
        """Whether nothing but smooth rings shifts boundaries, whose centre is not in the image."""
        away = max(
            abs(centre - size / 2) - size / 2
            for centre, size in ((pattern.ring_x, shape[1]), (pattern.ring_y, shape[0]))
        )
        alone = pattern.map_x.size == 0 and pattern.edge_x.size == 0
        return alone and away > _FROM_CENTRE and _quadrature_error(pattern) < _RING_AREA

    def _convolve(self, charges: Charges, out: FloatArray) -> None:
        """Areas by convolution, with as many kernels as matter for these charges."""
        if self._kernels is None:
            self._kernels = area_kernels(self._physics.edges)
        kernels = self._kernels
        low, low_second = _lowest(charges)
        inner = max(
            float(_inside(charges, charges.first).max() - low),
            float(_inside(charges, charges.second).max(initial=low_second) - low_second),
        )
        ny, nx = out.shape
        # Single precision is good to 1e-7 and twice as fast; where it costs nothing sums are
        # in double precision, as GalSim's.
        kind = np.float64 if out.size < _LARGE else np.float32
        row = np.empty(nx, kind)
        # Next to the image there is no charge: its border sees a larger spread.
        reach = kernels.linear[0].shape[0] // 2
        y0, x0 = min(reach, ny), min(reach, nx)
        y1, x1 = max(ny - reach, y0), max(nx - reach, x0)
        outer = max(inner, abs(float(low)), float(low) + inner)
        for spread, area in (
            (inner, (y0, y1, x0, x1)), (outer, (0, y0, 0, nx)), (outer, (y1, ny, 0, nx)),
            (outer, (y0, y1, 0, x0)), (outer, (y0, y1, x1, nx)),
        ):  # fmt: skip
            count = int(np.sum(np.abs(kernels.values) * (0.5 * spread) ** 2 > _SMALL_AREA))
            first, second = (
                np.concatenate([linear[None], squares[:count]]).astype(kind)
                for linear, squares in zip(kernels.linear, kernels.squares, strict=True)
            )
            convolved_areas(
                charges, first, second, kernels.values, count, low, low_second, *area, row,
                out,
            )  # fmt: skip


def _quadrature_error(pattern: Pattern) -> float:
    """Error of a pixel's area by two points of Gauss a side: 1/4320 of the fourth derivative."""
    a_pixel = max(round(1.0 / pattern.ring_step), 1)
    changes = np.diff(pattern.rings[:-2:a_pixel], 4)
    return 2.0 * float(np.abs(changes).max(initial=0.0)) / 4320.0


def _inside(charges: Charges, array: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give the pixels of the image of a padded array."""
    if not array.size:
        return array
    pad, rows = charges.pad, charges.ny + 2 * charges.pad
    grid = array[: rows * charges.stride].reshape(rows, charges.stride)
    return grid[pad : pad + charges.ny, pad : pad + charges.nx]


def _lowest(charges: Charges) -> tuple[np.float32, np.float32]:
    """Lowest effective charge of both modes in the image."""
    first, second = (_inside(charges, a) for a in (charges.first, charges.second))
    return first.min(), second.min() if second.size else np.float32(0)


def _no_charges(shape: tuple[int, int], physics: Physics) -> Charges:
    """Give the geometry of an image without room for its charge."""
    none = np.zeros(0, np.float32)
    return Charges(
        none, none, 1, 0, shape[1], shape[0], none, none, none, np.zeros(0, np.int64)
    )


def pixels_of(image: galsim.Image, *, write: bool = True) -> NDArray[np.floating]:
    """Give the array of an image that the engine can use."""
    if not image.bounds.isDefined():
        raise galsim.GalSimUndefinedBoundsError(
            "the image of a sensor must have defined bounds"
        )
    array: NDArray[np.floating] = image.array
    if array.dtype not in (np.float32, np.float64):
        raise TypeError(
            f"the image of a sensor must be float32 or float64, not {array.dtype}"
        )
    if write and image.isconst:
        raise galsim.GalSimImmutableError("the image of a sensor must be writeable", image)
    return array


def _light(photons: galsim.PhotonArray) -> Light:
    """Take the arrays of photons, refusing what is not finite."""
    has_angles = photons.hasAllocatedAngles()
    arrays = {
        "x": photons.x,
        "y": photons.y,
        "flux": photons.flux,
        "slope_x": photons.dxdz if has_angles else _EMPTY,
        "slope_y": photons.dydz if has_angles else _EMPTY,
        "wavelength": photons.wavelength if photons.hasAllocatedWavelengths() else _EMPTY,
    }
    for name, array in arrays.items():
        arrays[name] = np.ascontiguousarray(array, float)
        # The sum is finite for nearly all, and costs a tenth of looking at each.
        with np.errstate(all="ignore"):
            total = arrays[name].sum()
        if np.isfinite(total):
            continue
        # Infinitely long waves are not absorbed: a number that means something.
        good = ~np.isnan(array) if name == "wavelength" else np.isfinite(array)
        if not good.all():
            first = int(np.argmin(good))
            raise SensorError(
                f"photon {first}: {name} = {array[first]} is not a finite number "
                f"({np.count_nonzero(~good)} of {len(array)} photons)"
            )
    return Light(**arrays)


def read_numbers(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a configuration of ``key = value`` lines; numbers become numbers."""
    from bfsensor.device.poisson_ccd import read_configuration

    out: dict[str, Any] = {}
    for key, text in read_configuration(path).items():
        out[key] = _number(text)
    return out


def _number(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text.strip("'\"")
