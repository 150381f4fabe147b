"""
Covariances of flats from the table's areas
===========================================

What areas lose and gain per electron makes neighbouring pixels of flats correlate.
"""

import matplotlib.pyplot as plt
import numpy as np

from bfsensor import DistortionTable
from bfsensor.device.shipped import tables_dir

table = DistortionTable.read(tables_dir() / "e2v_ccd250_70" / "table.fits")
level = 40e3
more = table.area_changes(charge=level + 100.0, background=level, depth=95.0)
a = more / 100.0 / (table.pitch[0] * table.pitch[1])  # a_ij [1/e-], from -4 to 4 pixels
image = plt.imshow(
    a * 1e6, origin="lower", extent=(-4.5, 4.5) * 2, vmin=-0.3, vmax=0.3, cmap="RdBu"
)
plt.colorbar(image, label="$a_{ij}$ [1e-6 / e-]")
plt.xlabel("i (x) [pixel]")
plt.ylabel("j (y) [pixel]")

# %%
# Measured on the E2V sensors in 2019: a_00 = -1.68e-6 per electron; light here converts at the back.
assert abs(a[4, 4] / -1.68e-6 - 1) < 0.1
assert np.argmax(a[4:, 4:].ravel()) == 5  # the neighbour along the column gains most
