"""report.json and report.html of a diagnosis, written whole or not at all."""

from __future__ import annotations

import base64
import html
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bfsensor.diagnose.report.class_words import CLASS_WORDS
from bfsensor.diagnose.report.diagnosis_result import NAMES, Diagnosis
from bfsensor.diagnose.report.report_figures import Drawn, draw_figures
from bfsensor.diagnose.report.report_style import STYLE


def write_report(diagnosis: Diagnosis, folder: str | os.PathLike[str]) -> list[Path]:
    """Write report.json, report.html and, where matplotlib is there, figures.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.
    folder : path-like
        Made if it is not there.

    Returns
    -------
    list of Path
        What was written.
    """
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    figures = draw_figures(diagnosis, out)
    written = [p for f in figures for p in f.files]
    report = diagnosis.to_report()
    report["figures"] = [p.name for p in written]
    written.append(_write(out / "report.json", json.dumps(report, indent=1) + "\n"))
    written.append(_write(out / "report.html", to_html(diagnosis, figures)))
    return written


def to_html(diagnosis: Diagnosis, figures: Sequence[Drawn]) -> str:
    """One file that needs no other: figures are inside."""
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
        _not_tested(report),
        _notes(report),
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
    """What was held against what."""
    taken = ", ".join(f"{n} {k}" for k, n in report["exposures"].items())
    return (
        f"Baseline: {diagnosis.baseline}. "
        + (f"Exposures: {taken}. " if taken else "A reduced recording. ")
        + f"Family-wise p {report['p_value']:.2g} (chi-squares {report['p_chi2']:.2g}, scans "
        f"{report['p_scans']:.2g}); below {report['alarm']:g} counts as detected. "
        f"bfsensor {report['version']}."
    )


def _effects(
    diagnosis: Diagnosis, report: Mapping[str, Any], drawn: Mapping[str, Drawn]
) -> str:
    """What explains it: each effect with its parameters, and the classes' probabilities."""
    if not report["effects"]:
        return ""
    units: dict[str, Mapping[str, str]] = {}
    if diagnosis.attribution is not None:
        units = {
            f.effect.word: {p.name: p.unit for p in f.effect.parameters}
            for f in diagnosis.attribution.found
        }
    cards = []
    for effect in report["effects"]:
        word = effect["class"]
        title = word.replace("_", " ")
        if "variant" in effect:
            title += f", {effect['variant']}"
        rows = [
            [name, *(_number(told.get(k)) for k in ("value", "lo68", "hi68", "lo95", "hi95")),
             units.get(word, {}).get(name, "")]
            for name, told in effect["parameters"].items()
        ]  # fmt: skip
        cells = [[r[0], r[1], _range(r[2], r[3]), _range(r[4], r[5]), r[6]] for r in rows]
        table = _table(
            ["parameter", "value", "68 %", "95 %", "unit"], cells, numbers=(1, 2, 3)
        )
        others = [w for w in effect.get("tied", ()) if w != word]
        tags = "".join(
            f"<span class='tag tied'>or {_text(w.replace('_', ' '))}</span>" for w in others
        )
        gain = effect.get("gain_chi2")
        if gain is not None and gain == gain:
            tags += f"<span class=tag>chi-square falls by {gain:,.0f}</span>"
        source = (
            f"<p class=source>{_text(effect['source'])}</p>" if effect.get("source") else ""
        )
        plain = CLASS_WORDS.get(word, word)
        cards.append(
            f"<div class=card><h3>{_text(title)}</h3>"
            f"<p>{_text(plain[0].upper() + plain[1:])}.</p>{tags}{table if rows else ''}{source}</div>"
        )
    return f"<h2>What explains it</h2>{''.join(cards)}{_small(drawn, 'classes')}"


def _advice(report: Mapping[str, Any]) -> str:
    """Ties, and what to record."""
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
            ["other recordings", "exposures", "expected chi-square difference"],
            others,
            (1, 2),
        )
        out.append(
            f"<p class=advice>{_text(said)}"
            + (f" <span class=source>({_text(source)})</span>" if source else "")
            + f"</p><details><summary>What else was weighed</summary>{more}</details>"
        )
    return "".join(out)


