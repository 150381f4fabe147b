"""An attribution as keys of report.json, and in sentences for the report."""

from __future__ import annotations

from typing import Any

from bfsensor.device.quantities import describe
from bfsensor.diagnose.detect.locate import ALARM
from bfsensor.diagnose.explain.attribution import Attribution, Found
from bfsensor.diagnose.model.exchanged_axes import AxesExchanged, says_exchanged
from bfsensor.diagnose.report.class_words import (
    CLASS_WORDS,
    LAW_WORDS,
    NAMES,
    PARAMETER_WORDS,
    PIECE_WORDS,
    said_family_p,
    said_interval,
    said_number,
    said_p,
    said_value,
)
from bfsensor.diagnose.report.nonparametric_words import reported_freely, said_freely
from bfsensor.effects.changed_device import ChangedDevice
from bfsensor.effects.device_parameter import UNKNOWN_UNIT
from bfsensor.effects.effect import Effect

OUTSIDE = "outside_library"
"""Class of a mismatch that no effect of the library explains, in report.json."""


def reported(attribution: Attribution | None) -> dict[str, Any]:
    """Make the keys of report.json that state the effects found in a mismatch."""
    if attribution is None:
        return {
            "effects": [],
            "class_probability": {},
            "equivalence_class": [],
            "open_world": False,
            "free_form": None,
        }
    effects: list[dict[str, Any]] = [_effect(f) for f in attribution.found]
    if attribution.outside and not any(e["class"] == OUTSIDE for e in effects):
        effects.append({"class": OUTSIDE, "parameters": {}})
    return {
        "effects": effects,
        "class_probability": attribution.probability,
        "equivalence_class": attribution.tied,
        "open_world": attribution.outside,
        "free_form": reported_freely(attribution.free_form),
        "p_value_after": attribution.mismatch.p_value,
    }


def _effect(found: Found) -> dict[str, Any]:
    told: dict[str, Any] = {"class": found.effect.word, "parameters": found.intervals()}
    if found.effect.variant:
        told["variant"] = found.effect.variant
    if isinstance(found.effect, ChangedDevice):
        (known,) = found.effect.parameters
        told["parameters"][known.name] |= {"unit": known.unit, "nominal": known.neutral}
    if found.effect.variant in PIECE_WORDS:
        told["piece"] = found.effect.variant
    law = law_of(found.effect)
    if law is not None:
        told["law"] = law[0]
    told["gain_chi2"] = found.gain
    told["tied"] = list(found.tied)
    if found.alike:
        told["tied_quantities"] = list(found.alike)
    told["source"] = found.effect.source
    return told


def said_of(attribution: Attribution) -> list[str]:
    """Sentences: effects with their parameters, what is left, and chi-squares of held-out data."""
    out = []
    left = attribution.mismatch
    # An effect "explains" a mismatch only where it does so alone, by its own law, nothing that
    # stands out is left, and held-out values of every channel that it changes agree.
    alone = len(attribution.found) == 1 and not (left.detected or attribution.open_world)
    whole = alone and attribution.free_form is None and not attribution.fails_in
    verb = "explains it" if whole and not _other_law(attribution) else "explains part of it"
    for found in attribution.found:
        if isinstance(found.effect, AxesExchanged):
            out.append(
                says_exchanged(found.effect["amp"], found.errors.get("amp", 0.0)) + "."
            )
            continue
        out.append(f"{_said_effect(found, verb)}.")
        out += _said_quantity(found)
    out += _said_shares(attribution)
    if attribution.found and attribution.free_form is None:
        out.append(_said_left(attribution))
    named = any(f.effect.word == OUTSIDE for f in attribution.found)
    if attribution.open_world and not (named and attribution.free_form is None):
        what = "the rest" if attribution.found else "it"
        chance = attribution.probability[OUTSIDE]
        out.append(
            f"No effect of the library explains {what}; the probability that its physics is outside "
            f"the library is {chance:.2f}."
        )
    if attribution.free_form is not None:
        # The residuals are those with the nonparametric terms.
        out += [said_freely(attribution.free_form), _said_left(attribution)]
    before, after = attribution.chi2dof()
    if (attribution.found or attribution.free_form is not None) and before == before:
        way = "falls" if after < before else "rises"
        change = f"{way} from {before:.2f} to {after:.2f}"
        if f"{before:.2f}" == f"{after:.2f}":
            change = f"stays at {after:.2f}"
        out.append(f"On recordings that were not fitted, chi-square per value {change}.")
        for word in attribution.fails_in:
            worse, better, n = (attribution.heldout[word][k] for k in (1, 0, 2))
            p = said_p(attribution.heldout_p.get(word, 1.0))
            out.append(
                f"One channel does not agree there, {NAMES.get(word, word)} (from {better / n:.2f} to "
                f"{worse / n:.4g}, p {p}): do not rely on parameters of effects that act on it."
            )
    return out


