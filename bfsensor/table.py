"""Distortion tables: how far every vertex of the pixel boundaries moves.

The source pixel holds a charge, all other pixels a uniform background, and the light
converts at some depth; the table holds the total displacement of the vertices around the
source pixel for levels of all three.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from bfsensor.errors import TableError
from bfsensor.files import refuse_existing, written_whole
from bfsensor.interpolation import polynomial_weights, spline_weights

SCHEMA = "bfsensor distortion table"
SCHEMA_VERSION = 1

_ARRAYS = ("corners", "horizontal", "vertical")
_AXES = ("charges", "backgrounds", "depths")


def vertex_fractions(vertices: int) -> NDArray[np.float64]:
    """Nominal positions of the vertices along a side, 0 to 1, denser at the middle.

    Equal steps of the angle seen from the pixel centre, as in GalSim's tables, so that a
    table can be exported without resampling.

    Parameters
    ----------
    vertices : int
        Vertices between the corners.

    Returns
    -------
    fractions : ndarray, shape (vertices,)

    Examples
    --------
    >>> vertex_fractions(1)
    array([0.5])
    """
    angle = -np.pi / 4 + (np.arange(vertices) + 1) * np.pi / (2 * (vertices + 1))
    return np.asarray((np.tan(angle) + 1) / 2)


@dataclass(frozen=True)
class Displacements:
    """Displacements (dx, dy) [um] of corners and side vertices at one point of a table."""

    corners: NDArray[np.float64]
    horizontal: NDArray[np.float64]
    vertical: NDArray[np.float64]


def nominal_positions(
    pitch: tuple[float, float], reach: int, fractions: NDArray[np.float64]
) -> Displacements:
    """Positions (x, y) [um] of the vertices of undistorted pixels around (0, 0)."""
    n = 2 * reach + 1
    x = (np.arange(n + 1) - reach - 0.5) * pitch[0]
    y = (np.arange(n + 1) - reach - 0.5) * pitch[1]
    corners = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)
    along_x = (x[:-1, None] + fractions * pitch[0])[None]
    along_y = (y[:-1, None] + fractions * pitch[1])[:, None]
    horizontal = np.stack(np.broadcast_arrays(along_x, y[:, None, None]), -1)
    vertical = np.stack(np.broadcast_arrays(x[None, :, None], along_y), -1)
    return Displacements(corners, horizontal, vertical)


@dataclass(frozen=True, eq=False)
class DistortionTable:
    """Total displacement of the pixel vertices around a source pixel.

    Attributes
    ----------
    charges : ndarray, shape (nq,)
        Charge of the source pixel [e-], ascending.
    backgrounds : ndarray, shape (nb,)
        Charge of every other pixel [e-], ascending.
    depths : ndarray, shape (nd,)
        Conversion depths [um above the gates], ascending, above 0 up to the thickness.
    pitch : tuple of float
        Pixel pitch in x and y [um].
    thickness : float
        Height of the back surface [um].
    vertices : int
        Vertices a side between the corners, at :func:`vertex_fractions`.
    reach : int
        Pixel offsets -reach..reach.
    corners : ndarray, shape (nq, nb, nd, 2 reach + 2, 2 reach + 2, 2)
        Displacement (dx, dy) [um] of the corners, by edge line in y, then x.
    horizontal : ndarray, shape (nq, nb, nd, 2 reach + 2, 2 reach + 1, vertices, 2)
        Of vertices on edges along x: edge line in y, pixel in x.
    vertical : ndarray, shape (nq, nb, nd, 2 reach + 1, 2 reach + 2, vertices, 2)
        Of vertices on edges along y: pixel in y, edge line in x.
    full_well : float
        Charge at which a pixel spills along its column [e-]; nan where not known.
    errors : mapping of str to float
        Estimated errors, units in the names; nan where an estimate failed.
    provenance : mapping of str to str
        How it was made.
    device_text : str
        The device file, empty where not known.
    symmetric : bool
        Whether x and y through the source pixel's centre are mirror lines.

    Notes
    -----
    Where the source charge equals the background nothing moves.  Between levels the
    response D / (Q - B) is interpolated and multiplied by Q - B, so that this holds
    everywhere: cubic splines in charge and background (below four levels the polynomial
    through them), monotone cubics in the logarithm of depth.  At a node with Q = B the
    response is that of the polynomial through the three nearest charges.  Nodes come back
    to round-off.  A table of one charge is linear in charge from 0 on, as GalSim's are.

    Arrays are kept in single precision (1e-7 of a displacement) so that reading what was
    written gives the same bits.

    Examples
    --------
    >>> from bfsensor.resources import tables_dir
    >>> table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
    >>> change = table.area_changes(charge=50000.0, depth=95.0)
    >>> bool(change[4, 4] < 0 < change[4, 5] < change[5, 4])
    True
    """

    charges: NDArray[np.float64]
    backgrounds: NDArray[np.float64]
    depths: NDArray[np.float64]
    pitch: tuple[float, float]
    thickness: float
    vertices: int
    reach: int
    corners: NDArray[np.float64] = field(repr=False)
    horizontal: NDArray[np.float64] = field(repr=False)
    vertical: NDArray[np.float64] = field(repr=False)
    full_well: float = float("nan")
    errors: Mapping[str, float] = field(default_factory=dict, repr=False)
    provenance: Mapping[str, str] = field(default_factory=dict, repr=False)
    device_text: str = field(default="", repr=False)
    symmetric: bool = True

    def __post_init__(self) -> None:
        self._check_numbers()
        for name in _AXES:
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
        errors = {str(k): float(v) for k, v in self.errors.items()}
        provenance = {str(k): str(v) for k, v in self.provenance.items()}
        object.__setattr__(self, "errors", MappingProxyType(errors))
        object.__setattr__(self, "provenance", MappingProxyType(provenance))

    def _check_numbers(self) -> None:
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

    def __reduce__(self) -> tuple[Any, ...]:
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        values["errors"], values["provenance"] = dict(self.errors), dict(self.provenance)
        return _make, (values,)

    # -- questions ---------------------------------------------------------------------

    @cached_property
    def _responses(self) -> tuple[NDArray[np.float64], ...]:
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
        """Displacements between the levels of the table.

        Parameters
        ----------
        charge, background : float
            Source charge and charge of all other pixels [e-].
        depth : float
            Conversion depth [um above the gates].

        Returns
        -------
        Displacements

        Raises
        ------
        TableError
            A value outside the table; names the range, and for the charge the full well.
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
        margin = 1e-9 * max(abs(low), abs(high))
        if not low - margin <= value <= high + margin:
            allowed = f"{low:g}" if low == high else f"from {low:g} to {high:g}"
            raise TableError(
                f"{name} = {value:g} is outside the table, which holds {allowed} {unit}"
            )

    def nominal(self) -> Displacements:
        """Give the positions (x, y) [um] of undistorted vertices, source centre at 0."""
        return nominal_positions(self.pitch, self.reach, vertex_fractions(self.vertices))

    def _outlines(self, moved: Displacements) -> NDArray[np.float64]:
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
    ) -> NDArray[np.float64]:
        """Boundary of the pixel at offset (i, j) from the source.

        Parameters
        ----------
        i, j : int
            Offset in x and in y [pixel], whole numbers from -reach to reach.
        charge, background, depth : float
            As in :meth:`displacements`.

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

    def areas(
        self, *, charge: float, background: float = 0.0, depth: float
    ) -> NDArray[np.float64]:
        """Areas of all pixels [um^2].

        Returns
        -------
        areas : ndarray, shape (2 reach + 1, 2 reach + 1)
            ``areas[j + reach, i + reach]`` for offset i in x and j in y.
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
    ) -> NDArray[np.float64]:
        """Areas less the nominal area [um^2], see :meth:`areas`."""
        return (
            self.areas(charge=charge, background=background, depth=depth)
            - self.pitch[0] * self.pitch[1]
        )

    # -- files -------------------------------------------------------------------------

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write a FITS file (beside, then renamed).

        Of a table that is mirror-symmetric bit for bit only a quadrant is stored.

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
        from astropy.io import fits

        refuse_existing(path, overwrite, TableError)
        arrays = {name: getattr(self, name) for name in self._shapes()}
        quadrants = {name: _quadrant(array) for name, array in arrays.items()}
        quadrant = self.symmetric and all(
            np.array_equal(_whole(name, quadrants[name]), array)
            for name, array in arrays.items()
        )
        if quadrant:
            arrays = quadrants
        primary = fits.PrimaryHDU()
        header = primary.header
        header["SCHEMA"] = (SCHEMA, "what this file is")
        header["SCHEMAV"] = (SCHEMA_VERSION, "version of the schema")
        header["BUNIT"] = ("um", "unit of all displacements")
        header["VERTICES"] = (self.vertices, "vertices a side between the corners")
        header["REACH"] = (self.reach, "largest pixel offset")
        header["QUADRANT"] = (quadrant, "only offsets >= 0 are stored, the rest mirrored")
        header["SYMMETRC"] = (self.symmetric, "mirror-symmetric about the source pixel")
        header["PITCHX"] = (self.pitch[0], "[um] pixel pitch along the gates")
        header["PITCHY"] = (self.pitch[1], "[um] pixel pitch along the channel stops")
        header["THICKNSS"] = (self.thickness, "[um] height of the back surface")
        if np.isfinite(self.full_well):
            header["FULLWELL"] = (
                self.full_well,
                "[electron] charge at which a pixel spills",
            )
        header["DATE"] = (
            datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"),
            "[UTC] when this file was written",
        )
        # For people who look at the header; META is what is read back.
        for key, text in self.provenance.items():
            header["HISTORY"] = _printable(f"{key} = {text}")
        for key, error in self.errors.items():
            header["COMMENT"] = _printable(f"error: {key} = {error:.3g}")
        hdus = [primary]
        for name, array in arrays.items():
            hdu = fits.ImageHDU(array.astype(np.float32), name=name.upper())
            hdu.header["BUNIT"] = "um"
            hdus.append(hdu)
        for name, unit in zip(_AXES, ("electron", "electron", "um"), strict=True):
            hdu = fits.ImageHDU(getattr(self, name), name=name.upper())
            hdu.header["BUNIT"] = unit
            hdus.append(hdu)
        meta = json.dumps(
            {"errors": dict(self.errors), "provenance": dict(self.provenance)},
            sort_keys=True,
        )
        for name, text in (("META", meta), ("DEVICE", self.device_text)):
            data = np.frombuffer(text.encode(), np.uint8) if text else None
            hdus.append(fits.ImageHDU(data, name=name))
        with written_whole(path, TableError) as beside:
            fits.HDUList(hdus).writeto(beside, checksum=True, overwrite=True)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> DistortionTable:
        """Read what :meth:`write` wrote.

        Raises
        ------
        TableError
            Not such a file, an unknown schema, or damaged; names the file.
        """
        from astropy.io import fits
        from astropy.utils.exceptions import AstropyWarning

        path = Path(path)
        if not path.exists():
            raise TableError(f"{path}: no such file")
        try:
            with warnings.catch_warnings():
                # astropy only warns of a wrong checksum or a short file.
                warnings.simplefilter("error", AstropyWarning)
                # Opened here: astropy leaves a file open in whose headers it fails.
                with open(path, "rb") as stream, fits.open(stream, checksum=True) as hdus:
                    header = hdus[0].header
                    _check_schema(header, path)
                    data = {hdu.name: hdu.data for hdu in hdus[1:]}
                    hdus[0].verify("exception")
        except TableError:
            raise
        # Damaged headers end in many kinds of exception inside astropy.
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise TableError(f"{path}: not a FITS file, or damaged: {reason}") from None
        needed = [name.upper() for name in (*_ARRAYS, *_AXES, "meta", "device")]
        missing = [name for name in needed if name not in data]
        if missing:
            raise TableError(f"{path}: truncated: {', '.join(missing)} is missing")
        try:
            return cls._from_parts(header, data)
        except KeyError as error:
            raise TableError(
                f"{path}: not a FITS file, or damaged: {error.args[0]}"
            ) from None
        except (ValueError, TypeError, AttributeError, IndexError) as error:
            raise TableError(f"{path}: {error}") from None

    @classmethod
    def _from_parts(
        cls, header: Mapping[str, Any], data: dict[str, Any]
    ) -> DistortionTable:
        arrays = {}
        for name in _ARRAYS:
            array = np.array(data[name.upper()], float)
            arrays[name] = _whole(name, array) if header["QUADRANT"] else array
        meta = json.loads(_text(data["META"]))
        return cls(
            **{name: np.array(data[name.upper()], float) for name in _AXES},
            pitch=(header["PITCHX"], header["PITCHY"]),
            thickness=header["THICKNSS"],
            vertices=header["VERTICES"],
            reach=header["REACH"],
            full_well=header.get("FULLWELL", float("nan")),
            errors=meta["errors"],
            provenance=meta["provenance"],
            device_text=_text(data["DEVICE"]),
            symmetric=header["SYMMETRC"],
            **arrays,
        )


