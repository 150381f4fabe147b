"""A parameter of the device that lies far outside the uncertainty of its nominal value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bfsensor.effects.effect import Layout, Parameter, Seen, Shot
from bfsensor.effects.family import TemplateEffect, TemplateFamily
from bfsensor.errors import EffectError
from bfsensor.typing import Edges, FloatArray

NEAREST, FARTHEST = 3.0, 16.0
"""Plausible distances of a parameter from its nominal value [standard deviations of its prior].

Chosen: below 3 the free parameters of every fit explain the difference.  With both twice as large,
fits begin at 14 instead of 7 standard deviations, and detections below 6 lose their evidence."""

Conditions = Mapping[tuple[float, float], Edges]


class Floating(NamedTuple):
    """One parameter of a device, with the derivatives of the boundary shifts.

    Attributes
    ----------
    name : str
        Dotted name of the parameter in the device file.
    nominal, spread : float
        Nominal value and its standard deviation, in the unit of the device file.
    slopes : tuple of ((float, float), (ndarray, ndarray))
        Wavelength [nm] and back bias [V], and there the derivative of the shifts (kx, ky)
        [pixel/e- per unit], arrays with odd sides.
    """

    name: str
    nominal: float
    spread: float
    slopes: tuple[tuple[tuple[float, float], Edges], ...]


class DeviceParameter(TemplateEffect):
    """Boundary shifts of a device with another value of one parameter; one family for each parameter.

    The only parameter of the effect is the true value.  Unlike the free parameter of the same name
    in a fit of the baseline, it has no Gaussian prior around the nominal value.  Shifts change
    linearly with it.

    Parameters
    ----------
    values : mapping of str to float
        True value of the parameter, in its unit, 3 to 16 standard deviations from the nominal one.

    Notes
    -----
    For the image-charge device of ``validation.concealed`` the linear prediction misses the change
    of the areas, at 5 and 10 standard deviations, by 2 and 3 % of the change (thickness), 0.2 and
    0.6 % (h), 1 and 3 % (zx), 2 and 5 % (zy), 5 and 9 % (doping): by that much a fitted value may be
    wrong.  Widths of the charge (wx, wy) change areas by at most a per cent, and not linearly: the
    fitted change of these may be wrong by half.
    """

    word = "device_parameter"
    stage = "collect"
    touches = ("flat_cov", "spot")
    source = (
        "Derivatives of a simulation by the parameters of its device, as Astier & Regnault "
        "2023, A&A 670, A118, fit theirs; range assumed"
    )

    @classmethod
    def template_starts(
        cls, of: TemplateFamily, layout: Layout, seen: Sequence[Seen]
    ) -> list[dict[str, float]]:
        del layout, seen
        own: Floating = of.template
        middle = np.sqrt(NEAREST * FARTHEST) * own.spread
        return [{own.name: own.nominal + sign * float(middle)} for sign in (1.0, -1.0)]

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        del layout
        own: Floating = self.template
        change = self[own.name] - own.nominal
        if change == 0.0:
            return kx, ky
        slopes = nearest_edges(own.slopes, shot)
        return add_edges((kx, ky), slopes, change)


def nearest_edges(held: Sequence[tuple[tuple[float, float], Edges]], shot: Shot) -> Edges:
    """Shifts held for the nearest back bias, and among those for the nearest wavelength."""
    _, found = min(
        held,
        key=lambda s: (abs(s[0][1] - shot.back_bias), abs(s[0][0] - shot.wavelength)),
    )
    return found


def add_edges(edges: Edges, more: Edges, factor: float) -> Edges:
    """Add ``factor`` times other shifts, padded with 0 to the same reach."""
    moved = []
    for shifts, slope in zip(edges, more, strict=True):
        reach = max(len(shifts), len(slope)) // 2
        wide, slope = (np.pad(a, reach - len(a) // 2) for a in (shifts, slope))
        moved.append(wide + factor * slope)
    return moved[0], moved[1]


def device_parameters(
    derivatives: Mapping[str, Conditions],
    spread: Mapping[str, float],
    nominal: Mapping[str, float],
) -> tuple[TemplateFamily, ...]:
    """Make the candidates of a baseline: one family of effects for each free parameter.

    Parameters
    ----------
    derivatives : mapping of str to mapping of (wavelength, back_bias) to (dkx, dky)
        Derivative of the shifts by each parameter [pixel/e- per unit] at each condition.
    spread, nominal : mapping of str to float
        Standard deviation and nominal value of each parameter.  A parameter without a nominal value
        is left out: its true value could not be stated.

    Returns
    -------
    kinds : tuple of TemplateFamily
        Families of :class:`DeviceParameter`, named ``device_parameter:NAME``.

    Raises
    ------
    EffectError
        A spread that is not above 0.

    Examples
    --------
    >>> k = np.zeros((5, 5))
    >>> k[2, 2], k[2, 1] = -1e-6, 1e-6
    >>> kinds = device_parameters(
    ...     {"h": {(620.0, -60.0): (k / 2, k.T / 2)}}, {"h": 0.06}, {"h": 1.2})
    >>> effect = kinds[0]({"h": 1.4})
    >>> effect.name, effect.scaled(0.5)["h"].__round__(3)
    ('device_parameter:h', 1.3)
    """
    out = []
    for name, slopes in derivatives.items():
        if name not in nominal:
            continue
        if not spread[name] > 0:
            raise EffectError(
                f"device_parameter: spread of {name} = {spread[name]!r} must be above 0"
            )
        own = Floating(
            name, float(nominal[name]), float(spread[name]), tuple(slopes.items())
        )
        value = Parameter(
            name, "unit of the device file", NEAREST * own.spread, FARTHEST * own.spread,
            neutral=own.nominal, signed=True, amplitude=True,
        )  # fmt: skip
        out.append(
            TemplateFamily(
                DeviceParameter,
                DeviceParameter.word,
                name,
                own,
                DeviceParameter.source,
                (value,),
            )
        )
    return tuple(out)
