"""The baseline of a diagnosis: boundary shifts per electron, their derivatives, and their file."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bfsensor.checkpoints import digest_of
from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.exposure_info import numbers_of
from bfsensor.diagnose.model.device_solver import DeviceSolver
from bfsensor.effects.family import EffectFamily
from bfsensor.errors import DiagnosisError
from bfsensor.response.edge_response import area_matrix
from bfsensor.typing import Edges, FloatArray
from bfsensor.units import to_kelvin

Key = tuple[float, float]
"""Wavelength [nm] and back bias [V] at which a baseline has shifts."""

BY_FIELD = (
    "doping", "silicon.background_doping", "operating_point.back_bias", "vbb", "back_bias",
)  # fmt: skip
"""Names of parameters that change only the drift field: see :meth:`Baseline.derivative`."""


class Curve(NamedTuple):
    """Change of shifts beyond first order in the parameters, from a solution at other values of them.

    Attributes
    ----------
    pulls : mapping of str to float
        Parameters of the solution, less their nominal values, over their spreads.
    edges : mapping of (wavelength, back_bias) to (dkx, dky)
        Shifts there less those by the derivatives [pixel/e-].
    """

    pulls: Mapping[str, float]
    edges: Mapping[Key, Edges]

    def share(self, pulls: Mapping[str, float]) -> float:
        """Part of the change at other parameters: 1 at those of the solution, 0 at the nominal ones.

        It is the distance along the line between both: predictions stay linear in the parameters, and
        their fit has one minimum, which a square of the distance does not ensure.
        """
        along = sum(value * pulls.get(name, 0.0) for name, value in self.pulls.items())
        return along / sum(value**2 for value in self.pulls.values())


@dataclass(frozen=True, eq=False)
class Baseline:
    """Shifts of pixel boundaries per electron, by condition, and the free parameters they depend on.

    Attributes
    ----------
    name : str
        Path or name of its source, as printed in reports.
    edges : mapping of (wavelength, back_bias) to (kx, ky)
        Shift of the right (kx) and the upper edge (ky) of each pixel per electron stored in the
        central pixel [pixel/e-], positive to the right and upwards, indexed [row dy, column dx];
        all of one shape with odd sides.
    derivatives : mapping of str to (dkx, dky)
        Change of the shifts for a unit of each free device parameter, at ``reference``.
    spread : mapping of str to float
        Standard deviation of each parameter about its nominal value, in its unit.
    reference : tuple of float
        Wavelength [nm] and back bias [V] of the derivatives; nan if the shifts hold at all.
    not_below : tuple of str
        Parameters that cannot be below 0, such as areas that neighbours gain.
    slopes : mapping of (wavelength, back_bias) to (dkx, dky), optional
        Change of the shifts per electron with the level of a flat [pixel/e-^2].
    level : float
        Level [e-] at which the shifts are those of ``edges``, where there are slopes.
    bounds : mapping of str to (float, float)
        Least and greatest value, less the nominal one, of parameters that cannot lie outside.
    nominal : mapping of str to float
        Parameter values that ``edges`` were calculated with.
    held : mapping of (wavelength, back_bias) to mapping of str to (dkx, dky)
        Derivatives calculated at conditions other than ``reference``.
    warming : mapping of (wavelength, back_bias) to (dkx, dky), optional
        Change of the shifts with temperature [pixel/e-/K], where it was calculated.
    temperature : float
        Temperature of ``edges`` [K], where there is warming; nan otherwise.
    spots_bend : bool
        Whether shifts of spots also change with ``slopes``, as those of flats do.
    pieces : tuple of type
        Candidate effects for physics that the simulation leaves out
        (:func:`bfsensor.diagnose.model.left_out_physics.physics_left_out`).

    Raises
    ------
    DiagnosisError
        There are no shifts, their shapes differ or have even sides, or a parameter has no spread.

    Examples
    --------
    >>> k = np.zeros((3, 3)); k[1, 0], k[1, 1] = 1e-7, -1e-7
    >>> baseline = Baseline("mine", {(620.0, -60.0): (k, k.T)}, {}, {}, (620.0, -60.0))
    >>> baseline.reach, baseline.parameters
    (0, ())
    """

    name: str
    edges: Mapping[tuple[float, float], Edges]
    derivatives: Mapping[str, Edges]
    spread: Mapping[str, float]
    reference: tuple[float, float]
    not_below: tuple[str, ...] = ()
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    slopes: Mapping[tuple[float, float], Edges] = field(default_factory=dict)
    bends: Mapping[tuple[float, float], Edges] = field(default_factory=dict)
    """Half of the second derivative by the level [pixel/e-^3], by condition, where there are slopes."""
    level: float = 0.0
    nominal: Mapping[str, float] = field(default_factory=dict)
    card: Mapping[str, Any] = field(default_factory=dict)
    """Known dimensions of the device: 'pixel', 'thickness' [um], 'front' [V], 'absorption' [um] by
    wavelength [nm]."""
    held: Mapping[Key, Mapping[str, Edges]] = field(default_factory=dict)
    warming: Mapping[Key, Edges] = field(default_factory=dict)
    temperature: float = np.nan
    spots_bend: bool = False
    pieces: tuple[EffectFamily, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    """Unit of each parameter in which the values above are, where it is known."""
    accuracy: tuple[str, ...] = ()
    """Parameters that stand for errors of the calculation, not for the device."""
    solver: DeviceSolver | None = None
    """Solver of the device with another value of a quantity; None where the baseline is no device."""
    curve: Curve | None = None
    """Change of the shifts beyond first order, where the device was solved again."""

    def __post_init__(self) -> None:
        if not self.edges:
            raise DiagnosisError(f"{self.name}: no boundary shifts")
        shapes = {a.shape for pair in self.edges.values() for a in pair}
        shapes |= {a.shape for pair in self.derivatives.values() for a in pair}
        if len(shapes) != 1 or any(n % 2 == 0 for n in next(iter(shapes))):
            raise DiagnosisError(
                f"{self.name}: boundary shifts of shapes {sorted(shapes)} must be alike, with "
                "odd sides"
            )
        missing = set(self.derivatives) - set(self.spread)
        if missing:
            raise DiagnosisError(f"{self.name}: no spread for {', '.join(sorted(missing))}")

    @property
    def digest(self) -> str:
        """SHA-256 of all that the baseline predicts with, 64 hexadecimal digits."""
        numbers = (
            self.name, self.reference, self.not_below, self.accuracy, self.level, self.temperature,
            self.spots_bend, sorted(self.bounds.items()), sorted(self.spread.items()),
            sorted(self.nominal.items()),
            [] if self.curve is None else sorted(self.curve.pulls.items()),
            sorted(self.card.items(), key=str), [str(p) for p in self.pieces],
            sorted(self.units.items()), "" if self.solver is None else self.solver.text,
        )  # fmt: skip
        tables: dict[str, Mapping[Any, Edges]] = {
            "edges": self.edges, "slopes": self.slopes, "bends": self.bends,
            "warming": self.warming, "derivatives": self.derivatives,
            "curve": {} if self.curve is None else self.curve.edges,
            **{str(key): of_key for key, of_key in self.held.items()},
        }  # fmt: skip
        arrays = [
            part
            for name, table in tables.items()
            for key, (kx, ky) in sorted(table.items(), key=str)
            for part in (f"{name} {key}".encode(), kx.tobytes(), ky.tobytes())
        ]
        return digest_of([repr(numbers).encode(), *arrays])

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free device parameters."""
        return tuple(self.derivatives)

    @property
    def reach(self) -> int:
        """Largest lag [pixel] at which all edges of a pixel are within the shifts' window."""
        return next(iter(self.edges.values()))[0].shape[0] // 2 - 1

    def without(self, names: Iterable[str]) -> Baseline:
        """Make a copy in which some parameters are fixed at their nominal values.

        Parameters
        ----------
        names : iterable of str
            Parameters to fix; names that are not free are ignored.

        Returns
        -------
        Baseline
            Copy without their derivatives.
        """
        gone = set(names)
        kept = {k: v for k, v in self.derivatives.items() if k not in gone}
        floors = tuple(n for n in self.not_below if n in kept)
        bounds = {n: ends for n, ends in self.bounds.items() if n in kept}
        errors = tuple(n for n in self.accuracy if n in kept)
        return replace(
            self, derivatives=kept, not_below=floors, bounds=bounds, accuracy=errors
        )

    def nearest(self, condition: Condition) -> tuple[float, float]:
        """Find the condition with shifts that is nearest in back bias, then in wavelength.

        Parameters
        ----------
        condition : Condition
            Wavelength [nm], back bias [V]; unknown ones are taken as the reference's.

        Returns
        -------
        wavelength, back_bias : float
            A key of ``edges``.
        """
        wavelength, bias = (
            given if np.isfinite(given) else own
            for given, own in zip(numbers_of(condition)[:2], self.reference, strict=True)
        )
        return min(self.edges, key=lambda k: (_off(k[1], bias), _off(k[0], wavelength)))

    def at(
        self, condition: Condition, change: Mapping[str, float] | None = None
    ) -> tuple[Edges, bool]:
        """Calculate the shifts at a condition, with device parameters changed.

        Parameters
        ----------
        condition : Condition
            Wavelength [nm], back bias [V] and temperature [K]; the nearest condition with shifts
            is used, and scaled to the temperature where ``warming`` holds it.
        change : mapping of str to float, optional
            Device parameters less their nominal values, in their units.

        Returns
        -------
        (kx, ky) : tuple of ndarray
            Shifts per electron [pixel/e-].
        exact : bool
            Whether the nearest condition is within 0.5 nm and 0.5 V.
        """
        key = self.nearest(condition)
        kx, ky = self.edges[key]
        exact = all(
            not _off(given, own) >= 0.5
            for given, own in zip(numbers_of(condition)[:2], key, strict=True)
        )
        if key in self.warming:
            warmer = _signed(numbers_of(condition)[2], self.temperature)
            if warmer:
                tx, ty = self.warming[key]
                kx, ky = kx + warmer * tx, ky + warmer * ty
        for name, value in (change or {}).items():
            dkx, dky = self.derivative(name, key)
            kx = kx + value * dkx
            ky = ky + value * dky
        if change and self.curve is not None and key in self.curve.edges:
            share = self.curve.share({n: v / self.spread[n] for n, v in change.items()})
            dkx, dky = self.curve.edges[key]
            kx, ky = kx + share * dkx, ky + share * dky
        return (kx, ky), exact

    def derivative(self, name: str, key: Key) -> Edges:
        r"""Calculate the change of the shifts for a unit of a parameter, at one of the conditions.

        A derivative that was calculated at that condition is returned as it is.  Otherwise that of
        the reference is scaled by a power of the ratio r of the areas a_00.  Shifts are
        proportional to the field of the stored charge over the drift field E: a parameter of the
        charge's field (heights, widths) changes them by r times its effect at the reference, and a
        parameter of E alone, :data:`BY_FIELD`, by :math:`r^2` times, as
        :math:`d(1/E) = -dE/E^2`.

        Parameters
        ----------
        name : str
            One of ``parameters``.
        key : tuple of float
            Wavelength [nm] and back bias [V], a key of ``edges``.

        Returns
        -------
        dkx, dky : ndarray
            Change of the shifts [pixel/e- per unit of the parameter].

        Notes
        -----
        Compared with full solutions of the virtual sensor of ``validation.concealed`` at 20 V
        less back bias, where r = 1.37, the largest error over the largest change at lags to 2 is:
        doping 0.1 % (26.7 % with r), h, zx, zy 0.3 %, wx, wy 1 %, thickness, which changes both
        fields, 10 %.  At 950 nm, r = 0.97, the depth of conversion is not accounted for: h, doping
        3 %, zx, zy 2 %, wx, wy, thickness 5 to 7 %.

        Examples
        --------
        >>> k = np.zeros((3, 3)); k[1, 1] = -1e-6; zero = np.zeros((3, 3))
        >>> edges = {(620.0, -60.0): (k, zero), (620.0, -40.0): (1.5 * k, zero)}
        >>> d = {"h": (k, zero), "doping": (k, zero)}
        >>> b = Baseline("two", edges, d, {"h": 0.1, "doping": 0.1}, (620.0, -60.0))
        >>> [float((b.derivative(n, (620.0, -40.0))[0][1, 1] / k[1, 1]).round(3)) for n in d]
        [1.5, 2.25]
        """
        own = self.held.get(key, {})
        if name in own:
            return own[name]
        dkx, dky = self.derivatives[name]
        factor = self.scale_at(key) ** (2 if name in BY_FIELD else 1)
        return factor * dkx, factor * dky

    def derivatives_by_condition(self) -> dict[str, dict[Key, Edges]]:
        """Calculate the derivatives of all parameters at all conditions of ``edges``.

        Returns
        -------
        dict of str to dict of (wavelength, back_bias) to (dkx, dky)
            Change of the shifts for a unit of each parameter [pixel/e- per unit], the straight line
            through a second solution included.
        """
        out = {}
        for name in self.derivatives:
            out[name] = {key: self.derivative(name, key) for key in self.edges}
            if self.curve is None or name not in self.curve.pulls:
                continue
            # What :meth:`Curve.share` adds for a unit of the parameter.
            share = self.curve.share({name: 1 / self.spread[name]})
            for key, (x, y) in self.curve.edges.items():
                dkx, dky = out[name][key]
                out[name][key] = dkx + share * x, dky + share * y
        return out

    def scale_at(self, key: tuple[float, float]) -> float:
        """Calculate the ratio of a_00 at a condition of ``edges`` to that at the reference.

        Parameters
        ----------
        key : tuple of float
            Wavelength [nm] and back bias [V], a key of ``edges``.

        Returns
        -------
        float
            The ratio; 1 where a_00 at the reference is 0.
        """
        own = self.edges[key]
        nominal = centre(*self.edges.get(self.reference, own))
        return centre(*own) / nominal if nominal else 1.0

    def edges_on(
        self, condition: Condition, change: Mapping[str, float] | None, background: float
    ) -> Edges:
        """Calculate the shifts per electron where all pixels hold a background.

        Parameters
        ----------
        condition, change
            As for :meth:`at`.
        background : float
            Charge in all pixels [e-].

        Returns
        -------
        kx, ky : ndarray
            Shifts of right and upper edges [pixel/e-].
        """
        kx, ky = self.at(condition, change)[0]
        away, key = background - self.level, self.nearest(condition)
        for power, more in ((1, self.slopes), (2, self.bends)):
            if key in more:
                kx = kx + away**power * more[key][0]
                ky = ky + away**power * more[key][1]
        return kx, ky

    def areas_on(
        self, condition: Condition, change: Mapping[str, float] | None, background: float
    ) -> FloatArray:
        """Calculate the area changes per electron where all pixels hold a background.

        Parameters
        ----------
        condition, change
            As for :meth:`at`.
        background : float
            Charge in all pixels [e-].

        Returns
        -------
        ndarray
            Area changes, lag (0, 0) in the middle [1/e-].
        """
        return area_matrix(*self.edges_on(condition, change, background))

    def flat_areas(
        self,
        condition: Condition,
        change: Mapping[str, float] | None,
        levels: FloatArray,
    ) -> FloatArray:
        r"""Calculate the effective area changes per electron [1/e-] of flats of given levels.

        To first order in a, covariances grow as :math:`2\int a(\mu)\,\mu\,d\mu`.  A response that
        is linear in the level therefore counts as at 2/3 of the level reached; a quadratic term
        adds 1/18 of the level squared.

        Parameters
        ----------
        condition, change
            As for :meth:`at`.
        levels : ndarray, shape (n,)
            Levels of the flats [e-].

        Returns
        -------
        a : ndarray, shape (n, ny, nx), or (ny, nx) without slopes
            Area changes, lag (0, 0) in the middle [1/e-].
        """
        a = area_matrix(*self.at(condition, change)[0])
        key = self.nearest(condition)
        if key not in self.slopes:
            return a
        return a + level_areas(self.slopes[key], self.bends.get(key), self.level, levels)