def _make(values: dict[str, Any]) -> DistortionTable:
    return DistortionTable(**values)


def _keep(table: DistortionTable, name: str, array: NDArray[np.float64]) -> None:
    """Set a frozen attribute, read-only."""
    array.flags.writeable = False
    object.__setattr__(table, name, array)


def _check_schema(header: Mapping[str, Any], path: Path) -> None:
    """Refuse what is not a table of the schema that this version reads."""
    if header.get("SCHEMA") != SCHEMA:
        raise TableError(f"{path}: not a distortion table (no SCHEMA = '{SCHEMA}')")
    if header.get("SCHEMAV") != SCHEMA_VERSION:
        raise TableError(
            f"{path}: schema version {header.get('SCHEMAV')} is not {SCHEMA_VERSION}, the "
            "one this version of bfsensor reads"
        )


def _printable(text: str) -> str:
    """Turn text into what a FITS header may hold."""
    return text.encode("unicode_escape").decode("ascii")


def _text(data: NDArray[np.uint8] | None) -> str:
    """Decode the text of an extension; none where it has no data."""
    return "" if data is None else data.astype(np.uint8).tobytes().decode()


def _quadrant(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cut out the offsets from the source pixel's centre on."""
    ny, nx = array.shape[3:5]
    return array[:, :, :, ny // 2 :, nx // 2 :]


def _whole(name: str, quadrant: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mirror a quadrant to the whole array; the source's own row and column stay."""
    x, y, vertex = 4, 3, 5
    for axis, sides, sign in ((x, "horizontal", (-1.0, 1.0)), (y, "vertical", (1.0, -1.0))):
        mirrored = np.flip(quadrant, axis) * np.array(sign)
        if name == sides:  # its vertices run along the axis, and it counts pixels there
            mirrored = np.flip(mirrored, vertex)
            mirrored = np.delete(mirrored, -1, axis)
        quadrant = np.concatenate([mirrored, quadrant], axis) + 0.0
    return quadrant
