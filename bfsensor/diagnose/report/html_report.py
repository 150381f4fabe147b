"""Write a diagnosis to a folder as report.json, report.html and figures."""

from __future__ import annotations

import base64
import html
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bfsensor.diagnose.report.class_words import (
    CLASS_WORDS,
    NAMES,
    PARAMETER_WORDS,
    SCAN_WORDS,
    said_family_p,
    said_interval,
    said_p,
    said_value,
)
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.diagnose.report.report_figures import Drawn, draw_figures
from bfsensor.diagnose.report.report_style import STYLE
from bfsensor.errors import DiagnosisError
from bfsensor.files import written_whole

WHERE_WORDS = {
    "amp": ("amplifier", ""), "other": ("against amplifier", ""), "lags": ("lags (x, y)", ""),
    "level": ("level", "ADU"), "power": ("with the level to the power", ""),
    "set": ("group:", ""), "condition": ("wavelength [nm] / back bias [V] / temperature [C]:", ""),
    "exposure": ("exposure", ""), "x": ("column", ""), "y": ("row", ""),
    "map": ("map:", ""), "what": ("values:", ""), "period": ("period", "pixels"),
    "length": ("decay length", "pixels"), "k": ("", ""), "bit": ("bit of weight", ""),
    "code": ("code", ""), "device": ("parameter", ""), "effect": ("", ""),
}  # fmt: skip
"""Words and unit of the keys that state where a finding is ('where' in report.json)."""


