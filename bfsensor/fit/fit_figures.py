"""Figure of a fit: data and predictions, parameters against priors, profile likelihoods."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bfsensor.device.device import Device
from bfsensor.device.quantities import Quantity, describe, quantities
from bfsensor.device.written_units import INTERNAL
from bfsensor.fit.result import FitResult
from bfsensor.inference.profile_bounds import LEVELS, profile_bounds
from bfsensor.plots import fit as show_fit
from bfsensor.plots.style import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figure_for_fit(result: FitResult) -> Figure:
    """Draw predictions over data before and after the fit, parameters, and profiles.

    Parameters
    ----------
    result : FitResult
        Result of a fit, from :func:`fit_device` or read from ``fit.json``.

    Returns
    -------
    figure : matplotlib.figure.Figure
        A row for each data set; pulls of the parameters beside them; below, the profiles if any.

    Raises
    ------
    BFSensorError
        Matplotlib is not installed.

    Examples
    --------
    >>> from bfsensor.device.shipped import tables_dir
    >>> figure = figure_for_fit(FitResult.read(tables_dir() / "itl_sta3800c_2019" / "fit.json"))
    >>> len(figure.axes) >= 3
    True
    """
    sets, profiles = result.sets, list(result.profiles.items())
    rows = 2 * len(sets)
    tall = max(3.2 * len(sets), 1.2 + 0.22 * len(result.parameters))
    figure = new_figure(13, tall + (2.8 if profiles else 0.0))
    heights = [tall, 2.8] if profiles else [tall]
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    top = grid[0].subgridspec(
        rows, 2, width_ratios=[2.2, 1], height_ratios=[2, 1] * len(sets)
    )
    for n, one in enumerate(sets):
        ax = figure.add_subplot(top[2 * n, 0])
        show_fit.draw_ratios(
            one.labels, one.values, one.scale * one.errors, one.before, one.after, ax
        )
        ax.set_title(
            one.name + ("" if one.fitted else ", not fitted"), fontsize=9, loc="left"
        )
        ax.tick_params(labelbottom=False)
        show_fit.draw_data_pulls(
            one.labels, one.pulls, figure.add_subplot(top[2 * n + 1, 0])
        )
    show_fit.draw_pulls(
        [describe(name) for name in result.parameters], result.pulls,
        result.error / result.spread, figure.add_subplot(top[:, 1]),
    )  # fmt: skip
    if profiles:
        known = quantities(Device.from_toml(result.device))
        bottom = grid[1].subgridspec(1, max(len(profiles), 3))
        for n, (name, (values, rise)) in enumerate(profiles):
            k = result.parameters.index(name)
            kind = known.get(name, Quantity(1.0, "number", "", 0.0, 1.0)).kind
            unit = INTERNAL[kind].to_string()
            label = f"{describe(name)} [{unit}]" if unit else describe(name)
            show_fit.draw_profile(
                values, rise, float(result.value[k]), float(result.error[k]), label,
                figure.add_subplot(bottom[n]),
                bounds=[profile_bounds(values, rise, one) for one in LEVELS.values()],
            )  # fmt: skip
    return figure
