"""Figure of a camera's a_ij, measured and fitted by the image-charge model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor.plots.style import BLACK, BLUE, GREY, ORANGE, new_figure
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def figure_for_camera(
    a: FloatArray,
    errors: FloatArray,
    predicted: FloatArray,
    used: NDArray[np.bool_],
    title: str,
) -> Figure:
    """Draw a_ij against distance, measured and fitted, and the pulls by lag.

    Parameters
    ----------
    a, errors, predicted : ndarray, shape (n, n)
        Measured a_ij, errors, and a_ij of the fit, ``[j, i]`` [1/e-]; nan where not measured.
    used : ndarray of bool, shape (n, n)
        Lags that were fitted; the others are drawn in grey.
    title : str
        Line above the figure.

    Returns
    -------
    figure : matplotlib.figure.Figure

    Raises
    ------
    BFSensorError
        Matplotlib is not installed.

    Examples
    --------
    >>> a = np.array([[-1e-6, 7e-8], [1.5e-7, 5e-8]])
    >>> len(figure_for_camera(a, abs(a) / 10, a, np.ones((2, 2), bool), "A camera").axes)
    3
    """
    figure = new_figure(11, 4.6)
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    figure.suptitle(title, fontsize=10)
    _draw_distance(a, errors, predicted, used, left)
    pulls = np.where(np.isfinite(a), (a - predicted) / errors, np.nan)
    shown = right.imshow(pulls, origin="lower", cmap="RdBu_r", vmin=-4, vmax=4)
    for (j, i), pull in np.ndenumerate(pulls):
        if np.isfinite(pull):
            right.text(
                i, j, f"{pull:.1f}", ha="center", va="center", fontsize=7,
                color=BLACK if used[j, i] else "grey",
                fontstyle="normal" if used[j, i] else "italic",
            )  # fmt: skip
    right.set_xlabel("lag i in x, serial [pixel]")
    right.set_ylabel("lag j in y, parallel [pixel]")
    figure.colorbar(shown, ax=right, label="(measured - fitted) / error", shrink=0.85)
    return figure


def _draw_distance(
    a: FloatArray,
    errors: FloatArray,
    predicted: FloatArray,
    used: NDArray[np.bool_],
    ax: Axes,
) -> None:
    """Draw the size of all a_ij against the distance of their lag."""
    j, i = np.indices(a.shape)
    distance = np.where((i == 0) & (j == 0), 0.6, np.hypot(i, j))
    for where, colour, marker, label in (
        ((j == 0) & (i > 0), BLUE, ">", "along x"),
        ((i == 0) & (j > 0), ORANGE, "^", "along y"),
        ((i > 0) & (j > 0), BLACK, "o", "others"),
        ((i == 0) & (j == 0), GREY, "s", "$-a_{00}$, drawn at 0.6"),
    ):
        there = where & np.isfinite(a)
        sign = np.where((i == 0) & (j == 0), -1.0, 1.0)[there]
        filled = used[there]
        for mask, face in ((filled, colour), (~filled, "none")):
            ax.errorbar(
                distance[there][mask], (sign * a[there])[mask], errors[there][mask],
                fmt=marker, color=colour, markerfacecolor=face, markersize=5, capsize=2,
                label=label if face != "none" else None,
            )  # fmt: skip
        ax.plot(
            distance[there], sign * predicted[there], "_", color="red", markersize=11,
            label="fitted" if marker == "o" else None,
        )  # fmt: skip
    positive = np.abs(predicted)[np.isfinite(predicted) & (predicted != 0)]
    ax.set_xscale("log")
    least = float(positive.min()) if positive.size else 1e-9
    ax.set_yscale("symlog", linthresh=least)
    ax.set_ylim(-2 * least, 2 * float(np.nanmax(np.abs(a))))
    ax.axhline(0.0, color=GREY, linewidth=0.6)
    ax.set_xlabel("distance of the lag [pixel]")
    ax.set_ylabel("a$_{ij}$ [1/e$^-$] (hollow: not fitted)")
    ax.legend(fontsize=8)
