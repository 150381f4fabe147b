"""
The response is not linear in charge
====================================

Area that the filled pixel loses per electron, against its charge.
"""

import matplotlib.pyplot as plt
import numpy as np

from bfsensor import DistortionTable
from bfsensor.device.shipped import tables_dir

table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
charges = np.linspace(1e4, 1.3e5, 13)
lost = [-table.area_changes(charge=q, depth=95.0)[4, 4] / q * 1e5 for q in charges]
plt.plot(charges / 1e3, lost, "o-")
plt.xlabel("charge [1000 e-]")
plt.ylabel("area lost [um$^2$ per 100,000 e-]")

# %%
# A linear effect would be a horizontal line.
assert 1.05 < lost[0] / lost[-1] < 1.25
