"""Reports on concealed campaigns: each made once, timed, and fixed by its hash before truths open.

A folder of results holds, for each campaign, a folder NAME with report.json and ``cost.json`` (time and
peak memory), and ``submissions.json``: the SHA-256 of each report, the commitment that stood
beside the campaigns when it was made, and when that was.  Truths are neither needed nor looked for: a
campaign whose truth lies open in its folder is refused.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from validation.concealed.rows import locked
from validation.concealed.score import check_report

SUBMISSIONS = "submissions.json"
OPENED = "opened.json"


PR_SET_PDEATHSIG = 1
"""Number of Linux' request for a signal at the end of the parent.  Published: prctl(2)."""


def _end_with_parent() -> None:
    """Have the kernel kill this process when the one that started it ends, however that ends."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_json(path: Path, content: Any) -> None:
    """Write beside and rename."""
    beside = path.with_name(f"{path.name}.{os.getpid()}.part")
    beside.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
    os.replace(beside, path)


def read_json(path: Path, what: str) -> Any:
    """Read JSON, with the file's name in the error."""
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no {what}") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as fault:
        raise ValueError(f"{path}: not a {what}: {fault}") from None


def find_campaigns(folder: Path) -> list[Path]:
    """Return the campaigns of a folder, by name.

    Raises
    ------
    ValueError
        No campaign, no commitments, a campaign without one, or with its truth in it.
    """
    found = sorted(p.parent for p in folder.glob("*/campaign.yaml"))
    if not found:
        raise ValueError(f"{folder}: no campaigns (folders with a campaign.yaml)")
    commitments = read_json(folder / "commitments.json", "file of commitments")
    for campaign in found:
        if campaign.name not in commitments:
            raise ValueError(f"{folder}/commitments.json: no {campaign.name}")
        if (campaign / "truth.json").exists():
            raise ValueError(
                f"{campaign}/truth.json: the truth lies open; keep it elsewhere "
                "(make --truth-folder)"
            )
    return found


def read_report(folder: Path, name: str) -> dict[str, Any] | None:
    """Return a campaign's report, None if there is none or it is not complete."""
    path = folder / name / "report.json"
    try:
        report = json.loads(path.read_text())
        check_report(report, name)
    except (OSError, ValueError):
        return None
    return report


@dataclass(frozen=True)
class Run:
    """What came of running the command: how many were made, were there already, failed."""

    made: tuple[str, ...]
    there: tuple[str, ...]
    failed: tuple[str, ...]


def run_campaigns(
    folder: str | Path,
    results: str | Path,
    *,
    command: str = "bfsensor diagnose",
    progress: Callable[[Iterable[Path]], Iterable[Path]] | None = None,
) -> Run:
    """Run a command on each campaign of a folder; what is there already is not made again.

    Parameters
    ----------
    folder : path
        With campaigns and commitments.json.
    results : path
        Made if it is not there; one process at a time works in it.
    command : str
        Called with the campaign's path and ``-o`` and a folder to write report.json to.
    progress : callable, optional
        Wraps the sequence of campaigns, as ``tqdm`` does.

    Raises
    ------
    ValueError
        See :func:`find_campaigns`; no such command; truths were opened, a report that was
        submitted is gone or changed; another process is at work.
    """
    folder, results = Path(folder).resolve(), Path(results).resolve()
    campaigns = find_campaigns(folder)
    words = shlex.split(command)
    # a script beside this Python is found though its environment was not activated
    places = os.pathsep.join([os.environ.get("PATH", ""), str(Path(sys.executable).parent)])
    program = shutil.which(words[0], path=places) if words else None
    if program is None:
        raise ValueError(f"command {command!r}: not installed")
    words[0] = program
    results.mkdir(parents=True, exist_ok=True)
    try:
        with locked(results, wait=False):
            return _run_all(campaigns, results, words, progress)
    except BlockingIOError:
        raise ValueError(f"{results}: another run is at work there") from None


def _run_all(campaigns, results, words, progress) -> Run:
    for left in results.glob(".*.part"):
        shutil.rmtree(left, ignore_errors=True)
    submitted = _submitted(results)
    check_submissions(results, submitted)
    commitments = read_json(campaigns[0].parent / "commitments.json", "file of commitments")
    made, there, failed = [], [], []
    for campaign in campaigns if progress is None else progress(campaigns):
        name = campaign.name
        # complete where the run was ended before it could be submitted, too
        if read_report(results, name) is not None:
            there.append(name)
        elif (results / OPENED).exists():
            raise ValueError(f"{results}: the truths are open; no report can be added")
        elif _run_one(words, campaign, results):
            made.append(name)
        else:
            failed.append(name)
            continue
        if name not in submitted:
            if (results / OPENED).exists():
                raise ValueError(f"{results}: the truths are open; no report can be added")
            submitted[name] = {
                "report": digest(results / name / "report.json"),
                "commitment": commitments[name],
                "time": datetime.now(UTC).isoformat(timespec="seconds"),
            }
            write_json(results / SUBMISSIONS, submitted)
    return Run(tuple(made), tuple(there), tuple(failed))


def _submitted(results: Path) -> dict[str, dict[str, str]]:
    path = results / SUBMISSIONS
    return read_json(path, "file of submissions") if path.exists() else {}


def check_submissions(results: Path, submitted: dict[str, dict[str, str]]) -> None:
    """Refuse reports that were changed, or are gone, since they were submitted.

    Raises
    ------
    ValueError
        Names them all.
    """
    changed = [
        name for name, entry in sorted(submitted.items())
        if not (path := results / name / "report.json").exists()
        or digest(path) != entry["report"]
    ]  # fmt: skip
    if changed:
        raise ValueError(
            f"{results}: report.json of {', '.join(changed)} was changed after its submission"
        )


def _run_one(words: Sequence[str], campaign: Path, results: Path) -> bool:
    """Run the command into a folder beside, renamed when all is there; False if it failed."""
    beside = results / f".{campaign.name}.{os.getpid()}.part"
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir()
    begin = time.monotonic()
    with (beside / "said.txt").open("wb") as said:
        process = subprocess.Popen(
            [*words, str(campaign), "-o", str(beside)],
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=subprocess.STDOUT,
            preexec_fn=_end_with_parent if sys.platform == "linux" else None,
        )
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            process.wait()
            shutil.rmtree(beside, ignore_errors=True)
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    cost = {
        "wall_s": round(time.monotonic() - begin, 2),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 2),
        # in kB on Linux, in bytes on a Mac
        "memory_gb": round(usage.ru_maxrss / (1e9 if os.uname().sysname == "Darwin" else 1e6), 4),
        "cores": os.cpu_count(),
        "command": " ".join(words),
    }  # fmt: skip
    write_json(beside / "cost.json", cost)
    final = results / campaign.name
    if process.returncode or not (beside / "report.json").exists():
        # what it said is kept for a look; the next run tries again
        kept = results / f"{campaign.name}.failed.txt"
        os.replace(beside / "said.txt", kept)
        shutil.rmtree(beside, ignore_errors=True)
        return False
    try:
        check_report(json.loads((beside / "report.json").read_text()), campaign.name)
    except ValueError as fault:
        (results / f"{campaign.name}.failed.txt").write_text(f"{fault}\n")
        shutil.rmtree(beside, ignore_errors=True)
        return False
    shutil.rmtree(final, ignore_errors=True)
    os.replace(beside, final)
    (results / f"{campaign.name}.failed.txt").unlink(missing_ok=True)
    return True
