"""Checks of a campaign's headers and layouts against one another, without reading pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from bfsensor.recording.campaign.exposures import (
    LIT,
    Caution,
    Exposure,
    count_of,
    group_conditions,
    named,
)
from bfsensor.recording.campaign.manifest import Entry
from bfsensor.recording.raw.headers import whole_digest
from bfsensor.recording.raw.keywords import DATES, MEANINGS, TIMES
from bfsensor.recording.raw.sections import AmplifierLayout, overlaps

SAME = ("kind", "exposure_time", "wavelength", "filter", "back_bias", "temperature")
"""Quantities that must agree between two files of equal pixels for one of them to be used."""

PLACE = "campaign.yaml: amplifiers: [{name: ..., detector: '[x1:x2,y1:y2]'}, ...]"
"""Entry that states the places of amplifiers on the sensor, for messages."""


def set_aside_duplicates(entries: Sequence[Entry]) -> None:
    """Set aside files whose pixels equal another file's, bit for bit.

    The first of them stays where headers and manifest agree on their settings; where they do not,
    it is not known which settings are right, and all are set aside.
    """
    groups: dict[str, list[Entry]] = {}
    for one in entries:
        if not one.reason and one.scan is not None:
            groups.setdefault(one.scan.sample, []).append(one)
    for alike in groups.values():
        if len(alike) < 2:
            continue
        equal: dict[str, list[Entry]] = {}
        for one in alike:
            if one.scan is not None:
                equal.setdefault(whole_digest(one.scan), []).append(one)
        for copies in equal.values():
            first, *others = sorted(copies, key=lambda e: e.row is None)
            agree = all(
                other.said.get(name) == first.said.get(name)
                for other in others
                for name in SAME
            )
            for other in others:
                other.reason = f"the same pixels as {first.path.name}"
                if not agree:
                    other.reason += ", but header or manifest state other settings"
            if others and not agree:
                copy = others[0].path.name
                first.reason = f"the same pixels as {copy}, but header or manifest state other settings"


def set_aside_other_layouts(entries: Sequence[Entry]) -> tuple[AmplifierLayout, ...]:
    """Set aside files whose amplifiers differ in layout from those of most files.

    Returns
    -------
    amplifiers : tuple of AmplifierLayout
        Amplifiers of the first file of the most frequent layout; empty without files.
    """
    used = [one for one in entries if not one.reason and one.scan is not None]
    counts = Counter(_geometry(one) for one in used)
    if not counts:
        return ()
    most = counts.most_common(1)[0][0]
    model = next(one for one in used if _geometry(one) == most)
    for one in used:
        if _geometry(one) != most:
            one.reason = _first_difference(one, model, counts[most])
    return () if model.scan is None else model.scan.amplifiers


def set_aside_contradictions(entries: Sequence[Entry]) -> list[Caution]:
    """Set aside files whose manifest and header differ.

    Where most files differ, the cause is a unit or a meaning and not a slip: all of them stay, with
    the manifest's values and a warning.
    """
    having = [one for one in entries if one.row is not None and not one.reason]
    wrong = [one for one in having if one.disagree]
    if wrong and 2 * len(wrong) > len(having):
        return [
            Caution(
                "manifest",
                f"manifest and headers differ in {len(wrong)} of {len(having)} exposures, such "
                f"as {wrong[0].path.name}: {wrong[0].disagree[0]}; the manifest's values are used",
                "conditions are wrong if its columns are in other units; state them in its header "
                "or in campaign.yaml: keywords: {exposure_time: {unit: ms}}",
            )
        ]
    for one in wrong:
        one.reason = (
            f"manifest and header differ: {'; '.join(one.disagree)}; correct one of them"
        )
    return []


def check_layout(amplifiers: Sequence[AmplifierLayout]) -> list[Caution]:
    """Check the places of a sensor's amplifiers, and their overscan sections."""
    found = []
    for name, other in overlaps(amplifiers):
        found.append(
            Caution(
                "layout",
                f"DETSEC of {name} and {other} overlap",
                "maps and images of the sensor cannot be made; correct the places in "
                + PLACE,
            )
        )
    for one in amplifiers:
        if one.on_sensor is not None and one.on_sensor != one.shape:
            found.append(
                Caution(
                    "layout",
                    f"{one.name}: DETSEC has {one.on_sensor[1]} x {one.on_sensor[0]} pixels, "
                    f"DATASEC {one.shape[1]} x {one.shape[0]}",
                    "its place on the sensor is not known; state it in " + PLACE,
                )
            )
    if amplifiers and all(one.origin is None for one in amplifiers) and len(amplifiers) > 1:
        found.append(
            Caution(
                "layout",
                "no DETSEC",
                f"maps across amplifiers cannot be made; state their places in {PLACE}",
            )
        )
    found += [
        Caution(
            "overscan",
            f"{one.name}: {one.bias_problem}",
            "the overscan's level is not subtracted; state the section in campaign.yaml: "
            "amplifiers: [{name: ..., bias: '[x1:x2,y1:y2]'}, ...]",
        )
        for one in amplifiers
        if one.bias_problem
    ]
    above = [one for one in amplifiers if one.bias is not None and _bias_above(one)]
    if above:
        found.append(
            Caution(
                "axes",
                f"{above[0].name}: BIASSEC lies above DATASEC, not beside it: it is no serial "
                "overscan, or x and y are exchanged",
                "x must be the serial direction, else serial and parallel effects are exchanged; "
                "transpose the images if it is not",
            )
        )
    before = [
        one.name
        for one in amplifiers
        if one.bias is not None and one.bias[1].stop <= one.data[1].start
    ]
    if before:
        found.append(
            Caution(
                "overscan",
                f"{before[0]}: BIASSEC lies before DATASEC and is taken as prescan",
                "a prescan shows no deferred charge; if the file stores its columns against the "
                "readout, reverse the section in campaign.yaml: amplifiers: [{name: ..., data: "
                "'[x2:x1,y1:y2]'}, ...]",
            )
        )
    return found


