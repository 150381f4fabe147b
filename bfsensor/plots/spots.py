"""Figures of directly simulated spots: growth of the width, displaced light, build-up of charge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bfsensor.plots.style import BLUE, ORANGE, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bfsensor.direct.spot_exposure import Spot, SpotPlan
    from bfsensor.measure.growth import Growth


def draw_growth(growth: Growth, ax: Axes) -> None:
    """Draw the growth of the widths against the peak, with the fitted slopes.

    Parameters
    ----------
    growth : Growth
        Growth from :func:`bfsensor.measure.growth.measure_growth`.
    ax : matplotlib.axes.Axes
        Axes to draw into; x is the peak without the effect [1000 e-], y the growth [%].
    """
    line = np.array([0.0, growth.peak.max()])
    for n, (axis, colour, marker) in enumerate((("x", BLUE, "o"), ("y", ORANGE, "s"))):
        ax.errorbar(
            growth.peak / 1e3, growth.growth[:, n], growth.growth_error[:, n],
            fmt=marker, ms=4, color=colour,
            label=f"{axis}: {growth.slope[n]:.3f} $\\pm$ {growth.slope_error[n]:.3f}",
        )  # fmt: skip
        ax.plot(line / 1e3, growth.slope[n] * line / 5e4, color=colour, lw=1)
    ax.set(xlabel="peak without the effect [1000 e-]", ylabel="growth of sigma [%]")
    ax.legend(title="% per 50,000 e-", frameon=False)


def draw_moved_light(spots: Sequence[Spot], ax: Axes) -> None:
    """Draw the electrons that the effect has moved at the end, averaged over all spots.

    Parameters
    ----------
    spots : sequence of Spot
        Spots of the same plan, at least one.
    ax : matplotlib.axes.Axes
        Axes to draw into; x and y are pixels, colours the electrons gained or lost.
    """
    moved = np.sum([spot.on[-1] - spot.off[-1] for spot in spots], axis=0) / len(spots)
    limit = float(np.abs(moved).max()) or 1.0
    half = moved.shape[0] / 2
    shown = ax.imshow(
        moved, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit,
        extent=(-half, half, -half, half),
    )  # fmt: skip
    ax.figure.colorbar(shown, ax=ax, label="electrons moved, mean of the spots")
    ax.set(xlabel="x [pixel]", ylabel="y [pixel]")


def draw_build_up(spot: Spot, ax: Axes, *, profiles: int = 5) -> None:
    """Draw the row through a spot as charge builds up, with the effect and without.

    Parameters
    ----------
    spot : Spot
        The spot.
    ax : matplotlib.axes.Axes
        Axes to draw into; x is the pixel, y its charge [1000 e-].
    profiles : int
        Number of levels that are drawn, at least 1.
    """
    row = int(spot.off[-1].sum(1).argmax())
    x = np.arange(spot.on.shape[2]) - spot.on.shape[2] // 2
    steps = np.unique(np.linspace(0, len(spot.on), profiles + 1)[1:].astype(int)) - 1
    for n, step in enumerate(steps):
        shade = str(0.75 * (1 - (n + 1) / len(steps)))
        ax.step(
            x, spot.off[step][row] / 1e3, where="mid", color=shade, lw=1, ls=":",
            label="without" if n == len(steps) - 1 else None,
        )  # fmt: skip
        ax.step(
            x, spot.on[step][row] / 1e3, where="mid", color=shade, lw=1,
            label="with the effect" if n == len(steps) - 1 else None,
        )  # fmt: skip
    ax.set(xlabel="x [pixel]", ylabel="electrons in the central row [1000]")
    ax.legend(frameon=False)


def figure_for_spots(plan: SpotPlan, spots: Sequence[Spot], growth: Growth) -> Figure:
    """Draw growth, displaced light and build-up of a direct simulation on one page.

    Parameters
    ----------
    plan : SpotPlan
        Plan of the simulation.
    spots : sequence of Spot
        Simulated spots, at least one.
    growth : Growth
        Measured growth of their widths.

    Returns
    -------
    figure : matplotlib.figure.Figure
        Page with three panels, to be written with ``savefig``.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    """
    figure = new_figure(14.0, 4.4)
    axes = figure.subplots(1, 3)
    draw_growth(growth, axes[0])
    draw_moved_light(spots, axes[1])
    draw_build_up(spots[0], axes[2])
    point = plan.device.operating_point
    axes[0].set_title(
        f"{plan.device.name}, {point.back_bias:g} V, {point.gate_low:g}/{point.gate_high:+g} V"
    )
    axes[1].set_title(f"{len(spots)} spots of sigma = {plan.sigma:g} um")
    axes[2].set_title(f"first spot, peak {spots[0].on[-1].max():,} e-")
    return figure
