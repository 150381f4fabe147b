"""Figure of the photon transfer curve: variance and correlations of flats against the level."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from bfsensor.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bfsensor.measure.covariance_fit import CovarianceFit
    from bfsensor.measure.curve import CovarianceCurve

_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
_NEIGHBOURS = (("C10 (along x)", 0, 1, "o"), ("C01 (along y)", 1, 0, "s"))
"""Label, lag in y, lag in x and marker of the correlations that are drawn.

Chosen: the nearest lags, whose correlations are the largest."""


def figure_for_photon_transfer(
    curves: Mapping[str, CovarianceCurve], fits: Mapping[str, CovarianceFit]
) -> Figure:
    """Draw variances divided by the level, and correlations of neighbours, for each amplifier.

    Without a brighter-fatter effect both are constant: the variance of shot noise is proportional
    to the level, and pixels are not correlated.

    Parameters
    ----------
    curves : mapping of str to CovarianceCurve
        Curves by amplifier, at least one, all in the same unit.
    fits : mapping of str to CovarianceFit
        Fits of the amplifiers that were fitted, drawn as lines.

    Returns
    -------
    matplotlib.figure.Figure
        Page with two panels.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    """
    figure = new_figure(7.0, 7.5)
    above, below = figure.subplots(2, 1, sharex=True)
    unit = next(iter(curves.values())).unit
    word = {"electron": "e-", "adu": "ADU"}[unit]
    one_gain = unit == "electron"
    if one_gain:
        above.axhline(1.0, color=GREY, lw=1, label="shot noise")
    below.axhline(0.0, color=GREY, lw=1)
    for n, (name, curve) in enumerate(curves.items()):
        colour = _COLOURS[n % len(_COLOURS)]
        levels, c, e = curve.levels, curve.covariances, curve.errors
        above.errorbar(
            levels / 1e3, c[:, 0, 0] / levels, e[:, 0, 0] / levels, fmt="o", ms=4,
            color=colour, label=name,
        )  # fmt: skip
        for _, j, i, marker in _NEIGHBOURS:
            below.errorbar(
                levels / 1e3, 100 * c[:, j, i] / c[:, 0, 0], 100 * e[:, j, i] / c[:, 0, 0],
                fmt=marker, ms=4, color=colour, mfc=colour if i else "white",
            )  # fmt: skip
        if name in fits:
            grid = np.linspace(levels[0], levels[-1], 200)
            model = fits[name].model(grid)
            above.plot(grid / 1e3, model[:, 0, 0] / grid, color=colour, lw=1)
            for _, j, i, _marker in _NEIGHBOURS:
                ratio = 100 * model[:, j, i] / model[:, 0, 0]
                below.plot(grid / 1e3, ratio, color=colour, lw=1, ls="-" if i else "--")
    for label, _, i, marker in _NEIGHBOURS:
        below.plot(
            [], [], marker, ms=4, color=BLACK, mfc=BLACK if i else "white", label=label
        )
    above.set_ylabel("variance / level" + ("" if one_gain else f" [{word}]"))
    below.set(xlabel=f"level [1000 {word}]", ylabel="correlation with the neighbour [%]")
    columns = 1 + len(curves) // 8
    for ax in (above, below):
        ax.spines[["top", "right"]].set_visible(False)
        ax.legend(frameon=False, fontsize=8, ncols=columns)
    return figure
