"""
Stars grow with flux
====================

The same photons, with the effect and without it: the ratio of the widths is the brighter-
fatter effect alone.
"""

import galsim
import matplotlib.pyplot as plt

import bfsensor

FLUXES = 1e5, 3e5, 6e5, 1e6


def width(flux, strength):
    """Width of a star [pixel] drawn with a sensor."""
    sensor = bfsensor.BrighterFatterSensor(
        "itl_sta3800c", strength=strength, rng=galsim.BaseDeviate(815)
    )
    star = galsim.Moffat(beta=3, fwhm=0.7, flux=flux)
    image = star.drawImage(
        nx=41, ny=41, scale=0.2, method="phot", sensor=sensor, rng=galsim.BaseDeviate(3)
    )
    return image.FindAdaptiveMom().moments_sigma


growth = [100 * (width(f, 1.0) / width(f, 0.0) - 1) for f in FLUXES]
plt.plot([f / 1e6 for f in FLUXES], growth, "o-")
plt.xlabel("flux [1e6 electrons]")
plt.ylabel("growth of the width [%]")

# %%
# Ten times the flux grows about ten times as much.
assert 7 < growth[-1] / growth[0] < 13
