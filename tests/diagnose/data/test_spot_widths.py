"""Widths of spots: what floats, and what a change between conditions leaves."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import Axes
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.data.spot_widths import fit_widths
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.errors import ConvergenceError
from tests.virtual import virtual_baseline

CONDITIONS = tuple(
    Condition(wavelength=w, back_bias=v, temperature=t) for w, v, t in (
        (620.0, -60.0, 173.15), (620.0, -40.0, 173.15), (620.0, -60.0, 193.15),
        (950.0, -60.0, 173.15),
    )
)  # fmt: skip
ERROR = 1e-3
PHASES = np.random.default_rng(56).uniform(-0.5, 0.5, (12, 2))


def a_campaign(*widths: float) -> MeasuredChannels:
    """Spots of one flux at each condition, of given widths [pixel]."""
    axes, values = Axes(), []
    for n, (condition, width) in enumerate(zip(CONDITIONS, widths, strict=True)):
        for what in ("sigma_x", "sigma_y"):
            axes.add(1, condition, what=what, light=1.0, flux=3e4, time=1.0, exposure=n)
            values.append(np.array([width]))
    blocks = tuple(np.array([[ERROR**2]]) for _ in values)
    channel = Channel("spot", np.concatenate(values), blocks, axes.columns(), "")
    return MeasuredChannels(
        channels=(channel,), amplifiers=("one",), gains=(1.0,), read_noise=(3.0,),
        phases=(PHASES,) * len(CONDITIONS), columns=(64,), flips=((False, False),),
        origins=((0, 0),), shape=(64, 64),
    )  # fmt: skip


def test_widths_float_by_wavelength_and_temperature() -> None:
    predictor = Predictor(a_campaign(1.1, 1.1, 1.1, 1.2), virtual_baseline())
    assert [n for n in predictor.names if n.startswith("sigma")] == [
        f"sigma_{axis} {width}" for width in ("620/-100", "620/-80", "950/-100") for axis in "xy"
    ]  # fmt: skip


def test_one_width_moves_all_voltages() -> None:
    measured = a_campaign(1.1, 1.1, 1.1, 1.2)
    predictor = Predictor(measured, virtual_baseline())
    channel = measured.channels[0]
    here = predictor.predict(channel, predictor.start)
    n = predictor.names.index("sigma_x 620/-100")
    slope = predictor.slope(channel, predictor.start, n, here)
    x = channel.axes
    cold = x["temperature"] == 173.15
    own = (x["what"] == "sigma_x") & (x["wavelength"] == 620.0) & cold
    # The effect's own widening falls a little with the width.
    assert slope[own] == pytest.approx(np.ones(2), abs=0.1)
    assert np.all(slope[(x["wavelength"] == 950.0) | ~cold] == 0.0)
    # Diffusion at a lower voltage is thus left over: no width of its own follows it.  That of a
    # warmer sensor goes with kT, which no nominal device predicts: it has a width of its own.
    moved = [k for k, name in enumerate(predictor.names) if name.startswith("sigma")]
    slopes = np.array([predictor.slope(channel, predictor.start, k, here) for k in moved]).T

    def left(wider: NDArray[np.bool_]) -> float:
        wanted = np.where((x["what"] == "sigma_x") & wider, 20 * ERROR, 0.0)
        best = np.linalg.lstsq(slopes, wanted, rcond=None)[0]
        return float(np.square(wanted - slopes @ best).sum() / ERROR**2)

    assert left(x["back_bias"] == -40.0) == pytest.approx(400 * 1 / 2, rel=0.1)
    assert left(x["temperature"] == 193.15) < 1.0


def test_images_without_spots_are_no_singular_matrix():
    with pytest.raises(ConvergenceError, match="after 0 rounds") as error:
        fit_widths(np.zeros((1, 2, 9, 9)), (1.0, 1.0), np.zeros((2, 2)))
    assert len(error.value.history) == 0
