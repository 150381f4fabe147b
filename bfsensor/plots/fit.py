"""Figures of a device fit, drawn from plain arrays into an ``ax``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.plots.style import BLUE, GREY, RED
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_ratios(
    labels: Sequence[str],
    values: FloatArray,
    errors: FloatArray,
    before: FloatArray,
    after: FloatArray,
    ax: Axes,
) -> None:
    """Draw the ratios of simulated to measured values, before and after the fit.

    Values with a relative error of 0.7 or more are drawn faint and do not set the range of the
    axis; triangles at its ends stand for points beyond it.

    Parameters
    ----------
    labels : sequence of str, length n
        Names of the values.
    values, errors : ndarray, shape (n,)
        Measured values and their scaled errors, in any unit.
    before, after : ndarray, shape (n,)
        Simulated values before and after the fit, in the same unit.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    """
    at = np.arange(len(labels))
    part = np.abs(errors / values)
    told = part < 0.7
    off = np.abs(
        np.concatenate([before, after])[np.tile(told, 2)] / np.tile(values[told], 2) - 1
    )
    top = float(np.clip(1.2 * np.max(off, initial=0.0), 0.3, 1.0))
    ax.bar(at, 2 * np.minimum(part, 2 * top), 0.8, 1 - np.minimum(part, 2 * top),
           color="0.92", zorder=0, label="measured, scaled error")  # fmt: skip
    for ratio, colour, word, size, move in (
        (before / values, RED, "before", 5, -0.15), (after / values, BLUE, "after", 5, 0.15)
    ):  # fmt: skip
        fill = "white" if word == "before" else colour
        for faint, these in ((1.0, told), (0.35, ~told)):
            inside = these & (np.abs(ratio - 1) <= top)
            ax.plot(at[inside] + move, ratio[inside], "o", ms=size, color=colour, mfc=fill,
                    alpha=faint, label=word if faint == 1.0 else None)  # fmt: skip
            for side, shape in ((1, "^"), (-1, "v")):
                beyond = these & (side * (ratio - 1) > top)
                end = np.full(np.count_nonzero(beyond), 1 + 0.96 * side * top)
                ax.plot(at[beyond] + move, end, shape, ms=size, color=colour, mfc=fill,
                        alpha=faint)  # fmt: skip
    ax.axhline(1, color="0.5", lw=0.8)
    ax.set(
        ylim=(1 - top, 1 + top), ylabel="simulated / measured", xlim=(-0.7, len(at) - 0.3)
    )
    ax.set_xticks(at, labels, rotation=90, fontsize=7)
    ax.legend(
        frameon=False, fontsize=8, ncol=3, loc="lower center", bbox_to_anchor=(0.5, 1)
    )


def draw_pulls(names: Sequence[str], pulls: ArrayLike, errors: ArrayLike, ax: Axes) -> None:
    """Draw fitted parameters in units of the spreads of their priors.

    Parameters
    ----------
    names : sequence of str, length n
        Names of the parameters.
    pulls, errors : array_like, shape (n,)
        Differences from the prior means and posterior errors, both in spreads.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    """
    at = np.arange(len(names))[::-1]
    ax.axvspan(-1, 1, color="0.92", zorder=0)
    ax.axvline(0, color="0.6", lw=0.8)
    ax.errorbar(np.asarray(pulls), at, xerr=np.asarray(errors), fmt="o", ms=4, color=BLUE)
    ax.set_yticks(at, names, fontsize=8)
    ax.set(xlabel="difference from the prior mean [its spread]", ylim=(-0.7, len(at) - 0.3))


def draw_data_pulls(labels: Sequence[str], pulls: ArrayLike, ax: Axes) -> None:
    """Draw the differences of predicted and measured values after the fit.

    Parameters
    ----------
    labels : sequence of str, length n
        Names of the values.
    pulls : array_like, shape (n,)
        Predicted less measured values in scaled errors.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    """
    at = np.arange(len(labels))
    ax.axhspan(-1, 1, color="0.92", zorder=0)
    ax.axhline(0, color="0.6", lw=0.8)
    ax.plot(at, np.asarray(pulls), "o", ms=4, color=BLUE)
    ax.set(ylabel="pull", xlim=(-0.7, len(at) - 0.3))
    ax.set_xticks(at, labels, rotation=90, fontsize=7)


def draw_profile(
    values: FloatArray,
    rise: FloatArray,
    value: float,
    error: float,
    name: str,
    ax: Axes,
    *,
    bounds: Sequence[tuple[float, float]] = (),
) -> None:
    """Draw the profile of the fit's minimum against one parameter.

    Lines stand at rises of 1 and 3.84, the 68 % and 95 % intervals of one parameter.

    Parameters
    ----------
    values, rise : ndarray, shape (n,)
        Values of the parameter, and rise of chi-square and prior above the minimum.
    value, error : float
        Best value and its error, for the parabola that is drawn beside the profile.
    name : str
        Label of the parameter with its unit.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    bounds : sequence of (float, float)
        Intervals that are shaded; infinite ends are drawn at the last point of the profile.
    """
    for low, high in bounds:
        ax.axvspan(
            max(low, values.min()), min(high, values.max()), color=BLUE, alpha=0.1, lw=0
        )
    fine = np.linspace(values.min(), values.max(), 100)
    ax.plot(fine, ((fine - value) / error) ** 2, color=GREY, label="of the error")
    ax.plot(values, rise, "o-", ms=3, color=BLUE, label="profile")
    for level in (1, 3.84):
        ax.axhline(level, color="0.85", lw=0.8, zorder=0)
    ax.set(xlabel=name, ylabel="rise of chi-square and prior", ylim=(-0.2, 9.5))
    ax.legend(frameon=False, fontsize=8)