def level_areas(
    slope: Edges,
    bend: Edges | None,
    level: float,
    levels: FloatArray,
    *,
    grown: bool = True,
) -> FloatArray:
    """Calculate the area changes per electron [1/e-] by a response that changes with the level.

    ``slope`` is the derivative of the shifts by the level [pixel/e-^2]; the second argument is half
    the second derivative [pixel/e-^3], or None.  The change is 0 at ``level`` [e-].  ``levels``, shape
    (n,), are those of flats if ``grown``, as in :meth:`Baseline.flat_areas`, or of a background that
    was there before [e-].
    """
    away = ((2 / 3 if grown else 1.0) * levels - level)[:, None, None]
    a = away * area_matrix(*slope)
    if bend is not None:
        # The mean of the square over a flat's growth, weighted by the level, is 1/2 of its
        # level's, against 4/9 of the square of the mean.
        spread = (levels**2 / 18)[:, None, None] if grown else 0.0
        a = a + (away**2 + spread) * area_matrix(*bend)
    return np.asarray(a)


def _off(one: float, other: float) -> float:
    """Absolute difference; 0 where either is unknown, so that an unknown setting matches any."""
    return abs(one - other) if np.isfinite(one) and np.isfinite(other) else 0.0


def _signed(one: float, other: float) -> float:
    """Difference with sign; 0 where either is unknown."""
    return one - other if np.isfinite(one) and np.isfinite(other) else 0.0


