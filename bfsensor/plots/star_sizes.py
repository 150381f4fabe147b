"""Figure of star sizes against the charge in the peak, before and after a correction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.measure.star_sizes import size_slopes
from bfsensor.plots.style import BLUE, ORANGE, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figure_for_star_sizes(
    peaks: Sequence[ArrayLike], before: Sequence[ArrayLike], after: Sequence[ArrayLike]
) -> Figure:
    """Draw second moments of stars against the charge in their peak, in x and in y.

    Moments are relative to the median of their image after the correction.

    Parameters
    ----------
    peaks : sequence of array_like, each of shape (n,)
        Charge in the brightest pixel of each star [e-], an entry an image.
    before, after : sequence of array_like, each of shape (n, 2)
        Second moments in x and y [pixel^2] in the recorded and in the corrected images.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> import pytest
    >>> _ = pytest.importorskip("matplotlib")
    >>> peaks, size = np.linspace(1e4, 1e5, 20), np.full((20, 2), 2.0)
    >>> grown = size * (1 + 4e-7 * peaks[:, None])
    >>> figure = figure_for_star_sizes([peaks], [grown], [size])
    >>> len(figure.axes)
    2
    """
    figure: Any = new_figure(8.0, 3.6)
    some = [n for n in range(len(peaks)) if len(np.asarray(peaks[n]))]
    charge = np.concatenate([np.asarray(peaks[n], float) for n in some])
    both = size_slopes(
        [peaks[n] for n in some], *([m[n] for n in some] for m in (before, after))
    )
    panels = figure.subplots(1, 2, sharey=True)
    for k, (axes, axis) in enumerate(zip(panels, "xy", strict=True)):
        for name, moments, colour, slope in (
            ("recorded", before, ORANGE, both[0]), ("corrected", after, BLUE, both[1]),
        ):  # fmt: skip
            growth, error = slope[k], slope[2 + k]
            relative = np.concatenate(
                [
                    np.asarray(moments[n], float)[:, k]
                    / np.nanmedian(np.asarray(after[n], float)[:, k])
                    for n in some
                ]
            )
            label = f"{name}: {growth:+.2f} ± {error:.2f} % for 50,000 e-"
            axes.plot(
                charge / 1e3, 100 * (relative - 1), ".", ms=3, color=colour, label=label
            )
        axes.axhline(0.0, lw=0.8, color="0.5")
        axes.set_xlabel("charge in the peak [1000 e-]")
        axes.set_title(f"second moments in {axis}")
        axes.legend(fontsize=8, loc="upper left")
        axes.margins(y=0.2)
    panels[0].set_ylabel("size over the image's median [%]")
    return figure
