"""Memory and time that a whole diagnosis of a campaign of a large sensor takes.

``python -m validation.performance.diagnose_memory [--exposures 300] [--files 24] [--folder PLACE]``
diagnoses a campaign whose frames are made as they are read
(:mod:`validation.performance.large_campaign`), and one of fewer exposures from tile-compressed
files written to PLACE and taken away afterwards, each in a process of its own, against a baseline
without the effect, as the frames are, and against one with it.  A row of
``validation/results/diagnose_memory.ecsv`` is a part of one of them: its CPU seconds, those for
each exposure, and the peak of the process's memory when the part was over.  What explains a
mismatch is not sought.  'frames made' is what the campaign itself cost, no part of a diagnosis.
"""

from __future__ import annotations

import argparse
import json
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

from validation.common.write_results import write_results
from validation.performance.large_campaign import LargeCampaign

RESULTS = "validation/results/diagnose_memory.ecsv"
OTHER = "itl_sta3800c_60"
PARTS = ("headers", "reading", "frames made", "channels", "fit", "scans", "rest", "report")


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
            start = time.process_time()
            try:
                return function(*args, **options)
            finally:
                spent = time.process_time() - start
                own = spent - self._inside.pop()
                if self._inside:
                    self._inside[-1] += spent
                self.seconds[part] = self.seconds.get(part, 0.0) + own
                self.peak[part] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20

        return run


def diagnose_large(folder: Path | None, exposures: int) -> dict[str, Any]:
    """Diagnose files, or frames made on the way; seconds and memory [GB] by part."""
    from bfsensor.diagnose import diagnosis
    from bfsensor.diagnose.model.open_baseline import CampaignSource, find_baseline
    from bfsensor.diagnose.report.html_report import write_report
    from bfsensor.recording.campaign.campaign import read_campaign

    clock = Clock()
    source: Any = LargeCampaign(exposures)
    with tempfile.TemporaryDirectory() as place:
        truth = Path(place) / "nothing.json"
        source.write_baseline(truth)
        if folder is None:
            source.read = clock.timed("frames made", source.read)
        else:
            source = CampaignSource(clock.timed("headers", read_campaign)(folder))
            source.read = clock.timed("reading", source.read)
        # The diagnosis is the package's own; its steps are only watched.
        for part, name in (
            ("channels", "measure_channels"),
            ("fit", "fit_bounded"),
            ("scans", "locate_mismatch"),
        ):
            setattr(diagnosis, name, clock.timed(part, getattr(diagnosis, name)))
        found = clock.timed("rest", diagnosis.diagnose)(
            source, find_baseline(truth), campaign="large", progress=_say, explain=False
        )
        clock.timed("report", write_report)(found, place)
        out = {"exposures": len(source.exposures), "nothing": _told(clock, found)}
        clock.seconds.clear()
        # Once more against an effect that the frames do not have: much stands out.
        found = clock.timed("rest", diagnosis.diagnose_measured)(
            found.measured, find_baseline(OTHER), campaign="large", explain=False
        )
        clock.timed("report", write_report)(found, place)
    return out | {OTHER: _told(clock, found)}


def _told(clock: Clock, found: Any) -> dict[str, Any]:
    return {
        "seconds": dict(clock.seconds), "peak": dict(clock.peak), "said": found.said(),
        "p": found.mismatch.p_value,
        "chi2": {k: [round(v, 1) for v in both] for k, both in found.mismatch.chi2.items()},
        "findings": len(found.mismatch.findings),
    }  # fmt: skip


def _say(done: int, total: int) -> None:
    if done % 20 == 0:
        print(f"{done} of {total}, {time.process_time():.0f} CPU s", file=sys.stderr)


def run(folder: Path | None, exposures: int) -> list[dict[str, Any]]:
    """Diagnose in a process of its own; rows of its parts."""
    line = [sys.executable, "-m", "validation.performance.diagnose_memory"]
    line += ["--only", str(folder or ""), "--exposures", str(exposures)]
    out = json.loads(
        subprocess.run(line, stdout=subprocess.PIPE, text=True, check=True).stdout
    )
    count = out.pop("exposures")
    rows = []
    for baseline, found in out.items():
        print(f"{found['said']}\n{found['findings']} findings, {found['chi2']}")
        for part in (p for p in PARTS if p in found["seconds"]):
            seconds, peak = found["seconds"][part], found["peak"][part]
            rows.append({
                "frames": "made" if folder is None else "tile-compressed", "exposures": count,
                "baseline": baseline, "part": part, "cpu_s": round(seconds, 1),
                "cpu_s_an_exposure": round(seconds / count, 3), "memory_peak_gb": round(peak, 3),
                "p": found["p"], "findings": found["findings"],
            })  # fmt: skip
            print(rows[-1])
    return rows


def main() -> None:
    """Diagnose both campaigns and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exposures", type=int, default=300)
    parser.add_argument("--files", type=int, default=24)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--output", default=RESULTS)
    parser.add_argument("--only", help="one campaign, in this process; '' makes the frames")
    given = parser.parse_args()
    if given.only is not None:
        folder = Path(given.only) if given.only else None
        print(json.dumps(diagnose_large(folder, given.exposures)))
        return
    rows = []
    if given.files:
        place = Path(tempfile.mkdtemp(dir=given.folder))
        try:
            LargeCampaign(given.files).write(place / "large")
            rows += run(place / "large", given.files)
        finally:
            shutil.rmtree(place)
        rows += run(None, given.files)
    if given.exposures:
        rows += run(None, given.exposures)
    command = (
        f"python -m validation.performance.diagnose_memory --exposures {given.exposures} "
        f"--files {given.files}"
    )
    write_results(Table(rows=rows), given.output, command, times="CPU seconds, one thread")


if __name__ == "__main__":
    main()
