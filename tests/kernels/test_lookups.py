"""Reads and writes of arrays in loops that look numbers up in tables."""

import numba
import numpy as np
import pytest
from llvmlite.binding import get_host_cpu_features

from bfsensor._kernels.lookups import get, looked_up, put


@numba.njit
def look_up(table, places, out):
    for n in range(out.size):
        put(out, n, looked_up(table, get(places, n)))


@pytest.mark.kernels
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_numbers_of_a_table_are_written(kind):
    table = np.linspace(3.0, 5.0, 11).astype(kind)
    # More than fit into one vector, and a few left over.
    places = np.random.default_rng(5).integers(0, 11, 53)
    out = np.zeros(53)
    look_up(table, places, out)
    assert np.array_equal(out, table[places])


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_arrays_with_gaps_are_refused():
    gaps = np.zeros(20)[::2]
    whole, places = np.zeros(10), np.zeros(10, np.int64)
    for arrays in (
        (gaps, places, whole),
        (whole, places, gaps),
        (whole, places[::2], whole),
    ):
        with pytest.raises(numba.TypingError):
            look_up(*arrays)


def vectors(kernel):
    """Whether a compiled loop works on several numbers at a time."""
    return any(" x double>" in code for code in kernel.inspect_llvm().values())


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
@pytest.mark.skipif(
    not get_host_cpu_features().get("avx2"), reason="lookups need not pay off elsewhere"
)
def test_only_loops_with_lookups_become_vector_code():
    @numba.njit
    def plain(table, places, out):
        for n in range(out.size):
            out[n] = np.sqrt(table[np.uint64(places[n])])

    @numba.njit
    def marked(table, places, out):
        for n in range(out.size):
            put(out, n, np.sqrt(looked_up(table, get(places, n))))

    for kernel in (plain, marked):
        kernel(np.zeros(8), np.zeros(8, np.int32), np.zeros(8))
    assert vectors(marked) and not vectors(plain)
