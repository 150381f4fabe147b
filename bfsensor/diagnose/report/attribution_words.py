"""An attribution as report.json has it, and in plain words."""

from __future__ import annotations

from typing import Any

from bfsensor.diagnose.explain.attribution import Attribution, Found
from bfsensor.diagnose.model.exchanged_axes import AxesExchanged, says_exchanged
from bfsensor.diagnose.report.nonparametric_words import reported_freely, said_freely

OUTSIDE = "outside_library"


def reported(attribution: Attribution | None) -> dict[str, Any]:
    """Keys of report.json that say what explains a mismatch."""
    if attribution is None:
        return {
            "effects": [],
            "class_probability": {},
            "equivalence_class": [],
            "open_world": False,
            "free_form": None,
        }
    effects: list[dict[str, Any]] = [_effect(f) for f in attribution.found]
    if attribution.open_world and not any(e["class"] == OUTSIDE for e in effects):
        effects.append({"class": OUTSIDE, "parameters": {}})
    return {
        "effects": effects,
        "class_probability": attribution.probability,
        "equivalence_class": attribution.tied,
        "open_world": attribution.open_world,
        "free_form": reported_freely(attribution.free_form),
        "p_value_after": attribution.mismatch.p_value,
    }


def _effect(found: Found) -> dict[str, Any]:
    told: dict[str, Any] = {"class": found.effect.word, "parameters": found.intervals()}
    if found.effect.variant:
        told["variant"] = found.effect.variant
    told["gain_chi2"] = found.gain
    told["tied"] = list(found.tied)
    told["source"] = found.effect.source
    return told


def said_of(attribution: Attribution) -> list[str]:
    """Sentences: what explains it, what would as well, what is left, what it does to new data."""
    out = []
    for found in attribution.found:
        if isinstance(found.effect, AxesExchanged):
            out.append(
                says_exchanged(found.effect["amp"], found.errors.get("amp", 0.0)) + "."
            )
            continue
        values = ", ".join(
            f"{name} = {_value(told)}" for name, told in found.intervals().items()
        )
        text = f"{found.effect.word} explains it: {values}"
        others = [w for w in found.tied if w != found.effect.word]
        if others:
            text += f"; these recordings cannot tell it from {' or '.join(others)}"
        out.append(text + ".")
    named = any(f.effect.word == OUTSIDE for f in attribution.found)
    if attribution.open_world and not (named and attribution.free_form is None):
        what = "what is left" if attribution.found else "it"
        out.append(f"No effect of the library explains {what}.")
    elif not attribution.found and attribution.mismatch.detected:
        out.append(
            "No effect explains it; it is too faint to be called outside the library."
        )
    if attribution.free_form is not None:
        out.append(said_freely(attribution.free_form))
    before, after = attribution.chi2dof()
    if (attribution.found or attribution.free_form is not None) and before == before:
        out.append(
            f"On recordings that were not fitted chi-square per value goes from {before:.2f} to "
            f"{after:.2f}."
        )
        for word in attribution.fails_in:
            worse, better, n = (attribution.heldout[word][k] for k in (1, 0, 2))
            out.append(
                f"There it fails in the channel {word!r} (from {better / n:.2f} to {worse / n:.4g}): "
                "parameters of effects that act on it are not to be relied on."
            )
    return out


def _value(told: dict[str, Any]) -> str:
    if "lo68" not in told:
        return f"{told['value']:g}"
    low, high = f"{told['lo68']:.3g}", f"{told['hi68']:.3g}"
    open_ = told.get("open68", ())
    text = f"{low} to {high}"
    if len(open_) == 2:
        text = "any"
    elif open_:
        text = f"above {low}" if "hi" in open_ else f"below {high}"
    if told.get("stopped68"):
        text += f", followed from {low} to {high} only"
    return f"{told['value']:.3g} ({text})"
