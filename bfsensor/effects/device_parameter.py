"""A parameter of the device that lies far outside the uncertainty of its nominal value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bfsensor.effects.changed_device import ChangedDevice, Quantity
from bfsensor.effects.effect import Layout, Parameter, Seen
from bfsensor.effects.family import TemplateFamily
from bfsensor.errors import EffectError
from bfsensor.typing import Edges

NEAREST, FARTHEST = 3.0, 16.0
"""Plausible distances of a parameter from its nominal value [standard deviations of its prior].

Chosen: below 3 the free parameters of every fit explain the difference.  With both twice as large,
fits begin at 14 instead of 7 standard deviations, and detections below 6 lose their evidence."""

UNKNOWN_UNIT = "unit of the device file"
"""Unit of the quantities of a baseline whose file does not state their units."""

SILICON = {
    "operating_point.hole_quasi_fermi_level": "free_holes",
    "channel_stop.side_diffusion": "stop_diffusion",
    "channel.surface_charge": "oxide_charge",
}
"""Quantities by which a device has, or lacks, a piece of physics, and the name of the piece: they are of
class 'silicon_physics', all others of class 'device_parameter'."""

Conditions = Mapping[tuple[float, float], Edges]


class DeviceParameter(ChangedDevice):
    """Boundary shifts of a device with another value of one parameter; one family for each parameter.

    The only parameter of the effect is the true value.  Unlike the free parameter of the same name
    in a fit of the baseline, it has no Gaussian prior around the nominal value.

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
    source = (
        "Derivatives of a simulation by the parameters of its device, as Astier & Regnault "
        "2023, A&A 670, A118, fit theirs; range assumed"
    )

    @classmethod
    def template_starts(
        cls, of: TemplateFamily, layout: Layout, seen: Sequence[Seen]
    ) -> list[dict[str, float]]:
        del layout, seen
        own: Quantity = of.template
        low, high = of.parameters[0].ends
        middle = float(np.sqrt(NEAREST * FARTHEST) * own.spread)
        values = np.clip(own.nominal + middle * np.array([1.0, -1.0]), low, high)
        # At an end of its range, as no dose changes its sign, a parameter varies to one side only.
        return [{own.name: float(v)} for v in values if abs(v - own.nominal) > own.spread]


def device_parameters(
    derivatives: Mapping[str, Conditions],
    spread: Mapping[str, float],
    nominal: Mapping[str, float],
    *,
    units: Mapping[str, str] = {},
    bounds: Mapping[str, tuple[float, float]] = {},
) -> tuple[TemplateFamily, ...]:
    """Make the candidates of a baseline: one family of effects for each free parameter.

    Parameters
    ----------
    derivatives : mapping of str to mapping of (wavelength, back_bias) to (dkx, dky)
        Derivative of the shifts by each parameter [pixel/e- per unit] at each condition.
    spread, nominal : mapping of str to float
        Standard deviation and nominal value of each parameter.  A parameter without a nominal value
        is left out: its true value could not be stated.
    units : mapping of str to str
        Unit of each parameter, for reports, where it is known.
    bounds : mapping of str to (float, float)
        Least and greatest value, less the nominal one, of parameters that cannot lie outside.

    Returns
    -------
    kinds : tuple of TemplateFamily
        Families of :class:`DeviceParameter`, named ``device_parameter:NAME``, or
        ``silicon_physics:PIECE`` for the quantities of :data:`SILICON`.

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
        own = Quantity(
            name, float(nominal[name]), float(spread[name]), tuple(slopes.items())
        )
        low, high = bounds.get(name, (-np.inf, np.inf))
        value = Parameter(
            name, units.get(name, UNKNOWN_UNIT), NEAREST * own.spread,
            FARTHEST * own.spread, neutral=own.nominal, signed=True, amplitude=True,
            ends=(own.nominal + low, own.nominal + high),
        )  # fmt: skip
        word = "silicon_physics" if name in SILICON else DeviceParameter.word
        out.append(TemplateFamily(
            DeviceParameter, word, SILICON.get(name, name), own, DeviceParameter.source, (value,)
        ))  # fmt: skip
    return tuple(out)
