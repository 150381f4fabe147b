"""Predictions of collection's effects against pixels: ours, and those of the sensor's own engine."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.diagnose.model.predictor import Predictor, used_channels
from bfsensor.effects.device_parameter import device_parameters
from bfsensor.effects.library import make_effect
from tests.measured import measure_once
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.concealed.card import NOMINAL, SPREAD
from validation.concealed.library import make_effect as make_theirs
from validation.concealed.plan import Geometry, Size
from validation.concealed.sensor import VirtualSensor
from validation.effects.effects_on_pixels import (
    FOLDS,
    SHADOW,
    compare,
    null_campaign,
    residuals,
)

SMALL = Size(128, 2, 1, dithers=1, flat_seconds=(5.0, 20.0, 40.0, 60.0),
             spot_seconds=(3.75, 15.0, 30.0))  # fmt: skip
SEED = 31_000

ELSEWHERE = ("code_hist", "flat_map", "amp_cross")
"""Channels in which changes are not predicted: codes fall otherwise whenever a level moves, and
maps of pixels that the effect evens out a little more or less are below 10 standard deviations of
4000 values; a wide halo shows as crosstalk of 4."""

RANGES = {
    "bf_nonlinear": ({"b": 3e-7}, {"b": -1e-6}, {"b": 3e-6}),
    "bf_chromatic": ({"kappa": 0.01}, {"kappa": -0.05}, {"kappa": 0.2}),
    "bf_anisotropy": ({"eps": 0.02}, {"eps": -0.08}, {"eps": 0.3}),
    "bf_long_range": (
        {"amp": 5e-9, "power": 2.1}, {"amp": 2.2e-8, "power": 2.5}, {"amp": 1e-7, "power": 1.7},
    ),
    "voltage_dependence": ({"delta": 0.02}, {"delta": -0.08}, {"delta": 0.3}),
    "lateral_diffusion": ({"var": 0.005}, {"var": 0.03}, {"var": 0.2}),
    "psf_wings": (
        {"frac": 1e-3, "sigma": 3.0}, {"frac": 7e-3, "sigma": 5.0}, {"frac": 0.05, "sigma": 7.0},
    ),
    "charge_loss": ({"q": 1e-8}, {"q": 5e-8}, {"q": 3e-7}),
    "interpixel_coupling": (
        {"ax": 3e-4, "ay": 3e-4}, {"ax": 1e-3, "ay": 5e-4}, {"ax": 3e-3, "ay": 3e-3},
    ),
}  # fmt: skip
"""Weak, middle and strong."""

LEAST = {
    "bf_nonlinear": 5.0, "bf_chromatic": 8.0, "bf_anisotropy": 4.0, "bf_long_range": 40.0,
    "voltage_dependence": 20.0, "lateral_diffusion": 60.0, "psf_wings": 30.0,
    "charge_loss": 60.0, "interpixel_coupling": 2.0,
}  # fmt: skip
"""Standard deviations of all channels that the strong ones show in the small campaign at least:
else the comparison would show nothing."""


def check(found: dict[str, tuple[float, float, float]]) -> float:
    """Hold factors on the predictions against 1; gives the length of all predictions.

    Three parts are allowed.  Noise that is not shared, five times.  3 %: gains of the null's fit
    are 0.2 to 1 % off, its device by what its own noise says, and k b, k kappa ... go with
    them.  Half a standard deviation of the whole channel: what its neighbours miss is taken
    for parameters of the baseline and leaks.
    """
    total = 0.0
    for word, (length, factor, error) in found.items():
        if word in ELSEWHERE:
            continue
        if length > SHADOW:
            total = float(np.hypot(total, length))
            missed = abs(factor - 1) * length
            allowed = 5 * error * length + 0.03 * length + 0.5
            assert missed < allowed, (
                f"{word}: {length:.1f} sigma, {factor:.3f} +- {error:.3f}"
            )
        else:
            # Nothing is said, and nothing is to be seen.
            assert error < 1.0, f"{word}: {error:.1f} sigma unpredicted"
    return total


@pytest.mark.parametrize("word", RANGES)
def test_strong_effects_on_a_small_sensor(word):
    values = RANGES[word][2]
    found = compare(make_effect(word, values), SEED, SMALL, own=make_theirs(word, values))
    assert check(found) > LEAST[word]


@pytest.mark.slow
@pytest.mark.parametrize("strength", [0, 1, 2])
@pytest.mark.parametrize("word", RANGES)
def test_effects_on_pixels(word, strength):
    values = RANGES[word][strength]
    effect = make_effect(word, values)
    ours, theirs = (
        compare(effect, SEED, "S", own=own) for own in (None, make_theirs(word, values))
    )
    assert check(ours) == pytest.approx(check(theirs), rel=0.02)


# -- full well and device parameters: all else known


def truth(seed: int, size: Size | str, predictor: Predictor) -> np.ndarray:
    """Parameters of a predictor as the sensor has them."""
    pixels = 256 if size == "S" else size.pixels
    sensor = VirtualSensor(Geometry(pixels, 2), seed=seed)
    point = predictor.start.copy()
    point[:2] = sensor.electronics.gain
    for n, name in enumerate(predictor.names):
        kind, _, which = name.partition(" ")
        if kind == "device":
            point[n] = (sensor.device[which] - NOMINAL[which]) / SPREAD[which]
        elif kind in ("sigma_x", "sigma_y"):
            point[n] = sensor.lamp.spot_widths["xy".index(kind[-1])]
    _, fit = null_campaign(seed, size)
    point[2:4] = fit.values[2:4]
    return point


def chi_squares(seed: int, size: Size | str, effect, own) -> dict[str, tuple[float, int]]:
    """Of each channel at the true parameters, those that are linear fitted."""
    measured = measure_once(VirtualSource(seed=seed, size=size, effects=[own]))
    predictor = Predictor(measured, virtual_baseline(), [effect] if effect else [])
    point = truth(seed, size, predictor)
    out: dict[str, tuple[float, int]] = {}
    for channel in used_channels(measured.channels, FOLDS):
        left = channel.whiten(channel.values - predictor.predict(channel, point))
        columns = [channel.whiten(c) for c in predictor.linear(channel).values()]
        design = np.array([c for c in columns if np.abs(c).max() > 0]).T
        count = len(left)
        if design.size:
            solution, _, rank, _ = np.linalg.lstsq(design, left, rcond=1e-9)
            left, count = left - design @ solution, count - int(rank)
        before = out.get(channel.word, (0.0, 0))
        out[channel.word] = before[0] + float(left @ left), before[1] + count
    return out


def check_full_well(seed: int, size: Size | str, full_well: float) -> None:
    values = {"full_well": full_well}
    own = make_theirs("saturation", values)
    found = chi_squares(seed, size, make_effect("saturation", values), own)
    without = chi_squares(seed, size, None, own)
    for word in ("flat_cov", "flat_mean", "flat_map", "spot", "serial_overscan"):
        chi2, dof = found[word]
        # Five standard deviations, and a tenth for errors that are themselves estimates.
        assert chi2 < 1.1 * dof + 5 * np.sqrt(2 * dof), f"{word}: {chi2:.0f} of {dof}"
    # The brightest spots peak at 1.1e5 e-.
    for word in ("flat_cov", "flat_mean", "spot")[: 3 if full_well < 1e5 else 2]:
        assert without[word][0] > 3 * found[word][0], word


def test_full_well_on_a_small_sensor():
    check_full_well(SEED, SMALL, 8.8e4)


@pytest.mark.slow
@pytest.mark.parametrize("full_well", [7e4, 9e4, 1.07e5])
def test_full_well_on_pixels(full_well):
    check_full_well(SEED, "S", full_well)


def check_device_parameter(
    size: Size | str, name: str, spreads: float, miss: float
) -> None:
    """Change that a parameter's shift makes, none of it taken by the baseline's own."""
    baseline = virtual_baseline()
    kinds = device_parameters(
        baseline.derivatives_by_condition(),
        baseline.spread,
        baseline.nominal,
    )
    kind = next(k for k in kinds if k.variant == name)
    effect = kind({name: NOMINAL[name] + spreads * SPREAD[name]})
    pixels = 256 if size == "S" else size.pixels
    scattered = VirtualSensor(Geometry(pixels, 2), seed=SEED).device[name]
    own = make_theirs("device_parameter", {name: scattered + spreads * SPREAD[name]}, name)
    null, fit = null_campaign(SEED, size)
    other = measure_once(VirtualSource(seed=SEED, size=size, effects=[own]))
    before, bare, after = (
        residuals(fit, m, e, used_channels(other.channels, FOLDS))
        for m, e in ((null, ()), (other, ()), (other, (effect,)))
    )
    said, seen = bare["flat_cov"] - after["flat_cov"], bare["flat_cov"] - before["flat_cov"]
    length = np.linalg.norm(said)
    factor = said @ seen / length**2
    error = np.linalg.norm(said * (seen - factor * said)) / length**2
    assert length > 3
    assert abs(factor - 1) < 5 * error + miss + 0.02


def test_device_parameter_on_a_small_sensor():
    check_device_parameter(SMALL, "h", -6.0, 0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    # What straight lines miss at so many spreads: see the class's notes.
    ("name", "spreads", "miss"),
    [("thickness", 8.0, 0.03), ("thickness", -12.0, 0.05), ("h", -5.0, 0.01), ("zx", 6.0, 0.02),
     ("zy", -6.0, 0.03), ("doping", 9.0, 0.09)],
)  # fmt: skip
def test_device_parameters_on_pixels(name, spreads, miss):
    check_device_parameter("S", name, spreads, miss)


@pytest.mark.parametrize("word", ["bf_long_range", "saturation", "psf_wings"])
def test_neutral_effects_change_no_bit_of_a_prediction(word):
    measured, fit = null_campaign(SEED, SMALL)
    values = {**(RANGES[word][2] if word in RANGES else {"full_well": 9e4})}
    effect = make_effect(word, values).scaled(0.0)
    assert effect.is_neutral()
    plain = Predictor(measured, virtual_baseline())
    with_it = Predictor(measured, virtual_baseline(), [effect])
    point = np.concatenate(
        [fit.values[: len(plain.names)], with_it.start[len(plain.names) :]]
    )
    strong = Predictor(measured, virtual_baseline(), [make_effect(word, values)])
    strong_point = np.concatenate(
        [point[: len(plain.names)], strong.start[len(plain.names) :]]
    )
    changed = 0
    for channel in measured.channels:
        one = plain.predict(channel, point[: len(plain.names)])
        assert np.array_equal(with_it.predict(channel, point), one), channel.word
        changed += not np.array_equal(strong.predict(channel, strong_point), one)
    assert changed
