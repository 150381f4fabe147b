"""
Measured areas beside a simulation
==================================

The a_ij of an E2V sensor (Rubin, 2019) held against two tables: one of the voltages at
which they were measured, one of others.
"""

from pathlib import Path

import matplotlib.pyplot as plt

from bfsensor.diagnose.data.reduced_channels import measure_reduced
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.model.open_baseline import find_baseline, find_reduced_recording

recording = find_reduced_recording(
    Path("../../tests/data/e2v_covariances_21oct19.csv").resolve()
)
p_values = {}
for name in ("e2v_ccd250_70", "e2v_ccd250"):
    baseline = find_baseline(name)
    found = diagnose_measured(
        measure_reduced(recording, reach=baseline.reach), baseline, explain=False
    )
    p_values[name] = found.mismatch.p_value
    print(name, f"p = {found.mismatch.p_value:.2g}")
plt.barh(list(p_values), list(p_values.values()))
plt.xscale("log")
plt.xlabel("family-wise p-value")

# %%
# Only the table of the other voltages is refused.
assert p_values["e2v_ccd250_70"] > 0.01 > p_values["e2v_ccd250"]
