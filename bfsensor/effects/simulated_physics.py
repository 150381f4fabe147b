"""Physics that a simulation left out: templates are differences of its tables, with and without."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bfsensor.effects.device_parameter import add_edges, nearest_edges
from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.effects.tree_rings import TreeRings
from bfsensor.typing import Edges, FloatArray

Key = tuple[float, float]
Held = tuple[tuple[Key, Edges], ...]
"""Wavelength [nm] and back bias [V], and what belongs to them."""

STRENGTH = Parameter("strength", "", -2.0, 2.0, law="flat", signed=True, amplitude=True)
"""1: all of it, as simulated; 0: as the baseline.  Flat, so that fits stay within 4: straight lines
mean nothing at ten times the piece."""


class QuadraticTemplate(NamedTuple):
    """Change of the shifts with the charge about a level [e-], and half its second derivative."""

    level: float
    slopes: Held
    bends: Held


class Moved(NamedTuple):
    """Change of the shifts [pixel/e-] by all of a piece, with the temperature [per K], with charge."""

    edges: Held
    warming: Held = ()
    temperature: float = np.nan
    bent: QuadraticTemplate | None = None


class DiffusionWidths(NamedTuple):
    """Variance of the landing place [pixel^2] by condition, at a temperature [K]."""

    held: tuple[tuple[Key, float], ...]
    temperature: float


class Rings(NamedTuple):
    """Amplitude of the displacements [pixel] of all of the ripple, by period [pixel]."""

    periods: FloatArray
    held: tuple[tuple[Key, FloatArray], ...]


class Rim(NamedTuple):
    """Displacements [pixel] of the boundaries 0, 1, ... from the edge, inwards."""

    held: tuple[tuple[Key, FloatArray], ...]


class LeftOut(Effect):
    """A piece of physics, ``strength`` of it; made by :func:`left_out` for a baseline."""

    stage = "collect"
    parameters = (STRENGTH,)
    template: ClassVar[Any]

    def __reduce__(self) -> tuple[Any, ...]:
        kind = type(self)
        given = kind.word, kind.variant, kind.template, kind.source, kind.parameters
        return _restore, (kind.__mro__[1], given, dict(self.values))

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        del layout, seen
        return [{"strength": 1.0}]


class MovedEdges(LeftOut):
    """Shifts of a device with a piece less those without it, straight between."""

    touches = ("flat_cov", "spot")

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        del layout
        strength, told = self["strength"], self.template
        if strength == 0.0:
            return kx, ky
        moved = add_edges((kx, ky), nearest_edges(told.edges, shot), strength)
        warmer = shot.temperature - told.temperature
        if told.warming and np.isfinite(warmer):
            moved = add_edges(moved, nearest_edges(told.warming, shot), strength * warmer)
        return moved

    def level_response(
        self, shot: Shot, layout: Layout
    ) -> tuple[float, Edges, Edges] | None:
        del layout
        return _response(self.template.bent, self["strength"], shot)


class BentResponse(LeftOut):
    """Shifts change with the charge that is there, each lag as its table says."""

    touches = ("flat_cov", "spot")

    def level_response(
        self, shot: Shot, layout: Layout
    ) -> tuple[float, Edges, Edges] | None:
        del layout
        return _response(self.template, self["strength"], shot)


def _response(
    told: QuadraticTemplate | None, strength: float, shot: Shot
) -> tuple[float, Edges, Edges] | None:
    """So much of a response by level; None of none."""
    if told is None or strength == 0.0:
        return None
    (sx, sy), (bx, by) = (nearest_edges(h, shot) for h in (told.slopes, told.bends))
    return told.level, (strength * sx, strength * sy), (strength * bx, strength * by)


class FieldDiffusion(LeftOut):
    """Spots are wider by what electrons diffuse in the device's own field."""

    stage = "light"
    touches = ("spot",)

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, float, float]:
        del layout
        told = self.template
        heat = shot.temperature / told.temperature
        heat = heat if np.isfinite(heat) else 1.0
        return self["strength"] * heat * _nearest(told.held, shot), 0.0, 1.0


