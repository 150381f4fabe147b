"""What simulations leave out, as candidates: with all of it they are the other simulation."""

import dataclasses
import pickle

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.device.parameters import change_parameter, parameter_value
from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.data.exposure_info import Axes, condition_at
from bfsensor.diagnose.detect.candidates import candidates_of, name_of
from bfsensor.diagnose.model.cached_response import walk
from bfsensor.diagnose.model.device_baseline import baseline_of_device
from bfsensor.diagnose.model.left_out_physics import (
    GUARD,
    PIECES,
    RIPPLE,
    physics_left_out,
    rim_shifts,
    ring_shifts,
)
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.bf_long_range import BrighterFatterLongRange
from bfsensor.effects.effect import Layout, Shot
from bfsensor.response.edge_response import area_matrix
from bfsensor.sensor.drift_field import STEPS, Drift
from validation.explanation.concealed_physics import REFERENCE, _measured

CELLS = 8
HOLES = PIECES[0].step
LEVEL_OF_HOLES = PIECES[0].quantity
COLD = REFERENCE.temperature
SHOTS = [
    Shot("flat", 0, 1.0, w, v, COLD + t)
    for w, v, t in ((620.0, -50.0, 0.0), (950.0, -40.0, 10.0))
]
LAYOUT = Layout((64, 48), ())

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("walks")


@pytest.fixture(scope="module")
def device():
    return Device.load("itl_sta3800c")


@pytest.fixture(scope="module")
def lacking(device, folder):
    """A device with fewer holes, light that converts at the back, one response for all levels."""
    poor = change_parameter(device, LEVEL_OF_HOLES, -HOLES)
    bare = baseline_of_device(
        poor,
        back_biases=[-50.0, -40.0],
        lacks=["levels", "depths"],
        cells=CELLS,
        keep=folder,
    )
    pieces = physics_left_out(poor, bare, cells=CELLS, keep=folder)
    return dataclasses.replace(bare, pieces=pieces)


def piece(baseline, name):
    return next(k for k in candidates_of(baseline) if name_of(k) == name)


def test_every_piece_is_a_candidate(lacking):
    assert {name_of(k) for k in lacking.pieces} == {
        "silicon_physics:free_holes", "silicon_physics:stop_diffusion",
        "silicon_physics:oxide_charge", "silicon_physics:fewer_gates",
        "silicon_physics:charge_diffusion", "silicon_physics:quantum_yield",
        "bf_nonlinear:simulated", "bf_chromatic:simulated",
        "lateral_diffusion:simulated", "tree_rings:simulated", "edge_rolloff:simulated",
    }  # fmt: skip


def test_nothing_of_a_piece_changes_nothing(lacking):
    k = lacking.at(REFERENCE)[0]
    for kind in lacking.pieces:
        effect = kind({
            p.name: p.neutral if p.amplitude else 0.5 * (p.low + p.high)
            for p in kind.parameters
        })  # fmt: skip
        assert effect.is_neutral() and pickle.loads(pickle.dumps(effect)) == effect
        for shot in SHOTS:
            assert np.array_equal(effect.edges(*k, shot, LAYOUT), k)
            assert effect.level_response(shot, LAYOUT) is None
            assert effect.spot_light(shot, LAYOUT)[0] == 0.0
            assert effect.diffusion_growth(shot, LAYOUT) == 0.0
            moved = effect.displacements(shot, LAYOUT)
            assert moved is None or not any(m.any() for m in moved)


@pytest.mark.parametrize("shot", SHOTS)
def test_all_of_the_holes_are_the_device_with_them(device, lacking, folder, shot):
    full = baseline_of_device(
        device,
        back_biases=[-50.0, -40.0],
        lacks=["levels", "depths"],
        cells=CELLS,
        keep=folder,
    )
    where = condition_at((shot.wavelength, shot.back_bias, shot.temperature))
    plain, truth = (area_matrix(*b.at(where)[0]) for b in (lacking, full))
    value = parameter_value(device, LEVEL_OF_HOLES)
    effect = piece(lacking, "silicon_physics:free_holes")({LEVEL_OF_HOLES: value})
    told = area_matrix(*effect.edges(*lacking.at(where)[0], shot, LAYOUT))
    # Both are solved on one mesh, the truth on its own.
    np.testing.assert_allclose(told, truth, atol=0.01 * abs(truth).max())
    # Holes strengthen the pull of the middle by 8 %, and of the neighbour across stops by half.
    n = len(plain) // 2
    assert truth[n, n] / plain[n, n] > 1.05 and truth[n, n + 1] / plain[n, n + 1] > 1.3


@pytest.mark.parametrize("shot", SHOTS)
def test_all_of_the_depths_is_light_that_converts_where_it_is_absorbed(
    lacking, folder, shot
):
    poor = change_parameter(Device.load("itl_sta3800c"), LEVEL_OF_HOLES, -HOLES)
    there = change_parameter(
        poor, "operating_point.back_bias", shot.back_bias - REFERENCE.back_bias
    )
    truth = walk(there, cells=CELLS, keep=folder).edges(shot.wavelength, shot.temperature)
    where = condition_at((shot.wavelength, shot.back_bias, shot.temperature))
    effect = piece(lacking, "bf_chromatic:simulated")({"strength": 1.0})
    plain = lacking.at(where)[0]
    for told, wanted in zip(effect.edges(*plain, shot, LAYOUT), truth, strict=True):
        np.testing.assert_allclose(told, wanted, atol=1e-3 * abs(wanted).max())
    if shot.wavelength > 900:
        assert abs(plain[0] - truth[0]).max() > 0.02 * abs(truth[0]).max()


