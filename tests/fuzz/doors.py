"""All doors by name, and the loop that sends mutated inputs through one."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.fuzz.door_campaigns import Frames, Manifest, Settings
from tests.fuzz.door_commands import Commands
from tests.fuzz.door_devices import DeviceFile, PoissonFile
from tests.fuzz.door_lsst import Datasets
from tests.fuzz.door_sensors import Arguments, Report
from tests.fuzz.door_tables import Areas, Covariances, Profiles, SettingRows, Spots
from tests.fuzz.door_vertices import Stem, TableFile
from tests.fuzz.outcomes import FAULTS, Door, Outcome, run

DOORS: dict[str, type[Door]] = {
    one.name: one
    for one in (
        DeviceFile, PoissonFile, Stem, TableFile, Areas, Covariances, Spots, SettingRows, Profiles,
        Datasets, Settings, Manifest, Frames, Report, Arguments, Commands,
    )
}  # fmt: skip
"""Doors by name."""


class Fault(NamedTuple):
    """An input that ended badly, and how to repeat it."""

    door: str
    seed: int
    number: int
    words: str
    outcome: Outcome
    said: str

    def __str__(self) -> str:
        return (
            f"{self.outcome.value}: --door {self.door} --seed {self.seed} --only {self.number}: "
            f"{self.words}: {self.said}"
        )


def fuzz(
    name: str, folder: Path, numbers: Iterable[int], seed: int
) -> tuple[Counter[Outcome], list[Fault]]:
    """Send inputs through a door; the counts by outcome, and the faults."""
    door = DOORS[name](folder)
    counts: Counter[Outcome] = Counter()
    faults = []
    for number in numbers:
        case = door.make(np.random.default_rng([seed, zlib.crc32(name.encode()), number]))
        ended = run(case)
        counts[ended.outcome] += 1
        if ended.outcome in FAULTS:
            faults.append(Fault(name, seed, number, case.words, ended.outcome, ended.said))
    return counts, faults