def check_gains(
    amplifiers: Sequence[AmplifierLayout], entries: Sequence[Entry]
) -> list[Caution]:
    """Report amplifiers whose gain differs between headers; one of them is used for all files."""
    found = []
    scans = [one.scan for one in entries if not one.reason and one.scan is not None]
    for layout in amplifiers:
        gains = Counter(
            one.gain for scan in scans for one in scan.amplifiers if one.name == layout.name
        )
        if len(gains) < 2:
            continue
        words = ", ".join(
            f"{'none' if gain is None else f'{gain:.4g}'} in {count_of(count, 'file')}"
            for gain, count in gains.most_common()
        )
        taken = "none" if layout.gain is None else f"{layout.gain:.4g} e-/ADU"
        found.append(
            Caution(
                "gain",
                f"{layout.name}: headers give different gains [e-/ADU]: {words}; {taken} is used "
                "for all",
                "results per electron are wrong by the ratio in the other files; state the gain in "
                "campaign.yaml: keywords: {gain: {value: ...}}",
            )
        )
    return found


def check_keywords(
    exposures: Sequence[Exposure], entries: Sequence[Entry]
) -> list[Caution]:
    """Report each quantity that headers lack, once, with the analysis that needs it."""
    found: list[Caution] = []
    lit = [one for one in exposures if one.kind in LIT]
    sets = {
        "exposure_time": [one for one in exposures if one.kind != "bias"], "lamp": lit,
        "temperature": exposures, "back_bias": exposures, "gate_high": exposures,
    }  # fmt: skip
    words = {
        "exposure_time": "exposure time", "lamp": "lamp monitor", "back_bias": "back bias",
        "gate_high": "gate voltages",
    }  # fmt: skip
    for name, members in sets.items():
        lacking = [one for one in members if getattr(one, name) is None]
        found += _lacking(words.get(name, name), lacking, members, _consequence(name))
    dark = [one for one in lit if one.wavelength is None and one.filter is None]
    found += _lacking("wavelength or filter", dark, lit, _consequence("wavelength"))
    timeless = [one for one in exposures if one.mjd is None]
    found += _lacking(
        "time", timeless, exposures,
        "drifts of gain, lamp and bias cannot be ordered in time; add a column mjd to manifest.ecsv, "
        f"or one of the keywords {', '.join((*TIMES, *DATES))} to the headers",
    )  # fmt: skip
    guessed = [one for one in entries if one.kind_from_name and not one.reason]
    if guessed:
        found.append(
            Caution(
                "kind",
                f"the kind of {len(guessed)} exposures is from their names only",
                "a misnamed file would be used as another kind; manifest.ecsv with the columns "
                "file and kind states kinds",
            )
        )
    problems = Counter(p for one in entries if not one.reason for p in one.problems)
    for text, count in problems.items():
        found.append(
            Caution(
                "units",
                f"{text} ({count_of(count, 'exposure')})",
                "it is taken as not known"
                + (
                    ""
                    if "campaign.yaml" in text
                    else "; campaign.yaml's keywords may state another keyword, a unit, or the value"
                ),
            )
        )
    return found


