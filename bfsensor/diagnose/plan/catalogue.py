"""Catalogue of recordings that could be taken, with rules for those that are not predicted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.diagnose.plan.planned_exposures import Planned
from bfsensor.effects.effect import Effect, Layout
from bfsensor.units import to_celsius

PARTS = (0.1, 0.3, 0.6, 0.9)
"""Levels of a short ladder, as fractions of the campaign's brightest flats or spots. Chosen: four
levels separate a linear, a quadratic and a cubic law; below 1, so that nothing saturates."""

CURRENT_MODE = 5e-5
"""Relative error of the light measured by a photodiode whose current is integrated. Chosen, to be
derived: twice as large lowers expected chi-square differences that rest on the lamp, at most to a
quarter."""

FLATS = ("flat_cov", "flat_mean", "serial_overscan", "parallel_overscan")
BIASES = ("bias_cov", "bias_level", "amp_cross")
"""Channels that a recording of flats, and one of biases, repeats."""


@dataclass(frozen=True)
class Rule:
    """Factors on the templates of classes in a recording that is not predicted channel by channel.

    Attributes
    ----------
    channels : tuple of str
        Channels of the campaign that the recording repeats with its change.
    exposures : str
        Kind of exposures that these channels are measured in.
    keeps : mapping of str to float
        Factor on the template by class: 1 unchanged, 0 gone, -1 with the other sign.
    other : float
        Factor on classes that are not in ``keeps``.
    why, source : str
        Reason, and its source, for the report.
    strength : callable, optional
        For a recording that repeats no channel: gives the chi-square of one exposure from an
        effect, the layout and the read noise [e-].
    """

    channels: tuple[str, ...]
    exposures: str
    keeps: Mapping[str, float]
    other: float = 1.0
    why: str = ""
    source: str = ""
    strength: Callable[[Effect, Layout, float], float] | None = None

    def of(self, word: str) -> float:
        """Factor on the template of a class."""
        return self.keeps.get(word, self.other)


@dataclass(frozen=True)
class Recording:
    """A recording that could be taken.

    Attributes
    ----------
    name : str
        Short name, as in report.json.
    words : str
        Instruction in plain words, to be followed by the number of exposures.
    planned : tuple of Planned
        Exposures to take.
    rule : Rule, optional
        Rule for a recording that cannot be predicted; without one its channels are predicted.
    again : bool
        Whether the recording is the whole campaign once more.
    """

    name: str
    words: str
    planned: tuple[Planned, ...] = ()
    rule: Rule | None = None
    again: bool = False

    @property
    def exposures(self) -> int:
        """Number of exposures."""
        return sum(p.count for p in self.planned)


LINE = 1620.0
"""Charge of a Mn K-alpha photon of 5.9 keV [e-].  Derived: 5.9 keV over 3.65 eV per electron-hole pair
(Janesick 2001, Scientific CCDs, SPIE)."""

CLOUDS = 1e-3
"""Photons of Fe55 per pixel and exposure. Chosen: few enough that their charge clouds rarely overlap;
twice as many halve the exposures that are needed."""


def _clouds(effect: Effect, layout: Layout, noise: float) -> float:
    """Chi-square of the charge that an effect moves beside the clouds of one exposure of Fe55."""
    transfers = {
        "cti_serial": 0.5 * float(np.mean([s.columns for s in layout.segments])),
        "cti_parallel": 0.5 * float(np.mean([s.rows for s in layout.segments])),
    }
    # Coupling moves charge to both sides, which doubles its chi-square.
    factors = {
        "ax": 2**0.5,
        "ay": 2**0.5,
        "alpha": 1.0,
        "cti": transfers.get(effect.word, 0.0),
    }
    parts = [v * factors.get(name, 0.0) for name, v in effect.values.items()]
    events = CLOUDS * layout.shape[0] * layout.shape[1]
    return events * sum(p * p for p in parts) * (LINE / noise) ** 2


IN_PIXEL = {
    **dict.fromkeys(
        ("charge_loss", "bf_nonlinear", "bf_chromatic", "bf_anisotropy", "bf_long_range",
         "device_parameter", "silicon_physics", "voltage_dependence"), 0.5
    ),
    "saturation": 0.0,
}  # fmt: skip
"""Factors on classes that depend on the charge of one pixel, where two are binned. Derived: at equal
signal each pixel holds half of the charge, and no pixel reaches the full well."""

RULES: Mapping[str, Rule] = {
    "binned_serial": Rule(
        FLATS, "flat", {**IN_PIXEL, "cti_serial": 0.5},
        why="the same signal comes from half of the charge in each pixel: effects of the charge (loss, "
        "transfer, boundaries) halve, effects of the signal stay",
        source="charge is summed on the output node: Janesick 2001, Scientific CCDs, SPIE, ch. 1",
    ),
    "binned_parallel": Rule(
        FLATS, "flat", {**IN_PIXEL, "cti_parallel": 0.5},
        why="the same signal comes from half of the charge in each pixel, as two rows are added in the "
        "register: effects of the pixels' charge halve, effects in or behind the register stay",
        source="Janesick 2001, Scientific CCDs, SPIE, ch. 1",
    ),
    "near_columns": Rule(
        ("serial_overscan",), "flat", {"cti_serial": 0.5},
        why="behind an edge of light halfway to the amplifier the charge has had half of the transfers, "
        "while effects of amplifier, clamp and a trap at the output do not depend on the column",
        source="transfers against local offset: Snyder et al. 2021, JATIS 7, 048002",
    ),
    "near_rows": Rule(
        ("parallel_overscan",), "flat", {"cti_parallel": 0.5},
        why="behind an edge of light halfway up the charge has had half of the parallel transfers",
        source="as for columns",
    ),
    "pixel_time": Rule(
        FLATS, "flat",
        {"electronic_memory": 0.1, "amp_crosstalk": 0.5, "trap_serial": 0.5,
         "correlated_noise": 0.7},
        why="the amplifier's memory falls exponentially with the pixel time (1e-3 after one, 1e-6 after "
        "two; a tenth is assumed to be left, as clamps settle more slowly), charge left behind at "
        "transfers hardly changes",
        source="Snyder & Roodman 2019, Proc. SPIE 11117; sizes assumed",
    ),
    "reverse_clocks": Rule(
        BIASES, "bias",
        {"correlated_noise": 1.0, "bias_instability": 1.0, "adc_bits": 1.0}, other=0.0,
        why="the serial register is clocked away from the amplifier: no charge arrives, and only the "
        "amplifier's own noise and level are left",
        source="Janesick 2001, Scientific CCDs, SPIE, ch. 6",
    ),
    "clocks_off": Rule(
        BIASES, "bias", {"correlated_noise": 1.0, "bias_instability": 0.3}, other=0.0,
        why="signals that clocks inject are gone, noise of the amplifier and pickup stay",
        source="assumed",
    ),
    "one_amplifier": Rule(
        ("amp_cross",), "spot", {"amp_crosstalk": 1.0}, other=0.0,
        why="with light on one amplifier alone, a signal in the others is crosstalk; ghosts of their "
        "own light are gone, and shared noise averages out",
        source="O'Connor 2015, JINST 10, C05010",
    ),
    "other_light": Rule(
        ("flat_cov", "flat_mean", "flat_map"), "flat",
        {"illumination_turbulence": 0.0, "shutter_timing": 0.0}, other=1.0,
        why="effects of the light change with the projector and its shutter, effects of the sensor "
        "stay",
        source="turbulence in front of the sensor: Broughton et al. 2024, arXiv 2411.13386",
    ),
    "ladder_reversed": Rule(
        ("flat_mean", "flat_cov"), "flat",
        {"gain_drift": -1.0},
        why="with levels in the opposite order of time, an effect of time changes its sign against the "
        "level",
        source="order of exposures only",
    ),
    "purge": Rule(
        ("flat_map",), "flat", {"tearing": 0.0, "dark_hot": 1.0},
        why="a purge of holes before each exposure removes tearing and no other pattern",
        source="Juramy et al. 2020, Proc. SPIE 11454, 1145412",
    ),
    "fe55": Rule(
        (), "dark",
        {"interpixel_coupling": 1.0, "cti_serial": 1.0, "cti_parallel": 1.0,
         "electronic_memory": 1.0}, other=0.0, strength=_clouds,
        why="1600 electrons per photon in a dark frame: no pixel is filled and no lamp is on; coupling "
        "and transfer show in the clouds' tails, effects of large charges or of the lamp are gone",
        source="Janesick 2001, Scientific CCDs, SPIE, ch. 2",
    ),
}  # fmt: skip
"""Rules by recording. Factors are derived where ``why`` states a proportion; others (0.1, 0.3, 0.7
and the 0.5 of pixel_time) are chosen, to be derived: nearer to 1 they lower the expected
differences."""

SPECIAL = {
    "binned_serial": "Take pairs of flats binned by two along the row",
    "binned_parallel": "Take pairs of flats binned by two along the column",
    "near_columns": "Take pairs of flats with the half of the columns far from the amplifier masked",
    "near_rows": "Take pairs of flats with the half of the rows far from the register masked",
    "pixel_time": "Take pairs of flats with twice the pixel time",
    "reverse_clocks": "Take biases with the serial register clocked away from the amplifier",
    "clocks_off": "Take biases with the sensor's clocks off",
    "one_amplifier": "Take spots on one amplifier only, each amplifier in its turn",
    "other_light": "Take pairs of flats with another projector and shutter",
    "ladder_reversed": "Take the ladder of flats once more in the opposite order of time",
    "purge": "Take pairs of flats, each after a purge of holes by bipolar clock voltages",
    "fe55": "Take exposures of Fe55",
}
"""Instructions for the recordings of :data:`RULES`."""


def make_recordings(
    usual: Condition, brightest: float, brightest_spot: float
) -> tuple[Recording, ...]:
    """Make the catalogue of recordings for a campaign, each with a small number of exposures.

    Parameters
    ----------
    usual : Condition
        Condition of most of the campaign's flats.
    brightest, brightest_spot : float
        Level of its brightest flats and flux of its brightest spots [e-].

    Returns
    -------
    tuple of Recording
        Recordings with a prediction, and those of :data:`RULES`.
    """
    bias = usual.back_bias

    def flats(parts: tuple[float, ...], count: int, **more: Any) -> tuple[Planned, ...]:
        plain = (Planned("flat", count, level=p * brightest) for p in parts)
        return tuple(replace(p, **more) for p in plain)

    def spots(count: int, **more: Any) -> tuple[Planned, ...]:
        plain = (Planned("spot", count, flux=p * brightest_spot) for p in PARTS)
        return tuple(replace(p, **more) for p in plain)

    out = [
        Recording("flats_high", "Take more pairs of flats at the highest level", flats((0.9,), 24)),
        Recording("flats_low", "Take more pairs of flats at low level", flats((0.05,), 24)),
        Recording("flats_ladder", "Take more pairs of flats over the whole ladder", flats(PARTS, 8)),
        Recording("photodiode", "Take pairs of flats with the light measured by a photodiode in "
                  "current mode", flats(PARTS, 4, lamp_error=CURRENT_MODE)),
        Recording("light_rate", "Take pairs of flats with twice the light in half of the time, at "
                  "the same levels", flats(PARTS, 4, rate=2.0)),
        Recording("long_overscan", "Take pairs of flats with 64 overscan pixels and rows",
                  flats((0.3, 0.9), 4, overscan=64)),
        Recording("spots", "Take the ladder of spots with more dithers", spots(4)),
        Recording("darks", "Take long darks", (Planned("dark", 10, seconds=300.0),)),
        Recording("darks_after_flats", "Take a short dark after each of some of the brightest flats",
                  (Planned("dark", 10, seconds=15.0, after=brightest),
                   Planned("flat", 10, level=0.9 * brightest))),
        Recording("biases", "Take more biases", (Planned("bias", 40),)),
        Recording("again", "Take the whole campaign once more", again=True),
    ]  # fmt: skip
    for wavelength in (480.0, 620.0, 750.0, 950.0):
        if usual.wavelength is not None and abs(wavelength - usual.wavelength) > 50:
            name = f"{wavelength:g} nm"
            out += [
                Recording(f"flats_{wavelength:g}", f"Take pairs of flats at {name}",
                          flats((0.3, 0.9), 8, wavelength=wavelength)),
                Recording(f"spots_{wavelength:g}", f"Take a ladder of spots at {name}",
                          spots(4, wavelength=wavelength)),
            ]  # fmt: skip
    if bias is not None:
        for other in (bias + 20.0, bias - 10.0):
            out += [
                Recording(f"flats_{other:g}V", f"Take pairs of flats at a back bias of {other:g} V",
                          flats((0.3, 0.9), 8, back_bias=other)),
                Recording(f"spots_{other:g}V", f"Take a ladder of spots at a back bias of {other:g} V",
                          spots(4, back_bias=other)),
            ]  # fmt: skip
    if usual.temperature is not None:
        warm = usual.temperature + 20.0
        out.append(Recording("spots_warm", f"Take a ladder of spots at {to_celsius(warm):g} C",
                             spots(4, temperature=warm)))  # fmt: skip
    return (*out, *_ruled(brightest, brightest_spot))


def _ruled(brightest: float, brightest_spot: float) -> list[Recording]:
    """Recordings of :data:`RULES`."""
    out = []
    for name, rule in RULES.items():
        special = SPECIAL[name]
        planned: tuple[Planned, ...]
        if rule.exposures == "bias":
            planned = (Planned("bias", 20, special=special),)
        elif rule.exposures == "spot":
            planned = (Planned("spot", 8, flux=0.9 * brightest_spot, special=special),)
        elif name == "fe55":
            planned = (Planned("dark", 50, seconds=60.0, special=special),)
        else:
            # Binning adds two pixels: half of the level keeps the signal within the converter's range.
            each = 0.5 if name.startswith("binned") else 1.0
            planned = tuple(
                Planned("flat", 4, level=p * each * brightest, special=special)
                for p in PARTS
            )
        out.append(Recording(name, special, planned, rule))
    return out
