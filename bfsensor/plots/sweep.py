"""Figures of device sweeps: the response a_ij of flats against a swept quantity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import SweepError
from bfsensor.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    electrons_text,
    import_matplotlib,
    new_figure,
)
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN = (
    ("(0, 0)", 0, 0, BLACK, "o"),
    ("(1, 0) along x", 1, 0, ORANGE, "s"),
    ("(0, 1) along y", 0, 1, BLUE, "^"),
    ("(1, 1)", 1, 1, GREEN, "D"),
    ("(2, 0)", 2, 0, PURPLE, "v"),
    ("(0, 2)", 0, 2, SKY, "P"),
)
"""Label, lag in x, lag in y, colour and marker of the a_ij that are drawn.

Chosen: the lags within 2 pixels along the axes, and (1, 1)."""

_LINE_STYLES: tuple[Any, ...] = ("-", "--", "-.", ":")


class SweepResult(Protocol):
    """Protocol of a sweep that can be drawn, such as :class:`bfsensor.sweeps.rows.DeviceSweep`.

    Attributes
    ----------
    rows : astropy.table.Table
        One row a point, with the swept quantities as columns; ``meta['level']`` in electrons.
    swept : sequence of str
        Names of the swept columns.
    refused : ndarray of bool
        Whether each point was refused.
    a, errors : ndarray, shape (points, lags y, lags x)
        a_ij and their numerical errors [1/e-].
    """

    rows: Any

    @property
    def swept(self) -> Sequence[str]:
        """Names of the swept columns."""

    @property
    def refused(self) -> NDArray[np.bool_]:
        """Whether each point was refused."""

    @property
    def a(self) -> FloatArray:
        """Differential responses [1/e-]."""

    @property
    def errors(self) -> FloatArray:
        """Numerical errors of the responses [1/e-]."""


def draw_sweep(
    sweep: SweepResult, ax: Axes, *, against: str | None = None, relative: bool = False
) -> None:
    """Draw the nearest a_ij against a swept quantity.

    Parameters
    ----------
    sweep : SweepResult
        The sweep.  Refused points are left out; each set of values of the other swept quantities
        has a line style of its own.
    ax : matplotlib.axes.Axes
        Axes to draw into; y is the absolute value of a_ij [1e-6/e-] (a_00 is negative) with its
        numerical error, or the change from the first point of each line [%].
    against : str, optional
        Name of the swept column for x; by default the one with most values.
    relative : bool
        Draw the changes.  They are drawn without errors, which are not known: most of the
        numerical error of an a_ij is common to all points.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    SweepError
        ``against`` was not swept, or all points were refused.
    """
    import_matplotlib()
    from matplotlib.lines import Line2D

    rows = sweep.rows
    if against is None:
        against = max(sweep.swept, key=lambda name: len(np.unique(rows[name])))
    if against not in sweep.swept:
        raise SweepError(
            f"against = {against!r} was not swept; it must be one of {', '.join(sweep.swept)}"
        )
    good = ~sweep.refused
    if not good.any():
        raise SweepError(
            f"all points of the sweep were refused, the first because {rows['reason'][0]}"
        )
    others = [
        name for name in sweep.swept if name != against and len(np.unique(rows[name])) > 1
    ]
    labels = np.array([
        ", ".join(f"{n} {row[n]:g} {rows[n].unit or ''}".strip() for n in others) for row in rows
    ])  # fmt: skip
    lines = list(dict.fromkeys(labels[good]))
    a, errors = sweep.a, sweep.errors
    for k, label in enumerate(lines):
        use = np.flatnonzero(good & (labels == label))
        use = use[np.argsort(np.asarray(rows[against])[use], kind="stable")]
        first = np.flatnonzero(good & (labels == label))[0]
        x = np.asarray(rows[against], float)[use]
        for _, i, j, colour, marker in _SHOWN:
            style = {
                "color": colour, "marker": marker, "markersize": 4, "linewidth": 1.3,
                "linestyle": _LINE_STYLES[k % len(_LINE_STYLES)],
            }  # fmt: skip
            if relative:
                ax.plot(x, 100 * (a[use, j, i] / a[first, j, i] - 1), **style)
            else:
                size, error = 1e6 * np.abs(a[use, j, i]), 1e6 * errors[use, j, i]
                ax.errorbar(x, size, np.nan_to_num(error), capsize=2, **style)
    unit = rows[against].unit
    ax.set_xlabel(f"{against.replace('_', ' ')}" + (f" [{unit}]" if unit else ""))
    if relative:
        ax.axhline(0.0, color=GREY, linewidth=0.8, zorder=0)
        ax.set_ylabel("change from the first point [%]")
    else:
        ax.set_yscale("log")
        ax.set_ylabel(r"$|a_{ij}|$ [$10^{-6}$ / e$^-$]")
    handles = [
        Line2D([], [], color=c, marker=m, markersize=4, label=n) for n, _, _, c, m in _SHOWN
    ]
    if len(lines) > 1:
        handles += [
            Line2D([], [], color=GREY, linestyle=_LINE_STYLES[k % len(_LINE_STYLES)], label=text)
            for k, text in enumerate(lines)
        ]  # fmt: skip
    ax.legend(handles=handles, fontsize=8, frameon=False, title="lag (i, j)")


def figure_for_sweep(sweep: SweepResult, *, against: str | None = None) -> Figure:
    """Draw a sweep on one page: absolute values of a_ij, and their changes.

    Parameters
    ----------
    sweep : SweepResult
        The sweep.
    against : str, optional
        Name of the swept column for x; by default the one with most values.

    Returns
    -------
    figure : matplotlib.figure.Figure
        Page with two panels, to be written with ``savefig``.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    SweepError
        As :func:`draw_sweep`.
    """
    figure = new_figure(11.0, 5.2)
    left, right = figure.subplots(1, 2)
    draw_sweep(sweep, left, against=against)
    draw_sweep(sweep, right, against=against, relative=True)
    legend = left.get_legend()
    figure.legend(
        handles=list(legend.legend_handles),
        labels=[text.get_text() for text in legend.get_texts()],
        loc="outside right upper", fontsize=8, frameon=False, title="lag (i, j)",
    )  # fmt: skip
    for ax in (left, right):
        ax.get_legend().remove()
    level = float(sweep.rows.meta["level"])
    figure.suptitle(
        f"Differential response of flats at {electrons_text(level)}", fontsize=11
    )
    return figure