def _where(report: Mapping[str, Any]) -> str:
    """Where the recordings differ."""
    if not report["detected"]:
        return ""
    place = report["location"]
    words = {
        "lags": "lags (x, y)", "flux_e": "flux [e-]", "x": "columns", "y": "rows",
        "amps": "amplifiers", "wavelength": "wavelength [nm]", "exposures": "exposures",
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
            told = f"{_thousands(value[0])} to {_thousands(value[1])}"
        else:
            told = ", ".join(_thousands(v) for v in value)
        rows.append([title, told])
    return f"<h2>Where the recordings differ</h2>{_table([], rows)}"


def _held_out(report: Mapping[str, Any], drawn: Mapping[str, Drawn]) -> str:
    """Before and after on recordings that were not fitted."""
    held = report["heldout"]
    if held["chi2dof_before"] is None:
        return ""
    title = "<h2>On recordings that were not fitted</h2>"
    if not held["channels"] or held["chi2dof_after"] is None:
        return f"{title}<p>Chi-square per value {held['chi2dof_before']:.2f}.</p>"
    rows = [
        [NAMES.get(w, w), f"{r['before']:.2f}", f"{r['after']:.2f}", str(r["values"])]
        for w, r in held["channels"].items()
    ]
    count = sum(r["values"] for r in held["channels"].values())
    rows.append(
        ["all", f"{held['chi2dof_before']:.2f}", f"{held['chi2dof_after']:.2f}", str(count)]
    )
    table = _table(["channel", "baseline", "with the effects", "values"], rows, (1, 2, 3))
    return f"{title}{_small(drawn, 'heldout')}{table}"


def _channels(
    diagnosis: Diagnosis, report: Mapping[str, Any], drawn: Mapping[str, Drawn]
) -> str:
    """Chi-squares of what was fitted."""
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
        rows.append([*cells, f"{row['p_value']:.2g}"])
        out.append(row["p_value"] < 1e-4)
    titles = ["channel", "chi-square", "dof", "ratio"]
    titles += (["with the effects"] if both else []) + ["p of the channel alone"]
    table = _table(titles, rows, tuple(range(1, len(titles))), out)
    return f"<h2>Channels as fitted</h2>{table}"


def _residuals(figures: Sequence[Drawn]) -> str:
    """Figures by channel, the baseline's and with the effects beside it."""
    shown = [f for f in figures if f.name not in ("classes", "heldout")]
    if not shown:
        return "<p>No figures: matplotlib is not installed.</p>"
    out = ["<h2>Residuals, channel by channel</h2>"]
    if any(f.after for f in shown):
        out.append(
            "<p>Both figures of a pair have the same scales. Where one stands alone, the effects "
            "change nothing that could be seen.</p>"
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
    """What the scans of the baseline's residuals found."""
    rows = [
        [NAMES.get(f["channel"], f["channel"]), f["family"], f"{f['z']:.1f}",
         f"{f['p_value']:.1g}", _describe(f["where"])]
        for f in report["findings"][:15]
    ]  # fmt: skip
    if not rows:
        return ""
    titles = ["channel", "scan", "deviates", "family-wise p", "where"]
    return (
        "<h2>What stands out of the baseline</h2><details open><summary>The farthest of all scans"
        f"</summary>{_table(titles, rows, (2, 3))}</details>"
    )


def _not_tested(report: Mapping[str, Any]) -> str:
    """Classes that the recordings cannot show."""
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
    table = _table(["not seen", "because", "what would show it"], rows)
    return f"<h2>What was not tested</h2>{table}"


def _notes(report: Mapping[str, Any]) -> str:
    notes = "".join(f"<li>{_text(n)}</li>" for n in report["notes"])
    return f"<h2>Notes</h2><ul class=notes>{notes}</ul>" if notes else ""


def _missing(because: str) -> str:
    """Reason with channels in plain words."""
    for word, name in NAMES.items():
        because = because.replace(word, name)
    return because


def _table(
    titles: Sequence[str],
    rows: Iterable[Sequence[str]],
    numbers: Sequence[int] = (),
    out: Sequence[bool] = (),
) -> str:
    """Rows of plain text; which columns are numbers, which rows stand out."""

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
    """One figure of the summary."""
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


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def _range(low: str, high: str) -> str:
    return f"{low} to {high}" if low else "held"


def _thousands(value: float) -> str:
    """Number without needless digits."""
    return f"{value:,.0f}".replace(",", "\u202f") if abs(value) >= 1000 else f"{value:.4g}"


def _describe(where: Mapping[str, Any]) -> str:
    """Where a finding is, in a line."""
    parts = []
    for key, value in where.items():
        if isinstance(value, float):
            parts.append(f"{key} {value:.4g}")
        elif isinstance(value, list) and len(value) == 2 and not isinstance(value[0], list):
            parts.append(f"{key} {value[0]:.4g} to {value[1]:.4g}")
        else:
            parts.append(f"{key} {value}")
    return ", ".join(parts)


def _write(path: Path, text: str) -> Path:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)
    return path
