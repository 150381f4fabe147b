"""Shifts of pixel boundaries that do not depend on charge: tree rings, and maps of any shape."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor._kernels.photons import Pattern
from bfsensor.errors import SensorError
from bfsensor.files import refuse_existing, written_whole
from bfsensor.sensor.options import (
    check_array,
    check_number,
    check_path,
    check_shape,
    shown,
    wrong_value,
)
from bfsensor.typing import FloatArray

_FINER = 16
"""Samples of a ring function on each of its own steps.

Chosen: the kernels interpolate linearly between the samples; twice as many quarter the error and
double the memory."""

_NOTHING = np.zeros(0)
"""Array in place of rings that are not there (by definition empty)."""

_NO_MAP = np.zeros((0, 0))
"""Array in place of a map that is not there (by definition empty)."""

_EVEN = np.ones(2)
"""Factor by height of a map that is the same at all heights (by definition one)."""

Stills = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Displacements of edges between columns and between rows [pixel], or dx and dy of points."""


@dataclass(frozen=True, eq=False)
class ShiftMap:
    """A map of fixed boundary shifts, such as annealing or lithography patterns.

    Attributes
    ----------
    dx, dy : ndarray, shape (ny, nx)
        Shift of the boundaries along x and y [pixel] at pixel corners, interpolated linearly
        between them and zero outside; at least 2 x 2.  ``dx[j, i]`` belongs to the corner at
        (``x0`` + i, ``y0`` + j) in image coordinates, in which pixel centres are whole numbers.
    x0, y0 : float
        Image coordinates of ``dx[0, 0]``, by default the lower left corner of pixel (1, 1).
    depth : {'bulk', 'uniform'}
        'bulk': the shift grows with the height of conversion like that of tree rings;
        'uniform': it is the same for all heights, as for misplaced boundaries.

    Raises
    ------
    SensorError
        Arrays that are not two-dimensional, differ in shape or are not finite, a place that is
        no finite number, or another depth.

    Examples
    --------
    >>> ripple = 0.01 * np.sin(np.arange(65) / 5.0)
    >>> bamboo = ShiftMap(dx=np.zeros((65, 65)), dy=np.repeat(ripple[:, None], 65, 1))
    >>> bamboo.dy.shape
    (65, 65)
    """

    dx: FloatArray = field(repr=False)
    dy: FloatArray = field(repr=False)
    x0: float = 0.5
    y0: float = 0.5
    depth: Literal["bulk", "uniform"] = "bulk"

    def __post_init__(self) -> None:
        for name in ("dx", "dy"):
            array = check_array(f"{name} of a shift map", getattr(self, name))
            if array.ndim != 2 or min(array.shape) < 2:
                raise SensorError(
                    f"{name} of a shift map has the shape {array.shape}; it must be two-"
                    "dimensional, with at least 2 x 2 corners"
                )
            if not np.all(np.isfinite(array)):
                raise SensorError(f"{name} of a shift map holds values that are not finite")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.dx.shape != self.dy.shape:
            raise SensorError(
                f"dx and dy of a shift map have the shapes {self.dx.shape} and {self.dy.shape}"
            )
        for name in ("x0", "y0"):
            object.__setattr__(self, name, check_number(name, getattr(self, name)))
        if not isinstance(self.depth, str) or self.depth not in ("bulk", "uniform"):
            raise wrong_value(
                self.depth, f"depth = {shown(self.depth)} must be 'bulk' or 'uniform'"
            )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ShiftMap):
            return NotImplemented
        return (
            np.array_equal(self.dx, other.dx)
            and np.array_equal(self.dy, other.dy)
            and (self.x0, self.y0, self.depth) == (other.x0, other.y0, other.depth)
        )

    __hash__ = None  # type: ignore[assignment]

    @classmethod
    def from_edges(
        cls,
        shape: tuple[int, int],
        *,
        x_low: ArrayLike | None = None,
        x_high: ArrayLike | None = None,
        y_low: ArrayLike | None = None,
        y_high: ArrayLike | None = None,
    ) -> ShiftMap:
        """Make the map of a sensor whose boundaries shift near its edges.

        Shifts of opposite edges add up, and those in x and in y are independent: the
        corners of a sensor are not modelled.  Outside the sensor the shift of its outermost
        boundaries continues unchanged, so that light beyond the last pixel is shifted by it.  The
        shift grows with the height of conversion like that of long doping ripples ('bulk').  For
        a guard ring that holds at distances above about 3 / pi thicknesses from the edge; nearer
        to it, light that converts deep is moved too little or too much
        (``validation/edges/edge_shift.ipynb``).

        Parameters
        ----------
        shape : tuple of int
            Rows and columns of the sensor, at least 1; its first pixel is (1, 1).
        x_low, x_high, y_low, y_high : array_like, shape (n + 1,), optional
            Shifts [pixel] of the boundaries at 0, 1, ..., n pixels from that edge for
            conversion at the back surface, positive away from the edge: the last row of
            ``pixel_shifts`` of :class:`bfsensor.simulate.edge_shift.EdgeShift`.

        Returns
        -------
        ShiftMap

        Raises
        ------
        SensorError
            Shifts that are not finite, not one-dimensional, that make boundaries cross, or whose
            last value is above a hundredth of the largest.

        Examples
        --------
        >>> falling = -0.5 * np.exp(-np.arange(30) / 3.0)
        >>> edges = ShiftMap.from_edges((40, 60), x_low=falling, x_high=falling)
        >>> edges.dx.shape, bool(edges.dx[0, 0] == -edges.dx[0, -1])
        ((45, 65), True)
        """
        ny, nx = check_shape("shape", shape)
        given = {"x_low": x_low, "x_high": x_high, "y_low": y_low, "y_high": y_high}
        lines = {n: _edge_line(n, s, nx if n[0] == "x" else ny) for n, s in given.items()}
        pad = 1 + max(int(np.ceil(np.abs(s).max())) for s in lines.values())
        along = [
            np.pad(lines[f"{axis}_low"] - lines[f"{axis}_high"][::-1], pad, mode="edge")
            for axis in "xy"
        ]
        if any(np.any(np.diff(a) < -1 - 1e-9) for a in along):
            raise SensorError(
                "the shifts of opposite edges make boundaries cross one another"
            )
        counts = (ny + 1 + 2 * pad, nx + 1 + 2 * pad)
        return cls(
            np.broadcast_to(along[0], counts), np.broadcast_to(along[1][:, None], counts),
            0.5 - pad, 0.5 - pad,
        )  # fmt: skip

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> ShiftMap:
        """Read a FITS file with images DX and DY, and X0, Y0 and DEPTH in the header.

        Parameters
        ----------
        path : path-like
            The file; missing keywords have the defaults of the attributes.

        Returns
        -------
        ShiftMap

        Raises
        ------
        SensorError
            The file cannot be read as a shift map; the message names it.
        """
        from astropy.io import fits

        path = Path(check_path("path", path, "the path of a file"))
        try:
            with fits.open(path) as hdus:
                header = hdus[0].header
                return cls(
                    hdus["DX"].data, hdus["DY"].data, float(header.get("X0", 0.5)),
                    float(header.get("Y0", 0.5)), header.get("DEPTH", "bulk"),
                )  # fmt: skip
        except SensorError as error:
            raise SensorError(f"{path}: {error}") from None
        except (OSError, KeyError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise SensorError(
                f"{path}: not a shift map (a FITS file with images DX and DY): {reason}"
            ) from None

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write a FITS file that :meth:`read` reads, whole or not at all.

        Parameters
        ----------
        path : path-like
            Where to.
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        SensorError
            The file exists and ``overwrite`` is not set, or it cannot be written.
        """
        from astropy.io import fits

        path = check_path("path", path, "the path of a file")
        refuse_existing(path, overwrite, SensorError)
        primary = fits.PrimaryHDU()
        primary.header["X0"] = (self.x0, "[pixel] image coordinate of DX[0, 0]")
        primary.header["Y0"] = self.y0
        primary.header["DEPTH"] = self.depth
        primary.header["BUNIT"] = "pixel"
        hdus = [primary] + [
            fits.ImageHDU(getattr(self, n), name=n.upper()) for n in ("dx", "dy")
        ]
        with written_whole(path, SensorError) as beside:
            fits.HDUList(hdus).writeto(beside, overwrite=True)


def _edge_line(name: str, given: ArrayLike | None, pixels: int) -> FloatArray:
    """Shifts [pixel] at all boundaries of a row or column, counted from one edge."""
    out = np.zeros(pixels + 1)
    if given is None:
        return out
    shifts = check_array(name, given)
    if shifts.ndim != 1 or len(shifts) < 2 or not np.all(np.isfinite(shifts)):
        raise SensorError(
            f"{name} must hold the finite shifts of at least two boundaries, not an array of "
            f"shape {shifts.shape}" + ("" if np.all(np.isfinite(shifts)) else " with nan")
        )
    if np.any(np.diff(shifts) < -1 - 1e-9):
        raise SensorError(f"{name}: the shifts make boundaries cross one another")
    if len(shifts) <= pixels and abs(shifts[-1]) > 0.01 * np.abs(shifts).max():
        raise SensorError(
            f"{name} ends {len(shifts) - 1} pixels from the edge at {shifts[-1]:.3g} pixel; it must "
            "fall to a hundredth of its largest value, or reach across the sensor"
        )
    count = min(len(shifts), pixels + 1)
    out[:count] = shifts[:count]
    return out


def sample_rings(function: Any) -> tuple[FloatArray, float]:
    """Sample a radial LookupTable on equal steps, a sixteenth of its own.

    Parameters
    ----------
    function : galsim.LookupTable
        Radial shift [pixel] by radius [pixel].

    Returns
    -------
    values : ndarray
        Shift [pixel] at radii ``n step``; 0 before the table's first radius.  The last two are 0:
        beyond the table's last radius nothing moves, and within a step of it shifts fall to that.
    step : float
        Step of the radius [pixel]; at most 4 million samples are taken.
    """
    x = np.asarray(function.getArgs(), float)
    steps = np.diff(x)
    step = float(max(steps.min() / _FINER, x[-1] / 4e6))
    count = int(np.ceil(x[-1] / step))
    radius = np.linspace(0.0, x[-1], count + 1)
    values = np.zeros(count + 3)
    inside = np.flatnonzero(radius >= x[0])
    values[inside] = function(np.clip(radius[inside], x[0], x[-1]))
    return values, float(x[-1] / count)


def make_pattern(
    rings: tuple[FloatArray, float] | None,
    ring_centre: tuple[float, float],
    ring_factor: FloatArray,
    shift_map: ShiftMap | None,
    corner: tuple[float, float],
) -> Pattern:
    """Place rings and map in the frame of an image.

    Parameters
    ----------
    rings : tuple, optional
        Samples and step from :func:`sample_rings`.
    ring_centre : tuple of float
        Centre of the rings in original image coordinates [pixel].
    ring_factor : ndarray
        Factor on the shift by height, in equal steps from the gates to the back.
    shift_map : ShiftMap, optional
        Map in original image coordinates.
    corner : tuple of float
        Original coordinates of the lower left corner of the image.

    Returns
    -------
    Pattern
    """
    values, step = (_NOTHING, 1.0) if rings is None else rings
    uniform = shift_map is not None and shift_map.depth == "uniform"
    return Pattern(
        rings=values,
        ring_step=step,
        ring_x=ring_centre[0] - corner[0],
        ring_y=ring_centre[1] - corner[1],
        ring_factor=ring_factor,
        map_x=_NO_MAP if shift_map is None else shift_map.dx,
        map_y=_NO_MAP if shift_map is None else shift_map.dy,
        map_0x=0.0 if shift_map is None else shift_map.x0 - corner[0],
        map_0y=0.0 if shift_map is None else shift_map.y0 - corner[1],
        map_factor=_EVEN if uniform else ring_factor,
    )


def fine_stills(stills: Stills, rows: tuple[int, int], columns: tuple[int, int]) -> Stills:
    r"""Sample mean displacements of edges at two points a pixel, with the same means.

    Corners are displaced by the mean of the edges that meet there, the middle m of an edge of
    mean e between corners c so that :math:`(c_0 + 2 m + c_1) / 4 = e`.  Outside the sensor the
    displacements of its rim continue unchanged.

    Parameters
    ----------
    stills : pair of ndarray
        Mean displacements [pixel] of the edges between columns, shape (ny, nx + 1), and between
        rows, shape (ny + 1, nx).
    rows, columns : tuple of int
        First and last row and column line, in pixels from the sensor's corner.

    Returns
    -------
    dx, dy : ndarray, shape (2 (rows[1] - rows[0]) + 1, 2 (columns[1] - columns[0]) + 1)
        Displacements [pixel] at corners and at the middles between them.
    """
    x = _fine(stills[0], rows, columns)
    y = _fine(stills[1].T, columns, rows).T
    return np.ascontiguousarray(x), np.ascontiguousarray(y)


def _fine(
    edge: NDArray[np.float32], along: tuple[int, int], lines: tuple[int, int]
) -> NDArray[np.float32]:
    """Samples of the normal displacement of edges along lines, (pixels along, lines)."""
    line = np.clip(np.arange(lines[0], lines[1] + 1), 0, edge.shape[1] - 1)
    pixel = np.clip(np.arange(along[0] - 1, along[1] + 1), 0, edge.shape[0] - 1)
    mean = edge[pixel[:, None], line]
    corner = 0.5 * (mean[:-1] + mean[1:])
    out = np.empty((2 * (along[1] - along[0]) + 1, 2 * len(line) - 1), np.float32)
    out[::2, ::2] = corner
    out[1::2, ::2] = 2 * mean[1:-1] - 0.5 * (corner[:-1] + corner[1:])
    out[:, 1::2] = 0.5 * (out[:, :-1:2] + out[:, 2::2])
    return out
