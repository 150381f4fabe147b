"""A lag that is off in all tables, and effects with one parameter that describe it as well."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.detect.candidate_screen import Rival
from bfsensor.diagnose.explain.attribution import TIED
from bfsensor.diagnose.explain.single_value import _as_simple
from bfsensor.effects.electronic_memory import ElectronicMemory, Settling
from bfsensor.errors import ConvergenceError

GAIN = 1162.0
"""Of the free value, as of a memory of 34 standard deviations."""


class Fits:
    """Model whose joint fits with an effect have a given chi-square; it counts them."""

    def __init__(self, total):
        self.total, self.fitted = total, 0

    def with_effects(self, effects):
        (effect,) = effects
        self.fitted += 1
        if effect["alpha"] < 0:
            raise ConvergenceError("diverges")
        return SimpleNamespace(fit=SimpleNamespace(total=self.total))


def memory(gain, alpha=3e-3, **more):
    return Rival(ElectronicMemory({"alpha": alpha}), gain, 0.0, np.ones(1), **more)


def asked(total, *rivals):
    model, after = Fits(total), SimpleNamespace(fit=SimpleNamespace(total=100.0))
    return _as_simple(model, rivals, after, GAIN), model.fitted


@pytest.mark.parametrize(
    ("more", "simple"), [(2 * TIED - 0.1, True), (2 * TIED + 0.1, False)]
)
def test_joint_fits_decide_not_the_gain_of_the_screen(more, simple):
    """The screen's gain is 16 below that of the value, more than ties allow."""
    assert asked(100.0 + more, memory(GAIN - 16.0)) == (simple, 1)


def test_what_is_not_fitted():
    several = Rival(Settling({"alpha": 3e-3, "tau": 1.0}), GAIN, 0.0, np.ones(1))
    assert asked(
        0.0, several, memory(0.4 * GAIN), memory(GAIN, select=-50.0, share=0.1)
    ) == (False, 0)
    # Another candidate is asked where the first cannot be fitted.
    assert asked(0.0, memory(GAIN, -3e-3), memory(GAIN)) == (True, 2)
