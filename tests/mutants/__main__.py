"""Run mutants and keep what the tests said: ``python -m tests.mutants``.

Every mutant is one changed line of the package, drawn at random or of a fixed list of five
(:mod:`tests.mutants.sites`).  It is written into a copy of the checkout, and the test files of its room
that import it run there until one fails.  A row of the file says what came of it; mutants that have a
row are not run again unless their numbers are given.  ``tests/data/mutant_reasons.ecsv`` says of
mutants that no test can notice why not.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

from astropy.table import Table

from tests.caching import _imports
from tests.mutants.sites import ROOT, Mutant, choose, known

ROWS = ROOT / "tests" / "data" / "mutants.ecsv"
REASONS = ROOT / "tests" / "data" / "mutant_reasons.ecsv"

MOST_CPU = 200
"""Largest CPU time [s] of the tests of one mutant, unless ``--most`` says another; beyond it the mutant
is undecided, and counts as one that survived.  Chosen: with twice as much, mutants of the diagnosis
that nothing notices take up to an hour more in 120."""

FARTHEST = 2
"""Largest number of imports from a test file to the changed module.  Chosen: at 1 a module behind
another's door has no test; at 4 most mutants have every test of their room."""

NAMES = (
    "seed", "number", "room", "file", "line", "kind", "before", "after", "outcome",
    "killed_by", "cpu_s", "commit",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--seed", type=int, default=8231)
    parser.add_argument("--count", type=int, default=120)
    parser.add_argument("--room")
    parser.add_argument(
        "--numbers", help="such as 3,17; they run again where they have rows"
    )
    parser.add_argument(
        "--most", type=int, default=MOST_CPU, help="CPU seconds of a mutant"
    )
    parser.add_argument(
        "--tests", nargs="+", help="test files to run, in place of those that import"
    )
    parser.add_argument(
        "--check", action="store_true", help="run what killed, nothing changed"
    )
    parser.add_argument("--list", action="store_true", help="print the mutants only")
    parser.add_argument("-o", "--output", type=Path, default=ROWS)
    given = parser.parse_args()

    mutants = dict(enumerate([*known(), *choose(seed=given.seed, count=given.count)], 1))
    rows, durations = read_rows(given.output)
    if given.check:
        sys.exit(check(rows))
    numbers = [int(n) for n in given.numbers.split(",")] if given.numbers else []
    there = {(row["file"], row["before"], row["after"]) for row in rows}
    chosen = {
        number: mutant
        for number, mutant in mutants.items()
        if (not given.room or mutant.room == given.room)
        and (number in numbers if numbers else mutant.content not in there)
    }
    if given.list:
        for number, m in chosen.items():
            print(f"{number} {m.file}:{m.line} {m.kind}\n  - {m.before}\n  + {m.after}")
        return
    reasons = read_reasons()
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = Path(folder) / "checkout"
        copy_checkout(copy)
        for number, mutant in chosen.items():
            outcome, test, seconds = "equivalent", "", 0.0
            if mutant.content not in reasons:
                outcome, test, seconds = run(
                    mutant,
                    copy,
                    given.tests or tests_of(mutant.file, durations),
                    given.most,
                )
                durations |= durations_in(copy)
            rows.append({
                "seed": given.seed if number > len(known()) else 0, "number": number,
                "room": mutant.room, "file": mutant.file, "line": mutant.line,
                "kind": mutant.kind, "before": mutant.before, "after": mutant.after,
                "outcome": outcome, "killed_by": test, "cpu_s": round(seconds, 1),
                "commit": commit(),
            })  # fmt: skip
            write_rows(rows, durations, given.output)
            print(f"{number} {mutant.file}:{mutant.line} {outcome} {test} {seconds:.0f} s",
                  flush=True)  # fmt: skip
    print_table(rows, reasons)


def copy_checkout(copy: Path) -> None:
    """Copy what git tracks, and new files that it does not ignore."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)


def run(mutant: Mutant, copy: Path, files: list[str], most: int) -> tuple[str, str, float]:
    """Outcome, the test that failed and CPU seconds of one mutant, in a copy of the checkout."""
    before = (copy / mutant.file).read_bytes()
    mutant.apply(copy)
    report = copy.parent / "report.xml"
    report.unlink(missing_ok=True)
    spent = _cpu_of_children()
    try:
        status = _pytest(files, copy, "-x", f"--junitxml={report}", most=most)
    finally:
        (copy / mutant.file).write_bytes(before)
    seconds = _cpu_of_children() - spent
    if status == 0:
        return "survived", "", seconds
    if status in (1, 2) and report.exists():
        test = _failed(report) or "collection"
        return "killed", test, seconds
    if status in (3, 4):  # the package does not import: conftest or the fixtures fail
        return "killed", "import", seconds
    return "undecided", "", seconds


def tests_of(file: str, seconds: dict[str, float]) -> list[str]:
    """Test files for a module, quickest first, after the module's examples.

    They are those of its room from which at most :data:`FARTHEST` imports lead to the module, or all
    of the room where there is none; and those of other rooms that import it themselves.
    """
    room = file.split("/")[1].strip("_")
    module = file.removesuffix(".py").replace("/", ".")
    places = [*ROOT.glob(f"tests/{room}/**/test_*.py")]
    places += ROOT.glob(f"tests/validation/{room}/**/test_*.py")
    found = [path for path in places if _imports_at_most(path, module, FARTHEST)] or places
    others = sorted(set(ROOT.glob("tests/*/**/test_*.py")) - set(places))
    found += [path for path in others if module in _names(path)]
    names = [path.relative_to(ROOT).as_posix() for path in found]
    names.sort(key=lambda name: seconds.get(name, len((ROOT / name).read_bytes()) / 1000))
    examples = [file] if ">>>" in (ROOT / file).read_text(encoding="utf-8") else []
    return [*examples, *names]


def _imports_at_most(path: Path, module: str, most: int) -> bool:
    """Whether at most a number of imports lead from a test file to a module."""
    reached, found = [path], {path}
    for _ in range(most):
        names = set().union(*map(_names, reached))
        if module in names:
            return True
        places = {ROOT / f"{name.replace('.', '/')}.py" for name in names}
        reached = [p for p in places - found if p.is_file()]
        found |= set(reached)
    return False


@cache
def _names(path: Path) -> frozenset[str]:
    """Modules that a file imports."""
    return frozenset(_imports(path))


def _pytest(files: list[str], copy: Path, *options: str, most: int = MOST_CPU) -> int:
    """Run test files in a copy of the checkout within the CPU time allowed; give the exit status."""
    environment = os.environ | {
        "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg",
        # Compiled kernels are kept by the content of all kernels: those of a mutant are its own.
        "BFSENSOR_TEST_CACHE": os.environ.get("BFSENSOR_TEST_CACHE", str(copy.parent / "cache")),
    }  # fmt: skip
    command = [
        sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider",
        "-o", "addopts=--strict-markers --doctest-modules", "-m", "not slow and not golden",
        *options, *files,
    ]  # fmt: skip

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (most, most + 5))

    started = subprocess.Popen(
        command, cwd=copy, env=environment, preexec_fn=limit, start_new_session=True,
        stdout=(copy.parent / "output.txt").open("w"), stderr=subprocess.STDOUT,
    )  # fmt: skip
    end = time.monotonic() + 4 * most  # a mutant that waits for itself uses no CPU time
    while started.poll() is None and time.monotonic() < end:
        time.sleep(0.2)
    if started.poll() is None:
        os.killpg(started.pid, 9)
    return started.wait()


def _failed(report: Path) -> str:
    """Name of the test that failed, from pytest's report."""
    for case in ElementTree.parse(report).iter("testcase"):
        if case.find("failure") is not None or case.find("error") is not None:
            file = case.get("classname", "").replace(".", "/")
            return f"{file}.py::{case.get('name')}" if file else f"{case.get('name')}"
    return ""


def durations_in(copy: Path) -> dict[str, float]:
    """Seconds of the test files all of whose tests ran for the last mutant, from pytest's report."""
    report, total = copy.parent / "report.xml", dict[str, float]()
    if not report.exists():
        return {}
    failed = _failed(report).partition("::")[0]
    for case in ElementTree.parse(report).iter("testcase"):
        name = f"{case.get('classname', '').replace('.', '/')}.py"
        total[name] = total.get(name, 0.0) + float(case.get("time", 0.0))
    return {name: round(s, 1) for name, s in total.items() if name != failed}


def _cpu_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def check(rows: list[dict]) -> int:
    """Run the tests that killed mutants on the code as it is: each must pass."""
    found = {re.sub(r"\[.*", "", str(row["killed_by"])) for row in rows}
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = Path(folder) / "checkout"
        copy_checkout(copy)
        tests = sorted(test for test in found if "::test_" in test)
        status = _pytest(tests, copy, most=len(tests) * MOST_CPU)
        print((Path(folder) / "output.txt").read_text())
    return status


def read_rows(path: Path) -> tuple[list[dict], dict[str, float]]:
    """Rows of the file as dictionaries, and the seconds of test files; none without a file."""
    if not path.exists():
        return [], {}
    table = Table.read(path, format="ascii.ecsv").filled("")
    return [{name: row[name] for name in NAMES} for row in table], table.meta.get(
        "seconds", {}
    )


def write_rows(rows: list[dict], durations: dict[str, float], path: Path) -> None:
    """Write all rows, with what made them in the header."""
    table = Table(rows=rows, names=NAMES)
    table.meta = {
        "command": "python -m tests.mutants",
        "about": "Outcomes of single changed lines. Kept with the tests, not in "
        "validation/results, because no claim about physics rests on them.",
        "seconds": dict(sorted(durations.items())),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    table.write(path, format="ascii.ecsv", overwrite=True)


def read_reasons() -> dict[tuple[str, str, str], str]:
    """Reasons why no test can notice a mutant, by file and the line before and after."""
    if not REASONS.exists():
        return {}
    table = Table.read(REASONS, format="ascii.ecsv")
    return {(row["file"], row["before"], row["after"]): row["reason"] for row in table}


def commit() -> str:
    """Short hash of the checkout's commit."""
    found = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    )
    return found.stdout.strip()


def print_table(rows: list[dict], reasons: dict) -> None:
    """Print the last outcome of each mutant by room."""
    last = {(row["file"], row["before"], row["after"]): row for row in rows}
    counts: dict[str, Counter] = {}
    for content, row in last.items():
        outcome = "equivalent" if content in reasons else row["outcome"]
        counts.setdefault(str(row["room"]), Counter())[outcome] += 1
    outcomes = ("killed", "survived", "undecided", "equivalent")
    print(f"{'room':<12}{'run':>6}" + "".join(f"{name:>12}" for name in outcomes))
    counts = dict(sorted(counts.items()))
    counts["all"] = sum(counts.values(), Counter())
    for room, found in counts.items():
        numbers = "".join(f"{found[name]:>12}" for name in outcomes)
        print(f"{room:<12}{found.total():>6}{numbers}")


if __name__ == "__main__":
    main()