def write_report(
    diagnosis: Diagnosis,
    folder: str | os.PathLike[str],
    *,
    provenance: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write report.json, report.html and, if matplotlib is installed, figures as PNG.

    Each file is written under a temporary name and then renamed, so that an interrupted run
    leaves no half-written file; existing files are replaced.

    Parameters
    ----------
    diagnosis : Diagnosis
        Result to report.
    folder : path-like
        Folder of the files, made if it does not exist.
    provenance : mapping, optional
        What made the report, its block of that name: see
        :func:`~bfsensor.diagnose.report.provenance.provenance_of`.

    Returns
    -------
    list of Path
        Files that were written.

    Raises
    ------
    OSError
        The folder cannot be made or written.

    Examples
    --------
    Read a report back and list the classes of effects found::

        write_report(diagnose(source, baseline), "out")
        report = json.loads(Path("out/report.json").read_text())
        print([effect["class"] for effect in report["effects"]])
    """
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    figures = draw_figures(diagnosis, out)
    written = [p for f in figures for p in f.files]
    report = diagnosis.to_report()
    report["figures"] = [p.name for p in written]
    report["provenance"] = dict(provenance or {})
    written.append(_write(out / "report.json", json.dumps(report, indent=1) + "\n"))
    page = to_html(diagnosis, figures, provenance=provenance)
    written.append(_write(out / "report.html", page))
    return written


def to_html(
    diagnosis: Diagnosis,
    figures: Sequence[Drawn],
    *,
    provenance: Mapping[str, Any] | None = None,
) -> str:
    """Make the page of a diagnosis as one HTML text with the figures embedded."""
    report = diagnosis.to_report()
    drawn = {f.name: f for f in figures}
    name = _text(diagnosis.campaign or "recordings")
    mood = "" if report["detected"] else " clear"
    parts = [
        _effects(diagnosis, report, drawn),
        _advice(report),
        _where(report),
        _held_out(report, drawn),
        _channels(diagnosis, report, drawn),
        _residuals(figures),
        _findings(report),
        _cosmetics(report),
        _not_tested(report),
        _notes(report),
        _provenance(provenance or {}),
    ]
    body = "".join(p for p in parts if p)
    return f"""<!doctype html>
<html lang=en><head><meta charset=utf-8>
<meta name=viewport content="width=device-width, initial-scale=1">
<title>{name}: diagnosis</title>
<style>{STYLE}</style></head><body>
<h1>{name}</h1>
<p class="said{mood}">{_text(report["said"])}</p>
<p class=facts>{_text(_facts(diagnosis, report))}</p>
{body}
</body></html>
"""


def _facts(diagnosis: Diagnosis, report: Mapping[str, Any]) -> str:
    """State the baseline, the exposures and the p-values of the comparison."""
    taken = ", ".join(f"{n} {k}" for k, n in report["exposures"].items())
    return (
        f"Baseline: {diagnosis.baseline}. "
        + (f"Exposures: {taken}. " if taken else "A reduced recording (no exposures). ")
        + "Probability that noise alone gives a deviation as large in any of all tests (family-wise "
        f"p): {said_family_p(report['p_value'])} (chi-squares alone {said_p(report['p_chi2'])}, scans "
        f"alone {said_p(report['p_scans'])}); below {report['alarm']:g} a difference counts as "
        f"detected. Amplifiers are counted from 1, columns, rows and exposures from 0. "
        f"bfsensor {report['version']}."
    )


def _effects(
    diagnosis: Diagnosis, report: Mapping[str, Any], drawn: Mapping[str, Drawn]
) -> str:
    """List the effects found with their parameters, and the probabilities of the classes."""
    if not report["effects"]:
        return ""
    units: dict[str, Mapping[str, str]] = {}
    if diagnosis.attribution is not None:
        units = {
            f.effect.word: {p.name: p.unit for p in f.effect.parameters}
            for f in diagnosis.attribution.found
        }
    blocks = []
    for effect in report["effects"]:
        word = effect["class"]
        title = word.replace("_", " ")
        kind = effect.get("law", effect.get("variant"))
        if kind:
            title += f", {kind.replace('_', ' ')}"
        words = PARAMETER_WORDS.get(word, {})
        rows = [
            [words.get(name, name), said_value(word, name, told["value"]),
             said_interval(told, "68"), said_interval(told, "95"),
             units.get(word, {}).get(name, ""), name]
            for name, told in effect["parameters"].items()
        ]  # fmt: skip
        titles = ["parameter", "value", "68 %", "95 %", "unit", "in report.json"]
        table = _table(titles, rows, numbers=(1, 2, 3))
        others = [w for w in effect.get("tied", ()) if w != word]
        tags = "".join(
            f"<span class='tag tied'>or {_text(w.replace('_', ' '))}</span>" for w in others
        )
        gain = effect.get("gain_chi2")
        if gain is not None and gain == gain:
            tags += f"<span class=tag>lowers chi-square by {gain:,.0f}</span>"
        source = (
            f"<p class=source>{_text(effect['source'])}</p>" if effect.get("source") else ""
        )
        plain = CLASS_WORDS.get(word, word)
        blocks.append(
            f"<div class=effect><h3>{_text(title)}</h3>"
            f"<p>{_text(plain[0].upper() + plain[1:])}.</p>{tags}{table if rows else ''}{source}</div>"
        )
    return f"<h2>Effects found</h2>{''.join(blocks)}{_small(drawn, 'classes')}"


def _advice(report: Mapping[str, Any]) -> str:
    """Recommend recordings that would separate classes these ones do not distinguish."""
    if not report["plan"]:
        return ""
    out = ["<h2>What to record next</h2>"]
    for block, said in zip(report["plan"], report["recommended_recordings"], strict=False):
        others = [
            [o["recording"].replace("_", " "), str(o["exposures"]), f"{o['expected_delta_chi2']:.3g}"]
            for o in block["others"]
        ]  # fmt: skip
        source = block.get("rule", {}).get("source", "")
        more = _table(
            ["other recording", "exposures", "expected chi-square difference"],
            others,
            (1, 2),
        )
        out.append(
            f"<p class=advice>{_text(said)}"
            + (f" <span class=source>({_text(source)})</span>" if source else "")
            + f"</p><details><summary>Other recordings that were considered</summary>{more}</details>"
        )
    return "".join(out)


def _where(report: Mapping[str, Any]) -> str:
    """Tabulate where the recordings differ from the baseline."""
    if not report["detected"]:
        return ""
    place = report["location"]
    words = {
        "lags": "lags (x, y) [pixel]", "flux_e": "charge per pixel, or per spot [e-]",
        "x": "columns", "y": "rows", "amps": "amplifiers", "wavelength": "wavelength [nm]",
        "exposures": "exposures",
    }  # fmt: skip
    rows = [["channels", ", ".join(NAMES.get(w, w) for w in place["channels"])]]
    for key, title in words.items():
        value = place[key]
        if not value:
            continue
        if key == "lags":
            told = ", ".join(f"({a}, {b})" for a, b in value[:12])
            told += " ..." if len(value) > 12 else ""
        elif key == "amps":
            told = ", ".join(str(v) for v in value)
        elif len(value) == 2:
            # The last column and row of a location is one past the end.
            last = value[1] - 1 if key in "xy" else value[1]
            told = f"{_thousands(value[0])} to {_thousands(last)}"
        else:
            told = ", ".join(_thousands(v) for v in value)
        rows.append([title, told])
    return f"<h2>Where the recordings differ</h2>{_table([], rows)}"


def _held_out(report: Mapping[str, Any], drawn: Mapping[str, Drawn]) -> str:
    """Compare chi-squares of held-out recordings without and with the effects."""
    held = report["heldout"]
    if held["chi2dof_before"] is None:
        return ""
    title = "<h2>Held-out recordings, which were not fitted</h2>"
    if not held["channels"] or held["chi2dof_after"] is None:
        return f"{title}<p>Chi-square per value {held['chi2dof_before']:.2f}; noise alone gives 1.</p>"
    rows = [
        [NAMES.get(w, w), f"{r['before']:.2f}", f"{r['after']:.2f}", str(r["values"])]
        for w, r in held["channels"].items()
    ]
    count = sum(r["values"] for r in held["channels"].values())
    rows.append(
        ["all", f"{held['chi2dof_before']:.2f}", f"{held['chi2dof_after']:.2f}", str(count)]
    )
    titles = [
        "channel", "chi-square per value, baseline", "with the effects", "number of values"
    ]  # fmt: skip
    table = _table(titles, rows, (1, 2, 3))
    return f"{title}{_small(drawn, 'heldout')}{table}"


def _channels(
    diagnosis: Diagnosis, report: Mapping[str, Any], drawn: Mapping[str, Drawn]
) -> str:
    """Tabulate chi-squares of the fitted recordings by channel."""
    attribution = diagnosis.attribution
    after = {} if attribution is None else attribution.mismatch.chi2
    both = attribution is not None and bool(attribution.found)
    rows, out = [], []
    for word, row in report["channels"].items():
        ratio = f"{row['chi2'] / max(row['dof'], 1e-9):.2f}"
        cells = [NAMES.get(word, word), f"{row['chi2']:.0f}", f"{row['dof']:.0f}", ratio]
        if both:
            square, dof = after.get(word, (0.0, 0.0))
            cells.append(f"{square / max(dof, 1e-9):.2f}")
        rows.append([*cells, said_p(row["p_value"])])
        out.append(row["p_value"] < 1e-4)
    titles = ["channel", "chi-square", "degrees of freedom", "their ratio"]
    titles += (["ratio with the effects"] if both else []) + ["p of the channel, baseline"]
    table = _table(titles, rows, tuple(range(1, len(titles))), out)
    return f"<h2>Fitted recordings</h2>{table}"


def _residuals(figures: Sequence[Drawn]) -> str:
    """Show the figures by channel, the baseline beside the fit with the effects."""
    shown = [f for f in figures if f.name not in ("classes", "heldout")]
    if not shown:
        return "<p>No figures: matplotlib is not installed.</p>"
    out = ["<h2>Residuals, channel by channel</h2>"]
    if any(f.after for f in shown):
        out.append(
            "<p>Pull: residual over its standard error. Both figures of a pair have the same scales. "
            "Where a figure stands alone, the effects change no pull visibly.</p>"
        )
    for figure in shown:
        images = [("Baseline", figure.before)]
        if figure.after is not None:
            images.append(("With the effects", figure.after))
        inside = "".join(
            f"<div>{f'<h3>{title}</h3>' if figure.after else ''}{_image(path, figure.caption)}</div>"
            for title, path in images
        )
        single = "" if figure.after else " single"
        out.append(
            f"<figure><div class='pair{single}'>{inside}</div>"
            f"<figcaption>{_text(figure.caption)}</figcaption></figure>"
        )
    return "".join(out)


def _findings(report: Mapping[str, Any]) -> str:
    """Tabulate the largest deviations that scans of the baseline's residuals found."""
    rows = [
        [NAMES.get(f["channel"], f["channel"]), SCAN_WORDS.get(f["family"], f["family"]),
         f"{f['z']:.1f}", said_p(f["p_value"]), _describe(f["where"], f["channel"])]
        for f in report["findings"][:15]
    ]  # fmt: skip
    if not rows:
        return ""
    titles = ["channel", "scan", "standard deviations", "family-wise p", "where"]
    return (
        "<h2>Largest deviations from the baseline</h2><details open><summary>At most 15, the largest "
        f"first</summary>{_table(titles, rows, (2, 3))}</details>"
    )


def _cosmetics(report: Mapping[str, Any]) -> str:
    """Tabulate defects of the sensor that were repaired before anything was measured."""
    if not report["cosmetics"]:
        return ""
    rows = [
        [
            c["kind"].replace("_", " "), ", ".join(map(str, c["amps"])) or "all",
            "{} to {}".format(c["x"][0], c["x"][1] - 1), "{} to {}".format(c["y"][0], c["y"][1] - 1),
            f"{c['size']:.3g} {c['unit']}", f"{c['z']:.0f}",
        ]
        for c in report["cosmetics"]
    ]  # fmt: skip
    titles = ["defect", "amplifier", "columns", "rows", "size", "standard deviations"]
    return (
        "<h2>Defects of the sensor</h2><p>Repaired in all exposures before anything was measured, "
        "or, where the bench causes them, subtracted and fitted; "
        f"they are no part of the mismatch.</p>{_table(titles, rows, (4, 5))}"
    )


def _not_tested(report: Mapping[str, Any]) -> str:
    """Tabulate classes that these recordings are not sensitive to."""
    if not report["not_tested"]:
        return ""
    groups: dict[tuple[str, str], list[str]] = {}
    for entry in report["not_tested"]:
        key = entry["because"], entry["recording"]
        groups.setdefault(key, []).append(entry["class"].replace("_", " "))
    rows = [
        [", ".join(words), _missing(because), recording]
        for (because, recording), words in groups.items()
    ]
    table = _table(["class", "reason", "recordings that would show it"], rows)
    return f"<h2>What was not tested</h2>{table}"


def _provenance(told: Mapping[str, Any]) -> str:
    """Table of the provenance: command, time, versions, and hashes of the files that were read."""
    if not told:
        return ""
    plain = {k: v for k, v in told.items() if not isinstance(v, Mapping)}
    rows = "".join(
        f"<tr><th>{_text(k.replace('_', ' '))}</th><td>{_text(str(v))}</td></tr>"
        for k, v in {**plain, **told.get("versions", {})}.items()
    )
    files = "".join(
        f"<tr><th>{_text(name)}</th><td><code>{_text(value)}</code></td></tr>"
        for name, value in told.get("files", {}).items()
    )
    return (
        f"<details><summary>What made this report</summary><table>{rows}</table>"
        f"<p>SHA-256 of the files read</p><table>{files}</table></details>"
    )


def _notes(report: Mapping[str, Any]) -> str:
    notes = "".join(f"<li>{_text(n)}</li>" for n in report["notes"])
    return f"<h2>Notes</h2><ul class=notes>{notes}</ul>" if notes else ""


def _missing(because: str) -> str:
    """Replace the names of channels in a reason by plain words."""
    for word, name in NAMES.items():
        because = because.replace(word, name)
    return because


def _table(
    titles: Sequence[str],
    rows: Iterable[Sequence[str]],
    numbers: Sequence[int] = (),
    out: Sequence[bool] = (),
) -> str:
    """Make a table of plain texts; ``numbers``: numeric columns, ``out``: rows to highlight."""

    def cells(values: Sequence[str], tag: str) -> str:
        return "".join(
            f"<{tag}{' class=n' if n in numbers else ''}>{_text(v)}</{tag}>"
            for n, v in enumerate(values)
        )

    marks = [*out, *[False] * 1000]
    body = "".join(
        f"<tr{' class=out' if mark else ''}>{cells(r, 'td')}</tr>"
        for r, mark in zip(rows, marks, strict=False)
    )
    head = f"<tr>{cells(titles, 'th')}</tr>" if titles else ""
    return f"<div class=wide><table>{head}{body}</table></div>"


def _small(drawn: Mapping[str, Drawn], name: str) -> str:
    """Embed one figure of the summary, if it was drawn."""
    if name not in drawn:
        return ""
    caption = drawn[name].caption
    return (
        f"<figure class=small>{_image(drawn[name].before, caption)}"
        f"<figcaption>{_text(caption)}</figcaption></figure>"
    )


def _image(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img alt="{_text(caption)}" src="data:image/png;base64,{data}">'


def _text(value: str) -> str:
    return html.escape(str(value))


def _thousands(value: float) -> str:
    """Print a number without needless digits."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _describe(where: Mapping[str, Any], channel: str) -> str:
    """Describe in a line where a finding is, with units."""
    parts = []
    for key, value in where.items():
        title, unit = WHERE_WORDS.get(key, (key, ""))
        if key == "level" and channel == "spot":
            title, unit = "flux", "e-"
        if key == "k":
            title = "lag in readout order" if channel == "bias_cov" else "overscan pixel"
        if key in ("amp", "other"):
            parts.append(
                "all amplifiers" if value == "all" else f"{title} {int(value) + 1}"
            )
        elif key == "power":
            laws = ("independent of the level", "proportional to the level")
            parts.append(laws[value] if value < 2 else f"{title} {value}")
        elif key == "lags":
            shown = ", ".join(f"({i}, {j})" for i, j in value[:4])
            parts.append(f"{title} {shown}{' ...' if len(value) > 4 else ''}")
        elif isinstance(value, list) and len(value) == 2:
            # The last column and row of a place is one past the end.
            low, high = value[0], value[1] - 1 if key in "xy" else value[1]
            span = (
                _thousands(low)
                if low == high
                else f"{_thousands(low)} to {_thousands(high)}"
            )
            parts.append(f"{title} {span} {unit}".strip())
        elif isinstance(value, float):
            parts.append(f"{title} {_thousands(value)} {unit}".strip())
        else:
            parts.append(f"{title} {value} {unit}".strip())
    return ", ".join(parts)


def _write(path: Path, text: str) -> Path:
    with written_whole(path, DiagnosisError) as beside:
        beside.write_text(text, encoding="utf-8")
    return path
