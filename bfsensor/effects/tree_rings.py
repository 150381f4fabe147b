"""Tree rings: circles of doping about the axis of the crystal that the wafer was cut from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import Edges, FloatArray

AMP = Parameter("amp", "pixel", 1e-3, 0.05, amplitude=True)
PLACE = (
    Parameter("period", "pixel", 10.0, 100.0, step=0.01),
    Parameter("xc", "pixel", -3000.0, 3000.0, law="flat", step=0.3),
    Parameter("yc", "pixel", -3000.0, 3000.0, law="flat", step=0.3),
)
PHASE = Parameter("phase", "cycle", -0.5, 0.5, law="flat")


class _Rings(Effect):
    """Edges stand off along the radius from (``xc``, ``yc``) by a sine of a phase."""

    word = "tree_rings"
    stage = "collect"
    touches = ("flat_map",)
    of_pixels = True
    from_sightings = True
    bends = True
    source = (
        "Plazas, Bernstein & Sheldon 2014, PASP 126, 750 (DECam); Baumer, Davis & Roodman 2017, "
        "PASP 129, 084502; range assumed"
    )
    standing = True

    @classmethod
    def sighted(cls, layout: Layout) -> list[dict[str, float]]:
        """Rings of this kind that were followed across the map of all light."""
        names = [p.name for p in cls.parameters]
        return [
            {n: float(s[n]) for n in names}
            for s in layout.sightings
            if s["shape"] == "rings" and all(n in s for n in names)
        ]

    def turns(self, r: FloatArray) -> FloatArray:
        """Phase at radii [pixel], in cycles."""
        raise NotImplementedError

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        ny, nx = layout.shape
        if not self["amp"]:
            return None
        x, y = np.arange(float(nx)) - self["xc"], np.arange(float(ny))[:, None] - self["yc"]
        edge_x, edge_y = (
            np.arange(nx + 1.0) - 0.5 - self["xc"],
            np.arange(ny + 1.0)[:, None] - 0.5 - self["yc"],
        )
        return self._along(edge_x, y, edge_x), self._along(x, edge_y, edge_y)

    def _along(self, x: FloatArray, y: FloatArray, axis: FloatArray) -> FloatArray:
        """Displacement at places about the centre, its part along an axis."""
        r = np.sqrt(x * x + y * y)
        return np.asarray(
            self["amp"] * np.sin(2 * np.pi * self.turns(r)) * (axis / np.maximum(r, 0.5))
        )


class TreeRings(_Rings):
    r"""Rings whose frequency changes evenly with the radius.

    .. math::
        u(r) = A \sin 2 \pi \left[ \frac{r}{P} \left( 1 + c\, \frac{r - r_0}{200} \right)
        + \varphi \right],

    r from (``xc``, ``yc``), :math:`r_0` that of the pixel (0, 0).  ``chirp`` c: relative change of
    the rings' frequency per 100 pixels; ``phase`` in cycles.
    """

    parameters = (
        AMP,
        *PLACE,
        Parameter("chirp", "1/(100 pixel)", -0.05, 0.05, law="flat", step=5e-4),
        PHASE,
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Rings that were followed across the map of all light; without such, coarse ones."""
        found = cls.sighted(layout)
        if found or any(s["shape"] == "rings" for s in layout.sightings):
            return found
        # Half a turn of phase shows only as a sign.
        ny, nx = layout.shape
        periods = [s["period"] for s in seen if s.get("what") == "ring" and "period" in s]
        usual = {p.name: 0.0 for p in cls.parameters} | {"amp": 5e-3}
        return [
            usual | {"period": float(period), "xc": xc, "yc": yc, "phase": phase}
            for period in periods[:2] or [16.0, 24.0, 36.0, 54.0]
            for xc in (-0.4 * nx, 1.4 * nx) for yc in (-0.4 * ny, 1.4 * ny)
            for phase in (0.0, 0.25)
        ]  # fmt: skip

    def turns(self, r: FloatArray) -> FloatArray:
        r0 = np.hypot(self["xc"], self["yc"])
        rate = (1 + self["chirp"] / 200.0 * (r - r0)) / self["period"]
        return np.asarray(r * rate + self["phase"])


class UnevenTreeRings(_Rings):
    r"""Rings whose spacing grows and shrinks with the radius, as a crystal's growth did.

    .. math::
        u(r) = A \sin 2 \pi \left[ \frac{r}{P} \left( 1 + s \sin 2 \pi \left[ \frac{r}{L} + \psi
        \right] \right) + \varphi \right],

    r from (``xc``, ``yc``).  ``sway`` s over the ``length`` L, beginning at ``sway_phase``
    :math:`\psi`; phases in cycles.  Tried only where such rings were followed across a map.
    """

    variant = "uneven"
    parameters = (
        AMP,
        *PLACE,
        Parameter("sway", "", -0.5, 0.5, law="flat", step=5e-4),
        Parameter("length", "pixel", 100.0, 3000.0, step=0.3),
        Parameter("sway_phase", "cycle", -0.5, 0.5, law="flat", step=5e-4),
        PHASE,
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return cls.sighted(layout)

    def turns(self, r: FloatArray) -> FloatArray:
        bend = np.sin(2 * np.pi * (r / self["length"] + self["sway_phase"]))
        return np.asarray(r / self["period"] * (1 + self["sway"] * bend) + self["phase"])
