"""A parameter of the device card that is off by far more than its spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.errors import EffectError
from bfsensor.typing import Edges, FloatArray

NEAREST, FARTHEST = 3.0, 16.0
"""How far off a parameter plausibly is [spreads]: nearer ones float in every fit."""

Conditions = Mapping[tuple[float, float], Edges]


class Floating(NamedTuple):
    """One parameter of a card, and how the shifts go with it.

    Attributes
    ----------
    name : str
        As on the card.
    nominal, spread : float
        Value on the card and its standard deviation, in the card's unit.
    slopes : tuple of ((float, float), (ndarray, ndarray))
        Wavelength [nm] and back bias [V], and change of the shifts for a unit more there
        [pixel/e- per unit], odd sides.
    """

    name: str
    nominal: float
    spread: float
    slopes: tuple[tuple[tuple[float, float], Edges], ...]


class DeviceParameter(Effect):
    """Shifts of a device one of whose parameters has another value; one class for each.

    The parameter's value is the true one.  It is free of the prior that holds the same
    parameter, where it floats, to within its spread of the card.  The change is linear in it.

    Notes
    -----
    Of the image-charge device of ``validation.concealed``, straight lines miss the change of the
    areas, for shifts of 5 and 10 spreads, by 2 and 3 % of itself (thickness), 0.2 and 0.6 % (h),
    1 and 3 % (zx), 2 and 5 % (zy), 5 and 9 % (doping): that much of the shift found may be
    wrong.  Widths of the charge (wx, wy) change areas by a per cent at most, and crookedly: a
    shift of theirs is off by half of itself.
    """

    word = "device_parameter"
    stage = "collect"
    touches = ("flat_cov", "spot")
    source = (
        "Derivatives of a simulation by the parameters of its device card, as Astier & Regnault "
        "2023, A&A 670, A118, fit theirs; range assumed"
    )
    floating: ClassVar[Floating]

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore, (self.floating, dict(self.values))

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        del layout, seen
        own = cls.floating
        middle = np.sqrt(NEAREST * FARTHEST) * own.spread
        return [{own.name: own.nominal + sign * float(middle)} for sign in (1.0, -1.0)]

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        del layout
        own = self.floating
        change = self[own.name] - own.nominal
        if change == 0.0:
            return kx, ky
        slopes = nearest_edges(own.slopes, shot)
        return add_edges((kx, ky), slopes, change)


def nearest_edges(held: Sequence[tuple[tuple[float, float], Edges]], shot: Shot) -> Edges:
    """Those of the nearest back bias, and of the nearest wavelength there."""
    _, found = min(
        held,
        key=lambda s: (abs(s[0][1] - shot.back_bias), abs(s[0][0] - shot.wavelength)),
    )
    return found


def add_edges(edges: Edges, more: Edges, factor: float) -> Edges:
    """Add so much of other shifts, which may reach farther."""
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
) -> tuple[type[DeviceParameter], ...]:
    """Make the candidates for a baseline: one class for each parameter that floats.

    Parameters
    ----------
    derivatives : mapping of str to mapping of (wavelength, back_bias) to (dkx, dky)
        Change of the shifts for a unit of each parameter, at each condition.
    spread, nominal : mapping of str to float
        Of the card; a parameter without a nominal value has no true one to be told, and is left
        out.

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
                f"device_parameter: spread of {name} = {spread[name]!r}, above 0"
            )
        held = tuple(slopes.items())
        out.append(_kind(Floating(name, float(nominal[name]), float(spread[name]), held)))
    return tuple(out)


_KINDS: dict[tuple[Any, ...], type[DeviceParameter]] = {}


def _kind(own: Floating) -> type[DeviceParameter]:
    """Class of a parameter; the same for the same arrays, so that copies are equal."""
    key = (*own[:3], tuple((c, *(a.tobytes() for a in pair)) for c, pair in own.slopes))
    if key not in _KINDS:
        parameter = Parameter(
            own.name, "as on the card", NEAREST * own.spread, FARTHEST * own.spread,
            neutral=own.nominal, signed=True, amplitude=True,
        )  # fmt: skip
        _KINDS[key] = type(
            f"DeviceParameter_{own.name}", (DeviceParameter,),
            {"floating": own, "variant": own.name, "parameters": (parameter,),
             "__doc__": DeviceParameter.__doc__, "__module__": __name__},
        )  # fmt: skip
    return _KINDS[key]


def _restore(own: Floating, values: dict[str, float]) -> DeviceParameter:
    return _kind(own)(values)
