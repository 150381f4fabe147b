"""Laws that the virtual bench and the library share give the same with converted values."""

from dataclasses import replace

import numpy as np
import pytest

from bfsensor.effects.adc_bits import AdcBits, ShiftedCodes, WideCodes
from bfsensor.effects.cti_serial import SerialTraps, TwoSerialTraps
from bfsensor.effects.dark_hot import Glow
from bfsensor.effects.edge_rolloff import EdgeRolloff
from bfsensor.effects.effect import Layout as Sensor
from bfsensor.effects.effect import Segment, Shot
from bfsensor.effects.fringing import Fringing
from bfsensor.effects.gain_drift import GainCycle, GainWarming
from bfsensor.effects.mask_stitch import MaskStitch, WavyMask
from bfsensor.effects.shutter_timing import ShutterTiming
from bfsensor.effects.tearing import DivisaderoTearing
from bfsensor.effects.tree_rings import TreeRings
from validation.concealed.same_laws import (
    CYCLES,
    EQUAL_LAWS,
    SAME_LAWS,
    expected_parameters,
)
from validation.foreign.collection import Light
from validation.foreign.device import DEVICES
from validation.foreign.law import Setting, make_law
from validation.foreign.laws import LAWS
from validation.foreign.layout import Layout
from validation.foreign.plan import Plan

N = 64
DEVICE = DEVICES["thick_10um"]
LAYOUT = Layout(pixels=N, amplifiers=1)
PLAN = Plan("T", (1.0, 20.0, 40.0), wavelengths=(700.0, 1000.0))
TRUTH = {
    "pixels": N, "layout": LAYOUT.truth(), "plan": PLAN.truth(),
    "device": {"nominal": "thick_10um"},
}  # fmt: skip
SENSOR = Sensor((N, N), (Segment(0, 0, N, N),))


def _law(word, name, values):
    law = make_law(word, name, values)
    law.begin(Setting(LAYOUT, PLAN, DEVICE, DEVICE, [2.2], [5.5], 3))
    return law


def _expected(word, name, values, law=None):
    return expected_parameters(
        {"class": word, "law": name, "parameters": values, "shape": {}}, TRUTH, law=law
    )


FLAT = next(e for e in PLAN.exposures() if e.kind == "FLAT")


def test_words_of_both_tables_are_laws_of_the_bench():
    assert set(SAME_LAWS) | set(EQUAL_LAWS) <= set(LAWS)
    assert {word for word, _ in CYCLES} <= {word for word, _ in SAME_LAWS}


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("volume_filling", {"tau": 2.3}),
        ("two_time_constants", {"tau": 0.6, "tau2": 7.0, "share2": 0.45}),
    ],
)
def test_traps_leave_the_same_behind_a_flat(name, more):
    values = {"cti": 2e-6, "beta": 0.7, **more}
    own = _expected("cti_serial", name, values)
    frame = np.zeros((2, 160), np.float32)
    frame[:, :128] = np.array([[2e4], [9e4]])
    bench = _law("cti_serial", name, values).packets(frame.T.copy(), 0).T[:, 128:136]
    effect = (TwoSerialTraps if "tau2" in values else SerialTraps)(own)
    segment = Segment(0, 0, 128, 2, serial_overscan=32)
    sensor = Sensor((2, 128), (segment,))
    k = np.arange(1.0, 9)
    for row, level in enumerate((2e4, 9e4)):
        axes = {"amp": np.zeros(8, int), "k": k, "level": np.full(8, level)}
        # The bench's traps catch a little of what they have just released.
        np.testing.assert_allclose(
            bench[row], effect.serial_overscan(axes, sensor), rtol=0.03, atol=0.01
        )


EDGES = {
    ("mask_stitch", "wave"): (
        WavyMask, {"amp": -0.004, "period": 9.3, "phase": 5.0, "axis": "y"},
    ),
    ("mask_stitch", "step"): (
        MaskStitch, {"amp": -0.004, "period": 11.0, "phase": 4.0, "axis": "x"},
    ),
    ("edge_rolloff", "power"): (
        EdgeRolloff, {"amp": -0.05, "length": 2.5, "exponent": 2.9, "axes": "y"},
    ),
    ("edge_rolloff", "exponential"): (
        EdgeRolloff, {"amp": 0.05, "length": 2.5, "axes": "xy"},
    ),
    ("tearing", "divisadero"): (
        DivisaderoTearing, {"amp": 0.02, "length": 2.2, "column": 23 / N},
    ),
    ("tree_rings", "one_period"): (
        TreeRings, {"amp": 0.01, "xc": 90.0, "yc": -30.0, "period": 21.0, "phase": 5.1},
    ),
}  # fmt: skip


