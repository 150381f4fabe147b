"""Draw the figures of a report: residuals by channel, of the baseline and with the effects."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.kinds import KINDS
from bfsensor.diagnose.kinds.channel_kind import Picture
from bfsensor.diagnose.report.class_words import NAMES
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.plots import residuals as show
from bfsensor.plots.style import save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS = 130
"""Resolution of the figures [dots per inch].  Chosen: half a page wide they are sharp on screens and
paper; twice as many make report.html about four times as large."""

VISIBLE = 0.2
"""Change of a pull [standard errors] from which on a second figure, with the effects, is drawn.
Chosen: a fifth of an error bar is about the size of a mark; twice as large, fewer figures are pairs."""

SHOWN = 0.02
"""Probability from which on a class is drawn.  Chosen: where a named class is wrong, each of about 40
other classes has 0.005 to 0.01; half as large, bars of all of them may be drawn."""


class Drawn(NamedTuple):
    """Files of one figure of a report.

    Attributes
    ----------
    name, caption : str
        File name without its ending, and caption.
    before : Path
        Figure of the baseline, or the only one.
    after : Path or None
        Figure with the effects, on the same scales; None where they change nothing visible.
    """

    name: str
    caption: str
    before: Path
    after: Path | None = None

    @property
    def files(self) -> list[Path]:
        """Paths of the figures that were drawn, one or two."""
        return [p for p in (self.before, self.after) if p is not None]


SAME_PIXELS = (
    " Flats against position are of the same pixels, whose own response is the same in all flats: "
    "a pattern that held-out flats repeat is real, but not more likely to be the named effect."
)
"""Limit of held-out flats as evidence, added to their figure's caption."""


def draw_figures(diagnosis: Diagnosis, folder: Path) -> list[Drawn]:
    """Draw the figures that the channels allow into a folder; none if matplotlib is not installed."""
    try:
        import matplotlib
    except ImportError:
        return []
    del matplotlib
    out = []
    for name, picture in _summary(diagnosis).items():
        figure = _figure(picture)
        out.append(
            Drawn(name, picture.caption, save_figure(figure, folder / f"{name}.png", DOTS))
        )
    attribution = diagnosis.attribution
    before = _pictures(diagnosis.fit, diagnosis.mismatch.chi2)
    after: Mapping[str, Picture] = {}
    if attribution is not None and attribution.found:
        after = _pictures(attribution.fit, attribution.mismatch.chi2)
    changed = _changed(diagnosis)
    # Figures that the effects change come first.
    for name, picture in sorted(before.items(), key=lambda t: t[0] not in changed):
        other = after.get(name) if name in changed else None
        figures = [_figure(p) for p in (picture, other) if p is not None]
        if len(figures) == 2:
            _share(*figures)
        paths = [
            save_figure(f, folder / f"{name}{end}.png", DOTS)
            for f, end in zip(figures, ("", "_with_effects"), strict=False)
        ]
        out.append(Drawn(name, picture.caption, *paths))
    return out


def _changed(diagnosis: Diagnosis) -> set[str]:
    """Names of the figures that the effects change visibly."""
    out = {"channels", "device"}
    attribution = diagnosis.attribution
    if attribution is not None:
        away = np.abs(diagnosis.fit.residuals - attribution.fit.residuals)
        for word in {c.word for c in diagnosis.fit.channels}:
            if away[diagnosis.fit.of(word)].max(initial=0.0) > VISIBLE:
                out.add(word)
    return out


def _summary(diagnosis: Diagnosis) -> dict[str, Picture]:
    """Figures of the summary: probabilities of the classes, and held-out chi-squares."""
    out: dict[str, Picture] = {}
    attribution = diagnosis.attribution
    if attribution is None:
        return out
    shown = {w: p for w, p in attribution.probability.items() if p >= SHOWN}
    if shown:
        tied = [w for f in attribution.found if len(f.tied) > 1 for w in f.tied]
        height = 0.7 + 0.32 * len(shown)
        out["classes"] = Picture(
            "Probability that the baseline lacks an effect of each class, by the evidence and by how "
            "often a class named first was true in campaigns of an independent bench; classes below "
            f"{100 * SHOWN:g} % share the rest"
            + ("; classes that these recordings do not distinguish are in orange." if tied else "."),
            (5.2, height), (lambda ax: show.draw_classes(shown, ax, tied=tied),),
        )  # fmt: skip
    held = {
        NAMES.get(w, w): (b / n, a / n, n)
        for w, (b, a, n) in attribution.heldout.items() if n
    }  # fmt: skip
    if attribution.found and held:
        out["heldout"] = Picture(
            "Held-out recordings: chi-square per value with the baseline and with the effects. Grey "
            "bars: range of 95 % of cases with noise alone."
            + (SAME_PIXELS if NAMES["flat_map"] in held else ""),
            (6.2, 0.9 + 0.36 * len(held)), (lambda ax: show.draw_held_out(held, ax),),
        )  # fmt: skip
    return out


def _pictures(
    fit: BaselineFit, chi2: Mapping[str, tuple[float, float]]
) -> dict[str, Picture]:
    """Figures of the residuals of one fit, by channel."""
    found = {}
    for word in dict.fromkeys(c.word for c in fit.channels):
        parts = [
            (c, fit.residuals[s : s + len(c)])
            for c, s in zip(fit.channels, fit.starts, strict=False)
            if c.word == word
        ]
        found[word] = max(parts, key=lambda p: len(p[0]))
    out: dict[str, Picture] = {}
    out["channels"] = Picture(
        "Excess of each channel's chi-square over its degrees of freedom (dof), in standard "
        "deviations, with all free parameters fitted. Grey band: 3 standard deviations.",
        (5.2, 3.6), (lambda ax: show.draw_channels(_named(chi2), ax),),
    )  # fmt: skip
    errors = {
        n.removeprefix("device "): float(e)
        for n, e in zip(fit.names, fit.errors, strict=True) if n.startswith("device ")
    }  # fmt: skip
    if fit.pulls:
        out["device"] = Picture(
            "Fitted device parameters less their nominal values, in standard deviations of their "
            "priors (grey band: 1).", (5.2, 0.9 + 0.32 * len(fit.pulls)),
            (lambda ax: show.draw_parameters(fit.pulls, errors, ax),),
        )  # fmt: skip
    for word, kind in KINDS.items():
        picture = kind.picture(*found[word]) if word in found else None
        if picture is not None:
            out[word] = picture
    return out


def _named(chi2: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    return {NAMES.get(w, w): v for w, v in chi2.items()}


def _figure(picture: Picture) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=picture.size, layout="constrained")
    for n, part in enumerate(picture.parts):
        part(figure.add_subplot(len(picture.parts), 1, n + 1))
    return figure


def _share(one: Figure, other: Figure) -> None:
    """Give both figures the same scales, so that smaller residuals look smaller."""
    for a, b in zip(one.axes, other.axes, strict=True):
        for image, like in zip(a.images, b.images, strict=True):
            ends = [f(*v) for f, v in zip((min, max), zip(image.get_clim(), like.get_clim(),
                                                          strict=True), strict=True)]  # fmt: skip
            image.set_clim(*ends)
            like.set_clim(*ends)
        if a.images or not (a.lines or a.containers or a.collections):
            continue
        for axis in "xy":
            ends_a, ends_b = (getattr(ax, f"get_{axis}lim")() for ax in (a, b))
            both = min(ends_a[0], ends_b[0]), max(ends_a[1], ends_b[1])
            for ax in (a, b):
                getattr(ax, f"set_{axis}lim")(*both)
