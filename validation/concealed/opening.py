"""Truths opened: held against their commitments, reports against their submissions, then scored."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from validation.concealed.goals import Trial, trial_of
from validation.concealed.rows import append_rows, read_rows, write_rows
from validation.concealed.score import SCORED, Score, score_campaign
from validation.concealed.submit import (
    OPENED,
    SUBMISSIONS,
    check_submissions,
    digest,
    find_campaigns,
    read_json,
    read_report,
    write_json,
)
from validation.concealed.tally import Line

COMMAND = "python -m validation.concealed open"
TRUTH_KEYS = (
    "campaign", "effects", "size", "amplifiers", "seed", "where", "tie_broken", "layout",
    "plan", "device", "pixels",
)  # fmt: skip


@dataclass(frozen=True)
class Opened:
    """One campaign with its truth, report (None: none was given), cost and commitment."""

    truth: Mapping[str, Any]
    report: Mapping[str, Any] | None
    cost: Mapping[str, float]
    commitment: str

    def score(self) -> Score:
        """Hold report against truth."""
        return score_campaign(self.truth, self.report, self.cost)


def open_truths(
    folder: str | Path,
    results: str | Path,
    truths: str | Path,
    *,
    more: Mapping[str, Mapping[str, Any]] | None = None,
) -> list[Opened]:
    """Open the truths of a folder of campaigns; from here on nothing can be submitted.

    Parameters
    ----------
    folder, results : path
        Campaigns with commitments.json; what :func:`run_campaigns` made of them.
    truths : path
        Folder with NAME.json.
    more : mapping, optional
        By campaign, what was measured after and truths do not hold: ``snr`` (one for each
        effect), ``where``, ``tie_broken``.

    Raises
    ------
    ValueError
        Truths that are missing or do not have the hash committed to, commitments that are not
        those of the submission, reports changed after it; each by name.
    """
    folder, results, truths = Path(folder), Path(results), Path(truths)
    campaigns = [c.name for c in find_campaigns(folder)]
    commitments = read_json(folder / "commitments.json", "file of commitments")
    submitted = read_json(results / SUBMISSIONS, "file of submissions")
    moved = [
        n for n in campaigns
        if n in submitted and submitted[n]["commitment"] != commitments[n]
    ]  # fmt: skip
    if moved:
        raise ValueError(
            f"{folder}/commitments.json: commitments of {', '.join(moved)} are not those that the "
            "reports were submitted under"
        )
    check_submissions(results, submitted)
    missing = [n for n in campaigns if not (truths / f"{n}.json").exists()]
    if missing:
        raise ValueError(f"{truths}: no truth of {', '.join(missing)}")
    wrong = [n for n in campaigns if digest(truths / f"{n}.json") != commitments[n]]
    if wrong:
        raise ValueError(
            f"{truths}: truths of {', '.join(wrong)} do not have the hash committed to"
        )
    if not (results / OPENED).exists():
        time = datetime.now(UTC).isoformat(timespec="seconds")
        kept = {"time": time, "submissions": digest(results / SUBMISSIONS)}
        write_json(results / OPENED, kept)
    out = []
    for name in campaigns:
        truth = read_json(truths / f"{name}.json", "truth")
        report = read_report(results, name) if name in submitted else None
        cost = results / name / "cost.json"
        out.append(
            Opened(
                _with_more(truth, (more or {}).get(name, {})),
                report,
                read_json(cost, "file of costs") if report and cost.exists() else {},
                commitments[name],
            )
        )
    return out


def _with_more(truth: dict[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    effects = [dict(e) for e in truth["effects"]]
    given = more.get("snr")
    if given is not None:
        if len(given) != len(effects):
            raise ValueError(
                f"{truth['campaign']}: {len(given)} SNRs given, {len(effects)} effects"
            )
        for effect, snr in zip(effects, given, strict=True):
            effect["snr"] = snr
    rest = {k: more[k] for k in ("where", "tie_broken") if k in more}
    return {**truth, "effects": effects, **rest}


def to_row(opened: Opened, level: str, group: str) -> dict[str, Any]:
    """Return one row of results: what is looked at first, then all that scores are made from.

    ``level`` is "pixel" or "channel", ``group`` the name of the set of campaigns.
    """
    score = opened.score()
    truth = {k: opened.truth[k] for k in TRUTH_KEYS if k in opened.truth}
    if "nuisances" in opened.truth:
        # The virtual sensor of this folder states their sizes by name, the independent bench lists them.
        truth["nuisances"] = [
            n if isinstance(n, str) else n["kind"] for n in opened.truth["nuisances"]
        ]
    report = None
    if opened.report is not None:
        report = {k: opened.report[k] for k in SCORED if k in opened.report}
    return {
        "set": group,
        "campaign": score.campaign,
        "level": level,
        "size": score.size,
        "kind": score.kind,
        "truth": " ".join(score.classes),
        "snr": " ".join(f"{s:.2f}" for s in score.snr),
        "detected": score.detected,
        "p_value": score.p_value,
        "named": " ".join(score.named),
        "probability": round(score.probability, 5),
        "in_class": score.in_class,
        "class_size": len(score.told_class),
        "open_world": score.outside,
        "removed": round(score.removed, 4),
        "wall_s": score.wall_s,
        "cpu_s": score.cpu_s,
        "memory_gb": score.memory_gb,
        "commitment": opened.commitment,
        "truth_json": _compact(truth),
        "report_json": _compact(report),
    }


def _compact(content: Any) -> str:
    return json.dumps(content, separators=(",", ":"))


def from_row(row: Mapping[str, Any]) -> Score:
    """Score a row of results anew, from its truth and report."""
    return score_campaign(
        json.loads(row["truth_json"]), json.loads(row["report_json"]), row
    )


def trial_from_row(row: Mapping[str, Any]) -> Trial:
    """Trial of a row of results of an independent bench's campaign."""
    truth, report = json.loads(row["truth_json"]), json.loads(row["report_json"])
    return trial_of(truth, from_row(row), report)


def add_results(path: str | Path, rows: Sequence[Mapping[str, Any]], command: str) -> int:
    """Add rows to a file of results; a row of the same commitment stays as it was."""
    return append_rows(path, rows, command, key=("set", "campaign", "commitment"))


def write_summary(
    path: str | Path, lines: Sequence[Line], group: str, level: str, command: str
) -> None:
    """Write the table of one set beside those of others; the set's own is replaced."""
    rest = [r for r in read_rows(path) if (r["set"], r["level"]) != (group, level)]
    rows = [
        {
            "set": group, "level": level, "quantity": line.quantity, "value": line.value,
            "low": line.low, "high": line.high, "trials": line.trials, "hits": line.hits,
            "pass": line.passed, "moonshot": line.moonshot, "reached": line.reached(),
        }
        for line in lines
    ]  # fmt: skip
    write_rows(path, [*rest, *rows], command)


def write_goals(
    path: str | Path, lines: Mapping[str, Sequence[Line]], command: str
) -> None:
    """Write the table of goals, a row for each part of the trials and quantity."""
    rows = [
        {
            "part": part, "quantity": line.quantity, "value": line.value, "low": line.low,
            "high": line.high, "trials": line.trials, "hits": line.hits, "pass": line.passed,
            "moonshot": line.moonshot, "reached": line.reached(),
        }
        for part, own in lines.items()
        for line in own
        if line.trials
    ]  # fmt: skip
    write_rows(path, rows, command)
