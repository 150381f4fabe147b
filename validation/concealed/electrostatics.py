r"""Pixel boundary shifts of a card: charge rectangles between two conducting planes.

A stored charge fills a rectangle of sides ``wx`` x ``wy`` at the height ``h`` above the
gate plane; the gate plane (z = 0) and the back surface (z = thickness) are conductors, met by
images of alternate sign at heights :math:`2 n T \pm h`.  An electron that drifts down from
where it was converted is pushed sideways by

.. math::
    \Delta x = \int_{z_x}^{z_c} \frac{E_x(x, y, z)}{E_z(z)} dz, \qquad
    E_z(z) = \frac{V_{front} - V_{bb}}{T} + \frac{q N}{\epsilon}\,(T/2 - z),

so the boundary between two pixels moves by minus that, averaged along the edge.  Boundaries
between columns are sealed at the height ``zx``, between rows at ``zy``.  Averages along an edge
and over the rectangle are closed forms; the integral over height is by Gauss-Legendre nodes.

Sources: Astier & Regnault 2023, A&A 670, A118, section 2 (images, two sealed heights);
the linear field is that of a fully depleted slab of uniform doping.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

ELECTRON = 1.602176634e-19
"""Elementary charge [C]."""

SILICON = 11.7 * 8.8541878128e-18
"""Permittivity of silicon [F/um]."""

WINDOW = 10
"""Shifts are kept to this many pixels; beyond, and at the rim, edges do not move."""

_IMAGES = 8
_PIECES = 8
_NODES = 7


class EdgeShifts(NamedTuple):
    """Displacement of the right and the upper edge of each pixel [pixel/e-], ``[row, column]``.

    The charge is in the middle pixel; positive moves the edge to larger x (``kx``) or y.
    """

    kx: NDArray[np.float64]
    ky: NDArray[np.float64]

    def area_changes(self) -> NDArray[np.float64]:
        """a_ij: relative change of every pixel's area per electron; the sum is zero."""
        area = np.zeros_like(self.kx)
        area[:, 1:] += self.kx[:, 1:] - self.kx[:, :-1]
        area[1:, :] += self.ky[1:, :] - self.ky[:-1, :]
        return area


def _second_difference(function_of_v, low, high, side):
    """Integral over an edge from low to high of the mean over a side, from the antiderivative."""
    return (
        function_of_v(high + side / 2)
        - function_of_v(high - side / 2)
        - function_of_v(low + side / 2)
        + function_of_v(low - side / 2)
    )


def _push(across, along, height, wide, deep, charge_height, thickness, pitch):
    """Edge-averaged field per electron [V/um] across edges at (across, along) pixels.

    ``wide`` is the rectangle's side across the edge, ``deep`` the one along it.  The field of
    a rectangle needs asinh (one integral of 1/r^3); a second one along the edge gives
    v asinh(v / rho) - sqrt(v^2 + rho^2).
    """
    x = ((across + 0.5) * pitch)[:, None]
    low, high = ((along + s) * pitch for s in (-0.5, 0.5))
    field = np.zeros((len(across), len(height)))
    for n in range(-_IMAGES, _IMAGES + 1):
        for sign in (1.0, -1.0):
            dz2 = (height - (sign * charge_height + 2 * n * thickness))[None, :] ** 2
            for u, side in ((x + wide / 2, -1.0), (x - wide / 2, 1.0)):
                rho2 = u * u + dz2

                def inner(v, rho2=rho2):
                    v = v[:, None]
                    return v * np.arcsinh(v / np.sqrt(rho2)) - np.sqrt(v * v + rho2)

                field += sign * side * _second_difference(inner, low, high, deep)
    return field * ELECTRON / (4 * np.pi * SILICON) / (wide * deep * pitch)


@lru_cache(maxsize=64)
def _geometry(pitch, thickness, h, wide, deep, sealed):
    """Heights, weights and field [edge, height] for one axis; conditions reuse it."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    # pieces that grow with height: the field is steep next to the charge
    ends = sealed + (thickness - sealed) * np.linspace(0, 1, _PIECES + 1) ** 3
    half = np.diff(ends)[:, None] / 2
    height = (ends[:-1, None] + half + half * nodes).ravel()
    across, along = (
        g.ravel() for g in np.meshgrid(np.arange(WINDOW), np.arange(WINDOW), indexing="ij")
    )
    field = _push(
        across.astype(float), along.astype(float), height, wide, deep, h, thickness, pitch
    )
    return height, (half * weights).ravel(), field


def _axis(card, absorption, back_bias, wide, deep, sealed):
    """Displacements [along, across] of the edges of a quarter plane [pixel/e-]."""
    thickness = card["thickness"]
    height, weight, field = _geometry(
        card["pixel"], thickness, card["h"], card[wide], card[deep], card[sealed]
    )
    volts = card["vfront"] - back_bias
    slope = ELECTRON / SILICON * card["doping"] * 1e-12  # per um^3
    drift = volts / thickness + slope * (thickness / 2 - height)
    if drift.min() <= 0:
        raise ValueError(
            f"not depleted: {volts:g} V on {thickness:g} um at {card['doping']:g} /cm^3"
        )
    # electrons converted above a height pass it: depth is exponential, cut at the front
    passed = (1 - np.exp(-(thickness - height) / absorption)) / (
        1 - np.exp(-thickness / absorption)
    )
    shift = -(field * (weight * passed / drift)).sum(axis=1) / card["pixel"]
    return shift.reshape(WINDOW, WINDOW).T


def edge_shifts(
    card: Mapping[str, float], absorption: float, back_bias: float
) -> EdgeShifts:
    """Displacements of pixel edges per electron for one device and condition.

    Parameters
    ----------
    card : mapping
        ``pixel``, ``thickness``, ``h``, ``wx``, ``wy``, ``zx``, ``zy`` [um], ``vfront`` [V],
        ``doping`` [cm^-3].
    absorption : float
        Absorption length [um] at the wavelength of the light.
    back_bias : float
        Voltage of the back surface [V], negative.

    Returns
    -------
    EdgeShifts
        Two arrays of side ``2 * WINDOW + 1``.

    Raises
    ------
    ValueError
        The field changes sign inside the silicon.

    Examples
    --------
    >>> from validation.concealed.card import NOMINAL
    >>> shifts = edge_shifts(NOMINAL, 2.9, -60.0)
    >>> bool(-4e-6 < shifts.area_changes()[10, 10] < -3e-6)
    True
    """
    side = 2 * WINDOW + 1
    kx, ky = np.zeros((2, side, side))
    quarter_x = _axis(card, absorption, back_bias, "wx", "wy", "zx")  # [|dy|, dx]
    quarter_y = _axis(card, absorption, back_bias, "wy", "wx", "zy").T  # [dy, |dx|]
    for j in range(WINDOW):
        for i in range(WINDOW):
            for row in {WINDOW + j, WINDOW - j}:
                kx[row, WINDOW + i] = quarter_x[j, i]
                kx[row, WINDOW - 1 - i] = -quarter_x[j, i]
            for column in {WINDOW + i, WINDOW - i}:
                ky[WINDOW + j, column] = quarter_y[j, i]
                ky[WINDOW - 1 - j, column] = -quarter_y[j, i]
    # the outermost edges stand still, so that what one pixel loses another gains
    kx[:, 0] = ky[0, :] = 0.0
    return EdgeShifts(kx, ky)
