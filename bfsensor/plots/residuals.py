"""Figures of a diagnosis: residuals by channel, drawn from plain arrays into an ``ax``.

Functions whose first argument is ``axes`` take the coordinates of a channel's values, arrays of
one length by name, and one number a value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor.plots.style import BLUE, GREY, ORANGE, RED
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Table = Mapping[str, NDArray]


def draw_channels(chi2: Mapping[str, tuple[float, float]], ax: Axes) -> None:
    """Draw the deviate of each channel's chi-square, on a scale that shows both 1 and 1000.

    Parameters
    ----------
    chi2 : mapping of str to (float, float)
        Chi-square and degrees of freedom by channel.
    ax : matplotlib.axes.Axes
        Axes to draw into; x is (chi-square - dof) / sqrt(2 dof).
    """
    words = list(chi2)[::-1]
    z = [(s - d) / np.sqrt(2 * max(d, 1e-9)) for s, d in (chi2[w] for w in words)]
    colours = [RED if value > 4 else BLUE for value in z]
    ax.barh(words, z, color=colours)
    ax.axvspan(-3, 3, color="0.9", zorder=0)
    ax.set_xscale("symlog", linthresh=5)
    ticks = [t for t in (0, 10, 100, 1000, 10_000, 100_000) if t <= max([10, *z])]
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.set_xlabel("(chi-square - dof) / sqrt(2 dof)")


def draw_classes(
    probability: Mapping[str, float], ax: Axes, *, tied: Sequence[str] = ()
) -> None:
    """Draw the probability of each class of effects.

    Parameters
    ----------
    probability : mapping of str to float
        Probability by class, 0 to 1.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    tied : sequence of str
        Classes that the data do not distinguish, drawn in another colour.
    """
    words = list(probability)[::-1]
    values = [probability[w] for w in words]
    ax.barh(
        range(len(words)),
        values,
        color=[ORANGE if w in tied else BLUE for w in words],
        height=0.65,
    )
    ax.set_yticks(range(len(words)), [w.replace("_", " ") for w in words])
    for n, value in enumerate(values):
        text = f"{100 * value:.0f} %" if value >= 0.01 else f"{100 * value:.1f} %"
        ax.text(value + 0.015, n, text, va="center", fontsize=9)
    ax.set(xlim=(0, 1.14), xlabel="probability")
    ax.set_xticks(np.linspace(0, 1, 6))
    _plain(ax)


def draw_held_out(held: Mapping[str, tuple[float, float, int]], ax: Axes) -> None:
    """Draw chi-square per value of data that was not fitted, without and with the effects.

    Parameters
    ----------
    held : mapping of str to (float, float, int)
        By channel: chi-square per value without and with the effects, and number of values.
    ax : matplotlib.axes.Axes
        Axes to draw into; grey bars are the 95 % interval expected of noise.
    """
    names = list(held)[::-1]
    for n, name in enumerate(names):
        before, after, count = held[name]
        width = 1.96 * np.sqrt(2 / count)
        ax.barh(n, 2 * width, left=1 - width, color="0.88", height=0.7, zorder=0)
        ax.plot([before, after], [n, n], color=GREY, lw=1.5, zorder=1)
        ax.plot(
            before,
            n,
            "o",
            mfc="white",
            mec=RED,
            mew=1.6,
            ms=8,
            label="baseline" if n == 0 else None,
        )
        ax.plot(
            after, n, "o", color=BLUE, ms=6, label="with the effects" if n == 0 else None
        )
    ax.set_yticks(range(len(names)), names)
    values = [v for b, a, _ in held.values() for v in (b, a)]
    ax.set_xscale("log")
    ax.set_xlim(min(0.5, 0.8 * min(values)), max(2.0, 1.4 * max(values)))
    ticks = [t for t in (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 5000)
             if ax.get_xlim()[0] <= t <= ax.get_xlim()[1]]  # fmt: skip
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.axvline(1, color="0.5", lw=0.8, zorder=0)
    ax.set_xlabel("chi-square per value, not fitted")
    _legend(ax, 2)
    _plain(ax)


def draw_lags(axes: Table, pulls: FloatArray, ax: Axes) -> None:
    """Draw the pull of each lag, averaged over the levels.

    Levels are weighted by their square, in proportion to the signal of a relative change of area
    in the covariances of flats.

    Parameters
    ----------
    axes : mapping of str to ndarray, shape (n,)
        Lags ``i`` in x and ``j`` in y, and ``level``, of each value.
    pulls : ndarray, shape (n,)
        Residuals in units of their errors.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    """
    i, j, level = axes["i"].astype(int), axes["j"].astype(int), axes["level"].astype(float)
    weight = (level / level.max()) ** 2
    image = np.full((j.max() + 1, i.max() + 1), np.nan)
    for a in range(image.shape[1]):
        for b in range(image.shape[0]):
            here = (i == a) & (j == b)
            if here.any():
                image[b, a] = (weight[here] @ pulls[here]) / np.sqrt(
                    (weight[here] ** 2).sum()
                )
    _image(
        image,
        ax,
        "lag x",
        "lag y",
        (-0.5, image.shape[1] - 0.5, -0.5, image.shape[0] - 0.5),
    )


def draw_lag_levels(
    axes: Table, pulls: FloatArray, ax: Axes, *, lags: Sequence[tuple[int, int]]
) -> None:
    """Draw the pulls of some lags against level, without regard to amplifier and condition.

    Parameters
    ----------
    axes : mapping of str to ndarray, shape (n,)
        Lags ``i`` and ``j``, and ``level`` [ADU], of each value.
    pulls : ndarray, shape (n,)
        Residuals in units of their errors.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    lags : sequence of (int, int)
        Lags (i, j) that are drawn.
    """
    for n, (a, b) in enumerate(lags):
        here = (axes["i"] == a) & (axes["j"] == b)
        ax.plot(
            axes["level"][here] / 1e3,
            pulls[here],
            "o",
            ms=4,
            color=f"C{n}",
            label=f"({a},{b})",
        )
    _band(ax)
    ax.set(xlabel="level [1000 ADU]", ylabel="pull")
    _legend(ax, 6)


def draw_means(axes: Table, relative: FloatArray, ax: Axes) -> None:
    """Draw the relative residuals of the means against level, by amplifier.

    Parameters
    ----------
    axes : mapping of str to ndarray, shape (n,)
        Index ``amp`` of the amplifier and ``level`` [ADU] of each value.
    relative : ndarray, shape (n,)
        Residuals relative to the mean.
    ax : matplotlib.axes.Axes
        Axes to draw into; y is in %.
    """
    for amp in np.unique(axes["amp"]):
        here = axes["amp"] == amp
        ax.plot(
            axes["level"][here] / 1e3,
            100 * relative[here],
            ".",
            label=f"amplifier {int(amp) + 1}",
        )
    ax.axhline(0, color="0.6", lw=0.8)
    ax.set(xlabel="level [1000 ADU]", ylabel="mean, residual [%]")
    _legend(ax, 4)


def draw_overscan(axes: Table, values: FloatArray, errors: FloatArray, ax: Axes) -> None:
    """Draw the mean residual of each overscan pixel at the highest levels of each amplifier.

    Levels above 0.7 of an amplifier's highest one are averaged.

    Parameters
    ----------
    axes : mapping of str to ndarray, shape (n,)
        Index ``amp`` of the amplifier, ``level`` and overscan pixel ``k`` of each value.
    values, errors : ndarray, shape (n,)
        Residuals and their errors [ADU].
    ax : matplotlib.axes.Axes
        Axes to draw into.
    """
    for n, amp in enumerate(np.unique(axes["amp"])):
        own = axes["amp"] == amp
        top = own & (axes["level"] > 0.7 * axes["level"][own].max())
        k = np.unique(axes["k"])
        weight = 1 / errors**2
        mean = [
            np.average(
                values[top & (axes["k"] == q)], weights=weight[top & (axes["k"] == q)]
            )
            for q in k
        ]
        error = [1 / np.sqrt(weight[top & (axes["k"] == q)].sum()) for q in k]
        ax.errorbar(
            k + 0.1 * n, mean, error, fmt="o", ms=3, label=f"amplifier {int(amp) + 1}"
        )
    ax.axhline(0, color="0.6", lw=0.8)
    ax.set(xlabel="overscan pixel", ylabel="above its tail, residual [ADU]")
    _legend(ax, 4)


def draw_map(axes: Table, pulls: FloatArray, ax: Axes, *, name: str) -> None:
    """Draw the pulls of the blocks of a map.

    Parameters
    ----------
    axes : mapping of str to ndarray, shape (n,)
        Name ``map`` of the map, ``what`` ('block', 'column' or 'row') and centre ``x``, ``y``
        [pixel] of each value.
    pulls : ndarray, shape (n,)
        Residuals in units of their errors.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    name : str
        Map that is drawn; it has at least two columns of blocks.
    """
    here = (axes["map"] == name) & (axes["what"] == "block")
    x, y = axes["x"][here].astype(float), axes["y"][here].astype(float)
    columns, rows = np.unique(x), np.unique(y)
    image = np.full((len(rows), len(columns)), np.nan)
    image[np.searchsorted(rows, y), np.searchsorted(columns, x)] = pulls[here]
    half = 0.5 * (columns[1] - columns[0])
    _image(
        image, ax, "x [pixel]", "y [pixel]",
        (columns[0] - half, columns[-1] + half, rows[0] - half, rows[-1] + half),
    )  # fmt: skip


def draw_profile(axes: Table, pulls: FloatArray, ax: Axes, *, name: str) -> None:
    """Draw the pulls of the columns and rows of a map.

    Parameters
    ----------
    axes : mapping of str to ndarray, shape (n,)
        Coordinates, as for :func:`draw_map`.
    pulls : ndarray, shape (n,)
        Residuals in units of their errors.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    name : str
        Map that is drawn.
    """
    for what, axis in (("column", "x"), ("row", "y")):
        here = (axes["map"] == name) & (axes["what"] == what)
        ax.plot(axes[axis][here], pulls[here], ".", ms=3, label=f"{what}s")
    _band(ax)
    ax.set(xlabel="column or row [pixel]", ylabel="pull")
    _legend(ax, 2)


def draw_spots(axes: Table, pulls: FloatArray, ax: Axes) -> None:
    """Draw the pulls of the measurements of spots against flux.

    Parameters
    ----------
    axes : mapping of str to ndarray, shape (n,)
        Name ``what`` of the measurement and ``flux`` [e-] of each value.
    pulls : ndarray, shape (n,)
        Residuals in units of their errors.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    """
    for what in dict.fromkeys(axes["what"]):
        here = axes["what"] == what
        name = str(what).replace("sigma", "width").replace("_", " ")
        ax.plot(axes["flux"][here] / 1e6, pulls[here], "o", ms=3, label=name)
    _band(ax)
    ax.set(xlabel="flux [million e-]", ylabel="pull")
    _legend(ax, 6)


def draw_noise(axes: Table, pulls: FloatArray, ax: Axes) -> None:
    """Draw the pulls of the noise's correlations by lag in readout order, by amplifier.

    Parameters
    ----------
    axes : mapping of str to ndarray, shape (n,)
        Index ``amp`` of the amplifier and ``lag`` [pixel] of each value.
    pulls : ndarray, shape (n,)
        Residuals in units of their errors.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    """
    for amp in np.unique(axes["amp"]):
        here = axes["amp"] == amp
        ax.plot(axes["lag"][here], pulls[here], ".", label=f"amplifier {int(amp) + 1}")
    _band(ax)
    ax.set(xlabel="lag in readout order [pixel]", ylabel="pull")
    _legend(ax, 4)


def draw_parameters(
    pulls: Mapping[str, float], errors: Mapping[str, float], ax: Axes
) -> None:
    """Draw device parameters in units of the spreads of their priors.

    Parameters
    ----------
    pulls, errors : mapping of str to float
        Difference from the nominal value, and error, by parameter, both in spreads.
    ax : matplotlib.axes.Axes
        Axes to draw into.
    """
    names = list(pulls)[::-1]
    ax.errorbar(
        [pulls[n] for n in names],
        range(len(names)),
        xerr=[errors[n] for n in names],
        fmt="ko",
        ms=4,
    )
    ax.set_yticks(range(len(names)), names)
    ax.axvspan(-1, 1, color="0.9", zorder=0)
    ax.set_xlabel("difference from nominal\n[spread of prior]")


def _legend(ax: Axes, columns: int) -> None:
    """Put the legend above the axes, where it covers no data."""
    ax.legend(
        frameon=False, fontsize=8, ncol=columns, loc="lower center", bbox_to_anchor=(0.5, 1),
        handletextpad=0.2, columnspacing=1.0, borderaxespad=0.2,
    )  # fmt: skip


def _plain(ax: Axes) -> None:
    """Remove the frame except its lower side."""
    for side in ("top", "right", "left"):
        ax.spines[side].set_visible(False)
    ax.tick_params(axis="y", length=0)


def _band(ax: Axes) -> None:
    """Shade pulls from -2 to 2."""
    ax.axhspan(-2, 2, color="0.92", zorder=0)
    ax.axhline(0, color="0.6", lw=0.8)


def _image(
    image: FloatArray,
    ax: Axes,
    x: str,
    y: str,
    extent: tuple[float, float, float, float],
) -> None:
    """Draw an image of pulls with symmetric colours, at least from -4 to 4."""
    top = max(4.0, float(np.nanmax(np.abs(image))))
    drawn = ax.imshow(
        image, origin="lower", cmap="RdBu_r", vmin=-top, vmax=top, extent=extent
    )
    ax.figure.colorbar(drawn, ax=ax, label="pull", shrink=0.8)
    ax.set(xlabel=x, ylabel=y)
