"""Fits carried to a finer mesh, against solutions and a table on that mesh; from 8 to 16 cells."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.device.condition import Condition
from bfsensor.device.quantities import choose_priors
from bfsensor.errors import FitError
from bfsensor.fit import finer_mesh as finer
from bfsensor.fit import full_solutions as solving
from bfsensor.fit.data import area_data
from bfsensor.fit.finer_mesh import Finer
from bfsensor.fit.fit import fit_device
from bfsensor.fit.linear_response import LinearEmulator, Linearise, LinearResponse
from bfsensor.fit.result import FitResult
from bfsensor.response.edge_response import CHARGE, LEVEL, area_matrix, solve_response
from bfsensor.table.build import build_table
from bfsensor.table.table_plan import plan_table

HERE, RED = Condition(), Condition(wavelength=900.0)
DEVICE = Device.load("itl_sta3800c")
FREE = choose_priors(DEVICE, ("gate_high:0.5 V", "silicon.background_doping"))
NEAR = ((0, 0), (1, 0), (0, 1), (1, 1))


def make_finer(keep, conditions=(HERE,), free=FREE):
    linearise = Linearise(DEVICE, free, conditions, cells=8)
    return Finer(linearise, DEVICE, free, conditions, 16, 8, keep)


def table_areas(device):
    """a_ij [1/e-] of a table on 16 cells, with both charges of the response among its own."""
    plan = plan_table(
        device, charges=[0.0, LEVEL, LEVEL + CHARGE], backgrounds=[LEVEL], depths=[50.0, 100.0],
        accuracy=0.05,
    )  # fmt: skip
    assert plan.cells == 16
    table = build_table(plan)
    change = table.area_changes(charge=LEVEL + CHARGE, background=LEVEL, depth=100.0)
    return change[table.reach :, table.reach :] / (CHARGE * table.pitch[0] * table.pitch[1])


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return tmp_path_factory.mktemp("finer")


@pytest.mark.slow
def test_a_fit_ends_at_the_device_and_the_table_of_the_finer_mesh(tmp_path, kept):
    truth = np.array([prior.mean + 0.7 * prior.spread for prior in FREE])
    x, y = make_finer(kept)._solved(truth, 16)[HERE]
    areas = area_matrix(x, y)[5:-1, 5:-1]
    data = area_data("mock", areas, np.full(areas.shape, 0.002 * areas[0, 1]), scaled=False)
    exact = solving.FullSolutions(DEVICE, FREE, (HERE,), 16, finer.REFINE_Z, kept)
    there = exact(truth).predict(np.zeros(0), HERE)
    np.testing.assert_array_equal(there.areas, areas)
    solve = make_finer(kept)
    found = fit_device(
        DEVICE, [data], FREE, None, linearise=solve, solved=solve.at_draw, draws=2
    )
    # Noiseless and measured far better than the priors: with the coarse mesh's own a_ij the first
    # pull is -1.6, and chi2 2700.
    np.testing.assert_allclose(found.pulls, 0.7, atol=0.01)
    assert found.chi2 < 0.1
    # Derivatives of 8 cells hardly miss over what 0.2 % of a_01 leave open.
    assert found.posterior["solved"] == 2 and not found.posterior["curved"]
    assert 0 < np.max(found.posterior["rms"]["mock"]) < 0.002 * areas[0, 1]
    table = table_areas(Device.from_toml(found.fitted_device))
    ratio = np.array(found.mesh["ratios"][0]["finer_over_own"])
    for (i, j), value in zip(data.places, found.sets[0].after, strict=True):
        if (i, j) in NEAR:
            # Tables take the sheet of electrons and the boundaries less finely, and lay their
            # own mesh: 0.4 % at most.
            assert value == pytest.approx(table[j, i], rel=0.006)
    assert ratio[1, 0] > 1.1  # what the fit's own mesh would have missed of a_01
    written = tmp_path / "fit.json"
    found.write(written)
    assert FitResult.read(written).mesh == found.mesh
    assert (found.mesh["cells"], found.mesh["finer"]) == (8, 16)
    assert sum(f"(0,1) {ratio[1, 0]:.3f}" in note for note in found.notes) == 1


@pytest.mark.slow
def test_values_are_the_finer_mesh_s_and_solved_once(kept, monkeypatch):
    means = np.array([FREE[0].mean])
    solved = []

    def solve_nodes(nodes, **more):
        solved.append(len(nodes))
        return nodes_solver(nodes, **more)

    nodes_solver = solving.solve_nodes
    monkeypatch.setattr(solving, "solve_nodes", solve_nodes)
    both = make_finer(kept, (HERE, RED), FREE[:1])
    carried = both(means)
    coarse = carried.emulator
    assert solved == [1]  # light converts elsewhere, the solution is one
    wanted = solve_response(DEVICE, cells=16, refine_z=finer.REFINE_Z)
    files = {path: path.stat().st_mtime_ns for path in kept.iterdir()}
    for condition in (HERE, RED):
        edges = wanted.edges(condition.wavelength, DEVICE.operating_point.temperature)
        response = carried.predict(means, condition)
        np.testing.assert_allclose(response.kx, edges[0], rtol=0, atol=1e-15)
        np.testing.assert_allclose(response.ky, edges[1], rtol=0, atol=1e-15)
        own = coarse.predict(means, condition)
        np.testing.assert_array_equal(response.jacobian, own.jacobian)
        assert abs(response.areas[1, 0] / own.areas[1, 0] - 1) > 0.1
    again = make_finer(kept, (HERE, RED), FREE[:1])(means)
    np.testing.assert_array_equal(
        again.predict(means, RED).areas, carried.predict(means, RED).areas
    )
    assert {path: path.stat().st_mtime_ns for path in kept.iterdir()} == files
    with pytest.raises(FitError, match="no response was solved at 500 nm"):
        carried.predict(means, Condition(wavelength=500.0))


@pytest.mark.parametrize("cells", [16, 8, 33])
def test_the_finer_mesh_must_be_finer_and_even(cells):
    with pytest.raises(FitError, match=f"finer = {cells} .* even and above the 16"):
        Finer(lambda values: None, DEVICE, FREE, (HERE,), cells, 16)
    nothing = Finer(lambda values: None, DEVICE, FREE, (HERE,), 32, 16)
    with pytest.raises(FitError, match="nothing was solved"):
        nothing.record(np.zeros(2))
    with pytest.raises(FitError, match="nothing was solved"):
        nothing.at_draw(np.zeros(2))


def test_draws_on_fewer_cells_keep_what_the_finer_mesh_adds(monkeypatch):
    """A mesh whose shifts err in proportion to the parameter and to the size of its cells."""

    def solve(device, priors, values, conditions, *, cells, refine_z, keep, progress):
        k = values[0] * (1 + 1 / cells) * pattern
        return dict.fromkeys(conditions, (k, 2 * k))

    monkeypatch.setattr(finer, "solve_shifts", solve)
    pattern = np.random.default_rng(4).uniform(1.0, 2.0, (3, 3))
    nothing = np.zeros((0, 3, 3))
    own = LinearResponse(pattern, pattern, nothing, nothing)
    free = FREE[:1]
    linearise = lambda values: LinearEmulator((), np.zeros(0), {HERE: own})  # noqa: E731
    both = Finer(linearise, DEVICE, free, (HERE,), 48, 16)
    both(np.array([2.0]))
    for value, error in ((2.0, 0.0), (2.5, 0.5 * (1 / finer.DRAWN - 1 / 48))):
        found = both.at_draw(np.array([value])).predict(np.zeros(0), HERE)
        expected = value * (1 + 1 / 48) + error
        np.testing.assert_allclose(found.kx, expected * pattern, rtol=1e-13)
        np.testing.assert_allclose(found.ky, 2 * expected * pattern, rtol=1e-13)
