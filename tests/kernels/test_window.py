"""Sums over windows, written with vectors, against plain ones."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bfsensor._kernels import window

pytestmark = pytest.mark.kernels


@numba.njit
def sum_8(w, first, step, c, start, stride, rows):
    return window.sum_8(w, first, step, c, start, stride, rows)


@numba.njit
def sum_16(w, first, step, c, start, stride, rows):
    return window.sum_16(w, first, step, c, start, stride, rows)


@numba.njit
def two_sums_8(w, first, step, c, start, stride, rows):
    return window.two_sums_8(w, first, step, c, start, stride, rows)


@numba.njit
def two_sums_16(w, first, step, c, start, stride, rows):
    return window.two_sums_16(w, first, step, c, start, stride, rows)


def plain(w, first, c, start, stride, rows, lanes):
    """Sum, and sum of the sizes, in double precision."""
    total = size = 0.0
    for r in range(rows):
        for lane in range(lanes):
            term = float(w[first + r * lanes + lane]) * float(c[start + r * stride + lane])
            total += term
            size += abs(term)
    return total, size


def arrays(first, step, start, stride, rows, lanes, streams, seed):
    """Flat arrays that end where the last number read lies."""
    rng = np.random.default_rng(seed)
    weights = rng.normal(0, 1e-6, first + (streams - 1) * step + rows * lanes)
    charges = rng.uniform(-1e3, 1.5e5, start + max(rows - 1, 0) * stride + lanes)
    return weights.astype(np.float32), charges.astype(np.float32)


def bound(rows, size):
    # One rounding a product, one a row, at most four between lanes and blocks.
    return (rows + 5) * 2.0**-24 * size * 1.001


WHOLE = {
    "first": st.integers(0, 40),
    "step": st.integers(0, 200),
    "start": st.integers(0, 60),
    "stride": st.integers(0, 50),
    "rows": st.integers(0, 11),
    "seed": st.integers(43, 2**31),
}


@pytest.mark.parametrize(("function", "lanes"), [(sum_8, 8), (sum_16, 16)])
@settings(max_examples=60, deadline=None)
@given(**WHOLE)
def test_one_sum(function, lanes, first, step, start, stride, rows, seed):
    w, c = arrays(first, step, start, stride, rows, lanes, 1, seed)
    whole = (np.uint64(n) for n in (first, step))
    found = function(w, *whole, c, np.uint64(start), np.uint64(stride), np.uint64(rows))
    total, size = plain(w, first, c, start, stride, rows, lanes)
    assert abs(found - total) <= bound(rows, size)


@pytest.mark.parametrize(("function", "lanes"), [(two_sums_8, 8), (two_sums_16, 16)])
@settings(max_examples=60, deadline=None)
@given(**WHOLE)
def test_two_sums(function, lanes, first, step, start, stride, rows, seed):
    w, c = arrays(first, step, start, stride, rows, lanes, 2, seed)
    whole = (np.uint64(n) for n in (first, step))
    found = function(w, *whole, c, np.uint64(start), np.uint64(stride), np.uint64(rows))
    for k in (0, 1):
        total, size = plain(w, first + k * step, c, start, stride, rows, lanes)
        assert abs(found[k] - total) <= bound(rows, size)


@pytest.mark.parametrize(("function", "lanes"), [(sum_8, 8), (sum_16, 16)])
def test_every_lane_counts_once(function, lanes):
    # Powers of two show which numbers were multiplied: all sums are exact.
    rows, stride, start, first = 3, lanes + 3, 5, 2
    for r in range(rows):
        for lane in range(lanes):
            w = np.zeros(first + rows * lanes, np.float32)
            c = np.full(start + (rows - 1) * stride + lanes, 64, np.float32)
            w[first + r * lanes + lane] = 0.5
            c[start + r * stride + lane] = 8
            found = function(
                w, np.uint64(first), np.uint64(0), c, np.uint64(start), np.uint64(stride),
                np.uint64(rows),
            )  # fmt: skip
            assert found == 4


def test_two_sums_equal_one_sum_each():
    # The same order of additions: what is decided fast or exactly may not differ by bits.
    rows, first, step, start, stride = 9, 16, 160, 7, 31
    for one, two, lanes in ((sum_8, two_sums_8, 8), (sum_16, two_sums_16, 16)):
        w, c = arrays(first, step, start, stride, rows, lanes, 2, 55021)
        rest = (c, *(np.uint64(n) for n in (start, stride, rows)))
        both = two(w, np.uint64(first), np.uint64(step), *rest)
        for k in (0, 1):
            alone = one(w, np.uint64(first + k * step), np.uint64(0), *rest)
            assert alone == both[k]


@numba.njit
def add_16_points(w, first, c, start, stride, rows, pairs, out, at):
    window.add_16_points(w, first, c, start, stride, rows, pairs, out, at)


@settings(deadline=None, max_examples=40)
@given(rows=st.integers(0, 10), pairs=st.integers(1, 5), seed=st.integers(0, 2**32 - 1))
def test_sums_for_16_points_are_those_of_plain_loops(rows, pairs, seed):
    rng = np.random.default_rng(seed)
    first, start, at = (int(n) for n in rng.integers(0, 40, 3))
    stride = 2 * pairs + int(rng.integers(0, 9))
    weights = rng.normal(0, 1e-6, first + rows * pairs * 64).astype(np.float32)
    charges = rng.uniform(-1e3, 1.5e5, start + rows * stride + 2 * pairs).astype(np.float32)
    before = rng.normal(0, 0.1, at + 32).astype(np.float32)
    out = before.copy()
    whole = (np.uint64(n) for n in (first, start, stride, rows, pairs, at))
    first_, start_, stride_, rows_, pairs_, at_ = whole
    add_16_points(weights, first_, charges, start_, stride_, rows_, pairs_, out, at_)
    assert np.array_equal(out[:at], before[:at])
    w = weights[first:].astype(float).reshape(rows, 2 * pairs, 32)
    places = start + stride * np.arange(rows)[:, None] + np.arange(2 * pairs)
    terms = w * charges[places][..., None].astype(float)
    size = np.abs(terms).sum((0, 1)) + np.abs(before[at:])
    # One rounding a product and one an addition, at most.
    limit = (2 * rows * pairs + 3) * 2.0**-24 * size * 1.001
    assert (np.abs(out[at:] - before[at:] - terms.sum((0, 1))) <= limit).all()


@numba.njit
def add_8_kernels(w, first, c, start, stride, rows, columns, out):
    window.add_8_kernels(w, first, c, start, stride, rows, columns, out)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@settings(deadline=None, max_examples=30)
@given(rows=st.integers(0, 10), columns=st.integers(1, 11), seed=st.integers(0, 2**32 - 1))
def test_sums_by_8_kernels_are_those_of_plain_loops(kind, rows, columns, seed):
    rng = np.random.default_rng(seed)
    first, start = (int(n) for n in rng.integers(0, 40, 2))
    stride = columns + 15 + int(rng.integers(0, 9))
    weights = rng.normal(0, 1e-6, first + rows * columns * 8).astype(kind)
    charges = rng.uniform(-1e3, 1.5e5, start + rows * stride + 1).astype(np.float32)
    before = rng.normal(0, 0.1, (8, 16)).astype(kind)
    out = before.copy()
    whole = (np.uint64(n) for n in (first, start, stride, rows, columns))
    first_, start_, stride_, rows_, columns_ = whole
    add_8_kernels(weights, first_, charges, start_, stride_, rows_, columns_, out)
    w = weights[first:].astype(float).reshape(rows, columns, 8)
    places = (start + stride * np.arange(rows)[:, None] + np.arange(columns))[..., None]
    terms = w[..., None] * charges[places + np.arange(16)][:, :, None].astype(float)
    size = np.abs(terms).sum((0, 1)) + np.abs(before)
    # One rounding a product and one an addition, at most; in double precision those of this sum too.
    limit = 2 * (rows * columns + 2) * np.finfo(kind).eps * size
    assert (np.abs(out - before - terms.sum((0, 1))) <= limit).all()
