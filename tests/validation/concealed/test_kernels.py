"""Effects on the boundary shifts: covariances of twins against the closed form of changed shifts."""

import numpy as np
import pytest

from tests.validation.concealed.twins import covariances, exposure, flat_power, image_twins
from validation.concealed.card import NOMINAL, shifts_at
from validation.concealed.collect import Response, collect
from validation.concealed.electrostatics import EdgeShifts
from validation.concealed.library import make_effect
from validation.concealed.plan import Geometry
from validation.concealed.readout import Context
from validation.concealed.scene import Scene

PIXELS = 128
FLATS = 24
MU = 6e4


def _context(**condition):
    flat = exposure("FLAT", 30.0, **condition)
    return Context(flat, Geometry(PIXELS), None, None, dict(NOMINAL))


def _measured_change(before, after):
    """Mean change of covariances in twins, with its error, lags 0 to 2."""
    changes = []
    for k in range(FLATS):
        both = []
        for response in (before, after):
            flat = Scene(np.full((PIXELS, PIXELS), MU, np.float32))
            charge = collect(flat, response, np.random.default_rng(k)).astype(float)
            both.append(np.abs(np.fft.fft2(charge - MU)) ** 2 / PIXELS**2)
            both[-1][0, 0] = 0
        changes.append(covariances(both[1] - both[0]))
    return np.mean(changes, axis=0), np.std(changes, axis=0) / np.sqrt(FLATS - 1)


CASES = {
    "bf_chromatic": ({"kappa": 0.2}, "", {"wavelength": 950.0}),
    "bf_anisotropy": ({"eps": 0.3}, "", {}),
    "bf_long_range": ({"amp": 1e-7, "power": 2.0}, "", {}),
    "voltage_dependence": ({"delta": 0.2}, "", {"back_bias": -40.0}),
    "device_parameter": ({"h": 0.8}, "h", {}),
    "outside_library": ({"amp": 1.0}, "axes_exchanged", {}),
}


@pytest.mark.parametrize("word", CASES)
def test_changed_shifts_change_covariances(word):
    parameters, variant, condition = CASES[word]
    effect = make_effect(word, parameters, variant)
    context = _context(**condition)
    at = (context.exposure.wavelength, context.exposure.back_bias)
    old = shifts_at(NOMINAL, *at)
    new = effect.shifts(shifts_at(effect.device(dict(NOMINAL)), *at), context)
    seen, error = _measured_change(Response.of(old, PIXELS), Response.of(new, PIXELS))
    expected = covariances(flat_power(_area(new), MU, PIXELS)) - covariances(
        flat_power(_area(old), MU, PIXELS)
    )
    # first order: the change of a mu^2; signs and the nearest lags by the definition
    assert np.all(np.abs(seen - expected) < 5 * error + 0.03 * np.abs(expected))
    assert np.max(np.abs(expected) / error) > 8  # it shows
    if word == "bf_anisotropy":
        assert expected[0, 1] < 0 < expected[1, 0]
    if word == "bf_long_range":
        assert new.area_changes()[30, 35] - 1e-7 / 25 == pytest.approx(
            old.area_changes()[10, 15], rel=1e-6
        )
        assert np.all(expected.ravel()[1:] > 0)
    if word == "outside_library":
        assert np.allclose(new.area_changes()[2:-2, 2:-2], old.area_changes().T[2:-2, 2:-2])


def _area(shifts: EdgeShifts):
    return shifts.area_changes()


def test_curvature_of_the_shift():
    """b in k Q (1 + b Q / 2): the response at mu is a (1 + b mu), its integral mu + b mu^2 / 2."""
    b = -2e-6
    shifts = shifts_at(NOMINAL, 620.0, -60.0)
    seen, error = _measured_change(
        Response.of(shifts, PIXELS), Response.of(shifts, PIXELS, curvature=b)
    )
    area = shifts.area_changes()
    old = covariances(flat_power(area, MU, PIXELS))
    new = covariances(flat_power(area, MU, PIXELS, law=lambda s: b * s * s / 2))
    expected = new - old
    assert np.all(np.abs(seen - expected) < 5 * error + 0.05 * np.abs(expected))
    # 2/3 of the plain guess b mu at first order
    assert expected[1, 0] / (area[11, 10] * MU**2) == pytest.approx(2 / 3 * b * MU, rel=0.4)


def test_foreign_kernel_turns_its_sign():
    effect = make_effect("outside_library", {"amp": 1e-7, "turning": 4e4}, "sign_flip")
    shifts = shifts_at(NOMINAL, 620.0, -60.0)
    laws = effect.laws(_context())
    plain, changed = Response.of(shifts, PIXELS), Response.of(shifts, PIXELS, **laws)
    seen = {}
    for mu in (1.5e4, 1.2e5):
        c = []
        for k in range(16):
            both = []
            for response in (plain, changed):
                flat = Scene(np.full((PIXELS, PIXELS), mu, np.float32))
                d = collect(flat, response, np.random.default_rng(k)).astype(float) - mu
                both.append(np.mean(d * np.roll(d, 2, axis=0)))
            c.append(both[1] - both[0])
        seen[mu] = np.mean(c) / (np.std(c) / 4)
    assert seen[1.5e4] > 5 and seen[1.2e5] < -5


def test_only_their_condition_is_changed():
    """Twins of flats at 620 nm, -60 V are the same bits; at the other condition they are not."""
    conditions = [exposure("FLAT", 30.0, 0), exposure("FLAT", 30.0, 1, wavelength=950.0)]
    (a, b), (c, d) = image_twins(make_effect("bf_chromatic", {"kappa": 0.2}), conditions)
    assert np.array_equal(a, b) and not np.array_equal(c, d)
    conditions = [exposure("FLAT", 30.0, 0), exposure("FLAT", 30.0, 1, back_bias=-40.0)]
    (a, b), (c, d) = image_twins(
        make_effect("voltage_dependence", {"delta": 0.2}), conditions
    )
    assert np.array_equal(a, b) and not np.array_equal(c, d)
