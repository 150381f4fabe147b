"""``bfsensor sweep`` as a user runs it: file, resuming, executors, refused points, messages."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.sweeps.rows import DeviceSweep

# -50 V is the device as it is: three solutions with the finer mesh for the errors.
SMALL = ["sweep", "itl_sta3800c", "--over", "back_bias=-50V,-60V", "--cells", "8"]


def invoke(*arguments):
    return CliRunner().invoke(main, [*map(str, arguments)])


def same_numbers(one, other):
    names = [n for n in one.rows.colnames if n not in ("cpu", "reason")]
    for name in names:
        np.testing.assert_array_equal(one.rows[name], other.rows[name])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep")
    result = invoke(
        *SMALL,
        "--workers",
        1,
        "-o",
        folder / "a.ecsv",
        "--plot",
        folder / "a.png",
        "--json",
    )
    assert result.exit_code == 0, result.output
    return folder, json.loads(result.stdout)


def test_rows_figure_and_summary_are_written(finished):
    folder, summary = finished
    assert sorted(p.name for p in folder.iterdir()) == ["a.ecsv", "a.png"]
    assert summary["points"] == 2 and summary["refused"] == 0
    made = DeviceSweep.read(folder / "a.ecsv")
    assert list(made.rows["back_bias"]) == [-50, -60]
    assert made.a[1, 0, 0] / made.a[0, 0, 0] == pytest.approx(0.926, abs=0.01)
    assert (folder / "a.png").stat().st_size > 20_000


SLOW = pytest.mark.slow  # tests/test_sweep.py has these executors in every run


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["process", pytest.param("dask", marks=SLOW), pytest.param("parsl", marks=SLOW)]
)
def test_every_executor_gives_the_same_bits(finished, tmp_path, kind):
    if kind != "process":
        pytest.importorskip({"dask": "distributed", "parsl": "parsl"}[kind])
    result = invoke(*SMALL, "--workers", 2, "--executor", kind, "-o", tmp_path / "b.ecsv")
    assert result.exit_code == 0, result.output
    here, there = (
        DeviceSweep.read(p) for p in (finished[0] / "a.ecsv", tmp_path / "b.ecsv")
    )
    same_numbers(here, there)


@pytest.mark.slow
def test_a_killed_run_goes_on(finished, tmp_path):
    """``kill -9`` after the first point, the same command again: the same bits, not redone."""
    work = tmp_path / "k.ecsv.points"
    process = subprocess.Popen(
        [sys.executable, "-m", "bfsensor", *SMALL, "--workers", "1", "-o", "k.ecsv"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env={**os.environ}, cwd=tmp_path,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 300
        while not list(work.glob("*.npz")) and time.monotonic() < deadline:
            assert process.poll() is None, "ended before it could be killed"
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    assert not (tmp_path / "k.ecsv").exists()
    kept = {p.name: p.stat().st_mtime_ns for p in work.glob("*.npz")}
    assert 1 <= len(kept) <= 2
    # Only the missing points are solved: those that are there would fail.
    import bfsensor.sweeps.device_sweep as library

    solved = []
    original = library.solve_point

    def count(point):
        solved.append(point.key)
        return original(point)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "solve_point", count)
        result = invoke(*SMALL, "--workers", 1, "-o", tmp_path / "k.ecsv")
    assert result.exit_code == 0, result.output
    assert len(solved) == 3 - len(kept) and not {f"{k}.npz" for k in solved} & set(kept)
    assert not work.exists()
    same_numbers(
        DeviceSweep.read(finished[0] / "a.ecsv"), DeviceSweep.read(tmp_path / "k.ecsv")
    )


def test_refused_points_are_rows_and_status_1(tmp_path):
    """A thickness that no device may have, and gates that leave free holes."""
    result = invoke(
        "sweep", "itl_sta3800c", "--over", "thickness=100um,2000um", "--set", "gate_high=-7V",
        "--cells", 8, "--workers", 1, "-o", tmp_path / "r.ecsv", "--plot", tmp_path / "r.png",
    )  # fmt: skip
    assert result.exit_code == 1
    assert "2 of 2 points have no answer; see the column 'reason'" in result.output
    made = DeviceSweep.read(tmp_path / "r.ecsv")
    assert "is not depleted" in made.rows["reason"][0]
    assert "must be at most 1000 um" in made.rows["reason"][1]
    assert made.rows.meta["no_error"] == made.rows["reason"][0]
    assert np.isnan(made.a).all() and not (tmp_path / "r.png").exists()


def test_a_level_above_the_full_well_is_a_reason(tmp_path):
    result = invoke(
        "sweep", "itl_sta3800c", "--over", "spill_barrier=1.1V", "--level", 400_000, "--cells", 8,
        "--workers", 1, "-o", tmp_path / "w.ecsv",
    )  # fmt: skip
    assert result.exit_code == 1
    assert "above its full well" in DeviceSweep.read(tmp_path / "w.ecsv").rows["reason"][0]


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (
            ["--over", "bias=-30V"],
            1,
            "'bias'",
        ),
        (["--over", "back_bias=-30"], 1, "operating_point.back_bias: '-30'"),
        (["--over", "back_bias=-30V:-40V"], 1, "first:last:number"),
        (["--over", "back_bias=-30V", "--over", "back_bias=-40V"], 1, "back_bias"),
        (
            ["--paired", "--over", "back_bias=-30V", "--over", "gate_high=2V,3V"],
            1,
            "back_bias 1, gate_high 2",
        ),
        (
            ["--over", "back_bias=-30V", "--cells", "0"],
            1,
            "cells = 0 ",
        ),
        (["--over", "back_bias=-30V", "--accuracy", "1e-4"], 1, "0.005"),
        (["--over", "back_bias=-30V", "--level", "-5"], 1, "level = -5 e-"),
        (["--over", "back_bias=-30V", "--set", "thickness=9"], 1, "'9'"),
        (["--over", "back_bias"], 2, "KEY=VALUE"),
        ([], 2, "'--over'"),
        (
            ["--over", "back_bias=-30V", "--cells", "8", "--accuracy", "0.1"],
            2,
            "--accuracy",
        ),
    ],
)
def test_one_clear_line_for_bad_input(tmp_path, arguments, status, message):
    result = invoke("sweep", "itl_sta3800c", *arguments, "-o", tmp_path / "x.ecsv")
    assert result.exit_code == status
    assert message in result.output
    assert status == 2 or len(result.output.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_kept(finished):
    result = invoke(*SMALL, "-o", finished[0] / "a.ecsv")
    assert result.exit_code == 1 and "--overwrite" in result.output
