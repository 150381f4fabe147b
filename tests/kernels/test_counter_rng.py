"""Random numbers by counting: known answers, accuracy of the functions, distributions."""

from itertools import combinations

import numba
import numpy as np
import pytest
from scipy import stats

from bfsensor._kernels import counter_rng

# Random123 1.14, tests/kat_vectors, philox4x32 10 rounds: counter, key, words.
KNOWN_ANSWERS = [
    (
        (0, 0, 0, 0),
        (0, 0),
        (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8),
    ),
    (
        (0xFFFFFFFF,) * 4,
        (0xFFFFFFFF,) * 2,
        (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD),
    ),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]

EDGE_WORDS = np.array(
    sorted(
        {0, 1, 2, 3, 2**32 - 1, 2**32 - 2, 0x1FFFFFFF, 0x3FFFFFFF}
        | {2**n for n in range(32)}
        | {2**32 - 2**n for n in range(32)}
        | {n * 2**29 - 1 for n in range(1, 8)}
        | {n * 2**29 + 1 for n in range(1, 8)}
    ),
    np.uint32,
)


@numba.njit
def philox(c, k):
    return counter_rng.philox(c[0], c[1], c[2], c[3], k[0], k[1])


@numba.njit
def log_single(values, out):
    for n in range(values.size):
        out[n] = counter_rng.log_single(values[n])


@numba.njit
def log_uniform(words, out):
    for n in range(words.size):
        out[n] = counter_rng.log_uniform(words[n])


@numba.njit
def sine_cosine(words, out_sine, out_cosine):
    for n in range(words.size):
        out_sine[n], out_cosine[n] = counter_rng.sine_cosine(words[n])


def words_to_try(count, seed):
    rng = np.random.default_rng(seed)
    return np.concatenate([EDGE_WORDS, rng.integers(0, 2**32, count, dtype=np.uint32)])


def draw(first, count, key=(0x1B2C, 0x9931)):
    out = [np.full(count, np.nan, np.float32) for _ in range(3)]
    words = np.zeros(count, np.uint32)
    counter_rng.deviates(first, np.uint32(key[0]), np.uint32(key[1]), *out, words)
    return (*out, words)


def plain_philox(counter, key):
    """The ten rounds in whole numbers of any size."""
    c, k = list(counter), list(key)
    mask = 0xFFFFFFFF
    for _ in range(10):
        p0, p1 = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [(p1 >> 32) ^ c[1] ^ k[0], p1 & mask, (p0 >> 32) ^ c[3] ^ k[1], p0 & mask]
        k = [(k[0] + 0x9E3779B9) & mask, (k[1] + 0xBB67AE85) & mask]
    return tuple(c)


def plain_deviates(number, key):
    """Box and Muller in double precision."""
    a, b, c, d = plain_philox((number & 0xFFFFFFFF, number >> 32, 0, 0), key)
    radius = np.sqrt(-2.0 * np.log((b + 0.5) / 2**32))
    angle = 2 * np.pi * a / 2**32
    path = -np.log((c + 0.5) / 2**32)
    return radius * np.cos(angle), radius * np.sin(angle), path, d


@pytest.mark.kernels
@pytest.mark.parametrize(("counter", "key", "words"), KNOWN_ANSWERS)
def test_philox_gives_the_known_answers(counter, key, words):
    found = philox(np.array(counter, np.uint32), np.array(key, np.uint32))
    assert tuple(int(w) for w in found) == words
    assert plain_philox(counter, key) == words


@pytest.mark.kernels
def test_logarithm_of_words():
    words = words_to_try(200, 7301)
    out = np.zeros(words.size, np.float32)
    log_uniform(words, out)
    exact = np.log((words.astype(float) + 0.5) / 2.0**32)
    # A word rounded to single precision: 2^-24 of it, so 2^-24 in the logarithm; the
    # polynomial and its sum: 2e-7 of the value.
    assert np.all(np.abs(out - exact) <= 2.0**-24 + 2e-7 * np.abs(exact))
    assert np.all(out < 0)
    assert out[0] == np.float32(np.log(2.0**-33))


@pytest.mark.kernels
def test_logarithm_in_single_precision():
    rng = np.random.default_rng(90211)
    values = np.concatenate(
        [
            2.0 ** np.arange(-33, 40),
            np.sqrt(0.5) * (1 + np.linspace(-1e-3, 1e-3, 11)),
            1 + np.linspace(-1e-2, 1e-2, 21),
            10 ** rng.uniform(-9, 9, 200),
        ]
    ).astype(np.float32)
    out = np.zeros(values.size, np.float32)
    log_single(values, out)
    exact = np.log(values.astype(float))
    # Half a unit in the last place is 6e-8; Horner's rule and the sum add two or so.
    assert np.all(np.abs(out - exact) <= 2e-7 * np.abs(exact))


