"""Figures of a diagnosis: residuals by channel, each drawn from plain arrays into an ``ax``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor.show_style import BLUE, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Table = Mapping[str, NDArray]


def draw_channels(chi2: Mapping[str, tuple[float, float]], ax: Axes) -> None:
    """Deviate of each channel's chi-square, on a scale that shows both 1 and 1000."""
    words = list(chi2)[::-1]
    z = [(s - d) / np.sqrt(2 * max(d, 1e-9)) for s, d in (chi2[w] for w in words)]
    colours = [RED if value > 4 else BLUE for value in z]
    ax.barh(words, z, color=colours)
    ax.axvspan(-3, 3, color="0.9", zorder=0)
    ax.set_xscale("symlog", linthresh=5)
    ax.set_xlabel("(chi-square - dof) / sqrt(2 dof)")


def draw_lags(axes: Table, pulls: NDArray[np.float64], ax: Axes) -> None:
    """Pull of each lag, all levels together by their square, as covariances of flats see it."""
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
    axes: Table, pulls: NDArray[np.float64], ax: Axes, *, lags: Sequence[tuple[int, int]]
) -> None:
    """Pull of some lags against level, amplifiers and conditions as they come."""
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
    ax.legend(frameon=False, ncol=3, fontsize=8)


def draw_means(axes: Table, relative: NDArray[np.float64], ax: Axes) -> None:
    """Relative residual of the means against level."""
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
    ax.legend(frameon=False, fontsize=8)


def draw_overscan(
    axes: Table, values: NDArray[np.float64], errors: NDArray[np.float64], ax: Axes
) -> None:
    """Profile of an overscan for the strongest levels of each amplifier."""
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
    ax.set(xlabel="overscan pixel", ylabel="above its tail [ADU]")
    ax.legend(frameon=False, fontsize=8)


def draw_map(axes: Table, pulls: NDArray[np.float64], ax: Axes, *, name: str) -> None:
    """Pulls of the blocks of a map."""
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


def draw_profile(axes: Table, pulls: NDArray[np.float64], ax: Axes, *, name: str) -> None:
    """Pulls of columns and rows of a map."""
    for what, axis in (("column", "x"), ("row", "y")):
        here = (axes["map"] == name) & (axes["what"] == what)
        ax.plot(axes[axis][here], pulls[here], ".", ms=3, label=f"{what}s")
    _band(ax)
    ax.set(xlabel="column or row [pixel]", ylabel="pull")
    ax.legend(frameon=False, fontsize=8)


def draw_spots(axes: Table, pulls: NDArray[np.float64], ax: Axes) -> None:
    """Pulls of the spots' numbers against flux."""
    for what in dict.fromkeys(axes["what"]):
        here = axes["what"] == what
        ax.plot(axes["flux"][here] / 1e6, pulls[here], "o", ms=3, label=str(what))
    _band(ax)
    ax.set(xlabel="flux [million e-]", ylabel="pull")
    ax.legend(frameon=False, ncol=3, fontsize=8)


def draw_noise(axes: Table, pulls: NDArray[np.float64], ax: Axes) -> None:
    """Pulls of the noise by lag in readout order."""
    for amp in np.unique(axes["amp"]):
        here = axes["amp"] == amp
        ax.plot(axes["lag"][here], pulls[here], ".", label=f"amplifier {int(amp) + 1}")
    _band(ax)
    ax.set(xlabel="lag in readout order [pixel]", ylabel="pull")
    ax.legend(frameon=False, fontsize=8)


def draw_parameters(
    pulls: Mapping[str, float], errors: Mapping[str, float], ax: Axes
) -> None:
    """Device parameters in units of their spread."""
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
    ax.set_xlabel("off the card [its spread]")


def _band(ax: Axes) -> None:
    ax.axhspan(-2, 2, color="0.92", zorder=0)
    ax.axhline(0, color="0.6", lw=0.8)


def _image(
    image: NDArray[np.float64],
    ax: Axes,
    x: str,
    y: str,
    extent: tuple[float, float, float, float],
) -> None:
    top = max(4.0, float(np.nanmax(np.abs(image))))
    drawn = ax.imshow(
        image, origin="lower", cmap="RdBu_r", vmin=-top, vmax=top, extent=extent
    )
    ax.figure.colorbar(drawn, ax=ax, label="pull", shrink=0.8)
    ax.set(xlabel=x, ylabel=y)
