"""``python -m tests.golden make|compare [--quick] [--numbers] [NAME ...]``."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from datetime import UTC, datetime
from typing import Any

from tests.golden.cases import CASES
from tests.golden.record import (
    RECORD,
    differences,
    machine,
    make_entries,
    read_record,
    same_machine,
)


def main() -> int:
    """Make the record, or hold what is made now against it; 1 where something differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    parser.add_argument("what", choices=["make", "compare"])
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; all by default")
    parser.add_argument("--quick", action="store_true", help="only those of every test run")
    parser.add_argument(
        "--numbers", action="store_true", help="compare no bits, on whatever machine"
    )
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    unknown = set(options.names) - set(CASES)
    if unknown:
        parser.error(f"no case {', '.join(sorted(unknown))}; there are {', '.join(CASES)}")
    names = [
        name
        for name, case in CASES.items()
        if (not options.names or name in options.names)
        and (case.quick or not options.quick)
    ]
    here = machine()
    record = read_record() if RECORD.exists() else {"cases": {}}
    alike = [n for n in names if not options.numbers and same_machine(n, record, here)]
    print(
        f"{len(alike)} of {len(names)} cases bit for bit, as they were made on such a machine; "
        "others by numbers"
    )
    faults = 0
    for name, entry in make_entries(names, options.workers):
        if options.what == "make":
            record["cases"][name] = {"machine": here, **entry}
            _write(record)
            print(f"{name}: {entry['cpu_s']} CPU s", flush=True)
            continue
        found = differences(name, entry, record, bits=name in alike)
        faults += bool(found)
        print("\n".join(found) or f"{name}: equal, {entry['cpu_s']} CPU s", flush=True)
    if options.what == "make":
        return 0
    print(f"{len(names) - faults} of {len(names)} cases equal")
    return int(bool(faults))


def _write(record: dict[str, Any]) -> None:
    """Write the record with what made it, after every case: an interrupted run keeps them."""
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        capture_output=True,
        text=True,
        check=False,
    ).stdout.strip()
    record |= {
        "command": " ".join(["python -m tests.golden", *sys.argv[1:]]),
        "commit": commit,
        "date": datetime.now(UTC).date().isoformat(),
    }
    RECORD.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
