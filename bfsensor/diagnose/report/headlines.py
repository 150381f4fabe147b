"""First sentence of a report: each effect as a physicist would say it, with values and units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from string import Formatter
from typing import Any

from bfsensor.device.quantities import describe
from bfsensor.diagnose.detect.model_error import SAME
from bfsensor.diagnose.explain.attribution import Attribution, Found
from bfsensor.diagnose.report.class_words import CLASS_WORDS, PIECE_WORDS
from bfsensor.effects.changed_device import ChangedDevice
from bfsensor.effects.device_parameter import UNKNOWN_UNIT

VAGUE = 1000.0
"""Error of a value, over the value, above which it is not constrained.  Chosen: the recordings then say
nothing of its size; with 2000, a value known to within three orders of magnitude is stated."""

HEADLINES: Mapping[str, tuple[str, ...]] = {
    "cti_serial": (
        "serial transfer leaves {cti} of 5e4 e- behind at each step, by the power {power} of the "
        "signal; it comes back within {tau} pixels, {slow} of it within {slow_tau}",
        "serial transfer leaves {cti} of 5e4 e- behind at each step, by the power {power} of the "
        "signal; it comes back within {tau} pixels",
        "serial transfer leaves {cti} of the charge behind at each step",
    ),
    "cti_parallel": (
        "parallel transfer leaves {cti} of 5e4 e- behind at each step, by the power {power} of the "
        "signal; it comes back within {tau} pixels, {slow} of it within {slow_tau}",
        "parallel transfer leaves {cti} of 5e4 e- behind at each step, by the power {power} of the "
        "signal; it comes back within {tau} pixels",
        "parallel transfer leaves {cti} of the charge behind at each step",
    ),
    "trap_serial": (
        "a trap in the serial register of amplifier {amp}, before column {column} as they are read, "
        "is filled by {middle} e-, holds {size} e- and releases them within {tau} pixel times",
        "a trap in the serial register of amplifier {amp}, before column {column} as they are read, "
        "holds {size} e- and releases them within {tau} pixel times",
        "a trap in the serial register of amplifier {amp} is filled by {middle} e-, holds {size} e- and "
        "releases them within {tau} pixel times",
        "a trap in the serial register of amplifier {amp} holds {size} e- and releases them within "
        "{tau} pixel times",
    ),
    "electronic_memory": (
        "each pixel adds {alpha} of itself to the pixels after it, falling within {tau} pixel times",
        "pixels above {threshold} e- drive an offset of {scale} of the excess, which decays within "
        "{tau} pixel times",
        "{alpha} of each pixel appears in the pixel read next",
    ),
    "interpixel_coupling": (
        "pixels pass {ax} of their signal to each neighbour in the row, {ay} to each in the column",
    ),
    "amp_crosstalk": ("{c} of the signal of an amplifier appears in the others",),
    "correlated_noise": (
        "noise of {rms} e- (rms) falls with the frequency as the power {exponent} of it",
        "noise of {rms} e- (rms) repeats with a period of {period} pixel times",
        "noise of {rms} e- (rms) is correlated, by {corr} from one pixel read to the next",
        "amplifiers share noise of {rms} e- (rms)",
    ),
    "bias_instability": (
        "the bias level of rows moves by {rms} e- (rms) and remembers {corr} of the row before",
        "rows settle within {length} pixels by an amount that differs between frames by {rms} e- (rms)",
        "the bias level moves by {rms} e- (rms)",
    ),
    "gain_nonlinearity": (
        "the slope of the response changes by {slope} at {level} e-",
        "the signal lacks {deficit} e-, lost within the first {length} e-",
        "the response departs from proportion by {f3} at 4e4 e- and by {f6} at 1e5 e-",
        "the signal departs from the charge by {c2} at 1e5 e-, and by {c3} with its square",
    ),
    "adc_bits": (
        "every 2^{bit}-th code of the converter is {delta} ADU too wide ({place} from its multiples)",
        "codes with bit {bit} of the converter set are wrong by {delta} ADU",
    ),
    "gain_drift": (
        "the gain changes by {amp} within {tau} hours",
        "the gain cycles by {amp} every {period} hours",
        "the gain has changed by {g3} in the middle of the campaign, and by {g6} at its end",
        "the gain changes by {slope} an hour",
    ),
    "bf_nonlinear": (
        "boundary shifts are not in proportion to the charge Q: they go as Q (1 + b Q / 2) with b = "
        "{b} per electron",
    ),
    "bf_chromatic": (
        "boundary shifts change by {kappa} from 620 to 950 nm beyond what was simulated",
    ),
    "bf_anisotropy": (
        "boundary shifts in y exceed those in x by {eps} more than simulated",
    ),
    "bf_long_range": (
        "an electron changes areas by {amp} at 1 pixel, divided by the distance to the power "
        "{power}, beyond what was simulated",
    ),
    "voltage_dependence": (
        "boundary shifts grow by {delta} for 20 V less back bias beyond what was simulated",
    ),
    "lateral_diffusion": ("spots are wider by a variance of {var} pixel^2",),
    "tree_rings": (
        "tree rings displace light by {amp} pixel, on average {period} pixels from ring to ring",
        "tree rings displace light by {amp} pixel",
    ),
    "edge_rolloff": (
        "light at the rim is displaced by {amp} pixel, within {length} pixels",
    ),
    "mask_stitch": ("every {period} {along} a boundary is displaced by {amp} pixel",),
    "tearing": (
        "columns beside a boundary at {column} of the width are displaced by {amp} pixel, within "
        "{length} pixels",
    ),
    "charge_loss": (
        "pixels lose {q} of their light for each electron at 1e5 e-, by the power {power} of the charge",
        "pixels lose {q} of their light for each stored electron, ever less above {knee} e-",
        "pixels lose {q} of their light for each stored electron",
    ),
    "persistence": (
        "{frac} of the charge above {threshold} e- comes out in later exposures, within {tau} of them, "
        "{slow} of it within {slow_tau}",
        "{frac} of a pixel's charge comes out in the next exposure, then less by the power {exponent} "
        "of the age",
        "{frac} of a pixel's charge comes out in later exposures, within {tau} of them",
    ),
    "shutter_timing": ("exposures last {dt} s longer than stated",),
    "dark_hot": (
        "a corner of the sensor glows by {rate} e-/s, within {length} pixels",
        "hot columns, {columns} in number, collect {rate} e-/s",
        "the dark current is {rate} e-/s more than the baseline's",
    ),
    "saturation": (
        "pixels are full at {full_well} e- and lose {drain} of what is above",
        "pixels are full at {full_well} e-",
    ),
    "fringing": ("fringes vary the signal by {amp}, {period} pixels apart",),
    "psf_wings": (
        "{frac} of the light of spots lies in a halo {sigma} pixels wide",
        "{frac} of the light of spots lies in a halo that falls within {length} pixels",
    ),
    "cosmic_rays": ("particles leave {rate} tracks a minute on 256 x 256 pixels",),
    "silicon_physics": (
        "diffusion widens by {growth} % (variance) per 1e5 e- of charge in the pixel",
        "a photon of 350 nm makes {extra} electrons more than one",
    ),
    "illumination_turbulence": (
        "the illumination changes between frames by {rms} (rms) over {corr} pixels",
    ),
}
"""Sentences of each class, of which the first is used whose parameters the effect has."""


def headline(found: Found) -> str:
    """One effect in a clause, with its values and their 68 % errors.

    Parameters
    ----------
    found : Found
        The effect.

    Returns
    -------
    str
        Without a capital and a full stop.
    """
    word = found.effect.word
    plain = {
        p.name for p in found.effect.parameters
        if p.law == "whole" and p.plain == found.effect[p.name]
    }  # fmt: skip
    values = {
        name: _amount(told, whole=name not in found.errors)
        for name, told in found.intervals().items()
        if name not in plain
    }
    if word == "trap_serial" and "amp" in found.effect.values:
        values["amp"] = f"{found.effect['amp'] + 1:g}"
    if word == "mask_stitch":
        values["along"] = "rows" if found.effect.values.get("along") else "columns"
    if isinstance(found.effect, ChangedDevice):
        (name, value), (known,) = next(iter(values.items())), found.effect.parameters
        unit = "" if known.unit == UNKNOWN_UNIT else f" {known.unit}"
        number, *rest = value.split(" (")
        value = " (".join([f"{number}{unit}", *rest])
        text = f"{describe(name)} of the device is {value}, nominally {known.neutral:.4g}{unit}"
        if found.alike:
            text += f", or {' or '.join(map(describe, found.alike))} differs"
        piece = PIECE_WORDS.get(found.effect.variant, "")
        return f"{piece}: {text}" if piece else text
    for text in HEADLINES.get(word, ()):
        if {name for _, name, _, _ in Formatter().parse(text) if name} <= set(values):
            return text.format(**values)
    return CLASS_WORDS.get(word, word)


def headlines(attribution: Attribution) -> str:
    """Sentence that names all effects of an attribution, and whether anything is left; or ''.

    Where effects explain less than half of the chi-square above noise, the share that no effect
    explains is stated first.
    """
    own = [headline(f) for f in attribution.found]
    if not own:
        return ""
    text = "; ".join(own)
    if attribution.taken < SAME:
        rest = 100 * (1 - attribution.taken)
        share = f"{rest:.3g} %" if rest < 99.9 else "more than 99.9 %"
        return f"No effect of the library explains {share} of what stands out. The smaller part: {text}."
    left = attribution.open_world or attribution.mismatch.detected
    after = "More is left, see below." if left else "Nothing else is left."
    return f"{text[0].upper()}{text[1:]}. {after}"


def _amount(told: Mapping[str, Any], *, whole: bool) -> str:
    """Value with its error, half of the 68 % interval, to two digits of the error.

    Of an interval that is open at one end the other is stated.
    """
    value = float(told["value"])
    if whole or "lo68" not in told:
        return f"{value:g}"
    open_ = told.get("open68", ())
    if len(open_) == 2:
        return f"{value:.2g} (not constrained)"
    if open_:
        low = "hi" in open_
        return f"{'more' if low else 'less'} than {told['lo68' if low else 'hi68']:.3g}"
    error = 0.5 * (float(told["hi68"]) - float(told["lo68"]))
    if not (math.isfinite(error) and error > 0):
        return f"{value:.3g}"
    if error > VAGUE * abs(value) > 0:
        return f"{value:.2g} (not constrained)"
    # Digits of the value down to the error's second one.
    ratio = abs(value) / error
    digits = max(2, min(7, math.floor(math.log10(ratio)) + 3 if ratio > 0 else 2))
    return f"{value:.{digits}g} +- {error:.2g}"
