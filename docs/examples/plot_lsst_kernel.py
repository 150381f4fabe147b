"""
LSST's kernel of a table
========================

The scalar kernel that LSST's pipelines correct images with, from the shifts of a table.
"""

import matplotlib.pyplot as plt
import numpy as np

from bfsensor import DistortionTable
from bfsensor.device.shipped import tables_dir
from bfsensor.table.lsst_format import solve_kernel
from bfsensor.table.quadrant_shifts import quadrant_shifts

table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
shifts = quadrant_shifts(table, background=40e3)
kernel = solve_kernel(shifts.areas)
plt.imshow(kernel * 1e7, origin="lower")
plt.colorbar(label="kernel [1e-7 / e-]")

# %%
# Its Laplacian gives the areas back: what the central pixel loses.
middle = len(kernel) // 2
around = sum(kernel[middle + j, middle + i] for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1)))
assert np.isclose(around - 4 * kernel[middle, middle], -shifts.areas[0, 0])
