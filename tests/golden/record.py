"""What was made once, where and of which versions, and what differs from it."""

from __future__ import annotations

import json
import math
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

from llvmlite.binding import get_host_cpu_name
from threadpoolctl import threadpool_info

from tests.caching import processor
from tests.golden.cases import CASES, Product

RECORD = Path(__file__).with_name("golden.json")
PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "astropy", "galsim")
WIDTH = " width"


def machine() -> dict[str, str]:
    """Give what the last bits depend on: processor, kernels for it, Python, versions of libraries.

    Processors of one model name can be of several generations, for which compilers and BLAS have
    instructions of their own.
    """
    blas = {i["architecture"] for i in threadpool_info() if "architecture" in i}
    return {
        "processor": processor(),
        "compiled_for": get_host_cpu_name(),
        "blas": " ".join(sorted(blas)),
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
    }


def same_machine(name: str, record: Mapping[str, Any], here: Mapping[str, str]) -> bool:
    """Whether a case was made on a machine like this one, so that bits can be compared."""
    return bool(record["cases"].get(name, {}).get("machine") == here)


def make_entry(name: str) -> dict[str, Any]:
    """Make a case; give its digests, numbers and the CPU seconds it took."""
    began = time.process_time()
    product: Product = CASES[name].make()
    return {
        "digests": product.digests(),
        "numbers": dict(product.numbers),
        "cpu_s": round(time.process_time() - began, 1),
    }


def make_entries(
    names: Sequence[str], workers: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Make cases on processes, one after another in the order given."""
    with ProcessPoolExecutor(workers, max_tasks_per_child=1) as pool:
        yield from zip(names, pool.map(make_entry, names), strict=True)


def read_record() -> dict[str, Any]:
    """Read ``golden.json``."""
    return dict(json.loads(RECORD.read_text()))


def differences(
    name: str, entry: Mapping[str, Any], record: Mapping[str, Any], *, bits: bool
) -> list[str]:
    """Say what differs from the record, a line each.

    Parameters
    ----------
    name : str
        The case.
    entry, record : dict
        What was made now, and all that is recorded.
    bits : bool
        Compare digests, as on the machine of the record; else numbers within the case's
        tolerance.
    """
    if name not in record["cases"]:
        return [f"{name}: not recorded"]
    held = record["cases"][name]
    if bits:
        return [
            f"{name}: {part} is not the same, bit for bit"
            for part in sorted({*held["digests"], *entry["digests"]})
            if held["digests"].get(part) != entry["digests"].get(part)
        ]
    out = []
    for key in sorted({*held["numbers"], *entry["numbers"]}):
        if key.endswith(WIDTH):
            continue
        before, now = (e["numbers"].get(key, math.nan) for e in (held, entry))
        allowed = max(
            CASES[name].tolerance * abs(before), 0.2 * held["numbers"].get(key + WIDTH, 0.0)
        )
        if not abs(now - before) <= allowed:
            out.append(f"{name}: {key} is {now:.9g}, was {before:.9g} +- {allowed:.2g}")
    return out
