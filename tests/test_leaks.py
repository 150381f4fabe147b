"""Memory of one process that makes many sensors or many diagnoses stays flat.

``python -m pytest -n 0 -m slow -s tests/test_leaks.py`` prints the memory along each run.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from pathlib import Path

import galsim
import pytest
from click.testing import CliRunner

from bfsensor import BrighterFatterSensor
from bfsensor.cli.main import main
from tests.virtual import make_effect, write_campaign

MEASURED = Path(__file__).parent / "data" / "itl_covariances_21oct19.csv"

SETTLED = 0.25
"""Part of the rounds after which caches and the allocator's reserve are filled.  Chosen: at twice the
value, half as many rounds count and a leak must be twice as large to be seen."""

FLAT = 24.0
"""Growth of resident memory [MB] after that, at most.  Chosen: 1000 sensors that each kept a
32 x 32 image of floats (4 kB) pass, those that kept their table's 4.7 MB fail at once; at twice the
value, a diagnosis of size S may keep 6.4 MB of its 400."""


def memory() -> float:
    """Resident memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def grown(name: str, rounds: int, do: Callable[[int], None]) -> float:
    """Growth of memory [MB] over rounds of a task, from when it has settled."""
    found = []
    for n in range(rounds):
        do(n)
        gc.collect()
        found.append(memory())
    settled = found[int(SETTLED * rounds) :]
    every = max(len(found) // 10, 1)
    print(f"{name}, {rounds} times [MB]:", *(f"{m:.0f}" for m in found[::every]))
    return max(settled[-len(settled) // 4 :]) - settled[0]


def diagnose(*arguments: str) -> None:
    run = CliRunner().invoke(main, ["diagnose", *arguments])
    assert run.exit_code == 0, run.output


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="memory is read in /proc")
class TestMemoryStaysFlat:
    def test_sensors(self):
        """Each with a strength of its own, which makes a table of its own."""
        light = galsim.PhotonArray(10, x=[0.0] * 10, y=[0.0] * 10, flux=[1.0] * 10)

        def make(n: int) -> None:
            sensor = BrighterFatterSensor("itl_sta3800c", strength=1 + 1e-3 * n)
            image = galsim.ImageF(32, 32)
            image.setCenter(0, 0)
            sensor.accumulate(light, image)

        assert grown("sensors", 1000, make) < FLAT

    def test_diagnoses_of_a_table(self, tmp_path):
        """Seeds differ, so that nothing is answered from a cache."""
        arguments = (
            str(MEASURED),
            "--baseline",
            "itl_sta3800c_60",
            "-o",
            str(tmp_path / "out"),
        )

        def make(n: int) -> None:
            diagnose(*arguments, "--seed", str(n + 1))

        assert grown("diagnoses of a table", 200, make) < FLAT

    def test_diagnoses_of_a_campaign(self, tmp_path):
        """Size S, with an effect that is explained."""
        effect = make_effect("cti_serial", {"cti": 3e-6})
        write_campaign(tmp_path / "campaign", seed=7301, size="S", effects=[effect])

        def make(n: int) -> None:
            diagnose(
                str(tmp_path / "campaign"),
                "-o",
                str(tmp_path / "out"),
                "--seed",
                str(n + 1),
            )

        assert grown("diagnoses of a campaign", 10, make) < FLAT
