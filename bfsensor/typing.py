"""Array types for signatures; shapes and units are in the docstrings of their users."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""Array of double-precision numbers."""

Edges = tuple[FloatArray, FloatArray]
"""Shifts of the right and of the upper edge of each pixel, each [row, column]; the pixel that holds
the charge is in the middle."""