@pytest.mark.kernels
def test_sine_and_cosine_of_words():
    words = words_to_try(200, 6127)
    sine, cosine = np.zeros((2, words.size), np.float32)
    sine_cosine(words, sine, cosine)
    angle = 2 * np.pi * words.astype(float) / 2.0**32
    # The angle in its octant, below pi/4, rounds to 2.4e-8 twice; the sum near 1 to 6e-8.
    assert np.abs(sine - np.sin(angle)).max() < 1.5e-7
    assert np.abs(cosine - np.cos(angle)).max() < 1.5e-7
    # Eighths of the circle land on the right axis with the right sign.
    eighths = np.array([0, 2**30, 2**31, 3 * 2**30], np.uint32)
    sine, cosine = np.zeros((2, 4), np.float32)
    sine_cosine(eighths, sine, cosine)
    assert sine.tolist() == [0, 1, 0, -1]
    assert cosine.tolist() == [1, 0, -1, 0]


@pytest.mark.kernels
@pytest.mark.parametrize("first", [0, 817, 2**32 - 5, 2**40 + 3])
def test_deviates_equal_their_plain_twin(first):
    key = (0x77A1, 0xF0000005)
    x, y, path, words = draw(first, 12, key)
    for n in range(12):
        px, py, pp, pw = plain_deviates(first + n, key)
        assert words[n] == pw
        # Radius at most 6.8: relative errors of logarithm (halved by the root) and
        # angle of 2e-7 each, and that of the word's rounding where the radius is small.
        assert abs(x[n] - px) < 3e-6
        assert abs(y[n] - py) < 3e-6
        assert abs(path[n] - pp) < 6e-8 + 2e-7 * pp


@pytest.mark.kernels
def test_chunks_give_the_same_bits():
    whole = draw(2**32 - 20, 50)
    start = 0
    for size in (1, 7, 13, 0, 29):
        part = draw(2**32 - 20 + start, size)
        for a, b in zip(whole, part, strict=True):
            assert np.array_equal(a[start : start + size], b)
        start += size
    assert start == 50


@pytest.mark.kernels
def test_keys_and_counts_give_other_numbers():
    words = draw(5000, 30)[3]
    assert len(set(words.tolist())) == 30
    assert not np.any(words == draw(5000, 30, (0x1B2D, 0x9931))[3])
    assert not np.any(words == draw(5000, 30, (0x1B2C, 0x9930))[3])
    assert np.array_equal(words[1:], draw(5001, 29)[3])


COUNT = 200_000


@pytest.fixture(scope="module")
def many():
    return draw(314_159, COUNT)


def test_moments(many):
    x, y, path, words = (a.astype(float) for a in many)
    sigma = 1 / np.sqrt(COUNT)
    for normal in (x, y):
        # Five standard errors; those of the powers 2, 3, 4 are sqrt(2), sqrt(15), sqrt(96).
        assert abs(normal.mean()) < 5 * sigma
        assert abs((normal**2).mean() - 1) < 5 * np.sqrt(2) * sigma
        assert abs((normal**3).mean()) < 5 * np.sqrt(15) * sigma
        assert abs((normal**4).mean() - 3) < 5 * np.sqrt(96) * sigma
        assert np.abs(normal).max() < 6.8
    # Of an exponential: variance 1, of the square 4! - 2!^2 = 20.
    assert abs(path.mean() - 1) < 5 * sigma
    assert abs((path**2).mean() - 2) < 5 * np.sqrt(20) * sigma
    assert path.min() > 0
    uniform = words / 2.0**32
    assert abs(uniform.mean() - 0.5) < 5 * sigma / np.sqrt(12)
    # Spilling takes the lowest bit.
    assert abs((many[3] & 1).mean() - 0.5) < 2.5 * sigma


def test_distributions(many):
    x, y, path, words = many
    # The chance of a fault by accident is 1e-4 each, once and for all: the seed is fixed.
    assert stats.kstest(x, "norm").pvalue > 1e-4
    assert stats.kstest(y, "norm").pvalue > 1e-4
    assert stats.kstest(path, "expon").pvalue > 1e-4
    assert stats.kstest((words + 0.5) / 2.0**32, "uniform").pvalue > 1e-4
    # The tests can fail: a normal 2 % too wide does.
    assert stats.kstest(1.02 * x.astype(float), "norm").pvalue < 1e-4


def test_the_deviates_of_a_photon_are_independent(many):
    x, y, path, words = (a.astype(float) for a in many)
    bits = (many[3] & 1).astype(float)
    # A correlation of independent numbers has the standard error 1 / sqrt(count).
    limit = 5 / np.sqrt(COUNT)
    for a, b in combinations([x, y, path, words, bits], 2):
        assert abs(np.corrcoef(a, b)[0, 1]) < limit
    # Nor are their sizes, nor the next photon's.
    assert abs(np.corrcoef(x**2, y**2)[0, 1]) < limit
    assert abs(np.corrcoef(x**2, path)[0, 1]) < limit
    assert abs(np.corrcoef(x[1:], x[:-1])[0, 1]) < limit
    assert abs(np.corrcoef(path[1:], path[:-1])[0, 1]) < limit
    # The angle is uniform: 16 sectors, chi-square of 15 degrees of freedom.
    sectors = np.histogram(np.arctan2(y, x), 16, (-np.pi, np.pi))[0]
    assert stats.chisquare(sectors).pvalue > 1e-4
