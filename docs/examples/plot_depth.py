"""
Light that converts deep feels less
===================================

Boundaries are curved: near the gates they are displaced less. GalSim's sensor takes tanh(z
/ 12 um) for this.
"""

import matplotlib.pyplot as plt
import numpy as np

from bfsensor import DistortionTable
from bfsensor.device.shipped import tables_dir

table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
depths = np.geomspace(table.depths[0], table.depths[-1], 20)
loss = np.array([table.area_changes(charge=5e4, depth=z)[4, 4] for z in depths])
plt.plot(depths, loss / loss[-1], "o-", label="this table")
plt.plot(depths, np.tanh(depths / 12.0), "--", label="tanh(z / 12 um)")
plt.xlabel("height of conversion above the gates [um]")
plt.ylabel("part of the full response")
plt.legend()

# %%
# At 10 um the table has more of the response than the tanh.
assert np.interp(10.0, depths, loss / loss[-1]) > np.tanh(10.0 / 12.0) + 0.1
