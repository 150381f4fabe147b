"""
Absorption length with wavelength and temperature
=================================================

Red light converts deep, where boundaries move less; cold silicon absorbs less of it.
"""

import matplotlib.pyplot as plt
import numpy as np

from bfsensor.device.silicon import absorption_length

wavelengths = np.linspace(350.0, 1000.0, 60)
for temperature in (173.0, 293.0):
    lengths = absorption_length(wavelengths, temperature)
    plt.semilogy(wavelengths, lengths, label=f"{temperature:.0f} K")
plt.xlabel("wavelength [nm]")
plt.ylabel("absorption length [um]")
plt.legend()

# %%
# At 950 nm the silicon of a cold sensor is clearly more transparent.
assert absorption_length(950.0, 173.0) > 1.5 * absorption_length(950.0, 293.0)
