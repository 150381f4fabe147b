"""
A table for GalSim's own sensor
===============================

One charge of a table becomes the two files that ``galsim.SiliconSensor`` reads.
"""

import tempfile
from pathlib import Path

import galsim

from bfsensor import DistortionTable
from bfsensor.device.shipped import tables_dir
from bfsensor.table.galsim_format import write_galsim

table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
stem = Path(tempfile.mkdtemp()) / "itl"
write_galsim(table, stem, charge=80e3, depth=95.0)
sensor = galsim.SiliconSensor(name=str(stem))
image = galsim.Gaussian(sigma=0.3, flux=1e5).drawImage(
    nx=21, ny=21, scale=0.2, method="phot", sensor=sensor, rng=galsim.BaseDeviate(5)
)

# %%
# All but photons that fall beside the stamp are collected.
assert 0.99 < image.array.sum() / 1e5 < 1.01
