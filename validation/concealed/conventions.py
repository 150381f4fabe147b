"""One table: how truths and reports are held against one another, class by class.

A truth is what the generator applied, a report what `bfsensor diagnose` says, in the words of
its contract.  Both mean the same by each parameter's name except where a :class:`Reading` says
otherwise.  Beside the parameters: where a class is seen, for the scores of location.

    class               convention
    device_parameter    one parameter, its name the quantity, its value the true one in the card's
                        unit; relative errors are of the distance from the card's nominal value
    voltage_dependence  delta per +20 V (towards less back bias)
    adc_bits            delta in codes, bit counted from zero
    cosmic_rays         rate per minute and 256 x 256 pixels
    saturation          full_well in e-; relative errors of the value itself
    trap_serial         amp from zero, as in campaigns' truths; a place, not a measured number
    tearing             column as a part of the sensor's width; a place
    tree_rings          centre (xc, yc) and chirp are shape: not scored
    gain_nonlinearity   c2, c3 at 1e5 e-
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from validation.concealed.card import NOMINAL
from validation.concealed.library import EFFECTS
from validation.concealed.plan import SIZES, exposures_of

OUTSIDE = "outside_library"
NEAREST = ((1, 0), (0, 1))
NEAR = ((0, 0), (1, 0), (0, 1), (1, 1))


@dataclass(frozen=True)
class Reading:
    """How one parameter is held against the truth.

    Attributes
    ----------
    scored : bool
        Whether intervals and errors count; places and whole numbers do not.
    origin : float
        Relative errors are of the distance from here.
    scale : float
        What a report's value is multiplied by to be in the truth's unit.
    aliases : tuple of str
        Other names that a report may use.
    """

    scored: bool = True
    origin: float = 0.0
    scale: float = 1.0
    aliases: tuple[str, ...] = ()


_PLACE = Reading(scored=False)

READINGS: dict[tuple[str, str], Reading] = {
    ("trap_serial", "amp"): _PLACE,
    ("tearing", "column"): _PLACE,
    ("adc_bits", "bit"): _PLACE,
    ("dark_hot", "columns"): _PLACE,
    ("tree_rings", "xc"): _PLACE,
    ("tree_rings", "yc"): _PLACE,
    ("tree_rings", "chirp"): _PLACE,
    **{
        ("device_parameter", name): Reading(origin=value, aliases=(f"device {name}",))
        for name, value in NOMINAL.items()
    },
}
"""Parameters that are not held against the truth by the same name, from zero, as they are."""

_PLAIN = Reading()


def reading_of(word: str, name: str) -> Reading:
    """Return how a parameter of a class is read.

    Examples
    --------
    >>> reading_of("device_parameter", "thickness").origin
    100.0
    >>> reading_of("trap_serial", "amp").scored, reading_of("trap_serial", "tau").scored
    (False, True)
    """
    return READINGS.get((word, name), _PLAIN)


LAGS: dict[str, tuple[tuple[int, int], ...]] = {
    "interpixel_coupling": NEAREST,
    "bf_nonlinear": NEAR,
    "bf_chromatic": NEAR,
    "bf_anisotropy": NEAR,
    "voltage_dependence": NEAR,
}
"""Lags (x, y) that classes seen in covariances of flats have as their own."""


def is_class(word: str) -> bool:
    """Whether the taxonomy has this class."""
    return word in EFFECTS


def expected_location(truth: Mapping[str, Any]) -> dict[str, Any]:
    """Return where what one effect does must be placed; only for campaigns with one effect.

    Parameters
    ----------
    truth : mapping
        ``effects``, ``size``; ``where`` of :mod:`validation.challenge.concealed_trials` if there is one,
        with the fluxes (by channel) that the effect's signature holds.

    Returns
    -------
    dict
        Those of ``lags``, ``amps``, ``x``, ``exposures``, ``flux`` that the class has.

    Examples
    --------
    >>> tear = {"class": "tearing", "parameters": {"amp": 0.02, "length": 2.0, "column": 0.5}}
    >>> expected_location({"effects": [tear], "size": "S"})
    {'amps': [1, 2], 'x': [122, 134]}
    """
    if len(truth["effects"]) != 1:
        return {}
    effect = truth["effects"][0]
    word, values = effect["class"], effect["parameters"]
    amplifiers = int(truth.get("amplifiers", 2))
    out: dict[str, Any] = {}
    if word == OUTSIDE:
        return out
    out["amps"] = list(range(1, amplifiers + 1))
    if word in LAGS:
        out["lags"] = [list(lag) for lag in LAGS[word]]
    size = SIZES[truth.get("size", "S")]
    if word == "trap_serial":
        out["amps"] = [int(values["amp"]) % amplifiers + 1]
    if word == "tearing":
        # the shift of the boundaries falls to 5 % in three lengths
        middle, far = values["column"] * size.pixels, 3 * values["length"]
        out["x"] = [
            max(round(middle - far), 0),
            min(round(middle + far), size.pixels),
        ]
    if word == "gain_drift":
        taken = [e for e in exposures_of(size) if not e.withheld]
        flats = [e.sequence for e in taken if e.kind == "FLAT"]
        out["exposures"] = [min(flats), max(flats)]
    where = truth.get("where") or {}
    if where.get("flux"):
        out["flux"] = where["flux"]
    return out
