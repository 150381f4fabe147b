"""A diagnosis that was killed goes on: the same report but for its provenance."""

import contextlib
import json
import os
import random
import subprocess
import sys
import time

import pytest
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.diagnose import diagnosis
from tests.diagnose.data.test_tables_of_areas import areas_at, table_of, write
from tests.virtual import make_effect, write_campaign

FREE = "date", "seconds", "cpu_seconds", "host", "command"
"""Parts of the provenance that differ between runs; the command names another folder here."""

CHILDREN = "children_user", "children_system"


def report(folder):
    """Report of a folder without what differs between runs."""
    found = json.loads((folder / "report.json").read_text())
    assert set(FREE) < set(found["provenance"])
    for name in FREE:
        del found["provenance"][name]
    return found


def drawn(folder):
    """File of a_ij with lags of two pixels that no effect explains."""
    a = areas_at(5e4).copy()
    a[0, 2] *= 1.8
    a[2, 0] *= 1.8
    path = folder / "lags.csv"
    write(path, table_of(a, 43, error=1e-9))
    return path


@pytest.mark.parametrize("stage", ["attribute", "plan"])
def test_a_diagnosis_goes_on_where_it_was_interrupted(tmp_path, monkeypatch, stage):
    path = drawn(tmp_path)

    def run(name):
        command = ["diagnose", str(path), "--baseline", "itl_sta3800c_60", "--no-device"]
        return CliRunner().invoke(main, [*command, "-o", str(tmp_path / name)])

    assert run("whole").exit_code == 0

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(diagnosis, stage, interrupt)
    assert run("cut").exit_code != 0
    assert not (tmp_path / "cut" / "report.json").exists()
    assert list((tmp_path / "cut" / "unfinished").glob("stage_located_*"))
    monkeypatch.undo()

    def again(*args, **kwargs):
        raise AssertionError("a finished stage is done again")

    monkeypatch.setattr(diagnosis, "locate_effects", again)
    if stage == "plan":
        # The explanation holds nonparametric terms, which are stored as all else is.
        assert json.loads((tmp_path / "whole" / "report.json").read_text())["free_form"]
        monkeypatch.setattr(diagnosis, "attribute", again)
        monkeypatch.setattr(diagnosis, "explain_single_value", again)
    result = run("cut")
    assert result.exit_code == 0, result.output
    assert report(tmp_path / "cut") == report(tmp_path / "whole")
    assert not (tmp_path / "cut" / "unfinished").exists()


def test_other_errors_are_another_diagnosis(tmp_path, monkeypatch):
    """What was stored with scaled errors is not used with stated ones."""
    path = drawn(tmp_path)

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    command = ["diagnose", str(path), "--baseline", "itl_sta3800c_60", "--no-device", "-o"]
    command.append(str(tmp_path / "out"))
    monkeypatch.setattr(diagnosis, "plan", interrupt)
    CliRunner().invoke(main, command)
    (first,) = (tmp_path / "out" / "unfinished").glob("stage_located_*")
    CliRunner().invoke(main, [*command, "--errors", "stated"])
    assert len(list(first.parent.glob("stage_located_*"))) == 2


@pytest.mark.slow
def test_ten_kills_at_random_moments(tmp_path):
    """``kill -9`` loses the stage in work and nothing else; the last run writes the same report."""
    run = tmp_path / "run"
    write_campaign(run, seed=7301, effects=[make_effect("cti_serial", {"cti": 3e-6})])

    def command(name):
        return [
            sys.executable,
            "-m",
            "bfsensor",
            "diagnose",
            str(run),
            "-o",
            str(tmp_path / name),
        ]

    def spent(run):
        """CPU seconds of what ``run`` starts and waits for."""
        before = os.times()
        run()
        after = os.times()
        return sum(getattr(after, n) - getattr(before, n) for n in CHILDREN)

    def finish(name):
        subprocess.run(command(name), check=True, stdout=subprocess.DEVNULL)

    def kill(name, moment):
        process = subprocess.Popen(command(name), stdout=subprocess.DEVNULL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=moment)
        process.kill()
        process.wait()

    began = time.monotonic()
    whole = spent(lambda: finish("whole"))
    seconds = time.monotonic() - began
    moments = random.Random(9)
    lost = {}
    for n in range(10):
        moment = moments.uniform(2.0, seconds)
        used = spent(lambda moment=moment, n=n: kill(f"cut{n}", moment))
        used += spent(lambda n=n: finish(f"cut{n}"))
        lost[round(moment)] = round(used - whole)
        assert report(tmp_path / f"cut{n}") == report(tmp_path / "whole")
    print(f"{whole:.0f} CPU s; CPU s lost by the moment of the kill [s]: {lost}")
