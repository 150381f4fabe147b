"""
A device at another voltage
===========================

Change a quantity of a shipped device, solve a small table of it, compare.
"""

import matplotlib.pyplot as plt
import numpy as np

from bfsensor import Device, build_table, plan_table

charges = [20e3, 50e3, 80e3]
lost = {}
for volts in (-50, -70):
    device = Device.load("itl_sta3800c").with_value("back_bias", f"{volts} V")
    plan = plan_table(
        device, charges=charges, backgrounds=[0.0], depths=[95.0], accuracy=0.05
    )
    table = build_table(plan)
    areas = [table.area_changes(charge=q, depth=95.0)[4, 4] for q in charges]
    lost[volts] = -np.array(areas) / np.prod(table.pitch)
    plt.plot(np.array(charges) / 1e3, 100 * lost[volts], "o-", label=f"{volts} V")
plt.xlabel("charge in the pixel [1000 e-]")
plt.ylabel("part of its area that it loses [%]")
plt.legend(title="back bias")

# %%
# In the higher field electrons reach the gates sooner, and are displaced less on their way.
assert np.all(lost[-70] < 0.95 * lost[-50])
