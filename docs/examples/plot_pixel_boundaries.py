"""
Boundaries of pixels about a full one
=====================================

A table holds where the vertices of pixels move; :meth:`~bfsensor.DistortionTable.polygon`
gives their outlines.
"""

import matplotlib.pyplot as plt

from bfsensor import DistortionTable
from bfsensor.device.shipped import tables_dir

table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
figure, ax = plt.subplots(figsize=(5, 5))
for j in range(-2, 3):
    for i in range(-2, 3):
        outline = table.polygon(i, j, charge=100e3, depth=95.0)
        ax.fill(*outline.T, fc="none", ec="C0", lw=0.8)
ax.set(aspect="equal", xlabel="x [um]", ylabel="y [um]")

# %%
# What the full pixel loses the others gain: nearly nine tenths of it within four pixels.
changes = table.area_changes(charge=100e3, depth=95.0)
assert changes[4, 4] < 0 and 0.8 < 1 - changes.sum() / changes[4, 4] < 1.0