def centre(kx: FloatArray, ky: FloatArray) -> float:
    """Area change of the pixel that holds the charge, a_00 [1/e-]."""
    a = area_matrix(kx, ky)
    return float(a[a.shape[0] // 2, a.shape[1] // 2])


def read_edges(
    path: str | os.PathLike[str], *, card: str | os.PathLike[str] | None = None
) -> Baseline:
    """Read a baseline from a file of edge displacements and, optionally, a device card beside it.

    A device card, the keyword-only argument, is a JSON file with ``spread_1sigma``, the standard
    deviation of each parameter in its unit, and optionally ``nominal``; without one no parameter
    is free.

    Parameters
    ----------
    path : path-like
        JSON with the key ``conditions``: by "WAVELENGTH_BACKBIAS" [nm, V], such as "620_-60",
        the shifts ``kx`` and ``ky`` [pixel/e-].  Optional keys:
        ``derivatives_WAVELENGTH_mBACKBIAS`` (m for minus; the reference's first): by parameter
        ``dkx`` and ``dky``; ``slopes``: by condition
        ``dkx`` and ``dky`` with the level about ``level`` [e-] (half of the second derivatives under
        a key of their own, see :func:`~bfsensor.diagnose.model.device_baseline.write_edges`);
        ``warming``: by condition, with the temperature about ``temperature`` [deg C].

    Returns
    -------
    Baseline
        Shifts, with derivatives of the parameters that have a spread.

    Raises
    ------
    DiagnosisError
        A file cannot be read, or lacks a key; names the file and the key.

    Examples
    --------
    >>> import tempfile
    >>> text = {"conditions": {"620_-60": {"kx": [[-1e-7]], "ky": [[-1e-7]]}}}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "edges.json"
    ...     _ = path.write_text(json.dumps(text))
    ...     list(read_edges(path).edges)
    [(620.0, -60.0)]
    """
    try:
        text = json.loads(Path(path).read_text())
        edges = {
            _key(name, path): (np.array(v["kx"], float), np.array(v["ky"], float))
            for name, v in text["conditions"].items()
        }
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise DiagnosisError(
            f"{path}: not a file of edge displacements: {error!r}"
        ) from None
    if not edges:
        raise DiagnosisError(f"{path}: no boundary shifts")
    held: dict[Key, dict[str, Edges]] = {}
    reference = next(iter(edges))
    try:
        for name, block in text.items():
            if not name.startswith("derivatives"):
                continue
            part = name.removeprefix("derivatives_").replace("m", "-")
            key = _key(part, path) if "_" in part else reference
            reference = reference if held else key
            held[key] = _pairs(block, "dkx", "dky")
        slopes, bends, warming = (
            {_key(k, path): _pair(v, "dkx", "dky") for k, v in text.get(word, {}).items()}
            for word in ("slopes", "bends", "warming")
        )
        level, celsius = (
            other if text.get(word) is None else float(text[word])
            for word, other in (("level", 0.0), ("temperature", np.nan))
        )
    except (KeyError, ValueError, TypeError) as error:
        raise DiagnosisError(
            f"{path}: not a file of edge displacements: {error!r}"
        ) from None
    derivatives = held.get(reference, {})
    spread: dict[str, float] = {}
    nominal: dict[str, float] = {}
    known: dict[str, Any] = {}
    units: dict[str, str] = {}
    bounds: dict[str, tuple[float, float]] = {}
    accuracy: list[str] = []
    if card is not None:
        try:
            told = json.loads(Path(card).read_text())
            spread = {k: float(v) for k, v in told["spread_1sigma"].items()}
            nominal = {k: float(v) for k, v in told.get("nominal", {}).items()}
            known = dict(told.get("card", {}))
            units = {k: str(v) for k, v in told.get("units", {}).items()}
            accuracy = [str(n) for n in told.get("accuracy", [])]
            bounds = {
                k: (float(low), float(high))
                for k, (low, high) in told.get("bounds", {}).items()
            }
            known |= {
                name: nominal[key]
                for name, key in (
                    ("pixel", "pixel"),
                    ("thickness", "thickness"),
                    ("front", "vfront"),
                )
                if key in nominal
            }
            if "absorption_um" in told:
                known["absorption"] = {
                    float(k): float(v) for k, v in told["absorption_um"].items()
                }
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise DiagnosisError(
                f"{card}: not a JSON file with 'spread_1sigma' by parameter: {error!r}"
            ) from None
    derivatives = {k: v for k, v in derivatives.items() if k in spread}
    return Baseline(
        str(path), edges, derivatives, spread, reference, nominal=nominal, card=known,
        held=held, slopes=slopes, bends=bends, level=level, warming=warming,
        temperature=to_kelvin(celsius), spots_bend=bool(text.get("spots_bend", False)),
        units=units, bounds={k: v for k, v in bounds.items() if k in derivatives},
        accuracy=tuple(n for n in accuracy if n in derivatives),
    )  # fmt: skip


def _pair(block: Mapping[str, Any], one: str, other: str) -> Edges:
    return np.array(block[one], float), np.array(block[other], float)


def _pairs(block: Mapping[str, Any], one: str, other: str) -> dict[str, Edges]:
    return {name: _pair(v, one, other) for name, v in block.items()}


def _key(text: str, path: str | os.PathLike[str]) -> tuple[float, float]:
    try:
        wavelength, bias = (float(part) for part in text.split("_"))
    except ValueError:
        raise DiagnosisError(
            f"{path}: condition {text!r} is not WAVELENGTH_BACKBIAS, such as 620_-60"
        ) from None
    return wavelength, bias
