"""``bfsensor check``: list the exposures in a folder, and the questions they cannot answer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from bfsensor.cli.common import Bar


@click.command("check", short_help="List the exposures in a folder.")
@click.argument("campaign", type=click.Path(path_type=Path))
@click.option("--headers", is_flag=True,
              help="Read headers only: faster, but saturated pixels, NaN and wrong gains "
              "go unnoticed.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON for a program to read.")
def check(campaign: Path, headers: bool, as_json: bool) -> None:
    """List the exposures in the folder CAMPAIGN, and the questions they cannot answer.

    Prints the kinds of exposures with settings, levels [ADU] and flat pairs; the files that are
    not used, each with the reason; warnings; and for each open question the exposures to take.
    CAMPAIGN may also be a table of reduced recordings.  Nothing is written.  The exit status is
    0 if the folder could be read, whatever was found in it.

    \b
    Examples:
      bfsensor check recordings/run_12
      bfsensor check recordings/run_12 --headers --json
    """
    from bfsensor.recording.campaign.campaign import read_campaign
    from bfsensor.recording.campaign.inspection import inspect_campaign
    from bfsensor.recording.campaign.questions import open_questions
    from bfsensor.recording.tables.reduced import find_reduced

    reduced = find_reduced(campaign)
    if reduced and not _has_images(campaign):
        _print_reduced(reduced, as_json)
        return
    found = read_campaign(campaign, progress=Bar("headers"))
    levels: dict[int, dict[str, float]] = {}
    if not headers:
        inspection = inspect_campaign(found, progress=Bar("pixels"))
        found = inspection.campaign
        levels = {one.number: inspection.levels(one.number) for one in found.exposures}
    report: dict[str, Any] = {
        "campaign": found.name,
        "folder": str(found.folder),
        "kinds": found.kinds(),
        "manifest": found.has_manifest,
        "pixels_read": not headers,
        "conditions": _conditions(found, levels),
        "amplifiers": [_amplifier(one) for one in found.amplifiers],
        "baseline": None if found.baseline is None else str(found.baseline),
        "card": None if found.card is None else str(found.card),
        "reduced": [_reduced(one) for one in reduced],
        "set_aside": [{"file": one.path.name, "reason": one.reason} for one in found.set_aside],
        "warnings": [
            {"topic": one.topic, "message": one.message, "closes": one.closes,
             "exposures": list(one.exposures)}
            for one in found.warnings
        ],
        "open_questions": [
            {"question": one.question, "because": one.because, "take": one.take}
            for one in open_questions(found)
        ],
    }  # fmt: skip
    if as_json:
        click.echo(json.dumps(report, indent=1))
        return
    _print(report)


def _has_images(campaign: Path) -> bool:
    """Whether a path is a folder with FITS files that hold images."""
    from bfsensor.recording.tables.reduced import holds_images

    return campaign.is_dir() and holds_images(campaign)


def _conditions(found: Any, levels: dict[int, dict[str, float]]) -> list[dict[str, Any]]:
    """List a row for each kind of exposure and each setting."""
    rows = []
    for kind in found.kinds():
        for condition, members in found.conditions(kind).items():
            times = sorted(
                {e.exposure_time for e in members if e.exposure_time is not None}
            )
            row: dict[str, Any] = {
                "kind": kind, "condition": str(condition), "exposures": len(members),
                "exposure_times_s": times,
            }  # fmt: skip
            if kind == "flat":
                row["pairs"] = len(found.pairs(condition))
                row["pairs_by_exposure_time"] = {
                    f"{t:g}": len(found.pairs(condition, exposure_time=t))
                    for t in found.exposure_times(condition)
                }
            mine = [v for e in members for v in levels.get(e.number, {}).values() if v == v]
            if mine and kind in ("flat", "dark"):
                row["levels_adu"] = [min(mine), max(mine)]
            rows.append(row)
    return rows


def _amplifier(one: Any) -> dict[str, Any]:
    return {
        "name": one.name, "image": [one.shape[1], one.shape[0]], "prescan": one.prescan,
        "serial_overscan": one.serial_overscan, "parallel_overscan": one.parallel_overscan,
        "origin": one.origin, "flip_x": one.flip_x, "flip_y": one.flip_y, "gain": one.gain,
        "noise": one.noise,
    }  # fmt: skip


def _print(report: dict[str, Any]) -> None:
    """Print the report as text, a line for each setting, file and question."""
    from bfsensor.recording.campaign.exposures import count_of

    count = sum(report["kinds"].values())
    kinds = ", ".join(f"{n} {kind}" for kind, n in report["kinds"].items())
    source = "manifest and headers" if report["manifest"] else "headers"
    click.echo(f"{report['campaign']}: {count} exposures ({kinds}), from {source}")
    for row in report["conditions"]:
        times = row["exposure_times_s"]
        span = f"{times[0]:g} to {times[-1]:g} s" if len(times) > 1 else ""
        span = f"{times[0]:g} s" if len(times) == 1 else span
        words = [f"  {row['kind']:6} {row['exposures']:4}", f"{row['condition']:45}", span]
        if "pairs" in row:
            each = sorted(set(row["pairs_by_exposure_time"].values()))
            times = len(row["pairs_by_exposure_time"])
            ladder = f" at {count_of(times, 'level')}" if each else ""
            words.append(count_of(row["pairs"], "pair") + ladder)
        if "levels_adu" in row:
            low, high = row["levels_adu"]
            words.append(f"{low:.0f} to {high:.0f} ADU")
        click.echo("  ".join(word for word in words if word))
    for one in _grouped(report["amplifiers"]):
        click.echo(f"  {one}")
    for word in ("baseline", "card"):
        if report[word]:
            click.echo(f"  {word}: {report[word]}")
    for one in report["reduced"]:
        click.echo(f"  {one['file']}: {one['what']}")
    for title, lines in (
        ("set aside", [f"{x['file']}: {x['reason']}" for x in report["set_aside"]]),
        ("warnings", [_closing(x) for x in report["warnings"]]),
        (
            "left open",
            [
                f"{x['question']} ({x['because']}); {x['take']}"
                for x in report["open_questions"]
            ],
        ),
    ):
        if lines:
            click.echo(f"{title} ({len(lines)}):")
        for line in lines:
            click.echo(f"  {line}")
    if not report["pixels_read"]:
        click.echo("pixels were not read: --headers")


def _closing(one: dict[str, Any]) -> str:
    return f"{one['message']}: {one['closes']}" if one["closes"] else str(one["message"])


def _grouped(amplifiers: list[dict[str, Any]]) -> list[str]:
    """Give one line for all amplifiers of equal size."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for one in amplifiers:
        key = (
            *one["image"],
            one["prescan"],
            one["serial_overscan"],
            one["parallel_overscan"],
        )
        groups.setdefault(key, []).append(one)
    lines = []
    for (nx, ny, before, serial, parallel), members in groups.items():
        names = members[0]["name"]
        names += f" to {members[-1]['name']}" if len(members) > 1 else ""
        gains = {f"{m['gain']:.3g}" for m in members if m["gain"] is not None}
        said = ", no gain"
        if gains:
            said = f", gain {' '.join(sorted(gains))} e-/ADU by header or campaign.yaml"
        word = "amplifier" if len(members) == 1 else "amplifiers"
        lines.append(
            f"{len(members)} {word} ({names}): {nx} x {ny} pixels, prescan {before}, overscan "
            f"{serial} columns and {parallel} rows{said}"
        )
    return lines


def _reduced(one: Any) -> dict[str, Any]:
    return {"file": one.path.name, "what": one.what, "warnings": list(one.warnings)}


def _print_reduced(reduced: Any, as_json: bool) -> None:
    """Print the contents of a folder or file of reduced recordings."""
    rows = [_reduced(one) for one in reduced]
    if as_json:
        click.echo(json.dumps({"reduced": rows}, indent=1))
        return
    for row in rows:
        click.echo(f"{row['file']}: {row['what']}")
        for text in row["warnings"]:
            click.echo(f"  warning: {text}")
