"""Cached response: equal to the table, kept bit for bit, and smooth in the device."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.device.parameters import change_parameter
from bfsensor.diagnose.model.cached_response import SPAN, walk
from bfsensor.diagnose.model.table_baseline import edges_at
from bfsensor.errors import DiagnosisError, FitError
from bfsensor.response.edge_response import CHARGE, LEVEL, REFINE_Z, area_matrix
from bfsensor.table.build import build_table
from bfsensor.table.table_plan import plan_table


def areas(device):
    found = area_matrix(*walk(device, cells=8).edges(None, 173.0))
    n = len(found) // 2
    return found[n : n + 2, n : n + 2]


def test_a_walk_is_the_table_and_kept(tmp_path):
    device = Device.load("itl_sta3800c")
    found = walk(device, cells=16, keep=tmp_path)
    (path,) = tmp_path.glob("node_*.npz")
    again = walk(device, cells=16, keep=tmp_path)
    assert np.array_equal(found.kx, again.kx) and np.array_equal(found.ky, again.ky)
    plan = plan_table(
        device, charges=[LEVEL, LEVEL + CHARGE], backgrounds=[LEVEL],
        depths=list(found.depths), accuracy=0.05, refine_z=REFINE_Z,
    )  # fmt: skip
    wanted = edges_at(build_table(plan), 950.0, 173.0, background=LEVEL)
    for one, other in zip(found.edges(950.0, 173.0), wanted, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3 * abs(other).max())
    path.write_bytes(b"half")
    with pytest.raises(FitError, match=r"\.npz: .*delete it"):
        walk(device, cells=16, keep=tmp_path)
    with pytest.raises(DiagnosisError, match="one background"):
        found.bent(None, 173.0)


def test_slopes_and_bends_are_those_of_the_backgrounds():
    backgrounds = LEVEL - SPAN, LEVEL, LEVEL + SPAN
    found = walk(Device.load("itl_sta3800c"), cells=8, backgrounds=backgrounds)
    (slope, _), (bend, _) = found.bent(620.0, 173.0)
    middle = found.edges(620.0, 173.0)[0]
    for away, k in ((-SPAN, 0), (SPAN, 2)):
        ends = type(found)((LEVEL,), found.depths, found.kx[k : k + 1], found.ky[k : k + 1])
        told = middle + away * slope + away**2 * bend
        np.testing.assert_allclose(told, ends.edges(620.0, 173.0)[0], atol=1e-15)


def test_boundaries_at_low_back_bias_go_smoothly_with_the_device():
    """At -30 V the field over the stops is weak: boundaries were wrong by up to a pixel there."""
    device = Device.load("itl_sta3800c").with_value("back_bias", "-30 V")
    plain = areas(device)
    near = areas(change_parameter(device, "silicon.background_doping", -0.032))
    # Doping less by 1.3 % changes areas by 0.3 %.
    np.testing.assert_allclose(near, plain, rtol=0.006)
