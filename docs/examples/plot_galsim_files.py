"""
A table for GalSim's own sensor
===============================

One charge of a table becomes the two files that ``galsim.SiliconSensor`` reads.
"""

import tempfile
from pathlib import Path

import galsim
import matplotlib.pyplot as plt

from bfsensor import DistortionTable, write_galsim

table = DistortionTable.load("itl_sta3800c")
stem = Path(tempfile.mkdtemp()) / "itl"
write_galsim(table, stem, charge=80e3, depth=95.0)

# %%
# The same photons with the effect and (almost) without it: the core loses what its neighbours gain.
star = galsim.Gaussian(sigma=0.3, flux=1e6)
images = [
    star.drawImage(
        nx=15, ny=15, scale=0.2, method="phot", rng=galsim.BaseDeviate(5),
        sensor=galsim.SiliconSensor(str(stem), strength, galsim.BaseDeviate(7)),
    ).array
    for strength in (1.0, 1e-6)  # GalSim divides by it: not 0
]  # fmt: skip
change = images[0] - images[1]
plt.imshow(change, origin="lower", cmap="RdBu_r", vmin=-900, vmax=900)
plt.xlabel("x [pixel]")
plt.ylabel("y [pixel]")
plt.colorbar(label="electrons gained by the brighter-fatter effect")

# %%
# The width grows; nothing is lost in the middle of the image.
widths = [galsim.hsm.FindAdaptiveMom(galsim.Image(i)).moments_sigma for i in images]
assert 1.003 < widths[0] / widths[1] < 1.03
assert abs(change.sum()) < 1e-3 * images[0].sum()
