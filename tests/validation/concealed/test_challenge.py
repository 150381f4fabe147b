"""run and open: once, resumable, sealed; with a stand-in for the command, and once with the real one."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time

import pytest
from click.testing import CliRunner

from tests.validation.concealed.reports import report, truth
from validation.concealed.__main__ import main
from validation.concealed.campaign import seal, write_campaign
from validation.concealed.library import make_effect
from validation.concealed.opening import from_row, open_truths
from validation.concealed.plan import SIZES, Size
from validation.concealed.rows import locked, read_rows
from validation.concealed.submit import run_campaigns

STAND_IN = """
import json, os, pathlib, sys, time
campaign, _, out = sys.argv[-3:]
name = pathlib.Path(campaign).name
with open(os.environ["CALLS"], "a") as calls:
    calls.write(name + "\\n")
answer = json.loads(pathlib.Path(os.environ["ANSWERS"]).read_text()).get(name)
if answer == "fail":
    print("cannot be read: no flats", file=sys.stderr)
    sys.exit(1)
if answer == "hang":
    pathlib.Path(out, "report.json").write_text('{"schema": "half')
    time.sleep(60)
pathlib.Path(out, "report.json").write_text(json.dumps(answer))
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Three sealed campaigns without pixels, and a command that answers from a file."""
    (tmp_path / "stand_in.py").write_text(STAND_IN)
    for number in range(3):
        name = f"c_{number}"
        (tmp_path / "campaigns" / name).mkdir(parents=True)
        (tmp_path / "campaigns" / name / "campaign.yaml").write_text("schema: x\n")
        told = truth(*(["tearing"] if number else []), name=name, salt=f"{number}")
        seal(tmp_path / "campaigns" / name, told, tmp_path / "sealed")
    monkeypatch.setenv("CALLS", str(tmp_path / "calls.txt"))
    monkeypatch.setenv("ANSWERS", str(tmp_path / "answers.json"))
    answer(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def answer(place, **changes):
    answers = {f"c_{n}": report(campaign=f"c_{n}", p_value=0.2 + 0.1 * n) for n in range(3)}
    (place / "answers.json").write_text(json.dumps(answers | changes))


def command(place):
    return shlex.join([sys.executable, str(place / "stand_in.py")])


def run(place):
    return run_campaigns(place / "campaigns", place / "reports", command=command(place))


def calls(place):
    return (place / "calls.txt").read_text().split()


def invoke(*words):
    return CliRunner().invoke(main, [str(w) for w in words])


def open_all(place):
    return open_truths(place / "campaigns", place / "reports", place / "sealed")


def test_each_campaign_is_run_once_and_fixed_by_its_hash(place):
    assert run(place).made == ("c_0", "c_1", "c_2")
    submitted = json.loads((place / "reports" / "submissions.json").read_text())
    assert sorted(submitted) == ["c_0", "c_1", "c_2"]
    known = json.loads((place / "campaigns" / "commitments.json").read_text())
    assert all(submitted[n]["commitment"] == known[n] for n in known)
    cost = json.loads((place / "reports" / "c_1" / "cost.json").read_text())
    assert 0 < cost["wall_s"] < 60 and 0.001 < cost["memory_gb"] < 10
    again = run(place)
    assert (again.made, again.there) == ((), ("c_0", "c_1", "c_2"))
    assert calls(place) == ["c_0", "c_1", "c_2"]


def test_a_command_that_fails_is_tried_again_and_stops_no_other(place):
    answer(place, c_1="fail", c_2={"schema": "other"})
    done = invoke("run", "campaigns", "-o", "reports", "--command", command(place))
    assert done.exit_code == 1 and "no report of c_1, c_2" in done.output
    assert "no flats" in (place / "reports" / "c_1.failed.txt").read_text()
    assert "schema = 'other'" in (place / "reports" / "c_2.failed.txt").read_text()
    answer(place)
    done = invoke("run", "campaigns", "-o", "reports", "--command", command(place))
    assert done.exit_code == 0 and "2 diagnosed, 1 were there already" in done.output
    assert not list((place / "reports").glob("*.failed.txt"))


def _heed_interrupts():
    """Children of a shell's background jobs are born deaf to Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_ended_at_any_moment_it_goes_on(place, how):
    """The second campaign hangs with half a report; the run is ended; the next one finishes."""
    answer(place, c_1="hang")
    words = [sys.executable, "-m", "validation.concealed", "run", "campaigns", "-o", "reports",
             "--command", command(place)]  # fmt: skip
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        preexec_fn=_heed_interrupts,
    )  # fmt: skip
    deadline = time.monotonic() + 50
    while not list(place.glob("reports/.c_1.*.part/report.json")):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, how)
    said = process.communicate(timeout=180)[0]
    if how == signal.SIGINT:
        assert process.returncode == 130 and "the same command goes on" in said
    assert not (place / "reports" / "c_1").exists()
    answer(place)
    done = run(place)
    assert (done.made, done.there) == (("c_1", "c_2"), ("c_0",))
    assert calls(place) == ["c_0", "c_1", "c_1", "c_2"]
    assert not list((place / "reports").glob(".*.part"))


