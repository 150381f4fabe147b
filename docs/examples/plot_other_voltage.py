"""
A device at another voltage
===========================

Change a quantity of a shipped device, solve a small table of it, compare.
"""

import matplotlib.pyplot as plt

from bfsensor import Device, build_table, plan_table

lost = {}
for volts in (-50, -70):
    device = Device.load("itl_sta3800c").with_value("back_bias", f"{volts} V")
    plan = plan_table(
        device, charges=[50e3], backgrounds=[0.0], depths=[95.0], accuracy=0.05
    )
    table = build_table(plan)
    lost[volts] = -table.area_changes(charge=50e3, depth=95.0)[4, 4]
plt.bar([str(v) for v in lost], list(lost.values()))
plt.xlabel("back bias [V]")
plt.ylabel("area lost by 50,000 e- [um$^2$]")

# %%
# A higher field sweeps electrons to the gates faster and is displaced less.
assert lost[-70] < lost[-50]
