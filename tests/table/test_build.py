"""From device to table: plans, levels, resuming, error estimates."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from bfsensor.device.device import Device, builtin_devices
from bfsensor.device.parts import Ripple
from bfsensor.errors import DeviceError, TableError
from bfsensor.response.light import conversion_depths, storage_height
from bfsensor.simulate.boundaries import lowest_depth
from bfsensor.simulate.unit_cell import solve_unit_cell
from bfsensor.simulate.well import barrier, full_well
from bfsensor.table import build
from bfsensor.table.assess import (
    _area_changes,
    _single,
    _singles,
    assess,
    mesh_errors,
    superposition_error,
)
from bfsensor.table.build import build_table, peak_memory
from bfsensor.table.levels import Level, _workshop, solve_level
from bfsensor.table.table_plan import plan_table


@pytest.fixture(scope="module")
def device():
    return Device.load("itl_sta3800c")


@pytest.fixture(scope="module")
def plan(device):
    coarse = plan_table(
        device,
        charges=[0.0, 4e4, 8e4],
        backgrounds=[0.0, 4e4],
        depths=[10.0, 95.0],
        vertices=4,
        pixels=3,
        accuracy=0.05,
    )
    return dataclasses.replace(coarse, cells=8)


@pytest.fixture(scope="module")
def table(plan):
    return build_table(plan)


def test_finished_levels_are_found_whatever_is_known_of_the_device(plan, device):
    again = device.with_value("back_bias", "-61 V").with_value("back_bias", "-50 V")
    assert again.to_toml() != device.to_toml()  # its source is gone
    assert dataclasses.replace(plan, device=again).key == plan.key
    other = dataclasses.replace(plan, device=device.with_value("back_bias", "-61 V"))
    assert other.key != plan.key


def test_full_well_is_where_the_barrier_falls_to_the_spill_barrier(device):
    well = full_well(device)
    # 182,364 e- were measured at these gate voltages (another back bias); the spill barrier was
    # fitted to that and six other levels with 0.2 V of scatter, 9,000 e-/0.1 V.
    assert 1.5e5 < well < 2.1e5
    deeper = device.with_value("spill_barrier", "1.8 V")
    assert full_well(deeper) > 1.1 * well


def test_full_well_refuses_a_well_that_never_closes(device):
    with pytest.raises(
        DeviceError,
        match=r"spill_barrier = 9 V is not below the barrier of the empty pixel",
    ):
        full_well(device.with_value("spill_barrier", "9 V"))


def test_barrier_falls_as_the_well_fills(device):
    from bfsensor.simulate.mesh import make_mesh
    from bfsensor.simulate.poisson import Electrostatics

    solver = Electrostatics(device, make_mesh(device, pixels=(2, 2), cells=8))
    heights = []
    for charge in (0.0, 5e4, 1e5):
        charges = np.zeros(solver.pixel_shape)
        charges[0, 0] = charge
        heights.append(barrier(solver.solve(charges)))
    assert heights[0] > heights[1] > heights[2] > 0


@pytest.mark.parametrize(
    "name", [n for n in builtin_devices() if Device.load(n).image_charge is None]
)
def test_the_lowest_level_is_where_the_charge_is_stored(name):
    device = Device.load(name)
    for charge in (2e4, 1.5e5):
        found = lowest_depth(solve_unit_cell(device, charge, cells=16))
        # The mean height of the electrons falls by 0.09 um as the well fills.
        assert storage_height(device) == pytest.approx(found, abs=0.07)


def test_default_plan_covers_the_well(device):
    plan = plan_table(device)
    assert len([q for q in plan.charges if q > 0]) >= 6
    assert plan.charges[-1] == pytest.approx(0.9 * plan.full_well, rel=0.05)
    assert plan.backgrounds[-1] == pytest.approx(0.8 * plan.full_well, rel=0.05)
    assert plan.depths == conversion_depths(device)
    assert plan.depths[-1] == device.silicon.thickness


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"charges": [5e5]}, r"charge = 500000 e- must be .* full well .* 17\d+ e-, .* falls to 2.2 V"),
        ({"backgrounds": [3e5]}, r"background = 300000 e- must be from 0 to the full well"),
        ({"charges": [4e4, 4e4]}, r"charges \[40000.0, 40000.0\] must ascend"),
        ({"depths": [0.2]}, r"depth = 0.2 um must lie in the silicon of itl_sta3800c, from 0.9 um"),
        ({"depths": [140.0]}, r"depth = 140 um must lie in the silicon.*100 um, the back surface"),
        ({"pixels": 8}, r"pixels = 8 must be odd and from 3 to 11"),
        ({"vertices": 1}, r"vertices = 1 must be at least 2"),
        ({"accuracy": 1e-5}, r"accuracy = 1e-05 must be finite and at least 0.005"),
    ],
)  # fmt: skip
def test_requests_that_cannot_be_met(device, request_, message):
    with pytest.raises(TableError, match=message):
        plan_table(device, **request_)


def test_a_device_without_mirror_planes_is_refused(device):
    silicon = dataclasses.replace(device.silicon, ripples=(Ripple("plane", 0.01, 100.0),))
    with pytest.raises(TableError, match="mirror-symmetric"):
        plan_table(dataclasses.replace(device, silicon=silicon))


def test_uniform_images_do_not_distort(table):
    assert np.all(table.corners[1, 1] == 0)  # 40,000 e- on 40,000 e-
    assert np.all(table.horizontal[0, 0] == 0)
    assert np.abs(table.horizontal[2, 1]).max() > 0.01


def test_a_hole_in_a_background_attracts(table):
    dark = table.area_changes(charge=0.0, background=4e4, depth=95.0)
    bright = table.area_changes(charge=8e4, background=4e4, depth=95.0)
    assert dark[1, 1] > 0 > bright[1, 1]
    assert dark[1, 1] == pytest.approx(-bright[1, 1], rel=0.2)


def test_levels_do_not_depend_on_what_was_solved_before(plan, table):
    _workshop.cache_clear()
    alone = solve_level(plan, 8e4, 4e4)
    again = solve_level(plan, 8e4, 4e4)
    for name in ("corners", "horizontal", "vertical"):
        assert np.array_equal(getattr(alone, name), getattr(again, name))
        kept = np.array(getattr(alone, name), np.float32)
        assert np.array_equal(kept, getattr(table, name)[2, 1].astype(np.float32))


def test_an_interrupted_run_goes_on_to_the_same_bits(plan, table, tmp_path, monkeypatch):
    solved = []
    original = build.solve_level

    def interrupted(plan_, charge, background):
        if len(solved) == 3:
            raise KeyboardInterrupt
        solved.append((charge, background))
        return original(plan_, charge, background)

    monkeypatch.setattr(build, "solve_level", interrupted)
    with pytest.raises(KeyboardInterrupt):
        build_table(plan, checkpoint=tmp_path)
    monkeypatch.setattr(
        build, "solve_level", lambda *a: solved.append(a[1:]) or original(*a)
    )
    resumed = build_table(plan, checkpoint=tmp_path)
    assert len(solved) == 6  # three before, three after
    for name in ("corners", "horizontal", "vertical"):
        assert np.array_equal(getattr(resumed, name), getattr(table, name))


def test_another_plan_does_not_find_the_levels(plan):
    other = dataclasses.replace(plan, device=plan.device.with_value("back_bias", "-51 V"))
    assert other.key != plan.key


def test_level_round_trip(plan, tmp_path):
    level = solve_level(plan, 4e4, 0.0)
    level.write(tmp_path / "level.npz")
    back = Level.read(tmp_path / "level.npz")
    assert np.array_equal(back.corners, level.corners)
    assert (back.newton, back.error_volts) == (level.newton, level.error_volts)
    assert [p.name for p in tmp_path.iterdir()] == ["level.npz"]


def test_superposition_of_far_pixels_is_exact_and_of_near_ones_nearly(plan):
    pair = superposition_error(plan, {(0, 0): 8e4, (1, 0): 8e4})
    assert 0.0005 < pair < 0.03


@pytest.mark.slow
def test_assessment_of_the_shipped_devices_meets_its_aims():
    for name in ("itl_sta3800c", "e2v_ccd250"):
        errors = assess(plan_table(Device.load(name), accuracy=0.01))
        assert errors["tracing [um]"] < 3e-4
        assert errors["mesh (0,0) [%]"] < 1
        assert errors["superposition, star at half full well [%]"] < 2


def test_mesh_errors_of_a_table_are_of_its_own_levels(plan, monkeypatch):
    """The finer result is the table's: only the coarser mesh is solved, at the table's charge."""
    small = dataclasses.replace(plan, cells=16, charges=(0.0, 8e4), backgrounds=(0.0,))
    table = build_table(small)
    solved = []

    def solve(plan, charge, background):
        solved.append((plan.cells, charge, background))
        return solve_level(plan, charge, background)

    monkeypatch.setattr("bfsensor.table.assess.solve_level", solve)
    found = mesh_errors(small, table)
    # The table has no background, of which the error is still said.
    assert solved[0] == (8, 8e4, 0.0) and [cells for cells, *_ in solved[1:]] == [8, 16]
    rough, fine = (
        _area_changes(dataclasses.replace(small, cells=c), 8e4, 0.0) for c in (8, 16)
    )
    n = small.reach
    assert found["mesh (0,0) [%]"] == pytest.approx(
        100 * abs(1 - rough[n, n] / fine[n, n]) / 3, rel=1e-3
    )


def test_displacements_between_three_charges_are_nearly_exact(plan):
    """Single pixels of a star, of which three charges are solved and the others interpolated."""
    found = _singles(plan, (2e4, 3e4, 5e4, 9e4), 0.0)
    for part, exact in zip(found[3e4], _single(plan, 3e4, 0.0), strict=True):
        assert np.linalg.norm(part - exact) < 0.012 * np.linalg.norm(exact)


def test_peak_memory_is_that_of_the_largest_process():
    """A child holds 0.2 GB more than this process, or as the largest child, ever did."""
    before = peak_memory()
    assert before > 0.05  # this process alone, before it has had a child
    size = int(1.024e9 * before + 2e8)  # memory is counted in 1e6 kB of 1024 bytes
    subprocess.run([sys.executable, "-c", f"b'1' * {size}"], check=True)
    assert before + 0.18 < peak_memory() < before + 0.4
