"""Symmetries of deviating a_ij: along rows alone they are the readout's."""

import numpy as np

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.detect.silicon_or_readout import find_symmetry

SIGMA = 1e-9


def tables(biases=(-60.0, -40.0), side=5):
    j, i = (index.ravel() for index in np.indices((side, side)))
    n = len(biases)
    axes = {
        "i": np.tile(i, n), "j": np.tile(j, n), "table": np.repeat(np.arange(n), i.size),
        "back_bias": np.repeat(biases, i.size),
    }  # fmt: skip
    size = n * i.size
    blocks = tuple(np.full((size, 1, 1), SIGMA**2))
    return Channel("flat_cov", np.zeros(size), blocks, axes, PER_ELECTRON)


def response(channel, *, exponent=2.0):
    """Area changes that fall with the distance and conserve area, more of them at lower bias."""
    i, j = channel.axes["i"], channel.axes["j"]
    a = 1e-7 / np.maximum(np.hypot(i, j), 1) ** exponent
    a = np.where((i <= 2) & (j <= 2), a, 0.0)
    weight = np.where(i > 0, 2, 1) * np.where(j > 0, 2, 1)
    for t in np.unique(channel.axes["table"]):
        own = channel.axes["table"] == t
        centre = own & (i == 0) & (j == 0)
        a[centre] = 0.0
        a[centre] = -(weight * a)[own].sum()
    return a * np.where(channel.axes["back_bias"] > -50, 1.5, 1.0)


def noise(channel, seed):
    return SIGMA * np.random.default_rng(seed).standard_normal(len(channel))


def test_charge_that_rows_defer_is_of_the_readout():
    channel = tables()
    i, j = channel.axes["i"], channel.axes["j"]
    deferred = np.where(j == 0, 4e-8 * np.exp(-i), 0.0) * (i > 0)
    found = find_symmetry([channel], [deferred + noise(channel, 1)], [response(channel)])
    assert found.verdict == "readout"
    assert found.total < 0.01 and found.alike < found.scaled
    assert "as of the readout" in found.said() and "is not kept" in found.said()


def test_a_response_that_is_wrong_by_a_tenth_is_of_the_silicon():
    channel = tables()
    a = response(channel)
    found = find_symmetry([channel], [0.3 * a + noise(channel, 2)], [a])
    assert found.verdict == "silicon"
    assert found.total > 0.01 and found.scaled < found.alike
    assert "as of the silicon" in found.said()


def test_noise_decides_nothing_and_is_called_so():
    channel = tables()
    tries = [
        find_symmetry([channel], [noise(channel, seed)], [response(channel)])
        for seed in range(200)
    ]
    assert sum(t.verdict != "open" for t in tries) <= 8
    assert "does not decide" in tries[0].said()
    for values in (
        [t.rows for t in tries],
        [t.columns for t in tries],
        [t.total for t in tries],
    ):
        assert 0.3 < np.mean(values) < 0.7


def test_what_is_missing_is_not_tested():
    one = tables(biases=(-60.0,))
    found = find_symmetry([one], [noise(one, 3)], [response(one)])
    assert np.isnan(found.alike) and "back biases" not in found.said()
    inner = one.take(one.axes["i"] + one.axes["j"] > 0)
    assert np.isnan(find_symmetry([inner], [noise(inner, 3)], [response(one)[1:]]).total)
    row = one.take(one.axes["j"] == 0)
    assert find_symmetry([row], [noise(row, 3)], [row.values]) is None
    assert find_symmetry([], [], []) is None
