"""Layouts, flats, stars and axes that the pictures of effects share."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bfsensor.diagnose.model.table_baseline import edges_by_depth
from bfsensor.effects.effect import Effect, Layout, Segment, Shot
from bfsensor.effects.library import make_effect
from bfsensor.plots.style import BLACK, RED, new_figure
from bfsensor.response.edge_response import area_matrix
from bfsensor.response.light import conversion_weights
from bfsensor.table.quadrant_shifts import quadrant_shifts
from bfsensor.table.table import DistortionTable
from bfsensor.typing import Edges

Array = np.ndarray[Any, Any]
OFF = {"color": BLACK, "ls": "--", "lw": 1.3, "label": "without"}
ON = {"color": RED, "lw": 1.8, "label": "with the effect"}
NOISE = 5.0  # e-, read noise of the images


class Picture(NamedTuple):
    """A drawing of a class, and its caption."""

    draw: Callable[[], Figure]
    caption: str


PICTURES: dict[str, Picture] = {}


def picture(word: str) -> Callable[[Callable[[], Figure]], Callable[[], Figure]]:
    """Register a function that draws the picture of a class; its docstring is the caption."""

    def keep(draw: Callable[[], Figure]) -> Callable[[], Figure]:
        PICTURES[word] = Picture(draw, " ".join((inspect.getdoc(draw) or "").split()))
        return draw

    return keep


def make_layout(rows: int = 128, columns: int = 64, amplifiers: int = 2) -> Layout:
    """Amplifiers side by side, each with serial and parallel overscan."""
    segments = tuple(
        Segment(n * columns, 0, columns, rows, serial_overscan=24, parallel_overscan=24)
        for n in range(amplifiers)
    )
    return Layout((rows, amplifiers * columns), segments, gains=(1.0,) * amplifiers)


def flat_shot(seconds: float = 10.0, **known: Any) -> Shot:
    """One flat at the reference's settings."""
    usual = {"wavelength": 620.0, "back_bias": -60.0, "temperature": 173.15}
    return Shot("flat", 0, seconds, **{**usual, **known})


def areas(effect: Effect, shot: Shot, layout: Layout) -> Array:
    """Relative change of the light of each pixel by displaced edges [%]."""
    moved = effect.displacements(shot, layout)
    dx, dy = moved or (
        np.zeros((1, layout.shape[1] + 1)),
        np.zeros((layout.shape[0] + 1, 1)),
    )
    return 100 * ((1 + np.diff(dx, axis=1)) * (1 + np.diff(dy, axis=0)) - 1)


def frame(level: float, layout: Layout, rng: np.random.Generator) -> Array:
    """One amplifier's frame of a flat [e-] with its overscans, before it is shifted."""
    s = layout.segments[0]
    out = np.zeros((s.rows + s.parallel_overscan, s.columns + s.serial_overscan))
    out[: s.rows, : s.columns] = rng.poisson(level, (s.rows, s.columns))
    return out


def star(
    flux: float, shape: tuple[int, int], x: float, y: float, sigma: float = 1.5
) -> Array:
    """Mean image of a round star [e-]."""
    j, i = np.indices(shape)
    return np.asarray(
        flux / (2 * np.pi * sigma**2)
        * np.exp(-0.5 * ((i - x) ** 2 + (j - y) ** 2) / sigma**2)
    )  # fmt: skip


@cache
def shifts(wavelength: float = 620.0) -> Edges:
    """Shifts of edges per electron of the shipped ITL device about 40,000 e- [pixel/e-]."""
    table, (kx, ky) = by_depth()
    weights = conversion_weights(table.depths, wavelength, 173.0, thickness=table.thickness)
    return np.tensordot(weights, kx, 1), np.tensordot(weights, ky, 1)


@cache
def by_depth() -> tuple[DistortionTable, Edges]:
    """The device's table, and its shifts by depth of conversion."""
    table = DistortionTable.load("itl_sta3800c_60")
    return table, edges_by_depth(table, background=40e3)


def wide_shifts(reach: int) -> Edges:
    """Shifts of the same device, continued beyond its table as for corrections [pixel/e-]."""
    table, _ = by_depth()
    quadrant = quadrant_shifts(table, background=40e3, lags=reach + 1)
    i = np.arange(-reach, reach + 1)
    # The right edge of a pixel left of the charge moves as the left edge of its mirror image.
    beside, sign = np.where(i < 0, -i - 1, i), np.where(i < 0, -1.0, 1.0)
    kx = sign * quadrant.east[np.abs(i)[:, None], beside]
    ky = sign[:, None] * quadrant.north[beside[:, None], np.abs(i)]
    return kx, ky


def with_edges(effect: Effect, shot: Shot, layout: Layout) -> Array:
    """Change of areas per electron with an effect [1/e-], the charge in the middle."""
    kx, ky = shifts()
    return area_matrix(*effect.edges(kx, ky, shot, layout))


def lag(a: Array, i: int, j: int) -> float:
    """Element of a matrix of areas."""
    middle = len(a) // 2
    return float(a[middle + j, middle + i])


def row(count: int) -> tuple[Figure, list[Axes]]:
    """Panels beside one another."""
    figure = new_figure((5.0, 7.6, 9.6)[count - 1], 2.8)
    return figure, list(np.atleast_1d(figure.subplots(1, count)))


def show(
    ax: Axes, image: Array, title: str, low: float, high: float, *, map_: str = "gray",
    unit: str = "e⁻", origin: tuple[int, int] = (0, 0), bar: bool = True,
) -> None:  # fmt: skip
    """An image with its scale."""
    ny, nx = image.shape
    x, y = origin
    drawn = ax.imshow(
        image, origin="lower", cmap=map_, vmin=low, vmax=high, interpolation="nearest",
        extent=(x - 0.5, x + nx - 0.5, y - 0.5, y + ny - 0.5), aspect="equal",
    )  # fmt: skip
    ax.set(xlabel="x [pixel]", ylabel="y [pixel]")
    ax.set_title(title, fontsize=10)
    if bar:
        ax.figure.colorbar(drawn, ax=ax, label=f"[{unit}]", fraction=0.046, pad=0.03)


def curves(ax: Axes, x: Array, off: Array, on: Array, marker: str = "") -> None:
    """A curve without and one with the effect."""
    ax.plot(x, off, marker=marker, ms=4, **OFF)
    ax.plot(x, on, marker=marker, ms=4, **ON)
    ax.legend(frameon=False, fontsize=8)


def from_zero(ax: Axes) -> None:
    """Let an axis begin at 0 and end above its curves."""
    ax.set_ylim(0, 1.12 * max(float(np.max(line.get_ydata())) for line in ax.lines))


def before_and_after(
    word: str, values: dict[str, float], variant: str = ""
) -> tuple[Effect, Effect]:
    """An effect switched off, and the same with given values."""
    on = make_effect(word, values, variant)
    return on.scaled(0.0), on
