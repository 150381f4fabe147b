"""report.json, report.html and the figures of a diagnosis, written whole or not at all."""

from __future__ import annotations

import base64
import html
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor import show_mismatch as show
from bfsensor.diagnose.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.diagnosis import NAMES, Diagnosis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STYLE = """
body { font: 16px/1.5 Georgia, serif; color: #222; max-width: 60em; margin: 2em auto; padding: 0 1em; }
h1, h2 { font-family: Helvetica, Arial, sans-serif; font-weight: 600; line-height: 1.2; }
h2 { margin-top: 2em; border-bottom: 1px solid #ddd; }
.said { font-size: 1.15em; background: #f4f1ea; border-left: 5px solid #b6873a; padding: .8em 1.2em; }
.said.clear { border-color: #4a8f5a; background: #eef5ef; }
table { border-collapse: collapse; font: 14px/1.4 Helvetica, Arial, sans-serif; }
td, th { padding: .25em .9em .25em 0; text-align: left; border-bottom: 1px solid #eee; }
td.n { text-align: right; font-variant-numeric: tabular-nums; }
tr.out td { color: #a4221a; font-weight: 600; }
figure { margin: 1.5em 0; } img { max-width: 100%; } figcaption { color: #555; font-size: .9em; }
.notes { color: #555; font-size: .9em; }
"""


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
    written = [*figures.values()]
    report = diagnosis.to_report()
    report["figures"] = [p.name for p in written]
    written.append(_write(out / "report.json", json.dumps(report, indent=1) + "\n"))
    written.append(_write(out / "report.html", to_html(diagnosis, figures)))
    return written


