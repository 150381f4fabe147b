"""Mean shifts of pixel edges by one electron, from a distortion table, for image corrections."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from bfsensor.errors import TableError
from bfsensor.recording.tables.text_tables import LARGEST_LAG
from bfsensor.response.light import conversion_weights
from bfsensor.response.vertices import vertex_fractions
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray

_PROBE = 100.0
"""Charge above the background for which the shifts by one electron are taken [e-].

Chosen: the response is nearly linear there; twice the charge changes the a_ij of the two LSST
devices by 4e-4 at most."""


_BETWEEN = 20
"""Heights for each interval of the table's depths, between which shifts count as linear.

Chosen: the table's cubics are then met to 1e-4; twice as many meet them four times as well."""


class QuadrantShifts(NamedTuple):
    """Mean shifts of pixel edges by one electron, outward positive, by lag [j, i] from (0, 0).

    Other quadrants follow by symmetry.  :class:`bfsensor.simulate.image_charge.EdgeShifts` holds
    the shifts of all four edges from the image-charge engine, with the same signs.

    Attributes
    ----------
    north, east : ndarray, shape (n, n)
        Mean shifts of the upper and of the right edge of each pixel [pixel/e-].

    Examples
    --------
    >>> shifts = QuadrantShifts(np.full((2, 2), -1e-7), np.full((2, 2), -1e-7))
    >>> round(float(shifts.areas[0, 0] * 1e7), 6)
    -4.0
    """

    north: FloatArray
    east: FloatArray

    @property
    def south(self) -> FloatArray:
        """Mean shifts of the lower edges [pixel/e-]: those of the pixels below, reversed in sign."""
        return np.concatenate([self.north[:1], -self.north[:-1]])

    @property
    def west(self) -> FloatArray:
        """Mean shifts of the left edges [pixel/e-]."""
        return np.concatenate([self.east[:, :1], -self.east[:, :-1]], axis=1)

    @property
    def areas(self) -> FloatArray:
        """Relative changes a_ij of the area by one electron [1/e-], to first order."""
        return self.north + self.south + self.east + self.west


def quadrant_shifts(
    table: DistortionTable,
    *,
    background: float = 0.0,
    wavelengths: ArrayLike | None = None,
    photons: ArrayLike | None = None,
    temperature: float | None = None,
    lags: int = 8,
    tail_slope: float | None = -1.35,
) -> QuadrantShifts:
    r"""Compute the mean shifts of the edges around a small charge on a uniform background.

    Flats respond with these shifts at that level.  The four mirror images are averaged.

    Parameters
    ----------
    table : DistortionTable
        Any table that reaches at least 1 pixel.
    background : float
        Charge of all pixels [e-], within the table.
    wavelengths : array_like, shape (n,), optional
        Vacuum wavelengths of the light [nm]; shifts are averaged over the heights at which it
        converts.  By default all light converts at the back surface.
    photons : array_like, shape (n,), optional
        Number of photons that enter the silicon at each wavelength, in any unit, at least 0; by
        default equal numbers.
    temperature : float, optional
        Temperature for the absorption length [K], by default the device's.
    lags : int
        Number of lags from 0 in x and in y, 2 to 1000; 8 gives kernels of 17 x 17.
    tail_slope : float, optional
        Exponent p, below -1, of the tail beyond the table: areas change as
        :math:`(i^2 + j^2)^p`, shifts as :math:`x, y` times that, scaled to the table's outermost
        edges; -1.35 is cp_pipe's.  None: beyond the table nothing moves, as in the sensors.

    Returns
    -------
    QuadrantShifts
        Arrays of shape (lags, lags).

    Raises
    ------
    TableError
        A background outside the table, light that does not convert or that a table of one depth
        cannot represent, fewer than 2 lags, or a tail slope that is not below -1.

    Notes
    -----
    Light that crosses the silicon is left out.  Between the table's depths shifts are monotone
    cubics in the logarithm of depth, as in the sensors.  Shifts by image charges in 100 um of
    silicon fall faster than the tail of -1.35, which is 1.0 to 1.4 times too large at 5 pixels and
    1.3 to 2.4 times at 7.

    Examples
    --------
    >>> from bfsensor.device.shipped import tables_dir
    >>> table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
    >>> a = quadrant_shifts(table).areas
    >>> bool(-1.4e-6 < a[0, 0] < -1.2e-6), bool(a[1, 0] > 1.5 * a[0, 1] > 0)
    (True, True)
    """
    if not (isinstance(lags, int | np.integer) and 2 <= lags <= LARGEST_LAG):
        raise TableError(f"lags = {lags} must be a whole number from 2 to {LARGEST_LAG}")
    if table.reach < 1:
        raise TableError("a table with reach = 0 has no shifts of neighbours to export")
    if tail_slope is not None and not tail_slope < -1:
        raise TableError(f"tail_slope = {tail_slope} must be below -1: areas add up to 0")
    low, high = table.backgrounds[0], min(table.backgrounds[-1], table.charges[-1] - _PROBE)
    if not low <= background <= high:
        raise TableError(
            f"background = {background:g} is outside the table, which holds from {low:g} to "
            f"{high:g} e-"
        )
    by_depth = [_at_depth(table, background, depth) for depth in table.depths]
    north, east = (np.array([shifts[k] for shifts in by_depth]) for k in (0, 1))
    heights, weights = table.depths, np.eye(len(table.depths))[-1]
    if wavelengths is not None:
        heights, weights = _conversion(table, wavelengths, photons, temperature)
    elif photons is not None:
        raise TableError("photons are given without wavelengths: give both")
    means = []
    for values in (north, east):
        if len(heights) > len(table.depths):
            values = PchipInterpolator(np.log(table.depths), values)(np.log(heights))
        means.append(np.tensordot(weights, values, 1))
    return _extended(QuadrantShifts(*means), table.pitch, lags, tail_slope)


