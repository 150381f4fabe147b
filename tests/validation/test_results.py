"""Results say what made them, run by run."""

import os
import re
import subprocess
import sys
from datetime import datetime, timedelta
from importlib.metadata import version
from pathlib import Path

import pytest
from astropy.table import Table

import bfsensor
from validation.common import run_header as header
from validation.common.run_header import commit_here, run_header
from validation.common.write_results import replace_run, write_results
from validation.concealed.rows import append_rows

ROOT = Path(__file__).parents[2]


def test_a_run_replaces_its_own_rows_and_says_what_made_them(tmp_path):
    path = tmp_path / "rows.ecsv"
    first = {"device": "a", "seed": 1}
    for run, found in ((first, [1.0, 2.0]), ({"device": "a", "seed": 2}, [3.0])):
        table = Table([run | {"found": value} for value in found])
        replace_run(table, path, "python -m a", run, {"cpu_s": found[0]})
    made = Table.read(path, format="ascii.ecsv")
    assert made.meta["a 1"]["commit"] == commit_here() and made.meta["a 1"]["cpu_s"] == 1.0
    assert made.meta["a 1"]["versions"] == made.meta["versions"]
    # As if the second had been made by another commit.
    made.meta["a 2"] = {"commit": "elsewhere", "cpu_s": 3.0}
    made.write(path, format="ascii.ecsv", overwrite=True)

    again = Table([first | {"found": 4.0}])
    replace_run(again, path, "python -m a", first, {"command": "python -m b"})
    rows = Table.read(path, format="ascii.ecsv")
    assert sorted(zip(rows["seed"], rows["found"], strict=True)) == [(1, 4.0), (2, 3.0)]
    assert rows.meta["a 1"]["command"] == "python -m b"
    assert rows.meta["a 1"]["date"] == rows.meta["date"]
    assert rows.meta["a 2"] == {"commit": "elsewhere", "cpu_s": 3.0}
    assert rows.meta["command"] == "python -m a" and "earlier" not in rows.meta


def test_the_header_tells_the_run(tmp_path):
    path = tmp_path / "rows.ecsv"
    write_results(Table({"found": [1.0]}), path, "python -m a", seed=5)
    made = Table.read(path, format="ascii.ecsv").meta
    assert (made["command"], made["commit"], made["seed"]) == (
        "python -m a",
        commit_here(),
        5,
    )
    began = datetime.fromisoformat(made["date"])
    assert began.utcoffset() == timedelta(0) and began <= datetime.now(began.tzinfo)
    assert re.fullmatch(rf"\S.*, {os.cpu_count()} cores", made["machine"])
    assert made["versions"] == {
        "python": ".".join(map(str, sys.version_info[:3])),
        "bfsensor": bfsensor.__version__,
        **{
            name: version(name) for name in ("numpy", "scipy", "numba", "galsim", "astropy")
        },
    }


@pytest.mark.parametrize("burn", ["burn()", "subprocess.run([sys.executable, '-c', text])"])
def test_seconds_of_the_process_and_of_its_children_count(tmp_path, burn):
    """Half a second is burnt by the clock of the processor, and start-up comes to it."""
    text = "import time\nwhile time.process_time() < 0.5: pass"
    code = (
        f"import subprocess, sys, time\ntext = {text!r}\ndef burn(): exec(text)\n{burn}\n"
        "from validation.common.run_header import run_header\nprint(run_header('a')['cpu_s'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert float(done.stdout) >= 0.5


@pytest.mark.parametrize("way", ["write_results", "append_rows"])
def test_runs_that_add_rows_keep_what_made_the_earlier_ones(tmp_path, monkeypatch, way):
    path = tmp_path / "rows.ecsv"

    def add(n):
        if way == "append_rows":
            append_rows(path, [{"n": n}], "python -m a", key=("n",))
            return
        old = list(Table.read(path, format="ascii.ecsv")["n"]) if path.exists() else []
        write_results(Table({"n": [*old, n]}), path, "python -m a", added=True)

    old = {"command": "python -m a", "commit": "elsewhere"}  # of before headers had a date
    table = Table({"n": [0]})
    table.meta = {**old, "note": "not of a run"}
    table.write(path, format="ascii.ecsv")
    add(1)
    add(2)
    first = Table.read(path, format="ascii.ecsv").meta
    assert first["earlier"] == [old] and first["commit"] == commit_here()

    monkeypatch.setattr(header, "_BEGAN", header._BEGAN + timedelta(days=1))
    add(3)
    then = Table.read(path, format="ascii.ecsv")
    assert list(then["n"]) == [0, 1, 2, 3]
    assert [run["commit"] for run in then.meta["earlier"]] == ["elsewhere", commit_here()]
    assert then.meta["earlier"][1]["date"] == first["date"] < then.meta["date"]


def test_a_table_written_whole_is_of_one_run(tmp_path):
    path = tmp_path / "rows.ecsv"
    table = Table({"n": [0]})
    table.meta = {"command": "python -m a", "commit": "elsewhere"}
    table.write(path, format="ascii.ecsv")
    write_results(Table({"n": [1]}), path, "python -m a")
    assert "earlier" not in Table.read(path, format="ascii.ecsv").meta
    assert "earlier" not in run_header("python -m a")
