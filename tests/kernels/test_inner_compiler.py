"""Kernels that are compiled as parts of those that Python calls, and min and max within them."""

import builtins

import numba
import numpy as np
import pytest

from bfsensor._kernels import extremes
from bfsensor._kernels.compile_options import ENTRY, INNER
from bfsensor._kernels.extremes import max, min

compiled = pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")


@numba.njit(**INNER)
def _square(x):
    return x * x


@numba.njit(**INNER)
def _sum_of_squares(x):
    total = 0.0
    for n in range(x.size):
        total += _square(x[n])
    return total


@numba.njit(**{**ENTRY, "cache": False})
def norm(x):
    return np.sqrt(_sum_of_squares(x))


@numba.njit
def both(a, b):
    return min(a, b), max(a, b)


@pytest.mark.kernels
def test_inner_kernels_compute():
    assert norm(np.array([3.0, 4.0])) == 5.0


@compiled
def test_code_is_that_of_the_entry_alone():
    norm(np.array([3.0, 4.0]))
    (entry,) = norm.overloads.values()
    assert entry.library.get_pointer_to_function(entry.fndesc.llvm_func_name)
    for kernel in (_square, _sum_of_squares):
        (inner,) = kernel.overloads.values()
        assert kernel.stats.cache_path is None
        # It stands as numba translated it: what it calls is not copied into it yet.
        calls = [
            line for line in inner.library.get_llvm_str().splitlines() if "call" in line
        ]
        assert any("_square" in line for line in calls) == (kernel is _sum_of_squares)
    lines = entry.library.get_llvm_str().splitlines()
    assert not any("_square" in line and " call " in line for line in lines)


@compiled
def test_a_call_from_python_raises_an_error():
    norm(np.array([3.0, 4.0]))
    with pytest.raises((ValueError, TypeError)):
        _square(3.0)


@pytest.mark.kernels
@pytest.mark.parametrize(
    ("a", "b"),
    [
        (1, 2), (2, 1), (-1, 3), (np.uint64(7), np.uint64(2**63 + 1)), (np.int32(-3), 2),
        (np.float32(0.1), np.float32(0.2)), (np.float32(0.1), np.float64(0.1)), (0.0, -0.0), (-0.0, 0.0),
        (np.nan, 1.0), (1.0, np.nan), (np.inf, -np.inf), (3, 2.5),
    ],
)  # fmt: skip
def test_extremes_are_python_s(a, b):
    """The first number where neither is smaller or larger, and of the type that holds both."""
    smaller, larger = both(a, b)
    for found, expected in ((smaller, builtins.min(a, b)), (larger, builtins.max(a, b))):
        assert np.array_equal(found, expected, equal_nan=True)
        assert np.signbit(found) == np.signbit(expected)


@compiled
def test_what_has_no_order_is_refused():
    with pytest.raises(numba.TypingError):
        both(1.0 + 2.0j, 1.0)
    assert extremes.min is min
