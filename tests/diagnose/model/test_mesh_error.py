"""Errors of shifts by the mesh are free parameters, and no physics."""

from pathlib import Path

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.diagnose import diagnose_measured, measure_reduced
from bfsensor.diagnose.detect.candidates import candidates_of
from bfsensor.diagnose.model.baseline import Baseline, read_edges
from bfsensor.diagnose.model.cached_response import walk
from bfsensor.diagnose.model.device_baseline import write_edges
from bfsensor.diagnose.model.mesh_error import MESH, mesh_errors, part_of
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.response.edge_response import area_matrix

KEY = (620.0, -50.0)
N = 3


def shifts():
    at = np.arange(-N, N + 1)
    x, y = np.meshgrid(at + 0.5, at)
    kx = -1e-7 * np.sign(x) / (np.abs(x) + y**2) ** 2
    return kx, 1.5 * kx.T


def with_mesh(errors):
    edges = shifts()
    parts = {name: part_of(edges, name) for name in MESH}
    return Baseline(
        "thick", {KEY: edges}, parts, dict.fromkeys(MESH, errors), KEY, held={KEY: parts},
        accuracy=MESH,
    )  # fmt: skip


def table(factors):
    edges = shifts()
    parts = [part_of(edges, name) for name in MESH]
    kx, ky = (sum(f * p[n] for f, p in zip(factors, parts, strict=True)) for n in range(2))
    a = area_matrix(kx, ky)[N : N + 3, N : N + 3]
    errors = np.full(a.shape, 1e-10)
    noise = errors * np.random.default_rng(3).standard_normal(a.shape)
    return AreaChangeTable(Path("made"), a + noise, errors, np.ones(a.shape, bool))


def test_every_edge_has_one_error():
    edges = shifts()
    for axis in (0, 1):
        total = sum(part_of(edges, name)[axis] for name in MESH)
        np.testing.assert_array_equal(total, edges[axis])
    kx, ky = part_of(edges, "mesh.nearest_x")
    assert np.argwhere(kx).tolist() == [[N, N - 1], [N, N]] and not ky.any()


def test_error_is_the_change_between_meshes():
    edges = shifts()

    def scaled(*factors):
        parts = [
            [f * k for k in part_of(edges, n)] for f, n in zip(factors, MESH, strict=True)
        ]
        return tuple(sum(p[axis] for p in parts) for axis in (0, 1))

    found = mesh_errors(scaled(1.0, 0.92, 1, 1), scaled(1.01, 1, 1, 1), edges)
    assert found["mesh.nearest_x"] == pytest.approx(0.01)
    assert found["mesh.nearest_y"] == pytest.approx(0.02)
    assert found["mesh.far"] == 0.0


def test_what_the_mesh_explains_does_not_stand_out():
    measured = measure_reduced(table((1.0, 1.01, 0.995, 1.0)), reach=2)
    without = diagnose_measured(measured, with_mesh(1e-6), explain=False)
    assert without.mismatch.p_value < 1e-3
    free = diagnose_measured(measured, with_mesh(0.01), explain=False)
    assert free.mismatch.p_value > 0.05 and "Farthest" not in free.said()


def test_errors_of_the_mesh_are_no_candidates_and_are_kept_in_files(tmp_path):
    baseline = with_mesh(0.01)
    assert not any("mesh" in k.variant for k in candidates_of(baseline))
    write_edges(baseline, tmp_path / "b.json")
    assert read_edges(tmp_path / "b.json", card=tmp_path / "b.json").accuracy == MESH
    assert baseline.without(["mesh.far"]).accuracy == MESH[:3]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["itl_sta3800c", "e2v_ccd250"])
def test_stated_errors_hold_against_a_finer_mesh(name):
    device = Device.load(name)
    on = {n: walk(device, cells=n).edges(620.0, 173.0) for n in (16, 32, 48, 64)}
    for part, error in mesh_errors(on[16], on[32], on[48]).items():
        old, new = (
            np.concatenate([a.ravel() for a in part_of(on[n], part)]) for n in (48, 64)
        )
        assert abs(old @ new / (new @ new) - 1) < error
