"""Clouds that repel themselves: Coulomb's law, a ball that bursts, Fe55 in a device."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor._kernels import cloud as kernels
from bfsensor._kernels import transport as transport_kernels
from bfsensor.device import silicon
from bfsensor.direct.cloud import FE55_LENGTH, fe55_cloud, trace_cloud
from bfsensor.direct.transport import Tracer, Transport
from bfsensor.errors import SimulationError
from bfsensor.simulate.unit_cell import solve_unit_cell
from tests.direct.test_transport import FIELD, KT, TEMPERATURE, check_variance, synthetic

STRENGTH = 1 / (4 * np.pi * 11.7 * 55.26349362)  # V um


LINEAR = (1e11, 1e6, 1.0)
"""A mobility that does not depend on the field."""


def burst(starts, *, kt, strength, top, law=LINEAR):
    field = synthetic(lambda x, y, z: -FIELD * z, floor=-5.0, top=top)
    out = np.empty_like(starts)
    fates = np.empty(len(starts), np.int64)
    kernels.drift_together(
        *field, transport_kernels.Pace(0.1, 0.1, 1.0, 20_000), kt,
        law, strength, -1.0, starts,
        np.arange(len(starts), dtype=np.uint64), np.uint32(5), np.uint32(6), out, fates,
    )  # fmt: skip
    assert (fates == transport_kernels.ARRIVED).all()
    return out


def test_shells_are_pairs_for_a_round_cloud():
    p = np.random.default_rng(70).normal(0, 0.4, (3000, 3))
    active = np.ones(len(p), bool)
    shells, pairs = np.empty_like(p), np.empty_like(p)
    spread = kernels.shell_field(p, active, STRENGTH, shells)
    kernels.pair_field(p, active, STRENGTH, 0.02, pairs)
    assert spread == pytest.approx(0.4 * np.sqrt(3), rel=0.02)
    r = np.linalg.norm(p, axis=1)
    radial = [(f * p).sum(1) / r for f in (shells, pairs)]
    for low, high in ((0.3, 0.5), (0.5, 0.8), (0.8, 1.2), (1.2, 2.0)):
        ring = (r > low) & (r < high)
        ratio = radial[1][ring].mean() / radial[0][ring].mean()
        assert ratio == pytest.approx(1.0, abs=0.03)
    # Nothing pushes the cloud as a whole.
    assert np.abs(pairs.sum(0)).max() < 1e-9


def test_two_electrons_obey_coulombs_law():
    p = np.array([[0.0, 0, 0], [0, 3.0, 4.0]])
    out = np.empty_like(p)
    kernels.pair_field(p, np.ones(2, bool), STRENGTH, 0.0, out)
    np.testing.assert_allclose(out[1], STRENGTH / 25 * np.array([0, 0.6, 0.8]))
    np.testing.assert_allclose(out[0], -out[1])


def test_a_ball_bursts_as_it_must():
    """An even ball stays one: R^3 = R0^3 + 3 k N s after s = L / E."""
    rng = np.random.default_rng(71)
    count = 1500
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    ball = 0.6 * rng.random((count, 1)) ** (1 / 3) * direction + [0.0, 0.0, 90.0]
    out = burst(ball, kt=0.0, strength=STRENGTH, top=40.0)
    s = (90.0 - 40.0) / FIELD
    expected = (0.6**3 + 3 * STRENGTH * count * s) ** (1 / 3)
    # Rms of a ball across one axis is R / sqrt(5).
    for axis in (0, 1):
        assert out[:, axis].std() * np.sqrt(5) == pytest.approx(expected, rel=0.03)
    # Velocity saturates: the cloud gets flat, and is pushed harder across.
    flat = burst(
        ball, kt=0.0, strength=STRENGTH, top=40.0, law=silicon.mobility_law(TEMPERATURE)
    )
    assert flat[:, 0].std() > 1.05 * out[:, 0].std()
    still = burst(ball, kt=0.0, strength=0.0, top=40.0)
    np.testing.assert_allclose(still[:, :2], ball[:, :2], atol=1e-9)


def test_without_repulsion_the_cloud_diffuses_as_electrons_do():
    starts = np.tile([0.0, 0.0, 90.0], (6000, 1))
    out = burst(starts, kt=KT, strength=0.0, top=40.0)
    check_variance(out[:, 0], 2 * KT * (90.0 - out[:, 2].mean()) / FIELD)


@pytest.fixture(scope="module")
def tracer():
    return Tracer(solve_unit_cell(Device.load("itl_sta3800c"), 0.0, cells=8))


def test_repulsion_widens_fe55(tracer):
    starts = fe55_cloud(seed=72, place=(0.0, 0.0), thickness=100.0, height=80.0)
    shares = {}
    for name, options in (
        ("none", {"repulsion": 0.0}), ("shells", {}), ("pairs", {"softening": 0.01}),
    ):  # fmt: skip
        electrons = trace_cloud(tracer, starts, seed=73, **options)
        assert len(electrons.positions) == 1620
        shares[name] = np.mean((electrons.pixels == 0).all(1))
    assert shares["none"] > shares["shells"] + 0.05
    assert abs(shares["shells"] - shares["pairs"]) < 0.025
    again = trace_cloud(tracer, starts, seed=73)
    assert np.mean((again.pixels == 0).all(1)) == shares["shells"]


def test_x_rays_convert_along_their_attenuation_length():
    heights = np.array([
        fe55_cloud(seed=n, place=(1.0, 2.0), thickness=100.0, electrons=1)[0, 2]
        for n in range(3000)
    ])  # fmt: skip
    last = 96.0
    mean = FE55_LENGTH - last / np.expm1(last / FE55_LENGTH)
    assert abs((100 - heights).mean() - mean) < 4 * heights.std() / np.sqrt(len(heights))
    assert heights.max() <= 100.0 and heights.min() >= 2.0


def test_refuses_what_is_no_cloud(tracer):
    with pytest.raises(SimulationError, match="repulsion = -1"):
        trace_cloud(tracer, [[0, 0, 50.0]], seed=1, repulsion=-1)
    with pytest.raises(SimulationError, match=r"radius = 0\.0 um .* electrons = 1620"):
        fe55_cloud(seed=1, place=(0, 0), thickness=100.0, radius=0.0)
    lone = trace_cloud(tracer, [[1.0, 1.0, 50.0]], seed=1, transport=Transport(diffusion=0))
    assert lone.pixels.tolist() == [[0, 0]]
