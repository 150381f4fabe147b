"""Truths and reports made by hand, whose scores are known."""

import copy

EMPTY = {
    "schema": "bfsensor-diagnosis-1", "campaign": "c", "version": "0", "detected": False,
    "p_value": 0.5, "effects": [], "class_probability": {}, "equivalence_class": [],
    "open_world": False,
    "location": {"channels": [], "lags": [], "flux_e": [], "x": [], "y": [], "amps": [],
                 "wavelength": [], "exposures": []},
    "recommended_recordings": [], "heldout": {"chi2dof_before": 1.0, "chi2dof_after": None},
    "said": "Nothing stands out.",
}  # fmt: skip


def report(**changes):
    return copy.deepcopy(EMPTY) | changes


def interval(value, one, two=None):
    """A parameter with intervals of one (68 %) and two (95 %) to either side."""
    two = 2 * one if two is None else two
    return {
        "value": value, "lo68": value - one, "hi68": value + one,
        "lo95": value - two, "hi95": value + two,
    }  # fmt: skip


def found(*words, p=1e-6, chances=None, parameters=None, **changes):
    """A report that names classes, first of them first."""
    given = parameters or {}
    return report(
        detected=True, p_value=p,
        effects=[{"class": w, "parameters": given.get(w, {})} for w in words],
        class_probability={words[0]: 1.0} if chances is None and words else chances or {},
        equivalence_class=list(words[:1]),
    ) | changes  # fmt: skip


def truth(*words, snr=None, parameters=None, name="c", **more):
    given = {"tearing": {"amp": 0.02, "length": 2.0, "column": 0.5}} | (parameters or {})
    effects = [{"class": w, "parameters": given.get(w, {})} for w in words]
    for k, effect in enumerate(effects):
        if snr is not None:
            effect["snr"] = snr[k] if isinstance(snr, tuple) else snr
    return {"campaign": name, "effects": effects, "size": "S", **more}
