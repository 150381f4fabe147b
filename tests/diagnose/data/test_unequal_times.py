"""Flats of unequal exposure times make pairs by their light; flats without a partner give means."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from bfsensor.diagnose.data.flat_pairing import by_level, find_steps, group_flats
from bfsensor.diagnose.data.measure_channels import measure_channels
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.recording.campaign.exposures import Exposure, find_pairs
from tests.virtual import SMALL, Effect, Range, VirtualSource, virtual_baseline

PER_CENT = 0.01


def late(number: int) -> float:
    """Relative error of the exposure time of an exposure, up to a per cent either way."""
    return PER_CENT * float(np.random.default_rng(number).uniform(-1, 1))


class Unequal(Effect):
    """Light for as long as the header of each exposure says, which differs from all others."""

    word = "unequal"
    variants: ClassVar = {"": {"part": Range(0.0, 1.0, amplitude=True)}}

    def light(self, scene, context):
        if context.exposure.kind == "FLAT":
            scene.scale(1 + self.parameters["part"] * late(context.exposure.sequence))


@pytest.fixture(scope="module")
def equal():
    return VirtualSource(seed=7104, size=SMALL)


@pytest.fixture(scope="module")
def unequal():
    source = VirtualSource(seed=7104, size=SMALL, effects=[Unequal({"part": 1.0})])
    source.exposures = [
        replace(e, exposure_time=e.exposure_time * (1 + late(e.number)))
        if e.kind == "flat"
        else e
        for e in source.exposures
    ]
    return source


def counts(measured):
    return {(c.word, c.fold): len(c) for c in measured.channels}


@pytest.mark.slow
def test_pairs_and_folds_are_those_of_equal_times(equal, unequal):
    measured = measure_channels(unequal)
    assert counts(measured) == counts(measure_channels(equal))
    assert len(measured.channels) and all(
        ("flat_cov", fold) in counts(measured) for fold in ("fit", "held-out")
    )
    found = diagnose_measured(measured, virtual_baseline())
    assert found.mismatch.p_value > 0.01
    # Means follow each flat's own time: without it they would scatter by half a per cent.
    square, dof = found.mismatch.chi2["flat_mean"]
    assert square < dof + 5 * np.sqrt(2 * dof)


def test_levels_are_told_by_light(equal):
    flats = [e for e in equal.exposures if e.kind == "flat"]
    steps = find_steps(flats)
    assert steps == {e.number: e.exposure_time for e in flats}
    # The lamp twice as bright: other levels, although the exposure times are the same.
    half = len(flats) // 2
    bright = [replace(e, lamp=2 * e.lamp) for e in flats[:half]]
    both = [*bright, *flats[half:]]
    steps = find_steps(both)
    for one, other in zip(bright, flats, strict=False):
        later = [e for e in flats[half:] if e.exposure_time == other.exposure_time]
        assert all(steps[one.number] != steps[e.number] for e in later)
    for level in by_level(group_flats(both), steps):
        assert len({steps[e.number] for group in level for e in group}) == 1


def test_a_flat_without_a_partner_gives_its_mean(equal):
    flats = [e for e in equal.exposures if e.kind == "flat"]
    gone = {flats[n].number for n in (1, 4, 11)}
    fewer = VirtualSource.part(equal, withheld=False)
    fewer.exposures = [e for e in equal.exposures if e.number not in gone]
    measured = measure_channels(fewer)
    seen = {
        int(n) for c in measured.channels if c.word == "flat_mean" for n in c.axes["exposure"]
    }  # fmt: skip
    assert seen == {e.number for e in flats} - gone
    whole = {
        (int(n), int(a)): v
        for c in measure_channels(equal).channels if c.word == "flat_mean"
        for n, a, v in zip(c.axes["exposure"], c.axes["amp"], c.values, strict=True)
    }  # fmt: skip
    for c in measured.channels:
        if c.word == "flat_mean":
            for n, a, v in zip(c.axes["exposure"], c.axes["amp"], c.values, strict=True):
                # 1e-4: clipping by neighbours in place of the pair's difference, 7000 pixels.
                assert v == pytest.approx(whole[int(n), int(a)], rel=1e-4)


def test_pairs_of_a_campaign_are_of_equal_light():
    times, lamps = (10.0, 10.1, 10.0, 10.0, 20.0, 10.0), (1.0, 1.0, 1.0, 1.2, 1.0, 2.0)
    flats = [
        Exposure(n, Path(f"f{n}"), "flat", n, t, lamp=a)
        for n, (t, a) in enumerate(zip(times, lamps, strict=True))
    ]
    assert [(a.number, b.number) for a, b in find_pairs(flats)] == [(0, 1), (4, 5)]
    strict = find_pairs(flats, tolerance=1e-3)
    assert [(a.number, b.number) for a, b in strict] == [(4, 5)]
    assert [(a.number, b.number) for a, b in find_pairs(
        [replace(f, lamp=None) for f in flats]
    )] == [(0, 1), (2, 3)]  # fmt: skip
