"""Rims and combs: patterns that are significant as a whole but in no single column or row."""

import pytest

from bfsensor.diagnose.detect.locate import locate_mismatch
from tests.virtual import fit_virtual, make_effect


@pytest.mark.parametrize(
    ("word", "values", "family"),
    [
        ("edge_rolloff", {"amp": 0.0037, "length": 3.0}, "rims"),
        ("mask_stitch", {"amp": -0.0007, "period": 37.0}, "combs"),
    ],
)
def test_effects_of_twelve_standard_deviations_are_located(word, values, family):
    fit = fit_virtual(seed=777, size="S", effects=[make_effect(word, values)])[2]
    found = locate_mismatch(fit, seed=1)
    assert found.detected and found.findings[0].family == family
    assert abs(found.findings[0].z) > 8
