"""Recordings that are nothing like the baseline: a fit that does not settle still tells what is left."""

import numpy as np
import pytest

from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.extract import measure_channels
from bfsensor.diagnose.mismatch import UNSETTLED
from validation.concealed.library import make_effect
from validation.concealed.plan import Size
from validation.virtual_source import VirtualSource, virtual_baseline

SMALL = Size(128, 4, 1, dithers=1)


@pytest.fixture(scope="module")
def saturated():
    effect = make_effect("saturation", {"full_well": 5e4}, "")
    return measure_channels(VirtualSource(seed=5177, size=SMALL, effects=[effect]))


def test_flats_beyond_the_full_well_are_told_as_a_mismatch(saturated):
    found = diagnose_measured(saturated, virtual_baseline(), explain=False)
    assert UNSETTLED in found.notes
    assert found.mismatch.detected and found.mismatch.findings[0].word.startswith("flat_")
    assert np.isfinite(found.fit.values).all() and np.isfinite(found.fit.residuals).all()
