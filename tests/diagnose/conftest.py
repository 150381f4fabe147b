"""Fixtures of the diagnosis' tests: a mismatch that is explained."""

from __future__ import annotations

import pytest

from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.detect.locate import locate_mismatch
from bfsensor.diagnose.explain.attribution import Attribution
from bfsensor.diagnose.explain.stepwise import attribute
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.charge_loss import ChargeLoss
from bfsensor.effects.gain_nonlinearity import GainNonlinearity
from tests.caching import keep
from tests.virtual import FITTERS, fit_virtual, make_effect

TIED_SEED = 7101


@pytest.fixture(scope="session")
def fitted_loss() -> tuple[MeasuredChannels, Predictor, BaselineFit]:
    """A campaign with charge loss: channels, and the baseline without it fitted."""
    return fit_virtual(seed=TIED_SEED, effects=[make_effect("charge_loss", {"q": 1.5e-7})])


@pytest.fixture(scope="session")
def tied(fitted_loss) -> Attribution:
    """What explains that campaign: charge loss, and as well a curved response."""

    def make() -> Attribution:
        _, predictor, fit = fitted_loss
        kinds = ChargeLoss, GainNonlinearity
        return attribute(predictor, fit, locate_mismatch(fit), kinds=kinds)

    makers = *FITTERS, "tests.diagnose.conftest", "bfsensor.diagnose.explain.stepwise"
    return keep("tied", make, made_by=makers)
