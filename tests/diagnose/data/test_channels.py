"""Channels: whitening, what is refused, folds, pairs."""

import pickle
from dataclasses import dataclass

import numpy as np
import pytest

from bfsensor.diagnose.data.channels import Channel, join_channels
from bfsensor.diagnose.data.exposure_info import assign_folds, condition_of, label_of
from bfsensor.diagnose.data.flat_channels import TAIL, mean_profile, profile
from bfsensor.diagnose.data.flat_pairing import (
    PairFinder,
    by_level,
    find_steps,
    group_flats,
)
from bfsensor.errors import DiagnosisError


def example(word="flat_cov", fold="fit"):
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3)) + 3 * np.eye(3)
    blocks = (root @ root.T, np.array([[4.0]]))
    axes = {"i": np.arange(4), "level": np.full(4, 10.0)}
    return Channel(word, rng.normal(size=4), blocks, axes, "adu2", fold)


def test_whitened_noise_is_white():
    channel = example()
    rng = np.random.default_rng(4)
    dense = np.zeros((4, 4))
    dense[:3, :3], dense[3, 3] = channel.blocks[0], 4.0
    noise = np.linalg.cholesky(dense) @ rng.normal(size=(4, 40_000))
    white = channel.whiten(noise)
    np.testing.assert_allclose(white @ white.T / 40_000, np.eye(4), atol=0.03)
    np.testing.assert_allclose(channel.unwhiten(white[:, 0]), noise[:, 0], rtol=1e-9)
    square = (channel.whiten(channel.values) ** 2).sum()
    assert square == pytest.approx(channel.values @ np.linalg.solve(dense, channel.values))


def test_channels_pickle_and_join():
    one, other = example(), example()
    back = pickle.loads(pickle.dumps(one))
    assert back.word == one.word
    np.testing.assert_array_equal(back.whiten(one.values), one.whiten(one.values))
    both = join_channels([one, other])
    assert len(both) == 8
    np.testing.assert_allclose(both.whiten(both.values)[:4], one.whiten(one.values))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"word": "flats"}, "'flats' is not one of"),
        ({"fold": "train"}, "'train' is not one of fit, select, held-out"),
        ({"values": np.zeros(3)}, r"flat_cov: \(3,\) .* blocks of 4"),
        ({"values": np.array([0, 1, np.nan, 2.0])}, "1 values are not finite"),
        ({"blocks": (np.zeros((3, 3)), np.eye(1))}, "not positive definite"),
        ({"axes": {"i": np.arange(3)}}, r"axis i .*\(3,\).*\(4,\)"),
    ],
)
def test_refuses_what_does_not_fit(change, message):
    good = example()
    values = {"word": good.word, "values": good.values, "blocks": good.blocks,
              "axes": dict(good.axes), "unit": "adu2", "fold": "fit"}  # fmt: skip
    with pytest.raises(DiagnosisError, match=message):
        Channel(**{**values, **change})


@pytest.mark.parametrize("count", range(1, 30))
def test_folds_hold_out_some_of_three_and_more(count):
    folds = assign_folds(range(count), shift=count)
    assert len(folds) == count
    assert folds.count("fit") >= count / 2
    if count >= 3:
        assert "held-out" in folds
    if count >= 4:
        assert "select" in folds


@dataclass
class Shot:
    number: int
    exposure_time: float
    wavelength: float = 620.0
    back_bias: float = -60.0
    temperature: float | None = None
    lamp: float | None = None
    pair: int | None = None
    level: float = 1000.0


def pairs_of(shots):
    """Frames are stood for by the level itself."""
    finder = PairFinder(lambda shot: shot.level, lambda level: level)
    found = [
        (a[0].number, b[0].number)
        for groups in by_level(group_flats(shots), find_steps(shots))
        for a, b in finder.pairs(groups)
    ]
    return found, [s.number for s in finder.single], finder.notes


def test_pairs_are_neighbours_of_one_condition_and_time():
    times = [1, 1, 5, 5, 5, 1, 1]
    shots = [Shot(n, t) for n, t in enumerate(times)]
    assert pairs_of(shots) == ([(0, 1), (5, 6), (2, 3)], [4], [])
    shots[1].back_bias = -40.0
    assert pairs_of(shots) == ([(2, 3), (5, 6)], [4], [])
    assert label_of(condition_of(shots[0])) == "620/-60/nan"


def test_unequal_levels_make_no_pair():
    """The lamp of the first was 13 % weaker: the other two are the pair."""
    shots = [Shot(n, 30, level=v) for n, v in enumerate((5843.0, 6624.0, 6349.0))]
    found, single, (note,) = pairs_of(shots)
    assert found == [(1, 2)] and single == [0]
    assert all(f" {word} " in note for word in ("0, 1: levels of", "5843", "6624"))


def test_numbers_of_pairs_count_where_there_are_any():
    shots = [Shot(n, 30, pair=p) for n, p in enumerate((0, 1, 0, 1, None))]
    assert pairs_of(shots)[0] == [(0, 2), (1, 3)]


def test_overscan_profile_finds_what_is_deferred():
    rng = np.random.default_rng(7)
    frames = rng.normal(1000.0, 2.0, (40, 200, 24))
    frames[:, :, 0] += 0.5
    profiles = np.array([profile(f.astype(np.float32), 1) for f in frames])
    values, matrix = mean_profile(profiles)
    assert len(values) == 24 - TAIL
    error = np.sqrt(np.diag(matrix))
    np.testing.assert_allclose(error, 2.0 * np.sqrt(1 / 8000 + 1 / 64000), rtol=0.05)
    assert abs(values[0] - 0.5) < 4 * error[0]
    assert (np.abs(values[1:]) < 4.5 * error[1:]).all()
    assert profile(np.zeros((200, 5), np.float32), 1).shape == (0, 2)
