r"""The field of a charged rectangle between two conducting planes, by images.

The planes, a distance T apart, are met by images of alternate sign, :math:`\pm 1` at heights
:math:`2 n T \pm z_q` above the lower one for all whole n.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import zeta

from bfsensor._kernels import image_charge as kernel
from bfsensor.device.parts import Material
from bfsensor.errors import DeviceError, TableError
from bfsensor.typing import FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

if TYPE_CHECKING:
    from bfsensor.device.device import Device

TOLERANCE = 1e-14
"""Largest error of the image series [V/um per electron].

Chosen: 100,000 e- make it 1e-9 V/um beside a drift field of some 0.5 V/um; twice as large, that
error doubles and about a tenth of the images is saved, as the bound falls with their sixth power."""

_TAIL_TERMS = 15
"""Number of odd orders, l = 1, 3, ..., 29, of the potential of all further images.

The first two are added to the field, the others bound its error.  Derived: sizes more than halve
from term to term, so that the orders left out add less than 2^-12 to the bound."""

_MOST_PAIRS = 1000
"""Largest number of image pairs; a tolerance that needs more is refused.

Chosen: twice as many would reach points twice as far away (in gaps of the planes), at twice the
time of every field."""


@dataclass(frozen=True)
class ImageCharge:
    """Parameters of the analytic engine: a charged rectangle between two conducting planes.

    All heights are above the gates.

    Parameters
    ----------
    charge_height : float
        Height :math:`z_q` of the stored charge [um], above the lower plane.
    row_height, column_height : float
        Heights :math:`z_{sh}`, :math:`z_{sv}` [um] at which boundaries between rows and between
        columns are sealed, above the charge and below the back surface.  The lower one moves
        more: rows in CCDs.
    half_width_x, half_width_y : float
        Half sides a, b of the charged rectangle [um], above 0 and at most half a pitch.  The
        closed form loses digits as 1 / (a b): 1e-3 um each leave 1e-13 V/um of round-off.
    thickness : float
        Height of the back surface, the upper plane [um].
    pitch_x, pitch_y : float
        Pixel pitch [um].
    drift_field : float or sequence of (height, field)
        Field that carries electrons down [V/um], above 0: uniform, or pairs of height [um]
        and field, heights ascending, linear in between, from the lower sealed height or below to
        the back surface or above.  Silicon of uniform doping needs two pairs.
    permittivity : float
        Relative permittivity of silicon, at least 1; the default is that of a device file.
    plane_height : float
        Height of the lower plane [um], which stands for gates, oxide and the holes of channel
        stops together.  An oxide alone puts it below the gates (negative), holes above
        them.  Zero in Astier & Regnault (2023).

    Attributes
    ----------
    gap : float
        Distance T of the two planes [um].
    unit_field : float
        Field of one electron 1 um away without planes [V/um].

    Raises
    ------
    DeviceError
        A parameter is not allowed; the message names it and its limit.

    References
    ----------
    Astier & Regnault 2023, A&A 670, A118, arXiv:2301.03274.

    Examples
    --------
    >>> model = ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0, drift_field=((0, 0.75), (100, 0.37)))
    >>> float(model.drift_at(50.0))
    0.56
    """

    charge_height: float
    row_height: float
    column_height: float
    half_width_x: float
    half_width_y: float
    thickness: float = 100.0
    pitch_x: float = 10.0
    pitch_y: float = 10.0
    drift_field: float | tuple[tuple[float, float], ...] = 0.5
    permittivity: float = Material.permittivity_silicon
    plane_height: float = 0.0

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self):
            if spec.name == "drift_field":
                continue
            given = getattr(self, spec.name)
            unit = "" if spec.name == "permittivity" else " um"
            low = -np.inf if spec.name == "plane_height" else 0.0
            try:
                value = float(given)
            except (TypeError, ValueError):
                value = np.nan
            if not low < value < np.inf:
                above = f" above 0{unit}" if low == 0 else ""
                raise DeviceError(
                    f"image charge: {spec.name} = {given!r}{unit} must be a finite number{above}"
                )
            object.__setattr__(self, spec.name, value)
        if self.permittivity < 1:
            raise DeviceError(
                f"image charge: permittivity = {self.permittivity:g} must be at least 1"
            )
        if self.charge_height <= self.plane_height:
            raise DeviceError(
                f"image charge: charge_height = {self.charge_height:g} um must be above "
                f"plane_height = {self.plane_height:g} um"
            )
        for name in ("row_height", "column_height"):
            value = getattr(self, name)
            if not self.charge_height < value < self.thickness:
                raise DeviceError(
                    f"image charge: {name} = {value:g} um must be above charge_height = "
                    f"{self.charge_height:g} um and below thickness = {self.thickness:g} um"
                )
        for axis in "xy":
            value, pitch = (
                getattr(self, f"half_width_{axis}"),
                getattr(self, f"pitch_{axis}"),
            )
            if value > pitch / 2:
                raise DeviceError(
                    f"image charge: half_width_{axis} = {value:g} um must be at most half of "
                    f"pitch_{axis}, {pitch / 2:g} um"
                )
        self._check_drift_field()

    def _check_drift_field(self) -> None:
        try:
            given = np.array(self.drift_field, float)
        except (TypeError, ValueError):
            given = np.zeros(0)
        if given.ndim == 0:
            fields = given[None]
            object.__setattr__(self, "drift_field", float(given))
        elif given.ndim == 2 and given.shape[1] == 2 and len(given) > 1:
            heights, fields = given.T
            low = min(self.row_height, self.column_height)
            if np.any(np.diff(heights) <= 0) or not (
                heights[0] <= low and self.thickness <= heights[-1]
            ):
                raise DeviceError(
                    f"image charge: heights of drift_field, {heights.tolist()} um, must ascend "
                    f"from at most {low:g} um to at least thickness = {self.thickness:g} um"
                )
            object.__setattr__(self, "drift_field", tuple(map(tuple, given.tolist())))
        else:
            raise DeviceError(
                f"image charge: drift_field = {self.drift_field!r} must be a number or "
                "pairs (height, field)"
            )
        if not np.all((fields > 0) & (fields < np.inf)):
            raise DeviceError(
                f"image charge: drift_field = {self.drift_field} V/um must be finite and above "
                "0 V/um everywhere"
            )

    @classmethod
    def of_device(cls, device: Device) -> ImageCharge:
        """Make the model of a device that has a section ``image_charge``.

        Parameters
        ----------
        device : Device
            Device that was fitted to covariances.

        Returns
        -------
        model : ImageCharge
            Its heights, half sides and drift field, with the device's thickness, pitch and
            permittivity.

        Raises
        ------
        DeviceError
            The device has no such section.
        """
        fitted = device.image_charge
        if fitted is None:
            raise DeviceError(
                f"{device.name} has no section [image_charge]: its response is solved from its "
                "doping and voltages"
            )
        thickness = device.silicon.thickness
        return cls(
            fitted.charge_height, fitted.row_height, fitted.column_height,
            fitted.half_width_x, fitted.half_width_y, thickness, device.pixel.pitch_x,
            device.pixel.pitch_y,
            ((0.0, fitted.drift_field_front), (thickness, fitted.drift_field_back)),
            device.material.permittivity_silicon,
        )  # fmt: skip

    def drift_at(self, heights: ArrayLike) -> FloatArray:
        """Interpolate the drift field at given heights.

        Parameters
        ----------
        heights : array_like, any shape
            Heights above the gates [um]; beyond given pairs the field of the last one is held.

        Returns
        -------
        field : ndarray, shape of ``heights``
            Drift field [V/um], positive where it carries electrons down.
        """
        z = np.asarray(heights, float)
        if isinstance(self.drift_field, tuple):
            return np.interp(z, *np.array(self.drift_field).T)
        return np.full(z.shape, self.drift_field)

    @property
    def gap(self) -> float:
        """Distance T of the two planes [um]."""
        return self.thickness - self.plane_height

    @property
    def unit_field(self) -> float:
        """Field of one electron 1 um away without planes [V/um]: negative, towards it."""
        return -1 / (4 * np.pi * self.permittivity * VACUUM_PERMITTIVITY)


@dataclass(frozen=True)
class ImageSeries:
    """Images summed one by one, and the tail of all others; heights above the lower plane."""

    heights: FloatArray
    signs: FloatArray
    tail: FloatArray


def _tail_terms(model: ImageCharge, pairs: int) -> FloatArray:
    """Coefficients of r^l P_l, l = 1, 3, 5, ..., of the images beyond ``pairs``.

    Even terms cancel between images above and below.  Exact for a point charge.
    """
    order = 2.0 * np.arange(1, _TAIL_TERMS + 1)  # l + 1
    shift = (model.charge_height - model.plane_height) / (2 * model.gap)
    difference = zeta(order, pairs + 1 + shift) - zeta(order, pairs + 1 - shift)
    return np.asarray(2 * difference / (2 * model.gap) ** order)


def _bound(model: ImageCharge, pairs: int, distance: float) -> float:
    """Bound on the error of the field [V/um per electron] within ``distance`` of the origin."""
    radius = distance + np.hypot(model.half_width_x, model.half_width_y)
    if radius >= (pairs + 1) * model.gap:
        return np.inf  # kept away from 2 (pairs + 1) T - z_q, where the tail diverges
    terms = _tail_terms(model, pairs)[2:]
    degree = 5 + 2 * np.arange(len(terms))
    # |grad r^l P_l| <= sqrt(l (l + 1)) r^(l - 1); from term to term the sizes more than halve.
    sizes = np.sqrt(degree * (degree + 1)) * radius ** (degree - 1) * np.abs(terms)
    return float(sizes.sum() * abs(model.unit_field))


@lru_cache(maxsize=64)
def image_series(model: ImageCharge, distance: float, tolerance: float) -> ImageSeries:
    r"""Choose the images that give the field within ``distance`` of the origin [um].

    The images :math:`|n| \le N` are rectangles in closed form; of those beyond, the terms of
    their potential up to the third order are summed exactly with Hurwitz' zeta function.
    N is the smallest that bounds all further terms by ``tolerance`` [V/um per electron].
    Images: Jackson, Classical Electrodynamics, section 2.1 and problem 3.17.
    """
    if not tolerance > 0:
        raise TableError(f"tolerance = {tolerance} V/um must be above 0 V/um")
    pairs = 0
    while _bound(model, pairs, distance) > tolerance:
        pairs += 1
        if pairs > _MOST_PAIRS:
            raise TableError(
                f"tolerance = {tolerance:g} V/um is not reached {distance:g} um away with "
                f"{_MOST_PAIRS} pairs of images"
            )
    return _sum_images(model, pairs)


def _sum_images(model: ImageCharge, pairs: int) -> ImageSeries:
    n = np.arange(-pairs, pairs + 1)[:, None]
    signs = np.array([1.0, -1.0])
    height = model.charge_height - model.plane_height
    heights = 2 * n * model.gap + signs * height
    terms = _tail_terms(model, pairs)
    return ImageSeries(heights.ravel(), np.tile(signs, len(n)), terms[:2])


def sum_field(model: ImageCharge, points: FloatArray, series: ImageSeries) -> FloatArray:
    """Field of one stored electron at points (n, 3) [V/um], towards it; points are not checked.

    The drift field is not included; the centre of the charge is at x = y = 0.
    """
    points = points - np.array([0.0, 0.0, model.plane_height])
    out = np.zeros_like(points)
    half = np.array([model.half_width_x, model.half_width_y])
    kernel.add_fields(points, series.heights, series.signs, half, series.tail, out)
    return out * model.unit_field


def farthest(points: FloatArray, model: ImageCharge) -> float:
    """Largest distance from the lower plane's origin of a place or of the back above it [um].

    The lateral part is rounded up to a pitch, so that neighbouring places share a cached series.
    """
    if not points.size:
        return model.gap
    # Points (u, v), or edges (u, v, v): the farther end.
    lateral = float(np.hypot(points[:, 0], np.abs(points[:, 1:]).max(axis=1)).max())
    step = model.pitch_x
    return float(np.hypot(np.ceil(lateral / step) * step, model.gap))
