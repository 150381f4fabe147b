"""Colours, example charge and helpers that all figures share.

Colours are those of Okabe & Ito (2008), which the colour-blind can distinguish.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bfsensor.errors import BFSensorError
from bfsensor.files import written_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bfsensor.simulate.poisson import Potential

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, BLACK, GREY = "#CC79A7", "#56B4E9", "#222222", "#B5B5B5"

SHOWN_CHARGE = 80_000.0
"""Stored charge of the example figures [e-]: published, that of the figures of Lage, Bradshaw &
Tyson (2017)."""


def save_figure(figure: Figure, path: str | os.PathLike[str], dots: int = 120) -> Path:
    """Write a figure to a file, whole or not at all.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        The figure.
    path : path-like
        File to write, .png, .pdf or .svg; one that exists is replaced.
    dots : int
        Dots per inch of a .png.

    Returns
    -------
    path : Path
        The file.

    Raises
    ------
    BFSensorError
        The file cannot be written.
    """
    path = Path(path)
    with written_whole(path, BFSensorError) as beside:
        figure.savefig(beside, dpi=dots, format=path.suffix[1:] or "png")
    return path


def import_matplotlib() -> Any:
    """Import matplotlib.

    Returns
    -------
    module
        The package ``matplotlib``.

    Raises
    ------
    BFSensorError
        Matplotlib is missing; the message says how to install it.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise BFSensorError(
            "figures need matplotlib, which is not installed: pip install 'bfsensor[plots]'"
        ) from error
    return matplotlib


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure that is not attached to any window.

    Parameters
    ----------
    width, height : float
        Size [inch].

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    """
    import_matplotlib()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def electrons_text(charge: float) -> str:
    """Write a number of electrons with thin spaces between thousands, such as 80 000 e-."""
    return f"{charge:,.0f}".replace(",", "\u2009") + " e⁻"


def central_pixel(potential: Potential) -> tuple[int, int]:
    """Return the index (row, column) of pixel (0, 0) in ``potential.charges``."""
    mesh = potential.mesh
    return int(np.argmax(mesh.pixels("y") == 0)), int(np.argmax(mesh.pixels("x") == 0))