class DopingRings(LeftOut):
    """Rings of the doping: what :class:`TreeRings` are at each light and back bias.

    ``strength`` in units of the ripple that the template is of.
    """

    touches = ("flat_map",)

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        usual = Shot("flat", 0, 1.0, *layout.reference)
        out = []
        for values in TreeRings.starts(layout, seen):
            size = cls._size(values["period"], usual)
            shape = {k: v for k, v in values.items() if k != "amp"}
            out.append({"strength": values["amp"] / size} | shape)
        return out

    @classmethod
    def _size(cls, period: float, shot: Shot) -> float:
        told = cls.template
        return float(np.interp(period, told.periods, _nearest(told.held, shot)))

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        size = self._size(self["period"], shot)
        shape = {k: v for k, v in self.values.items() if k != "strength"}
        rings = TreeRings({"amp": self["strength"] * size} | shape)
        return rings.displacements(shot, layout)


class EdgeFieldLeftOut(LeftOut):
    """The field at the rim of the array: pixels reach farther out, or less far."""

    touches = ("flat_map",)

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        strength = self["strength"]
        if strength == 0.0:
            return None
        inwards = strength * _nearest(self.template.held, shot)
        ny, nx = layout.shape
        x, y = (_both_ends(inwards, n) for n in (nx, ny))
        return (
            np.broadcast_to(x, (ny, nx + 1)),
            np.broadcast_to(y[:, None], (ny + 1, nx)),
        )


def _both_ends(inwards: FloatArray, n: int) -> FloatArray:
    """Displacements of the edges between n pixels, towards larger numbers."""
    out = np.zeros(n + 1)
    reach = min(len(inwards), (n + 1) // 2)
    out[:reach] += inwards[:reach]
    out[-reach:] -= inwards[:reach][::-1]
    return out


def _nearest(held: Sequence[tuple[Key, Any]], shot: Shot) -> Any:
    """What is held for the nearest back bias, and the nearest wavelength there."""
    return min(
        held,
        key=lambda s: (abs(s[0][1] - shot.back_bias), abs(s[0][0] - shot.wavelength)),
    )[1]


def ring_parameters(size: float) -> tuple[Parameter, ...]:
    """Parameters of doping rings whose displacement is ``size`` pixels at strength 1."""
    amp, *shape = TreeRings.parameters
    strength = STRENGTH._replace(
        low=amp.low / size, high=amp.high / size, law="log", signed=False
    )
    return (strength, *shape)


_KINDS: dict[str, type[LeftOut]] = {}


def left_out(
    base: type[LeftOut],
    word: str,
    variant: str,
    template: Any,
    source: str,
    parameters: tuple[Parameter, ...] = (STRENGTH,),
) -> type[LeftOut]:
    """Make a candidate: one class for each piece of a baseline, the same for the same template.

    Parameters
    ----------
    base : type
        What the piece does: one of this module's classes.
    word, variant : str
        Class word, and what tells it from others of the word.
    template : Moved, QuadraticTemplate, DiffusionWidths, Rings or Rim
        As ``base`` takes it.
    source : str
        Where it comes from.
    parameters : tuple of Parameter
        ``strength``, and of the shape.

    Examples
    --------
    >>> k = np.zeros((3, 3)); k[1, 1] = -1e-6
    >>> told = Moved((((620.0, -50.0), (k, k.T)),))
    >>> kind = left_out(MovedEdges, "free_holes", "", told, "a test")
    >>> shot = Shot("flat", 0, 1.0, 620.0, -50.0, 173.15)
    >>> float(kind({"strength": 0.5}).edges(k, k.T, shot, None)[0][1, 1])
    -1.5e-06
    """
    given = word, variant, template, source, parameters
    key = hashlib.sha256(pickle.dumps((base.__name__, given))).hexdigest()
    if key not in _KINDS:
        _KINDS[key] = type(
            f"{base.__name__}_{word}", (base,),
            {"word": word, "variant": variant, "template": template, "source": source,
             "parameters": parameters, "__doc__": base.__doc__, "__module__": __name__},
        )  # fmt: skip
    return _KINDS[key]


def _restore(
    base: type[LeftOut], given: tuple[Any, ...], values: Mapping[str, float]
) -> LeftOut:
    return left_out(base, *given)(values)