def draw_figures(diagnosis: Diagnosis, folder: Path) -> dict[str, Path]:
    """Draw what the channels allow; gives caption and file.  Nothing without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return {}
    fit = diagnosis.fit
    found: dict[str, tuple[Channel, NDArray[np.float64]]] = {}
    for word in dict.fromkeys(c.word for c in fit.channels):
        parts = [
            (c, fit.residuals[s : s + len(c)])
            for c, s in zip(fit.channels, fit.starts, strict=False)
            if c.word == word
        ]
        found[word] = max(parts, key=lambda p: len(p[0]))
    out: dict[str, Path] = {}

    def add(
        name: str, caption: str, size: tuple[float, float], *parts: Callable[[Axes], None]
    ) -> None:
        figure = Figure(figsize=size, layout="constrained")
        for n, part in enumerate(parts):
            part(figure.add_subplot(1, len(parts), n + 1))
        path = folder / f"{name}.png"
        temporary = path.with_suffix(".tmp.png")
        figure.savefig(temporary, dpi=110)
        os.replace(temporary, path)
        out[caption] = path

    errors = {
        n.removeprefix("device "): float(e)
        for n, e in zip(fit.names, fit.errors, strict=True) if n.startswith("device ")
    }  # fmt: skip
    first: list[Callable[[Axes], None]] = [
        lambda ax: show.draw_channels(diagnosis.mismatch.chi2, ax)
    ]
    if fit.pulls:
        first.append(lambda ax: show.draw_parameters(fit.pulls, errors, ax))
    add("channels", "How far each channel is from the baseline, all that may float fitted; and the "
        "device's parameters against its card.", (10, 4), *first)  # fmt: skip
    if "flat_cov" in found:
        channel, pulls = found["flat_cov"]
        lags = [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2)]
        caption = "Covariances of flats: pulls by lag"
        panels: list[Callable[[Axes], None]] = [
            lambda ax: show.draw_lags(channel.axes, pulls, ax)
        ]
        if channel.unit != PER_ELECTRON:
            caption += ", weighted by the square of the level, and of the nearest lags against level"
            panels.append(
                lambda ax: show.draw_lag_levels(channel.axes, pulls, ax, lags=lags)
            )
        add("flat_cov", f"{caption}.", (5 * len(panels), 4), *panels)
    if "flat_mean" in found:
        channel_m, pulls_m = found["flat_mean"]
        left = channel_m.unwhiten(pulls_m) / np.maximum(channel_m.values, 1e-9)
        add("flat_mean", "Means of flats against exposure time and lamp.", (6, 3.6),
            lambda ax: show.draw_means(channel_m.axes, left, ax))  # fmt: skip
    for word in ("serial_overscan", "parallel_overscan"):
        if word in found:
            one = found[word][0]
            add(word, f"{NAMES[word].capitalize()}: mean profile of the brightest flats.", (6, 3.6),
                lambda ax, c=one: show.draw_overscan(c.axes, c.values, c.errors, ax))  # type: ignore[misc]  # fmt: skip
    if "flat_map" in found:
        channel_p, pulls_p = found["flat_map"]
        add("flat_map", "Flats against position, the light's smooth shape taken off: blocks, and "
            "columns and rows.", (10, 4),
            lambda ax: show.draw_map(channel_p.axes, pulls_p, ax, name="all"),
            lambda ax: show.draw_profile(channel_p.axes, pulls_p, ax, name="all"))  # fmt: skip
    if "spot" in found:
        channel_s, pulls_s = found["spot"]
        add("spot", "Spots: widths, flux, asymmetry and wings.", (7, 4),
            lambda ax: show.draw_spots(channel_s.axes, pulls_s, ax))  # fmt: skip
    if "bias_cov" in found:
        channel_n, pulls_n = found["bias_cov"]
        add("bias_cov", "Noise in readout order.", (6, 3.6),
            lambda ax: show.draw_noise(channel_n.axes, pulls_n, ax))  # fmt: skip
    return out


def to_html(diagnosis: Diagnosis, figures: dict[str, Path]) -> str:
    """One file that needs no other: figures are inside."""
    report = diagnosis.to_report()
    text = html.escape
    rows = []
    for word, row in report["channels"].items():
        ratio = row["chi2"] / max(row["dof"], 1e-9)
        out = row["p_value"] < 1e-4
        rows.append(
            f"<tr{' class=out' if out else ''}><td>{text(NAMES.get(word, word))}</td>"
            f"<td class=n>{row['chi2']:.0f}</td><td class=n>{row['dof']:.0f}</td>"
            f"<td class=n>{ratio:.2f}</td><td class=n>{row['p_value']:.2g}</td></tr>"
        )
    found = "".join(
        f"<tr><td>{text(NAMES.get(f['channel'], f['channel']))}</td><td>{text(f['family'])}</td>"
        f"<td class=n>{f['z']:.1f}</td><td class=n>{f['p_value']:.1g}</td>"
        f"<td>{text(_describe(f['where']))}</td></tr>"
        for f in report["findings"][:15]
    )
    heldout = report["heldout"]["chi2dof_before"]
    pictures = "".join(
        f'<figure><img alt="{text(caption)}" src="data:image/png;base64,'
        f'{base64.b64encode(path.read_bytes()).decode()}"><figcaption>{text(caption)}</figcaption></figure>'
        for caption, path in figures.items()
    )
    notes = "".join(f"<li>{text(n)}</li>" for n in report["notes"])
    if notes:
        notes = f"<h2>Notes</h2><ul class=notes>{notes}</ul>"
    if found:
        titles = "<tr><th>channel<th>scan<th>deviates<th>family-wise p<th>where</tr>"
        found = f"<h2>What stands out</h2><table>{titles}{found}</table>"
    head = "<tr><th>channel<th>chi-square<th>dof<th>ratio<th>p of the channel alone</tr>"
    mood = "" if report["detected"] else " clear"
    unseen = ""
    if heldout is not None:
        unseen = f"Flats that were not fitted: chi-square per value {heldout:.2f}."
    taken = ", ".join(f"{n} {k}" for k, n in report["exposures"].items())
    exposures = f"Exposures: {taken}." if taken else "A reduced recording."
    return f"""<!doctype html>
<html lang=en><meta charset=utf-8><title>{text(diagnosis.campaign)}: diagnosis</title>
<style>{STYLE}</style>
<h1>{text(diagnosis.campaign)}</h1>
<p class="said{mood}">{text(report["said"])}</p>
<p>Baseline: {text(diagnosis.baseline)}. {text(exposures)}
{unseen}
Family-wise p: {report["p_value"]:.2g} (chi-squares {report["p_chi2"]:.2g}, scans
{report["p_scans"]:.2g}); below {report["alarm"]:g} counts as detected.</p>
<h2>Channels</h2>
<table>{head}{"".join(rows)}</table>
{found}
<h2>Residuals of the baseline</h2>
{pictures or "<p>No figures: matplotlib is not installed.</p>"}
{notes}
</html>
"""


def _describe(where: dict[str, object]) -> str:
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
