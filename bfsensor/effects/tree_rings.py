"""Tree rings: circular variations of doping about the crystal's axis, which displace pixel edges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import ClassVar

import numpy as np
from scipy.interpolate import CubicSpline

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.effects.lateral_diffusion import drift_path
from bfsensor.typing import Edges, FloatArray

AMP = Parameter("amp", "pixel", 1e-3, 0.05, amplitude=True)
"""Amplitude of the displacements.  Range chosen; with a top twice as high its prior density falls by
15 %, and the evidence of every detection with it."""

PLACE = (
    Parameter("period", "pixel", 10.0, 100.0, step=0.01),
    Parameter("xc", "pixel", -3000.0, 3000.0, law="flat", step=0.3),
    Parameter("yc", "pixel", -3000.0, 3000.0, law="flat", step=0.3),
)
"""Spacing of the rings and place of their centre.  Ranges chosen: with those of the centre twice as
wide, the evidence of every detection falls by a factor of four."""

PHASE = Parameter("phase", "cycle", -0.5, 0.5, law="flat")
"""Phase of the rings at the centre: a whole cycle, by definition."""


class _Rings(Effect):
    """Edges are displaced along the radius from (``xc``, ``yc``) by a sine of a phase."""

    word = "tree_rings"
    stage = "collect"
    touches = ("flat_map",)
    needs: ClassVar[tuple[str, ...]] = ("pixels", "patterns")
    response = "quadratic"
    source = (
        "Plazas, Bernstein & Sheldon 2014, PASP 126, 750 (DECam); Baumer, Davis & Roodman 2017, "
        "PASP 129, 084502; range assumed"
    )
    maps_vary = "nothing"

    @classmethod
    def sighted(cls, layout: Layout) -> list[dict[str, float]]:
        """Parameters of rings of this kind that were detected in the map of all wavelengths."""
        names = [p.name for p in cls.parameters]
        return [
            {n: float(s[n]) for n in names}
            for s in layout.sightings
            if s["shape"] == "rings" and all(n in s for n in names)
        ]

    def turns(self, r: FloatArray) -> FloatArray:
        """Phase at radii [pixel], in cycles."""
        raise NotImplementedError

    def profile(self, r: FloatArray) -> FloatArray:
        """Displacement outwards at radii [pixel] over ``amp``."""
        return np.asarray(np.sin(2 * np.pi * self.turns(r)))

    def strength(self, shot: Shot, layout: Layout) -> float:
        """Amplitude of the displacements in an exposure [pixel]."""
        del shot, layout
        return self["amp"]

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        amp = self.strength(shot, layout)
        if not amp:
            return None
        across, up = _outwards(self.profile, self["xc"], self["yc"], layout.shape)
        return amp * across, amp * up


def _outwards(
    profile: Callable[[FloatArray], FloatArray],
    xc: float,
    yc: float,
    shape: tuple[int, int],
) -> Edges:
    """Displacements of edges along the radius from a centre, by a profile of the radius."""
    ny, nx = shape
    x, y = np.arange(float(nx)) - xc, np.arange(float(ny))[:, None] - yc
    edge_x = np.arange(nx + 1.0) - 0.5 - xc
    edge_y = np.arange(ny + 1.0)[:, None] - 0.5 - yc
    out = []
    for along_x, along_y, axis in ((edge_x, y, edge_x), (x, edge_y, edge_y)):
        r = np.sqrt(along_x * along_x + along_y * along_y)
        out.append(np.asarray(profile(r) * (axis / np.maximum(r, 0.5))))
    return out[0], out[1]


@lru_cache(maxsize=2)
def _radial(
    waves: tuple[tuple[float, ...], ...], xc: float, yc: float, shape: tuple[int, int]
) -> Edges:
    """Displacements by a sum of waves of the radius, equal but for a factor in all light."""

    def profile(r: FloatArray) -> FloatArray:
        # A spline is worst near its ends, so that it goes on for a few knots beyond the radii.
        near = np.arange(float(r.min()) - 3.0, float(r.max()) + 3.0, 0.5)
        turn = 2 * np.pi * near
        out = sum(b * np.sin(f * turn) + c * np.cos(f * turn) for f, b, c in waves)
        # Waves are longer than five pixels: a cubic through ten points of each is exact to 1e-3.
        return np.asarray(CubicSpline(near, out)(r))

    return _outwards(profile, xc, yc, shape)


class TreeRings(_Rings):
    r"""Tree rings whose frequency changes linearly with the radius.

    .. math::
        u(r) = A \sin 2 \pi \left[ \frac{r}{P} \left( 1 + c\, \frac{r - r_0}{200} \right)
        + \varphi \right],

    r is the distance from (``xc``, ``yc``) [pixel], :math:`r_0` that of the pixel (0, 0).  ``amp`` A
    is the displacement [pixel], ``period`` P the spacing [pixel], ``chirp`` c the relative change of
    the frequency per 100 pixels, ``phase`` :math:`\varphi` in cycles.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.001 to 0.05 (0 changes nothing); ``period`` [pixel]:
        10 to 100; ``xc`` [pixel]: -3000 to 3000; ``yc`` [pixel]: -3000 to 3000; ``chirp`` [1/(100
        pixel)]: -0.05 to 0.05; ``phase`` [cycle]: -0.5 to 0.5.

    Examples
    --------
    >>> shape = {"chirp": 0.0, "phase": 0.0}
    >>> TreeRings({"amp": 0.007, "period": 30.0, "xc": 0.0, "yc": 0.0} | shape).name
    'tree_rings'
    """

    law_name = "one_period"
    parameters = (
        AMP,
        *PLACE,
        Parameter("chirp", "1/(100 pixel)", -0.05, 0.05, law="flat", step=5e-4),
        PHASE,
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Begin with rings detected in the map of all wavelengths; without any, with a coarse grid."""
        found = cls.sighted(layout)
        if found or any(s["shape"] == "rings" for s in layout.sightings):
            return found
        # A shift by half a cycle is a change of sign: phases of 0 and a quarter are enough.
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
    r"""Tree rings whose spacing oscillates with the radius, as the growth of a crystal may.

    .. math::
        u(r) = A \sin 2 \pi \left[ \frac{r}{P} \left( 1 + s \sin 2 \pi \left[ \frac{r}{L} + \psi
        \right] \right) + \varphi \right],

    r is the distance from (``xc``, ``yc``) [pixel].  ``sway`` s is the relative amplitude of the
    oscillation, ``length`` L its period [pixel], ``sway_phase`` :math:`\psi` its phase; phases are in
    cycles.  Fits are tried only from such rings detected in a map.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.001 to 0.05 (0 changes nothing); ``period`` [pixel]:
        10 to 100; ``xc`` [pixel]: -3000 to 3000; ``yc`` [pixel]: -3000 to 3000; ``sway``: -0.5 to
        0.5; ``length`` [pixel]: 100 to 3000; ``sway_phase`` [cycle]: -0.5 to 0.5; ``phase``
        [cycle]: -0.5 to 0.5.

    Examples
    --------
    >>> shape = {"length": 500.0, "sway_phase": 0.0, "phase": 0.0}
    >>> UnevenTreeRings({"amp": 0.007, "period": 30.0, "xc": 0.0, "yc": 0.0, "sway": 0.0} | shape).name
    'tree_rings:uneven'
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


class RadialTreeRings(_Rings):
    r"""Tree rings of any profile in radius: several periods, with strengths that change with radius.

    .. math:: u(r) = A\, g(r) \left( \frac{d}{d_0} \right)^{e} \left( \frac{V_0}{V} \right)^{f}

    r is the distance from (``xc``, ``yc``) [pixel].  The profile g is the sum of waves that
    :func:`bfsensor.diagnose.data.map_rings.find_radial` detected in the map of all wavelengths, with
    the mean square of a sine: it is held by the layout and not fitted.  ``amp`` A [pixel];
    ``period`` [pixel] is that of a sine with as large displacements and slopes.  A radial field moves
    an electron in proportion to the length d of its drift and inversely to the drift field, and so to
    the voltage V: ``drift`` e and ``field`` f are 1; 0 if displacements are the same for all light and
    all voltages.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.001 to 0.05 (0 changes nothing); ``period`` [pixel]:
        10 to 100; ``xc`` [pixel]: -3000 to 3000; ``yc`` [pixel]: -3000 to 3000; ``drift``: 0 to 1;
        ``field``: 0 to 1.

    Examples
    --------
    >>> place = {"period": 30.0, "xc": 0.0, "yc": 0.0}
    >>> RadialTreeRings({"amp": 0.007, "drift": 1.0, "field": 1.0} | place).name
    'tree_rings:radial'
    """

    variant = "radial"
    maps_vary = "condition"
    # Its profile was fitted to the map, so that it raises no alarm; the scans for rings do.
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    parameters = (
        AMP,
        # The search has chosen periods and centre together with the profile: their priors are charged,
        # and nothing is fitted, for a profile about one centre holds no other.
        *(p._replace(law="whole") for p in PLACE),
        Parameter("drift", "", 0.0, 1.0, law="flat"),
        Parameter("field", "", 0.0, 1.0, law="flat"),
    )
    source = (
        "Several periods, amplitude growing with radius: Park et al. 2020, JATIS 6, 011005; Esteves et "
        "al. 2023, PASP 135, 115003; drift path over voltage: a constant lateral field along the path"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        names = ("amp", "period", "xc", "yc")
        return [
            {n: float(s[n]) for n in names} | {"drift": e, "field": e}
            for s in layout.sightings if s["shape"] == "radial" for e in (0.0, 1.0)
        ]  # fmt: skip

    def searched(self, layout: Layout) -> int:
        """Frequency, sine and cosine of each wave, but for the amplitude of all."""
        waves = [s["waves"] for s in layout.sightings if s["shape"] == "radial"]
        return max(3 * len(waves[0]) - 1, 0) if waves else 0

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        waves = [s["waves"] for s in layout.sightings if s["shape"] == "radial"]
        amp = self.strength(shot, layout)
        if not (amp and waves):
            return None
        own = tuple(tuple(map(float, wave)) for wave in waves[0])
        across, up = _radial(own, self["xc"], self["yc"], layout.shape)
        return amp * across, amp * up

    def strength(self, shot: Shot, layout: Layout) -> float:
        wavelength, back_bias, _ = layout.reference
        path = drift_path(shot.wavelength, layout) / drift_path(wavelength, layout)
        volts = (layout.front - back_bias) / (layout.front - shot.back_bias)
        return float(self["amp"] * path ** self["drift"] * volts ** self["field"])
