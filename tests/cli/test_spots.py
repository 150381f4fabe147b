"""``bfsensor spots`` as a user runs it: files, resuming, executors, messages."""

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
from bfsensor.direct.spot_exposure import Spot

SMALL = [
    "spots", "itl_sta3800c", "--pixels", "5", "--sigma", "4", "--steps", "2", "--peak", "40000",
    "--spots", "3",
]  # fmt: skip


def invoke(*arguments):
    return CliRunner().invoke(main, [*map(str, arguments)])


def images(folder):
    return {p.name: Spot.read(p).on for p in sorted(folder.glob("spot_*.fits"))}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("spots") / "run"
    result = invoke(*SMALL, "--workers", 1, "-o", folder, "--json")
    assert result.exit_code == 0, result.output
    return folder, json.loads(result.stdout)


def test_images_slopes_and_figure_are_written(finished):
    folder, summary = finished
    names = sorted(p.name for p in folder.iterdir())
    assert names[:2] == ["growth.ecsv", "growth.png"] and len(names) == 5
    assert summary["spots"] == 3
    x, y = (summary["slope_percent_per_50000e"][axis] for axis in "xy")
    assert 0.2 < float(x.split()[0]) < 8 and 0.2 < float(y.split()[0]) < 8
    assert (folder / "growth.png").stat().st_size > 20_000


def test_spots_that_are_there_are_kept(finished):
    folder, _ = finished
    first = sorted(folder.glob("spot_*.fits"))[0]
    before = first.stat().st_mtime_ns
    sorted(folder.glob("spot_*.fits"))[2].unlink()
    held = images(folder)
    assert invoke(*SMALL, "--workers", 1, "-o", folder).exit_code == 0
    assert first.stat().st_mtime_ns == before
    again = images(folder)
    assert len(again) == 3
    for name, image in held.items():
        np.testing.assert_array_equal(again[name], image)


SLOW = pytest.mark.slow  # tests/test_sweep.py has these executors in every run


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["process", pytest.param("dask", marks=SLOW), pytest.param("parsl", marks=SLOW)]
)
def test_every_executor_gives_the_same_bits(finished, tmp_path, kind):
    if kind != "process":
        pytest.importorskip({"dask": "distributed", "parsl": "parsl"}[kind])
    result = invoke(*SMALL, "--workers", 2, "--executor", kind, "-o", tmp_path)
    assert result.exit_code == 0, result.output
    here, there = images(finished[0]), images(tmp_path)
    assert list(here) == list(there) and len(here) == 3
    for name in here:
        np.testing.assert_array_equal(here[name], there[name])


@pytest.mark.slow
def test_a_killed_run_goes_on(finished, tmp_path):
    """``kill -9`` after the first spot, the same command again: the same bits."""
    command = [
        sys.executable,
        "-m",
        "bfsensor",
        *SMALL,
        "--workers",
        "1",
        "-o",
        tmp_path,
    ]
    process = subprocess.Popen(
        [*map(str, command)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ},
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("spot_*.fits")) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert 1 <= len(list(tmp_path.glob("spot_*.fits"))) <= 3
    assert not (tmp_path / "growth.ecsv").exists()
    assert invoke(*SMALL, "--workers", 1, "-o", tmp_path).exit_code == 0
    here, there = images(finished[0]), images(tmp_path)
    for name in here:
        np.testing.assert_array_equal(here[name], there[name])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--pixels", "4"], "pixels = 4 "),
        (["--sigma", "40"], "sigma = 40 um"),
        (["--depth", "300"], "depth = 300"),
        (["--diffusion", "-1"], "diffusion = -1.0"),
        (["--set", "back_bias=-60"], "'-60'"),
        (["--peak", "400000"], "peak = 400000 e-"),
    ],
)
def test_one_clear_line_for_bad_input(tmp_path, arguments, message):
    result = invoke("spots", "itl_sta3800c", *arguments, "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert message in result.output and len(result.output.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_help_shows_an_example():
    assert "bfsensor spots itl_sta3800c --set" in invoke("spots", "--help").output
