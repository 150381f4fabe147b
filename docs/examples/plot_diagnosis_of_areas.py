"""
Measured areas beside a simulation
==================================

The a_ij of an E2V sensor (Rubin, 2019) held against two tables: one of the voltages at
which they were measured, one of others.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

from bfsensor.diagnose.data.reduced_channels import measure_reduced
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.model.open_baseline import find_baseline, find_reduced_recording

# %%
# Relative covariances of flats per electron, by serial lag i and parallel lag j, from the
# repository Poisson_CCD (measurements/e2v_covariances_21oct19.txt).
MEASURED = """i_serial,j_parallel,cov_per_e,err_per_e
0,0,-1.680e-06,9.876e-09
1,0,9.828e-08,5.522e-09
2,0,2.797e-08,5.210e-09
0,1,2.747e-07,5.060e-09
1,1,6.433e-08,2.244e-09
2,1,1.923e-08,8.048e-09
0,2,3.405e-08,6.309e-09
1,2,2.293e-08,3.654e-09
2,2,9.687e-09,3.276e-09
"""
path = Path(tempfile.mkdtemp(), "e2v.csv")
path.write_text(MEASURED)
recording = find_reduced_recording(path)
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