def _consequence(name: str) -> str:
    """Say what needs a quantity, where it was looked for, and how to state it."""
    meaning = MEANINGS[name]
    # One lamp reading or exposure time for all exposures would be a false statement.
    for_all = (
        ""
        if name in ("lamp", "exposure_time")
        else f", or one value for all [{meaning.unit}], {{{name}: {{value: NUMBER}}}}"
    )
    return (
        f"{meaning.closes}; headers were searched for {', '.join(meaning.keywords)}; campaign.yaml "
        f"may name another keyword, keywords: {{{name}: KEYWORD}}{for_all}"
    )


def check_units(exposures: Sequence[Exposure]) -> list[Caution]:
    """Check exposure times against the time stamps, and signs of back biases."""
    found = []
    timed = [
        one for one in exposures if one.mjd is not None and one.exposure_time is not None
    ]
    timed.sort(key=lambda one: one.mjd or 0.0)
    if len(timed) > 2:
        # A stamp may be of the begin or the end: the exposure must fit into a gap on either side.
        gaps = np.diff([one.mjd for one in timed]) * 86400.0
        room = np.maximum(np.append(gaps, np.inf), np.insert(gaps, 0, np.inf))
        times = np.array([one.exposure_time for one in timed])
        open_shutter = times > 0
        late = open_shutter & (times > 1.05 * room + 1.0)
        if late.sum() * 2 > open_shutter.sum():
            worst = timed[int(np.argmax(np.where(late, times, 0)))]
            fits = np.all(times[late] / 1000 <= 1.05 * room[late] + 1.0)
            found.append(
                Caution(
                    "units",
                    f"{int(late.sum())} exposures are longer than the time until the next one "
                    f"began ({worst.path.name}: {worst.exposure_time:g} s)"
                    + (
                        "; in ms? then campaign.yaml: keywords: {exposure_time: {unit: ms}}"
                        if fits
                        else ""
                    ),
                    "rates of the lamp, of dark current and of drifts are wrong by the unit",
                )
            )
    biases = {one.back_bias for one in exposures if one.back_bias is not None}
    if any(v > 0 for v in biases):
        both = any(v < 0 for v in biases)
        found.append(
            Caution(
                "units",
                f"back bias is {'of both signs' if both else 'positive'} "
                f"({', '.join(f'{v:+g}' for v in sorted(biases))} V): a sensor that collects "
                "electrons has a negative one",
                "the device's prediction is impossible; campaign.yaml: keywords: {back_bias: "
                "{scale: -1}} changes the sign",
            )
        )
    stamps = Counter(one.mjd for one in exposures if one.mjd is not None)
    twice = [one for one in exposures if one.mjd is not None and stamps[one.mjd] > 1]
    if twice:
        found.append(
            Caution(
                "time",
                f"{len(twice)} exposures share time stamps ({named(twice)})",
                "their order, and with it pairs of flats, may be wrong; a column pair in "
                "manifest.ecsv states pairs",
                tuple(one.number for one in twice),
            )
        )
    return found