def _at_depth(table: DistortionTable, background: float, depth: float) -> QuadrantShifts:
    """Mean shifts [pixel/e-] at one depth, lags 0 to the table's reach."""
    moved = table.displacements(
        charge=background + _PROBE, background=background, depth=float(depth)
    )
    points = np.concatenate([[0.0], vertex_fractions(table.vertices), [1.0]])
    c = moved.corners[..., None, :]
    flat = np.concatenate([c[:, :-1], moved.horizontal, c[:, 1:]], axis=2)[..., 1]
    upright = np.concatenate([c[:-1], moved.vertical, c[1:]], axis=2)[..., 0]
    rows = np.trapezoid(flat, points) / (_PROBE * table.pitch[1])
    columns = np.trapezoid(upright, points) / (_PROBE * table.pitch[0])
    return QuadrantShifts(_quadrant(rows), _quadrant(columns.T).T)


def _quadrant(rows: FloatArray) -> FloatArray:
    """Average the mirror images of the edges between rows, (2 r + 2, 2 r + 1), to a quadrant."""
    r = rows.shape[1] // 2
    # Mirrored in y, the shift of an edge between rows changes its sign.
    odd = 0.5 * (rows[r + 1 :] - rows[r::-1])
    return np.asarray(0.5 * (odd[:, r:] + odd[:, r::-1]))


def _conversion(
    table: DistortionTable,
    wavelengths: ArrayLike,
    photons: ArrayLike | None,
    temperature: float | None,
) -> tuple[FloatArray, FloatArray]:
    """Heights [um], the table's depths and others between, and their weights for the light."""
    from bfsensor.device.device import Device
    from bfsensor.device.silicon import ABSORPTION_RANGE, absorption_length

    if temperature is None:
        if not table.device_text:
            raise TableError("the table holds no device: give its temperature [K]")
        temperature = Device.from_toml(table.device_text).operating_point.temperature
    waves = np.atleast_1d(np.asarray(wavelengths, float))
    flux = np.ones(len(waves)) if photons is None else np.asarray(photons, float)
    if waves.ndim != 1 or flux.shape != waves.shape:
        raise TableError(
            f"wavelengths and photons have the shapes {waves.shape} and {flux.shape}, not "
            "(n,) both"
        )
    if not (np.all(np.isfinite(flux)) and np.all(flux >= 0) and flux.sum() > 0):
        raise TableError("photons must be finite, not negative, and not all 0")
    if len(table.depths) == 1:
        raise TableError("a table of one depth has no shifts by wavelength")
    low, high = ABSORPTION_RANGE
    # Above the range silicon is transparent, which is refused below.
    if not np.all((waves >= low) & np.isfinite(waves)):
        raise TableError(f"wavelengths = {waves} nm must be from {low:g} to {high:g} nm")
    converts = -np.expm1(
        -table.thickness / np.asarray(absorption_length(waves, temperature), float)
    )
    shares = flux * converts
    if not shares.sum() > 1e-6 * flux.sum():
        raise TableError(
            f"wavelengths = {waves} nm: none of this light converts in the silicon"
        )
    last, between = np.arange(len(table.depths) - 1), np.linspace(0, 1, _BETWEEN + 1)[:-1]
    at = np.append((last[:, None] + between).ravel(), len(table.depths) - 1.0)
    heights = np.exp(np.interp(at, np.arange(len(table.depths)), np.log(table.depths)))
    by_wave = [
        conversion_weights(heights, w, temperature, thickness=table.thickness)
        for w in waves
    ]
    return heights, np.asarray(shares @ np.array(by_wave) / shares.sum())


def _extended(
    inner: QuadrantShifts, pitch: tuple[float, float], lags: int, tail_slope: float | None
) -> QuadrantShifts:
    """Cut shifts to so many lags, or continue them beyond the table by the tail."""
    known = len(inner.north)
    if lags <= known:
        return QuadrantShifts(*(part[:lags, :lags].copy() for part in inner))
    px, py = pitch
    k = np.arange(lags)
    tail = []
    for dx, dy, along in ((0.0, 0.5, 1), (0.5, 0.0, 0)):
        x, y = np.meshgrid((k + dx) * px, (k + dy) * py)
        power = 0.0 if tail_slope is None else (x**2 + y**2) ** tail_slope
        tail.append(power * (y / py if along else x / px))
    strength = 0.0
    if tail_slope is not None:
        ring = np.zeros((known, known), bool)
        ring[-1] = ring[:, -1] = True
        model = np.concatenate([t[:known, :known][ring] for t in tail])
        found = np.concatenate([part[ring] for part in inner])
        strength = float(model @ found / (model @ model))
    out = []
    for part, shape in zip(inner, tail, strict=True):
        whole = strength * shape
        whole[:known, :known] = part
        out.append(whole)
    return QuadrantShifts(*out)
