"""Light without a monitor: its error is assumed only where repeated exposures do not contradict it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.flat_channels import LAMP_UNKNOWN, FlatChannels


def scatter_of(times, levels, lamps=None):
    """Relative error of the light of flats in the order of their numbers."""
    rows = [
        (SimpleNamespace(number=n, lamp=None, exposure_time=t), "condition", [(m, 0.0, 1)])
        for n, (t, m) in enumerate(zip(times, levels, strict=True))
    ]
    sums = SimpleNamespace(
        _means={"fit": rows}, _lamps=lamps or {}, _step=lambda e: e.exposure_time
    )
    return FlatChannels._light_scatter(sums)


def test_three_equal_exposures_that_differ_by_a_tenth_tell_the_lamps_scatter():
    """Flats of 29.5 s of an SBIG CCD, run 'bergeson' of Astr480/CCDChar @ ccdc2a3, above bias [ADU]."""
    times = [9.0, 18.0, 29.5, 29.5, 29.5, 54.0, 90.0]
    found = scatter_of(times, [1697.0, 3953.0, 5844.0, 6626.0, 6344.0, 11983.0, 21055.0])
    assert found == pytest.approx(0.063, abs=0.001)


def test_equal_exposures_within_what_is_assumed_and_none_leave_it():
    assert scatter_of([1.0, 2.0, 3.0], [10.0, 25.0, 29.0]) == LAMP_UNKNOWN
    assert scatter_of([1.0, 2.0, 2.0, 3.0], [10.0, 20.0, 20.3, 29.0]) == LAMP_UNKNOWN


def test_another_setting_of_the_lamp_is_no_scatter():
    times, levels = [5.0, 5.0, 5.0, 5.0], [1000.0, 1001.0, 500.0, 500.2]
    settings = {0: (0, 1.0), 1: (0, 1.0), 2: (1, 0.5), 3: (1, 0.5)}
    assert scatter_of(times, levels, settings) == LAMP_UNKNOWN
    assert scatter_of(times, levels) > 0.3


def test_levels_repeated_over_the_series_are_the_error_however_small():
    rng = np.random.default_rng(5)
    times = np.tile([10.0, 20.0, 30.0, 40.0], 4)
    found = scatter_of(times, 100 * times * (1 + 0.003 * rng.standard_normal(16)))
    assert found == pytest.approx(0.003, rel=0.5)
