"""Fuzzing of every door: ``python -m tests.fuzz [--door NAME] [--count N] [--seed S] [--only K]``."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.fuzz.doors import DOORS, Fault, fuzz
from tests.fuzz.outcomes import FAULTS, Outcome

HEADS = {one: one.value for one in Outcome}


def main(given: list[str] | None = None) -> int:
    """Fuzz the doors, print a table and the faults; 1 where there are any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--door", choices=sorted(DOORS), action="append")
    parser.add_argument("--count", type=int, default=100, help="inputs of each door")
    parser.add_argument("--seed", type=int, default=6271)
    parser.add_argument("--only", type=int, help="number of the one input to run")
    args = parser.parse_args(given)
    faults: list[Fault] = []
    total: Counter[Outcome] = Counter()
    heads = [*HEADS.values(), "CPU s"]
    print("door".ljust(14), "inputs".rjust(7), *(h.rjust(len(h) + 1) for h in heads))
    for name in args.door or DOORS:
        began = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            numbers = range(args.count) if args.only is None else [args.only]
            counts, found = fuzz(name, Path(folder), numbers, args.seed)
        total += counts
        faults += found
        _print(name, counts, time.process_time() - began)
    _print("all", total, time.process_time())
    for fault in faults:
        print(fault)
    return 1 if any(total[one] for one in FAULTS) else 0


def _print(name: str, counts: Counter[Outcome], seconds: float) -> None:
    cells = [str(counts[one]).rjust(len(word) + 1) for one, word in HEADS.items()]
    print(
        name.ljust(14), str(counts.total()).rjust(7), *cells, f"{seconds:6.1f}", flush=True
    )


if __name__ == "__main__":
    sys.exit(main())
