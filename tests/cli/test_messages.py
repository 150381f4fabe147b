"""Messages on stderr: --verbose, --quiet, progress, closed pipes, and the main help."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from click.testing import CliRunner

from bfsensor.cli import common
from bfsensor.cli.main import main
from tests.broken_campaigns import make_campaign


def run(*args):
    return CliRunner().invoke(main, [str(a) for a in args])


def test_verbose_says_versions_seconds_and_where_an_error_happened():
    plain, more = run("device", "show", "nothing"), run("-v", "device", "show", "nothing")
    assert plain.exit_code == more.exit_code == 1
    assert len(plain.stderr.splitlines()) == 1
    assert ", python 3." in more.stderr and ", numba " in more.stderr
    assert "Traceback" in more.stderr and "in load_device" in more.stderr
    assert plain.stderr in more.stderr
    assert more.stderr.splitlines()[-1].endswith("s of CPU in this process")
    # The level of one call does not stay for the next.
    assert run("device", "show", "nothing").stderr == plain.stderr


def test_quiet_leaves_errors():
    assert run("-q", "device", "show", "nothing").stderr.startswith("bfsensor: 'nothing'")
    assert run("-q", "-v", "devices").exit_code == 2


def test_progress_without_a_terminal_is_a_line_at_most_every_30_s(monkeypatch, capsys):
    clock = [100.0]
    monkeypatch.setattr(common.time, "monotonic", lambda: clock[0])

    def lines(*, quiet):
        common.start_log(False, quiet)
        clock[0] = 100.0
        with common.progress_bar("level") as progress:
            for done in range(1, 101):
                clock[0] += 0.7
                progress(done, 100)
        return capsys.readouterr().err.splitlines()

    # 70 s: at 30.1 and at 60.2 s.
    assert lines(quiet=False) == [
        "bfsensor: level: 43 of 100, 30 s", "bfsensor: level: 86 of 100, 60 s",
    ]  # fmt: skip
    assert lines(quiet=True) == []
    common.start_log(False, False)


def test_a_terminal_gets_a_bar(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with common.progress_bar("level") as progress:
        progress(1, 4)
    assert "level:  25%" in capsys.readouterr().err


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_what_the_help_says(shell):
    text = run("--help").stdout
    assert f"{shell}_source" in text
    done = subprocess.run(
        [sys.executable, "-c", "from bfsensor.cli.main import main; main(prog_name='bfsensor')"],
        env={**os.environ, "_BFSENSOR_COMPLETE": f"{shell}_source"}, capture_output=True,
        text=True, check=True,
    )  # fmt: skip
    assert "_BFSENSOR_COMPLETE" in done.stdout


@pytest.mark.parametrize(
    "command", [("device", "show", "e2v_ccd250"), ("devices",), ("check", "CAMPAIGN")]
)
def test_a_closed_pipe_ends_without_a_message(tmp_path, command):
    campaign = make_campaign(tmp_path / "run_12")
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "bfsensor", *(campaign if c == "CAMPAIGN" else c for c in command)],
        stdout=writer, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")


def test_help_states_status_and_json():
    text = run("--help").stdout
    assert "130 interrupted" in text and "--json" in text