def test_a_report_complete_before_the_run_was_ended_is_submitted_and_not_made_again(place):
    run(place)
    path = place / "reports" / "submissions.json"
    left = json.loads(path.read_text())
    del left["c_2"]
    path.write_text(json.dumps(left))
    assert run(place).made == () and "c_2" in json.loads(path.read_text())


def test_two_runs_do_not_meet(place):
    run(place)
    with (
        locked(place / "reports"),
        pytest.raises(ValueError, match="another run is at work"),
    ):
        run(place)


def test_truths_altered_are_refused_by_name(place):
    run(place)
    path = place / "sealed" / "c_1.json"
    kept = path.read_bytes()
    path.write_bytes(kept.replace(b"tearing", b"tearinG"))
    with pytest.raises(
        ValueError, match=r"truths of c_1 do not have the hash committed to"
    ):
        open_all(place)
    assert not (place / "reports" / "opened.json").exists()
    path.unlink()
    with pytest.raises(ValueError, match="no truth of c_1"):
        open_all(place)
    path.write_bytes(kept)
    assert len(open_all(place)) == 3


def test_commitments_moved_after_the_submission_are_refused(place):
    """A truth exchanged together with its commitment."""
    run(place)
    seal(place / "campaigns" / "c_2", truth(name="c_2", salt="other"), place / "sealed")
    with pytest.raises(ValueError, match="commitments of c_2 are not those"):
        open_all(place)


def test_reports_changed_after_their_submission_are_refused_by_name(place):
    run(place)
    path = place / "reports" / "c_0" / "report.json"
    kept = path.read_text()
    path.write_text(json.dumps(report(campaign="c_0", p_value=0.9)))
    for action in (open_all, run):
        with pytest.raises(ValueError, match=r"report.json of c_0 was changed after"):
            action(place)
    path.unlink()
    with pytest.raises(ValueError, match=r"report.json of c_0 was changed after"):
        run(place)
    path.write_text(kept)
    assert len(open_all(place)) == 3


def test_nothing_is_submitted_once_truths_are_open(place):
    answer(place, c_2="fail")
    assert run(place).failed == ("c_2",)
    opened = open_all(place)
    assert [o.report is None for o in opened] == [False, False, True]
    answer(place)
    with pytest.raises(ValueError, match="truths are open; no report can be added"):
        run(place)
    # nor one laid there by hand
    late = place / "reports" / "c_2"
    late.mkdir()
    (late / "report.json").write_text(json.dumps(report(campaign="c_2")))
    with pytest.raises(ValueError, match="truths are open"):
        run(place)
    assert open_all(place)[2].report is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: (p / "campaigns" / "c_0" / "truth.json").write_text("{}"), "the truth lies open"),
        (lambda p: (p / "campaigns" / "commitments.json").unlink(), "no file of commitments"),
        (lambda p: (p / "campaigns" / "commitments.json").write_text("{}"), "no c_0"),
        (lambda p: (p / "campaigns" / "commitments.json").write_text("{"), "not a file of"),
    ],
)  # fmt: skip
def test_what_run_refuses(place, change, message):
    change(place)
    done = invoke("run", "campaigns", "-o", "reports", "--command", command(place))
    assert done.exit_code == 1 and message in done.output, done.output
    assert len(done.output.strip().splitlines()) == 1


