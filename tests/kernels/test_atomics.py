"""Numbers that several threads change at once."""

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest

from bfsensor._kernels.atomics import add, exchange, give_way, observe, publish


@numba.njit(nogil=True)
def count_up(numbers, times):
    for _ in range(times):
        add(numbers, 0, 1)
        while True:
            before = observe(numbers, 1)
            if exchange(numbers, 1, before, before + 3):
                break
            give_way()


@numba.njit(nogil=True)
def pass_on(numbers, mine, rounds):
    """Two threads write by turns, each after it has read what the other wrote."""
    for n in range(rounds):
        while observe(numbers, 0) != 2 * n + mine:
            give_way()
        numbers[1] = numbers[1] * 3 % 1_000_003 + mine
        publish(numbers, 0, 2 * n + mine + 1)


@pytest.mark.kernels
def test_one_thread():
    numbers = np.array([5, 7])
    count_up(numbers, 4)
    assert numbers.tolist() == [9, 19]


@pytest.mark.skipif(
    numba.config.DISABLE_JIT, reason="Python's own numbers are not shared so"
)
def test_nothing_is_lost():
    numbers = np.zeros(2, np.int64)
    count_up(numbers, 0)
    with ThreadPoolExecutor(4) as executor:
        for done in [executor.submit(count_up, numbers, 20_000) for _ in range(4)]:
            done.result()
    assert numbers.tolist() == [80_000, 240_000]


@pytest.mark.skipif(
    numba.config.DISABLE_JIT, reason="Python's own numbers are not shared so"
)
def test_what_was_written_before_is_seen():
    numbers = np.zeros(2, np.int64)
    pass_on(numbers, 0, 0)
    with ThreadPoolExecutor(2) as executor:
        for done in [executor.submit(pass_on, numbers, mine, 5000) for mine in (0, 1)]:
            done.result(timeout=60)
    expected = 0
    for n in range(10_000):
        expected = expected * 3 % 1_000_003 + n % 2
    assert numbers.tolist() == [10_000, expected]
