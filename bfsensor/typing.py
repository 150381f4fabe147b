"""Types of arrays that signatures name; shapes and units stand in the docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""Double-precision numbers."""

Edges = tuple[FloatArray, FloatArray]
"""Shifts of right and of upper edges, each [row, column] with (0, 0) in the middle."""