def check_pairs(exposures: Sequence[Exposure]) -> list[Caution]:
    """Report flats without a partner, and exposure times that rise or fall with time."""
    flats = [one for one in exposures if one.kind == "flat"]
    alone = [one for one in flats if one.pair is None]
    found = []
    if alone:
        found.append(
            Caution(
                "pairs", f"{len(alone)} of {len(flats)} flats have no partner ({named(alone)})",
                "they give mean levels and no covariances; flats are paired that follow one another "
                "directly with equal settings and light, to the part 'pairs: {tolerance: 0.05}' of "
                "campaign.yaml, or by a column pair in manifest.ecsv",
                tuple(one.number for one in alone),
            )
        )  # fmt: skip
    partners = Counter(one.pair for one in flats if one.pair is not None)
    odd = [one for one in flats if one.pair is not None and partners[one.pair] != 2]
    if odd:
        found.append(
            Caution(
                "pairs", f"pairs of the manifest that are not two flats: {named(odd)}",
                "they are not used; each value of the column pair must stand at two flats",
                tuple(one.number for one in odd),
            )
        )  # fmt: skip
    for members in group_conditions(flats).values():
        ladder = [one for one in members if one.exposure_time is not None]
        times = [one.exposure_time for one in ladder]
        if len(set(times)) < 4:
            continue
        order = np.argsort(np.argsort([one.position for one in ladder]))
        rank = _ranks(np.array(times, float))
        if abs(np.corrcoef(order, rank)[0, 1]) > 0.9:
            found.append(
                Caution(
                    "time", "exposure times rise or fall with time",
                    "drifts of gain or lamp cannot be separated from nonlinearity; take levels in "
                    "another order, or repeat one at the end",
                )
            )  # fmt: skip
    return found


def _ranks(values: Any) -> Any:
    """Rank of each value from 0; equal values have the mean of their ranks."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return (ends - (counts + 1) / 2)[inverse]


def _lacking(
    word: str, lacking: Sequence[Exposure], members: Sequence[Exposure], closes: str
) -> list[Caution]:
    """Warning that a quantity is missing in all or in some of the exposures that need it."""
    if not lacking:
        return []
    if len(lacking) == len(members):
        return [Caution("missing", f"no {word}", closes)]
    return [
        Caution(
            "missing", f"no {word} in {len(lacking)} of {len(members)} exposures "
            f"({named(lacking)})", closes, tuple(one.number for one in lacking),
        )
    ]  # fmt: skip


def _geometry(one: Entry) -> tuple[Any, ...]:
    return () if one.scan is None else tuple(a.geometry() for a in one.scan.amplifiers)


def _first_difference(one: Entry, model: Entry, count: int) -> str:
    """Describe the first difference of a file's amplifiers from those of most files."""
    if one.scan is None or model.scan is None:
        return "not read"
    mine, theirs = one.scan.amplifiers, model.scan.amplifiers
    if len(mine) != len(theirs):
        return f"has {len(mine)} amplifiers, {count} others have {len(theirs)}"
    for a, b in zip(mine, theirs, strict=True):
        if a.geometry() == b.geometry():
            continue
        if a.stored != b.stored:
            return (
                f"{a.name} is {a.stored[1]} x {a.stored[0]} pixels, in {count} others "
                f"{b.stored[1]} x {b.stored[0]}"
            )
        if (a.origin, a.flip_x, a.flip_y) != (b.origin, b.flip_x, b.flip_y):
            return (
                f"{a.name} lies at x {_place(a)} of the sensor by its DETSEC, in {count} others "
                f"at x {_place(b)}"
            )
        return f"{a.name}: name or sections differ from those of {count} others"
    return "not read"


def _place(one: AmplifierLayout) -> str:
    place = one.footprint()
    if place is None:
        return "nowhere"
    x = (place[0] + 1, place[1])
    first, last = reversed(x) if one.flip_x else x
    return f"{first}:{last}, y {place[2] + 1}:{place[3]}"


def _bias_above(one: AmplifierLayout) -> bool:
    """Whether BIASSEC follows the image in y and not in x."""
    return bool(
        one.bias is not None
        and one.bias[0].start >= one.data[0].stop
        and one.bias[1].start < one.data[1].stop
    )
