"""Edge shifts of the card against a mode sum, limits and the practice campaigns."""

import doctest
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.special import k1

import validation.concealed as package
from validation.concealed import (
    arrays,
    card,
    electrostatics,
    library,
    plan,
    sensor,
)
from validation.concealed.card import NOMINAL, SPREAD, baseline_edges, shifts_at
from validation.concealed.electrostatics import ELECTRON, SILICON, edge_shifts

SHARED = Path(__file__).parents[3].parent / "shared"
PRACTICE = SHARED / "practice" / "practice_a" / "baseline_edges.json"


@pytest.mark.parametrize(
    "module", [arrays, card, electrostatics, library, plan, sensor, package]
)
def test_examples_run(module):
    assert doctest.testmod(module).failed == 0


def test_far_edges_agree_with_the_mode_sum():
    """A point charge between planes, E_x = sum (2 / eps T) sin sin k K_1(k r) / 2 pi.

    Shares no formula with the images; the rectangle (6 x 3.5 um) and the edge's length enter
    at second order in their sides over the distance, so an edge 35 um away is averaged here
    over 9 x 9 x 9 points and has to agree to 1e-3.
    """
    absorption, volts = 2.9, NOMINAL["vfront"] + 60.0
    t, h, zx = NOMINAL["thickness"], NOMINAL["h"], NOMINAL["zx"]
    x, w = np.polynomial.legendre.leggauss(120)
    z, w = zx + (x + 1) / 2 * (t - zx), w / 2 * (t - zx)
    drift = volts / t + ELECTRON / SILICON * NOMINAL["doping"] * 1e-12 * (t / 2 - z)
    passed = (1 - np.exp(-(t - z) / absorption)) / (1 - np.exp(-t / absorption))
    n = np.arange(1, 200)[:, None]
    k = n * np.pi / t
    modes = np.sin(k * z) * np.sin(k * h)
    weights = (modes * (w * passed / drift)).sum(axis=1)
    node, weight = np.polynomial.legendre.leggauss(5)
    shift = 0.0
    for u, wu in zip(node, weight, strict=True):
        for v, wv in zip(node, weight, strict=True):
            for edge, we in zip(node, weight, strict=True):
                dx = 35.0 - u * NOMINAL["wx"] / 2
                dy = 5.0 * edge - v * NOMINAL["wy"] / 2
                r = np.hypot(dx, dy)
                field = (
                    ELECTRON / (np.pi * SILICON * t) * (k[:, 0] * k1(k[:, 0] * r) * weights)
                )
                shift -= wu * wv * we / 8 * field.sum() * dx / r / NOMINAL["pixel"]
    ours = shifts_at(NOMINAL, 620.0, -60.0).kx[10, 13]
    assert ours == pytest.approx(shift, rel=1e-3)


def test_shifts_have_the_symmetries_of_the_device_and_conserve_charge():
    shifts = shifts_at(NOMINAL, 620.0, -60.0)
    area = shifts.area_changes()
    inner = area[2:-2, 2:-2]  # the closed rim lacks one edge on the left and below
    assert np.allclose(inner, inner[::-1], rtol=1e-12)
    assert np.allclose(inner, inner[:, ::-1], rtol=1e-12)
    assert abs(area.sum()) < 1e-9 * abs(area[10, 10])
    assert area[10, 10] < 0 < area[10, 11] < area[11, 10]  # larger in y


def test_derivatives_predict_a_shifted_device():
    """Linear to second order: 5 % of the spread's change for one spread, 0.3 % for 0.1."""
    edges = baseline_edges()
    for name in SPREAD:
        moved = shifts_at(
            {**NOMINAL, name: NOMINAL[name] + 0.1 * SPREAD[name]}, 620.0, -60.0
        )
        slope = np.array(
            edges["derivatives_620_m60"][name]["dky" if name == "zy" else "dkx"]
        )
        nominal = shifts_at(NOMINAL, 620.0, -60.0)
        change = moved[1 if name == "zy" else 0] - nominal[1 if name == "zy" else 0]
        at = np.unravel_index(np.argmax(np.abs(change)), change.shape)
        assert change[at] == pytest.approx(0.1 * SPREAD[name] * slope[at], rel=0.01), name


def test_undepleted_silicon_is_refused():
    with pytest.raises(ValueError, match="not depleted: 1 V on 100 um"):
        edge_shifts(NOMINAL, 2.9, 7.0)


@pytest.mark.skipif(
    not PRACTICE.exists(), reason="practice campaigns are not in this place"
)
def test_close_to_the_practice_baseline():
    """Another engine with the same card: edges to 5 %, a_00 to 4 %, the nearest a_ij to 11 %.

    Their edge (0, 0) is 1.7 % more and (0, 1) 3.7 % less than ours, at all biases: another
    average along the edge.  At 6 pixels ours are 1 % smaller, at 950 nm the nearest 4 %.
    """
    theirs = json.loads(PRACTICE.read_text())
    assert theirs["note"] == baseline_edges()["note"]
    for condition, given in theirs["conditions"].items():
        wavelength, bias = (float(v) for v in condition.split("_"))
        ours = shifts_at(NOMINAL, wavelength, bias)
        for axis, k in enumerate(ours):
            other = np.array(given["kx" if axis == 0 else "ky"])
            near = np.s_[10:17, 10:17]
            assert np.allclose(k[near] / other[near], 1, atol=0.05), condition
        area = electrostatics.EdgeShifts(*(np.array(given[k]) for k in ("kx", "ky")))
        ratio = ours.area_changes()[10:14, 10:14] / area.area_changes()[10:14, 10:14]
        assert abs(ratio[0, 0] - 1) < 0.04, condition
        assert np.all(np.abs(ratio - 1) < 0.11), condition