def law_of(effect: Effect) -> tuple[str, str] | None:
    """Law within an effect's class, as report.json and as sentences have it; None where there is one."""
    if effect.name in LAW_WORDS:
        name, said = LAW_WORDS[effect.name]
        return name, f"here {said}"
    if effect.variant in PIECE_WORDS:
        return effect.variant, PIECE_WORDS[effect.variant]
    if isinstance(effect, ChangedDevice):
        return effect.variant, describe(effect.template.name)
    if effect.law_name:
        return effect.law_name, f"law: {effect.law_name.replace('_', ' ')}"
    return None


def _said_effect(found: Found, verb: str) -> str:
    """One effect: class, meaning, parameters with units, and the classes that fit as well."""
    word = found.effect.word
    units = {p.name: p.unit for p in found.effect.parameters}
    plain = {p.name: p.plain for p in found.effect.parameters}
    words = PARAMETER_WORDS.get(word, {})
    values = []
    for name, told in found.intervals().items():
        if name not in found.errors and told["value"] == plain[name]:
            # It was searched, and the plain law is the best.
            continue
        unit = f" {units[name]}" if units[name] and units[name] != UNKNOWN_UNIT else ""
        spoken = describe(name) if isinstance(found.effect, ChangedDevice) else name
        interval = said_interval(told, "68")
        interval = f"68 %: {interval}" if name in found.errors else interval
        values.append(
            f"{words.get(name, spoken)} = {said_value(word, name, told['value'])}{unit} ({interval})"
        )
    meaning = CLASS_WORDS.get(word, word)
    law = law_of(found.effect)
    if law is not None:
        meaning += f"; {law[1]}"
    text = f"{word} ({meaning}) {verb}: {', '.join(values)}"
    others = [w for w in found.tied if w != word]
    if others:
        text += f"; these recordings do not distinguish it from {' or '.join(others)}"
    if found.alike:
        text += f"; another value of {' or '.join(map(describe, found.alike))} does as well"
    return text


def _said_quantity(found: Found) -> list[str]:
    """State which quantity of the device does best in place of a law of the boundary shifts."""
    rival = found.quantity
    if rival is None:
        return []
    (known,) = rival.effect.parameters
    value, nominal, gain, whole = map(
        said_number, (rival.effect[known.name], known.neutral, rival.gain, found.gain)
    )
    return [
        f"Of the device's quantities {describe(known.name)} does best: at {value} {known.unit}, "
        f"nominally {nominal}, it takes {gain} of {whole} in chi-square; it may be the cause if the "
        "simulated response to it is wrong."
    ]


def _said_left(attribution: Attribution) -> str:
    """State whether residuals with the effects still stand out, by their p-value."""
    left = attribution.mismatch
    p = said_family_p(left.p_value)
    if not left.detected:
        return f"Nothing else stands out (family-wise p {p})."
    text = f"What is left still stands out (family-wise p {p})"
    if attribution.found and not attribution.open_world:
        text += ", but errors of the effects' own predictions may make it"
    return f"{text}."


def _other_law(attribution: Attribution) -> bool:
    """Whether a measurable part of the mismatch asks for another law of the effects."""
    return attribution.shares.get("laws", 0.0) > 0


def _said_shares(attribution: Attribution) -> list[str]:
    """Shares that the effects take by their own laws, and that other laws or causes take beside them."""
    shares = attribution.shares
    if not attribution.found or not shares:
        return []
    out = []
    if shares["laws"] > 0:
        out.append(
            f"By the law that is printed here, effects take {_percent(shares['effects'])} of the "
            f"chi-square above noise; another {_percent(shares['laws'])} lies where they act and "
            "asks for another law of the same class."
        )
    if shares["outside"] + shares["left"] > ALARM:
        rest = _percent(shares["outside"] + shares["left"])
        out.append(f"A part, {rest} of the chi-square above noise, remains beside them.")
    return out


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