def test_other_refusals(place):
    done = invoke("run", "nowhere")
    assert done.exit_code == 1 and "nowhere: no campaigns" in done.output
    done = invoke("run", "campaigns", "--command", "no_such_program diagnose")
    assert (
        done.exit_code == 1 and "'no_such_program diagnose': not installed" in done.output
    )
    done = invoke("open", "campaigns", "reports", "sealed")
    assert done.exit_code == 1 and "submissions.json: there is no" in done.output
    run(place)
    (place / "more.json").write_text(json.dumps({"c_1": {"snr": [3.0, 4.0]}}))
    done = invoke(
        "open", "campaigns", "reports", "sealed", "-o", "x.ecsv", "--more", "more.json"
    )
    assert done.exit_code == 1 and "c_1: 2 SNRs given, 1 effects" in done.output


def test_rows_hold_all_that_scores_are_made_from(place):
    run(place)
    (place / "more.json").write_text(json.dumps({"c_1": {"snr": [5.5]}}))
    words = [
        "open",
        "campaigns",
        "reports",
        "sealed",
        "-o",
        "out.ecsv",
        "--more",
        "more.json",
    ]
    done = invoke(*words)
    assert done.exit_code == 0, done.output
    assert "c_1: tearing (SNR 5.5): not detected (p = 0.3)" in done.output
    assert "3 rows added of 3" in done.output
    rows = read_rows("out.ecsv")
    for row, opened in zip(rows, open_all(place), strict=True):
        score = from_row(row)
        assert score.campaign == opened.truth["campaign"]
        assert (score.p_value, score.classes) == (
            opened.score().p_value,
            opened.score().classes,
        )
    assert from_row(rows[1]).snr == (5.5,)
    assert "0 rows added of 3" in invoke(*words).output
    assert len(read_rows("out.ecsv")) == 3
    summary = read_rows("out_summary.ecsv")
    (alarms,) = [r for r in summary if r["quantity"].startswith("false alarms")]
    assert (alarms["hits"], alarms["trials"], alarms["pass"]) == (0, 1, "<= 0.03")


@pytest.mark.slow
def test_end_to_end_with_the_installed_command(tmp_path, monkeypatch):
    """A null and a torn campaign of 64 x 64 pixels, written, run and opened: about 15 CPU s."""
    small = Size(64, 3, 0, dithers=1, spot_seconds=(5.0, 30.0))
    monkeypatch.setitem(SIZES, "S", small)
    monkeypatch.chdir(tmp_path)
    torn = make_effect("tearing", {"amp": 0.1, "length": 2.0, "column": 0.3})
    for name, effects in (("c_0", ()), ("c_1", (torn,))):
        write_campaign(
            f"campaigns/{name}", seed=7001, effects=effects, truth_folder=tmp_path / "sealed"
        )  # fmt: skip
    done = invoke("run", "campaigns", "-o", "reports")
    assert done.exit_code == 0, done.output
    done = invoke("open", "campaigns", "reports", "sealed", "-o", "out.ecsv")
    assert done.exit_code == 0, done.output
    null, other = (from_row(r) for r in read_rows("out.ecsv"))
    assert (null.campaign, null.detected, null.kind) == ("c_0", False, "null")
    assert other.detected and other.p_value < 1e-6
    assert other.location["x"] > 0.3
    assert 1 < other.wall_s < 300 and 0.1 < other.memory_gb < 4 and other.cpu_s > 1
    assert "detected, SNR not known" in done.output
