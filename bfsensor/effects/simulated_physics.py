"""Effects of physics that a simulation left out, from simulated templates with and without it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from bfsensor.effects.changed_device import (
    ChangedDevice,
    Key,
    Quantity,
    add_edges,
    level_response,
    nearest_edges,
    nearest_value,
)
from bfsensor.effects.effect import Halo, Layout, Parameter, Seen, Shot
from bfsensor.effects.family import TemplateEffect, TemplateFamily
from bfsensor.effects.tree_rings import TreeRings
from bfsensor.typing import Edges, FloatArray

STRENGTH = Parameter("strength", "", -2.0, 2.0, law="flat", signed=True, amplitude=True)
"""Strength of the physics: 1 as simulated, 0 as in the baseline.

Range chosen: flat, so that fits stay between -4 and 4; the linear template is not valid at ten times
the simulated effect.  Twice as wide, evidence for an effect falls by a factor of two."""


class DiffusionWidths(NamedTuple):
    """Variance of the landing place of electrons [pixel^2] by condition, at a temperature [K]."""

    held: tuple[tuple[Key, float], ...]
    temperature: float


class Rings(NamedTuple):
    """Amplitude of the displacements [pixel] by the simulated ripple, by its period [pixel]."""

    periods: FloatArray
    held: tuple[tuple[Key, FloatArray], ...]

    def size(self, period: float, shot: Shot) -> float:
        """Amplitude at strength 1 [pixel], for a period [pixel] and the condition of a shot."""
        return float(np.interp(period, self.periods, nearest_value(self.held, shot)))


class Rim(NamedTuple):
    """Displacements [pixel], inwards, of the boundaries 0, 1, ... from the edge of the array."""

    held: tuple[tuple[Key, FloatArray], ...]


class LeftOut(TemplateEffect):
    """Physics missing in the baseline, with ``strength``; :func:`left_out` makes the families."""

    stage = "collect"
    parameters = (STRENGTH,)

    @classmethod
    def template_starts(
        cls, of: TemplateFamily, layout: Layout, seen: Sequence[Seen]
    ) -> list[dict[str, float]]:
        del of, layout, seen
        return [{"strength": 1.0}]


class MovedEdges(LeftOut):
    """Boundary shifts of the device with the physics, interpolated linearly from those without."""

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
        return level_response(self.template.bent, self["strength"], shot)


class BentResponse(LeftOut):
    """Boundary shifts that change with the charge in the pixels, by a template for each lag."""

    touches = ("flat_cov", "spot")

    def level_response(
        self, shot: Shot, layout: Layout
    ) -> tuple[float, Edges, Edges] | None:
        del layout
        return level_response(self.template, self["strength"], shot)


class SiliconPhysics(ChangedDevice):
    """Boundary shifts of a device with physics that its baseline lacks, by the value of a quantity.

    The quantity has no prior: at its nominal value the device lacks this physics.
    """

    word = "silicon_physics"

    @classmethod
    def template_starts(
        cls, of: TemplateFamily, layout: Layout, seen: Sequence[Seen]
    ) -> list[dict[str, float]]:
        del layout, seen
        own: Quantity = of.template
        (value,) = of.parameters
        ends = np.clip(own.nominal + own.spread * np.array([1.0, -1.0]), *value.ends)
        return [{value.name: float(v)} for v in ends if v != own.nominal]


class FieldDiffusion(LeftOut):
    """Spots widened by diffusion in the simulated field of the device."""

    stage = "light"
    touches = ("spot",)

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, Halo]:
        del layout
        told = self.template
        heat = shot.temperature / told.temperature
        heat = heat if np.isfinite(heat) else 1.0
        return self["strength"] * heat * nearest_value(told.held, shot), ()


class DopingRings(LeftOut):
    """Tree rings of the doping, with the amplitude simulated at each wavelength and back bias.

    ``strength`` is relative to the ripple of the doping in the template; the other parameters are
    those of :class:`TreeRings`.
    """

    touches = ("flat_map",)

    @classmethod
    def template_starts(
        cls, of: TemplateFamily, layout: Layout, seen: Sequence[Seen]
    ) -> list[dict[str, float]]:
        usual = Shot("flat", 0, 1.0, *layout.reference)
        out = []
        for values in TreeRings.starts(layout, seen):
            size = of.template.size(values["period"], usual)
            shape = {k: v for k, v in values.items() if k != "amp"}
            out.append({"strength": values["amp"] / size} | shape)
        return out

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        size = self.template.size(self["period"], shot)
        shape = {k: v for k, v in self.values.items() if k != "strength"}
        rings = TreeRings({"amp": self["strength"] * size} | shape)
        return rings.displacements(shot, layout)


class EdgeFieldLeftOut(LeftOut):
    """Lateral field at the rim of the array, which displaces the outermost boundaries."""

    touches = ("flat_map",)

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        strength = self["strength"]
        if strength == 0.0:
            return None
        inwards = strength * nearest_value(self.template.held, shot)
        ny, nx = layout.shape
        x, y = (_both_ends(inwards, n) for n in (nx, ny))
        return (
            np.broadcast_to(x, (ny, nx + 1)),
            np.broadcast_to(y[:, None], (ny + 1, nx)),
        )


def _both_ends(inwards: FloatArray, n: int) -> FloatArray:
    """Displacements of the n + 1 edges of n pixels [pixel], positive towards larger numbers."""
    out = np.zeros(n + 1)
    reach = min(len(inwards), (n + 1) // 2)
    out[:reach] += inwards[:reach]
    out[-reach:] -= inwards[:reach][::-1]
    return out


def ring_parameters(size: float) -> tuple[Parameter, ...]:
    """Parameters of doping rings whose displacements have the amplitude ``size`` at strength 1.

    Parameters
    ----------
    size : float
        Amplitude [pixel], above 0; the range of the strength is that of tree rings divided by it.

    Returns
    -------
    parameters : tuple of Parameter
        'strength', and those of the rings' shape.
    """
    amp, *shape = TreeRings.parameters
    strength = STRENGTH._replace(
        low=amp.low / size, high=amp.high / size, law="log", signed=False
    )
    return (strength, *shape)


def left_out(
    effect: type[LeftOut],
    word: str,
    variant: str,
    template: Any,
    source: str,
    parameters: tuple[Parameter, ...] = (STRENGTH,),
) -> TemplateFamily:
    """Make a family of effects for physics missing in a baseline.

    Parameters
    ----------
    effect : type
        Class of this module that applies the template.
    word, variant : str
        Name in the taxonomy, and the variant that distinguishes it from others of this name.
    template : Moved, QuadraticTemplate, DiffusionWidths, Rings or Rim
        Simulated change, of the type that ``effect`` takes.
    source : str
        Origin of the template, for reports.
    parameters : tuple of Parameter
        'strength', and parameters of the shape.

    Returns
    -------
    family : TemplateFamily
        Called with values of the parameters, it makes the effect.

    Examples
    --------
    >>> from bfsensor.effects.changed_device import Moved
    >>> k = np.zeros((3, 3)); k[1, 1] = -1e-6
    >>> template = Moved((((620.0, -50.0), (k, k.T)),))
    >>> family = left_out(MovedEdges, "bf_chromatic", "simulated", template, "a test")
    >>> shot = Shot("flat", 0, 1.0, 620.0, -50.0, 173.15)
    >>> float(family({"strength": 0.5}).edges(k, k.T, shot, None)[0][1, 1])
    -1.5e-06
    """
    return TemplateFamily(effect, word, variant, template, source, parameters)
