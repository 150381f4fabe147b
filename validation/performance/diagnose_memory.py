"""Memory and time that a whole diagnosis of a large campaign takes, explanation included.

``python -m validation.performance.diagnose_memory [--only NAME ...] [--folder PLACE]`` writes the
campaigns of :data:`CAMPAIGNS` as plain 16 bit files to PLACE, one after another, diagnoses each in a
process of its own against a baseline that knows nothing of the charge left behind in the serial
register, and takes the files away.  'made' makes the frames as they are read: 300 exposures need no
disk then, and what making them costs is no part of a diagnosis.  A row of
``validation/results/diagnose_memory.ecsv`` is a part of one diagnosis: its CPU seconds, those for each
exposure, and the peak of the process's memory when the part was over.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from astropy.table import Table

from validation.common.write_results import RESULTS, replace_run
from validation.performance.large_campaign import SIDES, LargeCampaign

PARTS = ("headers", "reading", "frames made", "channels", "fit", "location", "explanation",
         "rest", "report")  # fmt: skip

CAMPAIGNS: dict[str, dict[str, Any]] = {
    "X": {"exposures": 300, "sides": (128, 512), "pairs": 60},
    "4k": {"exposures": 60, "sides": SIDES},
    "4k 300": {"exposures": 300, "sides": SIDES},
}
"""1024 x 1024 pixels with 60 pairs at each of eight levels, and 4096 x 4004 pixels; 16 amplifiers."""

CTI = 1e-6
"""Charge left at each serial transfer: tens of standard deviations in the first overscan pixel."""

MOST_MEMORY, MOST_SECONDS = 8.0, {"X": 600.0}
"""Criteria: peak of the memory [GB] of any diagnosis, and CPU seconds of the one of size X."""


class Clock:
    """CPU seconds of parts of a process, what runs inside another part not counted twice."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.peak: dict[str, float] = {}
        self._inside: list[float] = []

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Give the function with its time taken down."""

        def run(*args: Any, **options: Any) -> Any:
            self._inside.append(0.0)
            start = cpu_seconds()
            try:
                return function(*args, **options)
            finally:
                spent = cpu_seconds() - start
                own = spent - self._inside.pop()
                if self._inside:
                    self._inside[-1] += spent
                self.seconds[part] = self.seconds.get(part, 0.0) + own
                self.peak[part] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20

        return run


def cpu_seconds() -> float:
    """CPU seconds of this process and of those that it has waited for."""
    return sum(os.times()[:4])


def diagnose_large(name: str, folder: Path | None) -> dict[str, Any]:
    """Diagnose files, or frames made on the way; seconds and memory [GB] by part."""
    from bfsensor.diagnose import diagnosis
    from bfsensor.diagnose.model.open_baseline import CampaignSource, find_baseline
    from bfsensor.diagnose.report.html_report import write_report
    from bfsensor.recording.campaign.campaign import read_campaign

    clock = Clock()
    source: Any = LargeCampaign(**CAMPAIGNS[name], cti=CTI)
    with tempfile.TemporaryDirectory() as place:
        baseline = Path(place) / "nothing.json"
        source.write_baseline(baseline)
        if folder is None:
            source.read = clock.timed("frames made", source.read)
        else:
            source = CampaignSource(clock.timed("headers", read_campaign)(folder))
            source.read = clock.timed("reading", source.read)
        # The diagnosis is the package's own; its steps are only watched.
        for part, step in (
            ("channels", "measure_channels"), ("fit", "fit_bounded"),
            ("location", "locate_effects"), ("explanation", "attribute"),
        ):  # fmt: skip
            setattr(diagnosis, step, clock.timed(part, getattr(diagnosis, step)))
        found = clock.timed("rest", diagnosis.diagnose)(
            source, find_baseline(baseline), campaign=name, progress=_say
        )
        clock.timed("report", write_report)(found, place)
    named = found.attribution.found if found.attribution is not None else ()
    return {
        "exposures": len(source.exposures), "pixels": source.shape[0] * source.shape[1],
        "seconds": clock.seconds, "peak": clock.peak, "said": found.said(),
        "p": found.mismatch.p_value, "named": " ".join(sorted(e.effect.name for e in named)),
    }  # fmt: skip


def _say(done: int, total: int) -> None:
    if done % 20 == 0:
        print(f"{done} of {total}, {time.process_time():.0f} CPU s", file=sys.stderr)


def run(name: str, folder: Path | None) -> list[dict[str, Any]]:
    """Diagnose in a process of its own; rows of its parts."""
    line = [sys.executable, "-m", "validation.performance.diagnose_memory"]
    line += ["--within", str(folder or ""), "--only", name]
    out = json.loads(
        subprocess.run(line, stdout=subprocess.PIPE, text=True, check=True).stdout
    )
    print(out["said"])
    seconds, peak, count = out["seconds"], out["peak"], out["exposures"]
    total = sum(v for k, v in seconds.items() if k != "frames made")
    parts = {p: (seconds[p], peak[p]) for p in PARTS if p in seconds}
    parts["all"] = total, max(peak.values())
    rows = []
    for part, (spent, most) in parts.items():
        rows.append({
            "campaign": name, "frames": "made" if folder is None else "plain",
            "exposures": count, "pixels": out["pixels"], "part": part, "cpu_s": round(spent, 1),
            "cpu_s_an_exposure": round(spent / count, 3), "memory_peak_gb": round(most, 3),
            "named": out["named"],
        })  # fmt: skip
        print(rows[-1])
    return rows


def main() -> None:
    """Diagnose the campaigns, write their rows, and hold them against the criteria."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=CAMPAIGNS, nargs="*", default=["X", "4k"])
    parser.add_argument("--made", action="store_true", help="make frames as they are read")
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument(
        "--within", help="diagnose these files in this process; '' makes frames"
    )
    given = parser.parse_args()
    if given.within is not None:
        folder = Path(given.within) if given.within else None
        print(json.dumps(diagnose_large(given.only[0], folder)))
        return
    failed = []
    for name in given.only:
        if given.made:
            rows = run(name, None)
        else:
            place = Path(tempfile.mkdtemp(dir=given.folder))
            try:
                LargeCampaign(**CAMPAIGNS[name], cti=CTI).write(
                    place / "large", compress=False
                )
                rows = run(name, place / "large")
            finally:
                shutil.rmtree(place)
        command = f"python -m validation.performance.diagnose_memory --only '{name}'"
        replace_run(
            Table(rows=rows), RESULTS / "diagnose_memory.ecsv",
            command + (" --made" if given.made else ""), {"campaign": name},
            {"cpu_s": rows[-1]["cpu_s"], "times": "CPU seconds, one thread"},
        )  # fmt: skip
        most = rows[-1]["memory_peak_gb"]
        if most > MOST_MEMORY:
            failed.append(f"{name}: {most} GB, above {MOST_MEMORY}")
        if rows[-1]["cpu_s"] > MOST_SECONDS.get(name, float("inf")):
            failed.append(f"{name}: {rows[-1]['cpu_s']} CPU s, above {MOST_SECONDS[name]}")
    if failed:
        raise SystemExit("; ".join(failed))


if __name__ == "__main__":
    main()