@pytest.mark.parametrize("unit", ["adu2", PER_ELECTRON])
def test_all_of_the_levels_is_a_baseline_with_levels(lacking, folder, unit, monkeypatch):
    """In flats, and in a_ij on a background that is not the baseline's."""
    monkeypatch.setattr("bfsensor.diagnose.data.reduced_channels.LEVEL", 7e4)
    poor = change_parameter(Device.load("itl_sta3800c"), LEVEL_OF_HOLES, -HOLES)
    full = baseline_of_device(
        poor, back_biases=[-50.0, -40.0], lacks=["depths"], cells=CELLS, keep=folder
    )
    effect = piece(lacking, "bf_nonlinear:simulated")({"strength": 1.0})
    axes = Axes()
    for n, level in enumerate((2e4, 9e4)):
        axes.add(3, REFERENCE, i=[0, 1, 0], j=[0, 0, 1], amp=0, level=level, time=float(n))
    channel = Channel("flat_cov", np.zeros(6), (np.eye(6),), axes.columns(), unit)
    measured = _measured([channel], (), {})
    told, wanted, without = (
        p.predict(channel, p.start)
        for p in (Predictor(measured, lacking, [effect]), Predictor(measured, full),
                  Predictor(measured, lacking))
    )  # fmt: skip
    np.testing.assert_allclose(told, wanted, rtol=1e-9)
    # Areas change by 1 % over 30,000 e-, neighbours' covariances by 3 %.
    assert abs(without / wanted - 1).max() > 0.01


def uniform(high, field):
    heights = np.linspace(0.0, high, STEPS + 1)
    return Drift(heights, np.full(STEPS + 1, field), heights, heights)


def test_ripples_of_the_doping_in_both_limits(device):
    """Short ones pull as in free silicon, long ones as a slab between planes."""
    pitch, high, field = 10.0, 100.0, 0.5
    density = RIPPLE * abs(device.silicon.background_doping)
    permittivity = 11.7 * 55.26349  # e- / (V um)
    drift = uniform(high, field)
    short = ring_shifts(device, drift, 0.0, np.array([1.0]))[0] * pitch
    k = 2 * np.pi / pitch
    # Each plane takes a layer of 1/k away.
    free = density / (permittivity * k * field) * (high - 2 / k)
    assert short[-1] == pytest.approx(free, rel=2e-3)
    long = ring_shifts(device, drift, 0.0, np.array([500.0]))[0] * pitch
    k /= 500.0
    # phi = rho z (L - z) / 2 epsilon, its integral L^3 / 12.
    slab = k * density / (2 * permittivity) * high**3 / 6 / field
    assert long[-1] == pytest.approx(slab, rel=2e-3)


def test_a_guard_ring_shifts_the_outer_boundaries_inwards(device, lacking):
    kind = piece(lacking, "edge_rolloff:simulated")
    moved = kind({"strength": 0.1}).displacements(SHOTS[0], LAYOUT)
    poor = change_parameter(device, LEVEL_OF_HOLES, -HOLES)
    _, inwards = rim_shifts(dataclasses.replace(poor, edge=GUARD))
    # Light of 620 nm converts 3 um below the back surface.
    assert moved[0][0, 3] == pytest.approx(0.1 * inwards[-1, 3], rel=0.1)
    assert moved[0][0, -4] == -moved[0][0, 3]
    assert np.array_equal(moved[1][:, 0][:20], moved[0][0, :20])


def test_spots_follow_the_levels_whatever_reaches_farther(lacking, folder):
    """A far-reaching effect beside slopes that reach less far; without slopes sizes differ."""
    poor = change_parameter(Device.load("itl_sta3800c"), LEVEL_OF_HOLES, -HOLES)
    full = baseline_of_device(
        poor, back_biases=[-50.0, -40.0], lacks=["depths"], cells=CELLS, keep=folder
    )
    axes = Axes()
    for number, flux in enumerate((5e4, 5e5)):
        axes.add(
            1, REFERENCE, what="sigma_x", light=flux, flux=flux, time=1.0, hours=0.0,
            exposure=number,
        )  # fmt: skip
    channel = Channel("spot", np.ones(2), (np.eye(2),), axes.columns(), "")
    measured = _measured([channel], (), {})
    far = BrighterFatterLongRange({
        p.name: 1e-5 * p.low if p.amplitude else p.low
        for p in BrighterFatterLongRange.parameters
    })  # fmt: skip
    levels = piece(lacking, "bf_nonlinear:simulated")({"strength": 1.0})
    bent, with_far, told, straight = (
        p.predict(channel, p.start)
        for p in (Predictor(measured, full), Predictor(measured, full, [far]),
                  Predictor(measured, lacking, [levels]), Predictor(measured, lacking))
    )  # fmt: skip
    np.testing.assert_allclose(with_far, bent, atol=2e-5)
    np.testing.assert_allclose(told, bent, rtol=1e-12)
    assert abs(straight - bent).max() > 3e-4
