"""Distortion table: displacements of the pixels' vertices by charge, background and depth.

The source pixel holds a charge, all other pixels a uniform background, and the light
converts at some depth; the table holds the total displacement of the vertices around the
source pixel for levels of all three.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from bfsensor.device.shipped import did_you_mean, tables_dir
from bfsensor.errors import TableError
from bfsensor.response.vertices import Displacements, nominal_positions, vertex_fractions
from bfsensor.table.interpolation import polynomial_weights, spline_weights
from bfsensor.typing import FloatArray


@dataclass(frozen=True, eq=False)
class DistortionTable:
    """Total displacement of the pixel vertices around a source pixel.

    Attributes
    ----------
    charges : ndarray, shape (nq,)
        Charge of the source pixel [e-], at least 0, ascending.
    backgrounds : ndarray, shape (nb,)
        Charge of every other pixel [e-], at least 0, ascending.
    depths : ndarray, shape (nd,)
        Conversion depths [um above the gates], ascending, above 0 up to the thickness.
    pitch : tuple of float
        Pixel pitch in x and y [um].
    thickness : float
        Height of the back surface [um].
    vertices : int
        Vertices a side between the corners, at :func:`vertex_fractions`.
    reach : int
        Largest pixel offset: the table holds offsets -reach to reach.
    corners : ndarray, shape (nq, nb, nd, 2 reach + 2, 2 reach + 2, 2)
        Displacement (dx, dy) [um] of the corners, by edge line in y, then x.
    horizontal : ndarray, shape (nq, nb, nd, 2 reach + 2, 2 reach + 1, vertices, 2)
        Displacement [um] of the vertices on edges along x, by edge line in y, then pixel in x.
    vertical : ndarray, shape (nq, nb, nd, 2 reach + 1, 2 reach + 2, vertices, 2)
        Displacement [um] of the vertices on edges along y, by pixel in y, then edge line in x.
    full_well : float
        Charge at which a pixel spills along its column [e-]; nan where not known.
    errors : mapping of str to float
        Estimated errors, with units in the names; nan where an estimate failed.
    provenance : mapping of str to str
        Version, engine and settings that made the table.
    device_text : str
        Text of the device file; empty where not known.
    symmetric : bool
        Whether the lines in x and in y through the source pixel's centre are mirror lines.
    drift_field : ndarray, shape (n,)
        Drift field of the empty device, averaged over a pixel [V/um], at the 257 heights of
        :func:`bfsensor.simulate.mean_field.mean_drift_field`; of size 0 where not known.

    Raises
    ------
    TableError
        Axes that are not finite or do not ascend, arrays of another shape, displacements where
        charge and background are equal, or another value that is not allowed.

    Notes
    -----
    Where the source charge Q equals the background B nothing moves.  Between levels the
    response D / (Q - B) is interpolated and multiplied by Q - B, so that this holds
    everywhere: cubic splines in charge and background (below four levels the polynomial
    through them), monotone cubics in the logarithm of depth.  At a node with Q = B the
    response is that of the polynomial through the three nearest charges.  At nodes the
    interpolation returns the table's values to round-off.  A table of one charge is linear in
    charge from 0 on, as GalSim's are.

    Arrays are rounded to single precision (1e-7 of a displacement), which the file holds, so that
    a table reads back equal bit for bit.

    Examples
    --------
    >>> table = DistortionTable.load("itl_sta3800c")
    >>> table
    <DistortionTable of itl_sta3800c, 7 charges, 4 backgrounds, 10 depths, 9 x 9 pixels>
    >>> change = table.area_changes(charge=50000.0, depth=95.0)
    >>> bool(change[4, 4] < 0 < change[4, 5] < change[5, 4])
    True
    """

    charges: FloatArray
    backgrounds: FloatArray
    depths: FloatArray
    pitch: tuple[float, float]
    thickness: float
    vertices: int
    reach: int
    corners: FloatArray = field(repr=False)
    horizontal: FloatArray = field(repr=False)
    vertical: FloatArray = field(repr=False)
    full_well: float = float("nan")
    errors: Mapping[str, float] = field(default_factory=dict, repr=False)
    provenance: Mapping[str, str] = field(default_factory=dict, repr=False)
    device_text: str = field(default="", repr=False)
    symmetric: bool = True
    drift_field: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)

    def __post_init__(self) -> None:
        self._check_numbers()
        for name in ("charges", "backgrounds", "depths"):
            axis = np.array(getattr(self, name), float)
            if (
                axis.ndim != 1
                or not len(axis)
                or not np.all(np.isfinite(axis))
                or np.any(np.diff(axis) <= 0)
            ):
                raise TableError(f"{name} = {axis.tolist()} must be finite and ascend")
            _keep(self, name, axis)
        if self.charges[0] < 0 or self.backgrounds[0] < 0:
            raise TableError("charges and backgrounds must not be negative")
        if self.depths[0] <= 0:
            raise TableError(
                f"depths = {self.depths.tolist()} must be above the gates, 0 um"
            )
        if self.depths[-1] > self.thickness * (1 + 1e-9):
            raise TableError(
                f"depths = {self.depths.tolist()} um must not be above the thickness, "
                f"{self.thickness:g} um"
            )
        if len(self.charges) == 1 and self.charges[0] in self.backgrounds:
            raise TableError(
                f"charges = {self.charges.tolist()} e- must hold one that differs from the "
                f"background, {self.charges[0]:g} e-: where they are equal nothing moves"
            )
        for name, shape in self._shapes().items():
            with np.errstate(over="ignore"):
                # Adding 0 turns -0 into 0, so that mirrored arrays are equal in their bits.
                array = np.array(getattr(self, name), np.float32).astype(float) + 0.0
            if array.shape != shape:
                raise TableError(f"{name} has the shape {array.shape}, not {shape}")
            if not np.all(np.isfinite(array)):
                raise TableError(f"{name} holds values that are not finite")
            if np.any(array[self.charges[:, None] == self.backgrounds]):
                raise TableError(
                    f"{name} holds shifts where the charge equals the background and "
                    "nothing moves"
                )
            _keep(self, name, array)
        drift = np.array(self.drift_field, float)
        if drift.ndim != 1 or not np.all(np.isfinite(drift)):
            raise TableError("drift_field must be a list of finite numbers")
        _keep(self, "drift_field", drift)
        errors = {str(k): float(v) for k, v in self.errors.items()}
        provenance = {str(k): str(v) for k, v in self.provenance.items()}
        object.__setattr__(self, "errors", MappingProxyType(errors))
        object.__setattr__(self, "provenance", MappingProxyType(provenance))

    def _check_numbers(self) -> None:
        """Convert the scalars to plain numbers and refuse those outside their ranges."""
        for name, low in (("vertices", 1), ("reach", 0)):
            value = getattr(self, name)
            if int(value) != value or value < low:
                raise TableError(f"{name} = {value} must be a whole number from {low}")
            object.__setattr__(self, name, int(value))
        if len(self.pitch) != 2:
            raise TableError(f"pitch = {self.pitch} um must be the pitch in x and in y")
        object.__setattr__(self, "pitch", (float(self.pitch[0]), float(self.pitch[1])))
        for name in ("thickness", "full_well"):
            object.__setattr__(self, name, float(getattr(self, name)))
        object.__setattr__(self, "symmetric", bool(self.symmetric))
        for name, value in (
            ("pitch x", self.pitch[0]),
            ("pitch y", self.pitch[1]),
            ("thickness", self.thickness),
        ):
            if not 0 < value < np.inf:
                raise TableError(f"{name} = {value} um must be finite and above 0 um")
        if not (np.isnan(self.full_well) or 0 < self.full_well < np.inf):
            raise TableError(
                f"full_well = {self.full_well} e- must be above 0 e- (nan: not known)"
            )

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape that each array must have."""
        levels = (len(self.charges), len(self.backgrounds), len(self.depths))
        n, nv = 2 * self.reach + 1, self.vertices
        return {
            "corners": (*levels, n + 1, n + 1, 2),
            "horizontal": (*levels, n + 1, n, nv, 2),
            "vertical": (*levels, n, n + 1, nv, 2),
        }

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, DistortionTable):
            return NotImplemented
        for name in self.__dataclass_fields__:
            a, b = getattr(self, name), getattr(other, name)
            if name == "errors":
                same = a.keys() == b.keys() and all(
                    np.array_equal(a[k], b[k], equal_nan=True) for k in a
                )
            elif isinstance(a, np.ndarray | float):
                same = np.array_equal(a, b, equal_nan=True)
            else:
                same = a == b
            if not same:
                return False
        return True

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        named = re.search(r'^name = "(.*)"$', self.device_text, re.MULTILINE)
        side = 2 * self.reach + 1
        return (
            f"<DistortionTable{f' of {named[1]}' if named else ''}, {len(self.charges)} "
            f"charges, {len(self.backgrounds)} backgrounds, {len(self.depths)} depths, "
            f"{side} x {side} pixels>"
        )

    def __str__(self) -> str:
        from bfsensor.device.summary import format_summary

        return format_summary("DistortionTable", self._rows())

    def _repr_html_(self) -> str:
        from bfsensor.device.summary import summary_to_html

        return summary_to_html("DistortionTable", self._rows())

    def _rows(self) -> list[tuple[str, str]]:
        """Rows of the summary: contents, errors and provenance."""
        side = 2 * self.reach + 1
        well = "not known" if np.isnan(self.full_well) else f"{self.full_well:,.0f} e-"
        rows = [
            ("device", self._device_words()),
            (
                "pixels",
                f"{side} x {side} of {self.pitch[0]:g} x {self.pitch[1]:g} um, "
                f"{self.vertices} vertices a side"
                f"{', mirror-symmetric' if self.symmetric else ''}",
            ),
            ("charges", ", ".join(f"{q:,.0f}" for q in self.charges) + " e- in the source"),
            (
                "backgrounds",
                ", ".join(f"{b:,.0f}" for b in self.backgrounds) + " e- in all others",
            ),
            ("depths", ", ".join(f"{d:.4g}" for d in self.depths) + " um above the gates"),
            ("full well", well),
        ]
        errors = []
        for name, value in self.errors.items():
            plain, _, unit = name.partition(" [")
            said = "unknown" if np.isnan(value) else f"{value:.2g} {unit.rstrip(']')}"
            errors.append(f"{plain} {said}".rstrip())
        if errors:
            rows.append(("errors", "; ".join(errors)))
        made = ", ".join(f"{k} {v}" for k, v in self.provenance.items())
        return [*rows, ("made by", made)] if made else rows

    def _device_words(self) -> str:
        """Name the device with its voltages."""
        # Not at the top: astropy, which reads units, is slow to load.
        from bfsensor.device.device import Device
        from bfsensor.device.summary import device_title
        from bfsensor.errors import DeviceError

        if not self.device_text:
            return f"not known, {self.thickness:g} um thick"
        try:
            device = Device.from_toml(self.device_text)
        except DeviceError as error:
            return f"cannot be read: {error}"
        return device_title(device.name, device.silicon, device.operating_point)

    def __reduce__(self) -> tuple[Any, ...]:
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        values["errors"], values["provenance"] = dict(self.errors), dict(self.provenance)
        return _make, (values,)

    # -- questions ---------------------------------------------------------------------

    @cached_property
    def _responses(self) -> tuple[FloatArray, ...]:
        """D / (Q - B) on the grid; where Q = B, from its neighbours in charge."""
        step = self.charges[:, None] - self.backgrounds[None, :]
        out = []
        for array in (self.corners, self.horizontal, self.vertical):
            flat = array.reshape(*step.shape, -1)
            response = np.divide(
                flat, step[..., None], out=np.zeros_like(flat), where=step[..., None] != 0
            )
            for b in range(step.shape[1]):
                known = step[:, b] != 0
                if known.all():
                    continue
                missing = int(np.nonzero(~known)[0][0])
                order = np.argsort(np.abs(self.charges[known] - self.charges[missing]))[:3]
                near = np.nonzero(known)[0][np.sort(order)]
                weights = polynomial_weights(self.charges[near], self.charges[missing])
                response[missing, b] = weights @ response[near, b]
            out.append(response.reshape(array.shape))
        return tuple(out)

    def displacements(
        self, *, charge: float, background: float = 0.0, depth: float
    ) -> Displacements:
        """Interpolate the displacements between the levels of the table.

        Parameters
        ----------
        charge, background : float
            Source charge and charge of all other pixels [e-], within the table's levels.
        depth : float
            Conversion depth [um above the gates], within the table's depths.

        Returns
        -------
        Displacements
            Displacements (dx, dy) of corners and vertices [um], shapes as in the table without
            its first three axes.

        Raises
        ------
        TableError
            A value outside the table; the message names the range, and for the charge the full
            well.

        Examples
        --------
        >>> table = DistortionTable.load("itl_sta3800c")
        >>> table.displacements(charge=50000.0, depth=95.0).corners.shape
        (10, 10, 2)
        """
        low = 0.0 if len(self.charges) == 1 else float(self.charges[0])
        well = "" if np.isnan(self.full_well) else f" (full well {self.full_well:,.0f} e-)"
        self._inside("charge", charge, low, self.charges[-1], f"e-{well}")
        self._inside(
            "background", background, self.backgrounds[0], self.backgrounds[-1], "e-"
        )
        self._inside("depth", depth, self.depths[0], self.depths[-1], "um")
        wq, wb = (
            spline_weights(self.charges, charge),
            spline_weights(self.backgrounds, background),
        )
        out = []
        for response in self._responses:
            at = np.tensordot(wq, np.tensordot(wb, response, (0, 1)), (0, 0))
            if len(self.depths) == 1:
                value = at[0]
            else:
                value = PchipInterpolator(np.log(self.depths), at, axis=0)(np.log(depth))
            out.append((charge - background) * value)
        return Displacements(*out)

    @staticmethod
    def _inside(name: str, value: float, low: float, high: float, unit: str) -> None:
        """Refuse a value outside the table, with a margin for round-off."""
        margin = 1e-9 * max(abs(low), abs(high))
        if not low - margin <= value <= high + margin:
            allowed = f"{low:g}" if low == high else f"from {low:g} to {high:g}"
            raise TableError(
                f"{name} = {value:g} is outside the table, which holds {allowed} {unit}"
            )

    def nominal(self) -> Displacements:
        """Return the positions (x, y) [um] of undistorted vertices, source centre at 0."""
        return nominal_positions(self.pitch, self.reach, vertex_fractions(self.vertices))

    def _outlines(self, moved: Displacements) -> FloatArray:
        """Polygons of all pixels, (n, n, 4 nv + 4, 2), anticlockwise from lower left."""
        at = self.nominal()
        c = at.corners + moved.corners
        h = at.horizontal + moved.horizontal
        v = at.vertical + moved.vertical
        return np.concatenate(
            [
                c[:-1, :-1, None], h[:-1], c[:-1, 1:, None], v[:, 1:],
                c[1:, 1:, None], h[1:, :, ::-1], c[1:, :-1, None], v[:, :-1, ::-1],
            ],
            axis=2,
        )  # fmt: skip

    def polygon(
        self, i: int, j: int, *, charge: float, background: float = 0.0, depth: float
    ) -> FloatArray:
        """Return the boundary of the pixel at offset (i, j) from the source.

        Parameters
        ----------
        i, j : int
            Offset in x and in y [pixel], whole numbers from -reach to reach.
        charge, background, depth : float
            Charges [e-] and conversion depth [um], as in :meth:`displacements`.

        Returns
        -------
        points : ndarray, shape (4 vertices + 4, 2)
            Vertices (x, y) [um], the source pixel's centre at 0, counter-clockwise from the
            middle of the left side, just below the pixel's centre, as in GalSim's tables.

        Raises
        ------
        TableError
            An offset or a value outside the table.
        """
        if max(abs(i), abs(j)) > self.reach:
            raise TableError(
                f"offset ({i}, {j}) is outside the table, which reaches {self.reach} pixels"
            )
        moved = self.displacements(charge=charge, background=background, depth=depth)
        outline = self._outlines(moved)[j + self.reach, i + self.reach]
        return np.roll(outline, self.vertices // 2, axis=0)

    def areas(self, *, charge: float, background: float = 0.0, depth: float) -> FloatArray:
        """Return the areas of all pixels.

        Parameters
        ----------
        charge, background, depth : float
            Charges [e-] and conversion depth [um], as in :meth:`displacements`.

        Returns
        -------
        areas : ndarray, shape (2 reach + 1, 2 reach + 1)
            Areas [um^2], ``areas[j + reach, i + reach]`` for offset i in x and j in y.

        Raises
        ------
        TableError
            A value outside the table.
        """
        p = self._outlines(
            self.displacements(charge=charge, background=background, depth=depth)
        )
        q = np.roll(p, -1, axis=2)
        return np.asarray(
            0.5 * np.sum(p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0], axis=2)
        )

    def area_changes(
        self, *, charge: float, background: float = 0.0, depth: float
    ) -> FloatArray:
        """Return the areas of all pixels less the nominal area.

        Parameters
        ----------
        charge, background, depth : float
            Charges [e-] and conversion depth [um], as in :meth:`displacements`.

        Returns
        -------
        changes : ndarray, shape (2 reach + 1, 2 reach + 1)
            Area changes [um^2], ``changes[j + reach, i + reach]``.

        Raises
        ------
        TableError
            A value outside the table.

        Examples
        --------
        >>> table = DistortionTable.load("itl_sta3800c")
        >>> bool(table.area_changes(charge=50000.0, depth=95.0)[4, 4] < 0)
        True
        """
        return (
            self.areas(charge=charge, background=background, depth=depth)
            - self.pitch[0] * self.pitch[1]
        )

    # -- files -------------------------------------------------------------------------

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write a FITS file under a temporary name, then rename it: half a file never exists.

        Only one quadrant is stored of a table that is mirror-symmetric bit for bit.

        Parameters
        ----------
        path : path-like
            Where to.
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        TableError
            The file exists and ``overwrite`` is not set, or it cannot be written.
        """
        # Not at the top: astropy is slow to load.
        from bfsensor.table.fits_format import write_table

        write_table(self, path, overwrite=overwrite)

    @classmethod
    def load(cls, name: str) -> DistortionTable:
        """Read the table that comes with the package for a built-in device.

        Parameters
        ----------
        name : str
            Name of the device, such as 'e2v_ccd250'.

        Returns
        -------
        DistortionTable

        Raises
        ------
        TableError
            No table of that name; the message lists all names and suggests the most similar one.

        Examples
        --------
        >>> DistortionTable.load("e2v_ccd250").thickness
        100.0
        """
        folder = tables_dir()
        known = sorted(path.parent.name for path in folder.glob("*/table.fits"))
        if name not in known:
            raise TableError(
                f"{name!r} is not a table of bfsensor ({', '.join(known)})"
                f"{did_you_mean(str(name), known)}; files are read by DistortionTable.read"
            )
        return cls.read(folder / name / "table.fits")

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> DistortionTable:
        """Read a table from a FITS file.

        Parameters
        ----------
        path : path-like
            File that :meth:`write` wrote.

        Returns
        -------
        DistortionTable

        Raises
        ------
        TableError
            The file is missing, of another kind or schema, or damaged; the message names it.
        """
        from bfsensor.table.fits_format import read_fields

        fields = read_fields(path)
        try:
            return cls(**fields)
        except (ValueError, TypeError, AttributeError, IndexError) as error:
            raise TableError(f"{Path(path)}: {error}") from None


def _make(values: dict[str, Any]) -> DistortionTable:
    return DistortionTable(**values)


def _keep(table: DistortionTable, name: str, array: FloatArray) -> None:
    """Set a frozen attribute, read-only."""
    array.flags.writeable = False
    object.__setattr__(table, name, array)
