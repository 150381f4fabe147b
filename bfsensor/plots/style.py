"""What all figures share: colours, sizes, words.

Colours are those of Okabe & Ito (2008), which the colour-blind can tell apart.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bfsensor.errors import BFSensorError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bfsensor.simulate.poisson import Potential

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, BLACK, GREY = "#CC79A7", "#56B4E9", "#222222", "#B5B5B5"

SHOWN_CHARGE = 80_000.0
"""Stored charge of the example figures [e-], as in the publication."""


def import_matplotlib() -> Any:
    """Import matplotlib, or say how to get it.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise BFSensorError(
            "figures need matplotlib, which is not installed: pip install 'bfsensor[plots]'"
        ) from error
    return matplotlib


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure of a size [inch], not attached to any window."""
    import_matplotlib()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def electrons_text(charge: float) -> str:
    """Write a number of electrons as it is read: 80 000 e-."""
    return f"{charge:,.0f}".replace(",", "\u2009") + " e⁻"


def central_pixel(potential: Potential) -> tuple[int, int]:
    """Place of pixel (0, 0) in ``potential.charges``."""
    mesh = potential.mesh
    return int(np.argmax(mesh.pixels("y") == 0)), int(np.argmax(mesh.pixels("x") == 0))
