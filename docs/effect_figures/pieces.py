"""One picture for each piece of silicon physics, from the rows of ``validation.silicon.pieces``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from astropy.table import Table
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bfsensor.plots.style import BLACK, RED, new_figure
from effect_figures.parts import Array, Picture

FILE = (
    Path(__file__).resolve().parents[2] / "validation" / "results" / "silicon_pieces.ecsv"
)
USUAL = "620 nm, -50 V"

PIECES: dict[str, Picture] = {}


def piece(name: str) -> Callable[[Callable[[], Figure]], Callable[[], Figure]]:
    """Register a function that draws the picture of a piece; its docstring is the caption."""

    def keep(draw: Callable[[], Figure]) -> Callable[[], Figure]:
        PIECES[name] = Picture(draw, " ".join((inspect.getdoc(draw) or "").split()))
        return draw

    return keep


@cache
def rows() -> Table:
    """Rows of the results."""
    return Table.read(FILE, format="ascii.ecsv")


def select(name: str, what: str) -> Table:
    """Rows of one piece and quantity."""
    table = rows()
    return table[(table["piece"] == name) & (table["what"] == what)]


def by_lag(name: str, what: str, at: str) -> Array:
    """Values by lag, shape (4, 4), row j and column i."""
    out = np.zeros((4, 4))
    for row in select(name, what):
        if row["at"] == at:
            out[row["j"], row["i"]] = row["value"]
    return out


def show_lags(ax: Axes, values: Array, title: str) -> None:
    """Values by lag as colours and numbers."""
    limit = float(np.abs(values).max())
    ax.imshow(values, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit)
    for (j, i), value in np.ndenumerate(values):
        dark = abs(value) > 0.6 * limit
        digits = 2 if limit < 1 else 1 if limit < 20 else 0
        # Rounded zeros have no sign.
        text = f"{round(float(value), digits) + 0.0:.{digits}f}"
        ax.text(i, j, text, ha="center", va="center", fontsize=8,
                color="white" if dark else "black")  # fmt: skip
    ax.set(
        xlabel="lag i (x) [pixel]",
        ylabel="lag j (y) [pixel]",
        xticks=range(4),
        yticks=range(4),
    )
    ax.set_title(title, fontsize=10)


def show_spots(ax: Axes, name: str) -> None:
    """Change of the growth of spots along x and y."""
    values = [float(select(name, f"spot_{axis}")["value"][0]) for axis in "xy"]
    ax.bar((0, 1), values, 0.5, color=RED)
    ax.axhline(0, color=BLACK, lw=0.8)
    ax.set(xticks=(0, 1), xticklabels=("x", "y"), xlabel="axis", xlim=(-0.6, 1.6),
           ylabel="change of the growth [%]")  # fmt: skip
    ax.set_title("spots of 1 pixel", fontsize=10)


def show_conditions(ax: Axes, name: str) -> None:
    """Length of the change over that of all a_ij, by condition."""
    table = select(name, "length")
    values, names = list(map(float, table["value"])), [str(a) for a in table["at"]]
    best = int(np.argmax(values))
    colours = [RED if n == best else "0.7" for n in range(len(values))]
    ax.barh(range(len(values)), values, 0.6, color=colours)
    ax.set(yticks=range(len(values)), yticklabels=names, xlabel="change over all a_ij [%]",
           ylabel="")  # fmt: skip
    ax.set_ylabel("condition")
    ax.tick_params(axis="y", labelsize=8)
    ax.set_title("best seen", fontsize=10)


def draw_piece(name: str) -> Figure:
    """Changes by lag, of spots, and by condition."""
    figure = new_figure(9.6, 2.9)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.1, 0.7, 1.0))
    show_lags(left, by_lag(name, "a_ij", USUAL), f"change of a_ij [%], {USUAL}")
    show_spots(middle, name)
    show_conditions(right, name)
    return figure


@piece("free_holes")
def draw_free_holes() -> Figure:
    """Holes in the channel stops, with a quasi-Fermi level 3 V from the device file's."""
    return draw_piece("free_holes")


@piece("stop_diffusion")
def draw_stop_diffusion() -> Figure:
    """Channel stops that spread sideways by 1.1 um more, or less, than in the device file."""
    return draw_piece("stop_diffusion")


@piece("oxide_charge")
def draw_oxide_charge() -> Figure:
    """A charge of 2e11 electrons a square centimetre at the interface of oxide and silicon."""
    return draw_piece("oxide_charge")


@piece("fewer_gates")
def draw_fewer_gates() -> Figure:
    """Charge that is stored under one gate in place of two (E2V's device)."""
    return draw_piece("fewer_gates")


@piece("more_gates")
def draw_more_gates() -> Figure:
    """Charge that is stored under three gates in place of two (E2V's device)."""
    return draw_piece("more_gates")


@piece("back_bias")
def draw_back_bias() -> Figure:
    """A back bias that differs by 5 V from what the device file states."""
    return draw_piece("back_bias")


@piece("gate_high")
def draw_gate_high() -> Figure:
    """A voltage of the collecting gates that differs by 0.5 V."""
    return draw_piece("gate_high")


@piece("gate_low")
def draw_gate_low() -> Figure:
    """A voltage of the barrier gates that differs by 0.5 V."""
    return draw_piece("gate_low")


@piece("charge_diffusion")
def draw_charge_diffusion() -> Figure:
    """Diffusion whose variance grows by 5 % per 1e5 e- in the pixel, several times what the
    solved fields let expect.
    """
    return draw_piece("charge_diffusion")


@piece("quantum_yield")
def draw_quantum_yield() -> Figure:
    """Covariance that photons with two electrons add, over the level, by lag at 400 nm, and its
    variance and sum over lags against the wavelength, for the published yield.
    """
    figure = new_figure(9.6, 2.9)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.4))
    show_lags(
        left,
        by_lag("quantum_yield", "covariance", "400 nm"),
        "covariance / level [%], 400 nm",
    )
    for what, colour, label in (
        ("variance", BLACK, "variance"), ("all lags", RED, "sum over all lags"),
    ):  # fmt: skip
        table = select("quantum_yield", what)
        waves = [float(str(a).removesuffix(" nm")) for a in table["at"]]
        right.plot(waves, table["value"], color=colour, label=label)
    right.set(xlabel="wavelength [nm]", ylabel="excess over the level [%]")
    right.legend(frameon=False, fontsize=8)
    return figure
