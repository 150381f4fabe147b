"""Nonparametric terms in sentences for the report, and as the block 'free_form' of report.json."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bfsensor.diagnose.explain.nonparametric import Coefficient, OpenWorld
from bfsensor.diagnose.explain.terms import ALL_TABLES, SINGLE
from bfsensor.diagnose.report.class_words import said_p

NEAR = 30.0
"""Angle [degrees] between whitened templates below which an effect of the library is printed as similar.
Chosen, to be derived: cos 30 degrees = 0.87, so a similar effect would take 75 % of the term's
chi-square; at 60 degrees effects that take only a quarter would be printed as similar."""

TOLD_ALIKE = ("pattern of position", "odd boundary shifts", "mean in time", "mean by level")
"""Groups for which the report also prints terms that fit as well as the first one."""

REFUSED = 1e-3
"""p-value of a constraint below which it is printed as broken.  Chosen, to be derived: with a handful of
constraints one report in some 200 prints one as broken by chance; twice as large, twice as many."""


def said_freely(found: OpenWorld) -> str:
    """Sentences: each group of terms with sizes, constraints that hold, and similar effects."""
    parts = []
    for group in found.groups:
        own = found.of_group(group)
        say = WORDS.get(group)
        if own and say is not None:
            parts.append(say(own) + ".")
        if group in TOLD_ALIKE and found.alike.get(group):
            text = "; ".join(f"{name}: {value:.3g}" for name, value in found.alike[group])
            parts.append(
                f"These recordings fit as well, in place of the first term: {text}."
            )
    tests = _tests(found.tests)
    if tests:
        parts.append(tests)
    near = [(name, angle) for name, angle in found.nearest if angle < NEAR]
    if near:
        text = ", ".join(f"{name} ({angle:.0f} degrees)" for name, angle in near[:2])
        parts.append(
            f"Most similar effects of the library, by the angle between templates: {text}."
        )
    elif found.nearest:
        name, angle = found.nearest[0]
        parts.append(
            "No effect of the library is similar: the nearest, by the angle between templates, is "
            f"{name} ({angle:.0f} degrees)."
        )
    return " ".join(parts)


def reported_freely(found: OpenWorld | None) -> dict[str, Any] | None:
    """Make the block 'free_form' of report.json; None where there is no nonparametric model."""
    if found is None:
        return None
    before, after = found.chi2dof()
    return {
        "groups": list(found.groups),
        "coefficients": {
            c.name: {"value": c.value, "error": c.error, "where": _plain(c.where)}
            for c in found.coefficients
        },
        "by_group": {k: list(v) for k, v in found.by_group.items()},
        "alike": {
            k: [{"name": n, "value": float(x)} for n, x in v] for k, v in found.alike.items()
        },
        "scores": {k: float(v) for k, v in found.scores.items()},
        "tests": {k: {n: float(v) for n, v in t.items()} for k, t in found.tests.items()},
        "nearest": [{"name": n, "angle_degrees": a} for n, a in found.nearest],
        "chi2dof": {"heldout_before": _finite(before), "heldout_after": _finite(after)},
        "folds": {
            fold: {w: {"before": b / n, "after": a / n, "values": n} for w, (b, a, n) in held.items()}
            for fold, held in found.folds.items()
        },
        "p_value_after": found.mismatch.p_value,
        "said": said_freely(found),
    }  # fmt: skip


def _amount(c: Coefficient, unit: str = "") -> str:
    digits = (
        3
        if not c.error
        else int(np.clip(np.ceil(np.log10(abs(c.value) / c.error)) + 1, 2, 5))
        if c.value
        else 2
    )
    return f"{c.value:.{digits}g} +- {c.error:.1g}{unit}"


def _shifts(own: Sequence[Coefficient]) -> str:
    """Even boundary shifts: which edges, direction, and power of the charge."""
    powers = sorted({int(c.where["power"]) for c in own})
    law = {
        (0,): "in proportion to the charge", (1,): "with the square of the charge",
        (0, 1): "with the charge and its square",
    }[tuple(powers)]  # fmt: skip
    reach = max(float(np.hypot(c.where["along"], c.where["across"])) for c in own)
    axes = {c.where["axis"] for c in own}
    where = (
        "alike in x and y" if axes == {"xy"}
        else f"along {' and '.join(sorted(axes & {'x', 'y'})) or 'x and y'}"
    )  # fmt: skip
    sizes = "; ".join(
        f"edges {c.where['along']:g} pixels along "
        f"{'x and y' if c.where['axis'] == 'xy' else c.where['axis']} and {c.where['across']} across "
        f"{_way(c)} by "
        + _amount(replace(c, value=abs(c.value)), " 1e-8 pixel/e-")
        + (" per 1e5 e-" if c.where["power"] else "")
        for c in own[:4]
    )
    turn = _turning(own)
    return (
        f"Pixel boundaries move more or less than in the baseline, {where}, symmetrically on both "
        f"sides, {law}, up to {reach:.1f} pixels away, charge conserved: {sizes}{turn}"
    )


def _way(c: Coefficient) -> str:
    return "move away from the charge" if c.value > 0 else "move towards the charge"


def _turning(own: Sequence[Coefficient]) -> str:
    """Level [e-] at which a shift with terms in the charge and in its square changes sign."""
    by: dict[tuple[Any, ...], dict[int, float]] = {}
    for c in own:
        key = (c.where["axis"], c.where["along"], c.where["across"])
        by.setdefault(key, {})[int(c.where["power"])] = c.value
    for parts in by.values():
        if 0 in parts and 1 in parts and parts[0] * parts[1] < 0:
            level = -parts[0] / parts[1] * 1e5
            return f"; the shift changes sign at a charge of {level:.2g} e-"
    return ""


def _odd(own: Sequence[Coefficient]) -> str:
    out = []
    for c in own:
        axis, side = c.where["odd"], "+" if c.value > 0 else "-"
        if c.where.get("shape") == "baseline":
            out.append(
                f"Edges on both sides of a charge move towards {side}{axis} by a further "
                f"{abs(c.value):.3g} +- {c.error:.1g} of their shift in the baseline: the "
                f"kernel is odd in {axis}"
            )
        else:
            out.append(
                f"edges {c.where['along']:g} pixels along {c.where['axis']} and {c.where['across']} "
                f"across move towards {side}{axis} on both sides by {_amount(c, ' 1e-8 pixel/e-')}"
            )
    text = "; ".join(out)
    return (
        text[0].upper()
        + text[1:]
        + " (flats are not sensitive to it, and spots do not constrain its range)"
    )


def _filter(own: Sequence[Coefficient]) -> str:
    main = [c for c in own if "lag" in c.where]
    texts = []
    for c in main:
        n, p = int(c.where["lag"]), int(c.where["power"])
        what = "S" if p == 1 else "S^2 / 1e5 e-"
        texts.append(
            f"{_amount(c)} {what}, S the signal [e-] of the pixel read {n} pixel "
            f"time{'s' * (n > 1)} before"
        )
    mean = (
        "in proportion to the signal"
        if all(c.where["power"] == 1 for c in main)
        else "with its square"
    )
    if len({c.where["power"] for c in main}) > 1:
        mean = "with the signal and its square"
    return (
        f"An echo in readout order, {mean}: each pixel gains {'; '.join(texts)} (mirrored in "
        "amplifiers that read from the other side)"
    )


def _parity(own: Sequence[Coefficient]) -> str:
    main = [c for c in own if "parity" in c.where]
    return "; ".join(
        f"Odd and even pixels differ ({c.where['parity']}) by {_amount(c)} of the signal"
        + _power_of(c) for c in main
    )  # fmt: skip


def _power_of(c: Coefficient) -> str:
    if "condition" in c.where:
        return f" at {c.where['condition']} (nm/V/C) beyond that in other conditions"
    p = int(c.where.get("power", 0))
    return (
        ", the same at all levels",
        " at 1e5 e-, in proportion to the level",
        " at 1e5 e-, with the square of the level",
    )[p]


def _places(own: Sequence[Coefficient]) -> str:
    main = [c for c in own if not c.where.get("square")]
    text = "; ".join(
        f"{c.name}: {_amount(c)} of the signal{_power_of(c)}" for c in main[:4]
    )
    return f"A pattern fixed on the sensor: {text}"


def _ripple(own: Sequence[Coefficient]) -> str:
    c = own[0]
    size = np.sqrt(max(c.value, 0.0) * 1e-6)
    error = 0.5e-6 * c.error / size if size else np.inf
    return (
        "The signal varies as a sine of the readout time, with the same phase in all frames: period "
        f"{c.where['period']:.4g} pixel times, amplitude {size:.3g} +- {error:.1g} of the signal, "
        "the same at all levels"
    )


def _by_level(own: Sequence[Coefficient]) -> str:
    text = "; ".join(f"{c.name}: {_amount(c)} of the mean" for c in own[:4])
    return f"The mean is not proportional to the level S (here in units of 1e5 e-): {text}"


def _in_time(own: Sequence[Coefficient]) -> str:
    main = [c for c in own if "quarter" not in c.where][:5]
    text = "; ".join(f"{c.name}: {_amount(c)} of the mean" for c in main)
    return f"The mean changes with time: {text}"


def _before(own: Sequence[Coefficient]) -> str:
    main = [c for c in own if "power" in c.where]
    if not main:
        return (
            "The mean of flats differs after exposures that are missing from the campaign"
        )
    words = []
    for c in main:
        of = (
            "1e5 e- of that exposure's mean level"
            if c.where["power"] == 1
            else "(1e5 e-)^2 of that exposure's mean level squared"
        )
        words.append(
            f"{'falls' if c.value < 0 else 'rises'} by {abs(c.value):.3g} +- {c.error:.1g} of itself "
            f"per {of}"
        )
    return f"The gain depends on the exposure taken before: it {' and '.join(words)}"


def _lags(own: Sequence[Coefficient]) -> str:
    text = "; ".join(
        f"lag ({c.where['lags'][0][0]}, {c.where['lags'][0][1]}): {_amount(c)} e-^2 at 1e5 e-, "
        f"growing with the level to the power {c.where['power']}" for c in own[:4]
    )  # fmt: skip
    return (
        "Covariances of flats differ from the baseline at single lags, which shifts of boundaries "
        f"cannot cause: {text}"
    )


def _single(own: Sequence[Coefficient]) -> str:
    text = "; ".join(
        f"a_{c.where['lags'][0][0]}{c.where['lags'][0][1]}"
        f"{' in all tables' if c.where.get('of') == ALL_TABLES else ''} by {_amount(c)} 1e-8 / e- "
        f"({100 * c.value * c.where['relative']:+.1f} % of the measured value)" for c in own[:4]
    )  # fmt: skip
    if len(own) > 1:
        return f"Single a_ij differ from the baseline, in no pattern of shifts: {text}"
    at = own[0].where["lags"][0]
    more = (
        ". All lags together then no longer add up to 0: charge is lost, the gain is wrong for this "
        "lag, area is gained beyond the lags of the table, or the value is wrong"
        if tuple(at) == (0, 0) else ""
    )  # fmt: skip
    return f"One value is off, and no other supports it: {text}{more}"


def _smooth(own: Sequence[Coefficient]) -> str:
    lags = ", ".join(f"({i}, {j})" for i, j in own[0].where["lags"][:6])
    return (
        "Covariances of flats differ from the baseline smoothly with lag and level, in no simple law: "
        f"most at lags (x, y) {lags}"
    )


WORDS: Mapping[str, Callable[[Sequence[Any]], str]] = {
    "boundary shifts": _shifts, "odd boundary shifts": _odd, "readout filter": _filter,
    "pattern of two-pixel parity": _parity, "pattern of position": _places,
    "ripple in readout time": _ripple, "mean by level": _by_level, "mean in time": _in_time,
    "mean by the exposure before": _before, "covariances by lag": _lags, SINGLE: _single,
    "smooth covariances over lag and level": _smooth,
}  # fmt: skip
"""Function that describes the coefficients of each group of nonparametric terms."""


def _tests(tests: Mapping[str, Mapping[str, float]]) -> str:
    """Constraints that hold, and the size of the violation of those that do not."""
    kept, broken = [], []
    for name, test in tests.items():
        if "p_value" not in test:
            continue
        if test["p_value"] > REFUSED:
            kept.append(f"{name} (p {said_p(test['p_value'])})")
        else:
            value = (
                f" by {test['value']:.2g} +- {test['error']:.1g}" if "value" in test else ""
            )
            broken.append(f"{name}{value} (p {said_p(test['p_value'])})")
    parts = []
    if kept:
        parts.append(f"Constraints that hold: {', '.join(kept)}.")
    if broken:
        parts.append(f"Constraints that are violated: {', '.join(broken)}.")
    if "decay" in tests:
        d = tests["decay"]
        parts.append(
            "The added area changes fall off with distance r as r^-p, p = "
            f"{d['value']:.1f} +- {d['error']:.1f}."
        )
    return " ".join(parts)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _plain(where: Mapping[str, Any]) -> dict[str, Any]:
    def plain(v: Any) -> Any:
        if isinstance(v, list | tuple):
            return [plain(x) for x in v]
        return v.item() if isinstance(v, np.generic) else v

    return {k: plain(v) for k, v in where.items()}
