"""Ends of blocks: whole electrons are counted, with the result of adding them one by one."""

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor._kernels.charge import IN_BLOCK, N_SUMS, TOTAL
from bfsensor._kernels.shoot import _all_one, _end_of_block


@pytest.mark.parametrize("size", [1.0, 99.5, 100.0, 156.25, 700.0, np.inf])
@pytest.mark.parametrize("before", [0.0, 0.25, 40.0, 99.0, 120.0])
def test_counted_electrons_end_a_block_where_their_sum_does(size, before):
    flux = np.ones(600)
    found = []
    for whole in (True, False):
        ledger = SimpleNamespace(sums=np.zeros(N_SUMS))
        ledger.sums[[IN_BLOCK, TOTAL]] = before, before + 1000.0
        end = _end_of_block.py_func(flux, ledger, 50, 10, 500, size, whole)
        found.append((end, *ledger.sums))
    assert found[0] == found[1]


def test_one_other_photon_is_found():
    flux = np.ones(20)
    flux[7] = -1.0
    assert _all_one.py_func(flux, 8, 20)
    assert not _all_one.py_func(flux, 0, 20)