@pytest.mark.parametrize("key", EDGES)
def test_edges_have_the_same_fixed_shifts(key):
    kind, values = EDGES[key]
    bench = np.array(_law(*key, values).fixed_edges(*np.zeros((2, N, N)), FLAT))
    own = _expected(*key, values)
    plain = {p.name: p.plain for p in kind.parameters if p.plain is not None}
    dx, dy = kind(plain | own).displacements(Shot("flat", 1, 20.0, level=5e4), SENSOR)
    # The outermost edges of the bench end the sensor.
    np.testing.assert_allclose(bench[0][:, :-1], dx[:, 1:-1], atol=2e-7)
    np.testing.assert_allclose(bench[1][:-1], dy[1:-1], atol=2e-7)


def test_light_is_shaded_alike():
    values = {"amp": 0.005, "bowl": 0.6, "wedge": [-0.7, 0.4]}
    red = replace(FLAT, wavelength=1000.0)
    even = Light.smooth(np.ones((N, N), np.float32), 1.0)
    bench = _law("fringing", "wedge", values).light(even, red).rate
    own = Fringing(_expected("fringing", "wedge", values))
    shot = Shot("flat", 1, 20.0, wavelength=1000.0)
    np.testing.assert_allclose(bench, own.light_map(shot, SENSOR), atol=5e-6)
    for name, values in (
        ("offset", {"dt": -0.02}),
        ("iris", {"dt": 0.02, "shading": 1.2}),
        ("blade", {"dt": -0.02, "shading": 2.0}),
    ):
        seconds = _law("shutter_timing", name, values).seconds(20.0, FLAT)
        own = ShutterTiming(_expected("shutter_timing", name, values))
        np.testing.assert_allclose(
            np.broadcast_to(seconds, (N, N)) / 20, own.light_map(shot, SENSOR), atol=1e-6
        )
        assert own.law_name == SAME_LAWS["shutter_timing", name].law


def test_glow_of_a_corner_is_the_same_within_a_percent():
    values = {"rate": 0.5, "length": 20.0, "corner": [1, 0]}
    bench = 0.5 * _law("dark_hot", "glow", values).rate()
    own = Glow(_expected("dark_hot", "glow", values))._light(SENSOR)
    np.testing.assert_allclose(bench, own, rtol=0.008)


def test_gain_drifts_are_the_same_curves():
    hours = np.linspace(0, 3, 7)
    for name, kind, values in (
        ("warming_up", GainWarming, {"slope": -0.02, "tau_hours": 0.5}),
        ("thermal_cycle", GainCycle, {"slope": -0.02, "period_hours": 1.3}),
    ):
        own = kind(_expected("gain_drift", name, values))
        bench = _law("gain_drift", name, values).change(hours)
        np.testing.assert_allclose(bench, own._change(hours, SENSOR), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "law", "kind", "delta"),
    [
        ("bit_weight", "shifted_codes", ShiftedCodes, 0.6),
        ("bit_weight", "shifted_codes", ShiftedCodes, -1.5),
        ("bit_weight", "bit_weight", AdcBits, -0.6),
        ("wide_codes", "wide_codes", WideCodes, 0.4),
    ],
)
def test_codes_are_as_frequent(name, law, kind, delta):
    values = {"bit": 4, "delta": delta}
    # Codes below a multiple of 64 that each come 4000 times.
    codes = np.repeat(np.arange(1024), 4000).astype(np.float32)[None]
    seen = _law("adc_bits", name, values).codes([codes], FLAT)[0]
    counts = np.bincount(seen.astype(int).ravel(), minlength=1024)[64:960]
    bench = counts.reshape(-1, 32).mean(0) / 4000 - 1
    own = kind(_expected("adc_bits", name, values, law))._widths(np.arange(32))
    np.testing.assert_allclose(bench, own, atol=0.02)


def test_losses_of_traps_that_fill_are_the_same():
    values = {"q": 3e-6, "saturation_charge": 6e4}
    charge = np.linspace(0, 1.3e5, 9)
    left = _law("charge_loss", "langmuir", values).efficiency(charge)
    own = _expected("charge_loss", "langmuir", values)
    lost = own["q"] * charge / (1 + charge / own["knee"])
    np.testing.assert_allclose(left, np.exp(-lost), atol=3e-4)


def test_what_depends_on_a_missing_entry_is_left_out():
    settling = {"class": "bias_instability", "law": "along_rows", "shape": {},
                "parameters": {"rms": 2.0, "length": 20.0}}  # fmt: skip
    assert set(expected_parameters(settling)) == {"length"}
    rms = expected_parameters(settling, TRUTH)["rms"]
    columns = np.exp(-np.arange(LAYOUT.frame_shape[1]) / 20.0)
    assert rms * np.sqrt(np.mean(columns**2)) == pytest.approx(2.0)
    assert (
        expected_parameters({"class": "psf_wings", "law": "king", "parameters": {}}) == {}
    )
