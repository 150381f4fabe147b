"""Darts: equal to plain twins that read the same words, whatever is thrown beside them."""

import numpy as np
import pytest

from bfsensor._kernels import toy
from tests.kernels.test_counter_rng import plain_philox

KEY = (0x51C3, 0x90000007)


def plain_pair(alpha, count, realisation):
    """Difference of the charges and the largest met, one dart after the other."""
    difference = largest = 0
    for m in range(count):
        word = plain_philox((m // 4, realisation, 0, 0), KEY)[m % 4]
        difference += 1 if word / 2**32 < (1 - alpha * difference) / 2 else -1
        largest = max(largest, abs(difference))
    return difference, largest


def plain_array(partners, weights, count, realisation):
    """Charges of one array: words in pairs, the first for the pixel, the second to stay."""
    pixels = len(partners)
    areas, charges = np.ones(pixels), np.zeros(pixels, int)
    throw = 0
    while charges.sum() < count:
        words = plain_philox((throw // 2, realisation, 0, 0), KEY)
        pixel = words[2 * (throw % 2)] * pixels // 2**32
        if words[2 * (throw % 2) + 1] / 2**32 < areas[pixel] / 2:
            charges[pixel] += 1
            for partner, weight in zip(partners[pixel], weights, strict=True):
                areas[partner] += weight
        throw += 1
    return charges


def keys():
    return np.uint32(KEY[0]), np.uint32(KEY[1])


@pytest.mark.kernels
@pytest.mark.parametrize("alpha", [0.0, 0.02, 0.3])
def test_pairs_equal_their_plain_twin(alpha):
    # Counts about a multiple of four, and more realisations than lanes abreast.
    darts = np.resize([37, 0, 1, 4, 5, 38, 39, 40], toy.LANES + 9)
    found = np.full(darts.size, np.nan)
    largest = toy.throw_pair(alpha, darts, *keys(), found)
    twins = [plain_pair(alpha, count, r) for r, count in enumerate(darts)]
    assert found.tolist() == [t[0] for t in twins]
    assert largest == max(t[1] for t in twins)


@pytest.mark.kernels
def test_arrays_equal_their_plain_twin():
    partners = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1]])
    weights = np.array([-0.05, 0.01, 0.04])  # no mirror: the order of partners counts
    darts = np.array([700, 0, 1, 555])
    found = np.full((4, 3), -1, np.int32)
    least, largest = toy.throw_array(partners, weights, darts, *keys(), found)
    for r, count in enumerate(darts):
        assert found[r].tolist() == plain_array(partners, weights, count, r).tolist()
    assert 0 < least < 1 < largest < 2
