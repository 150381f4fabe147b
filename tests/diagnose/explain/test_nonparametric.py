"""Nonparametric models of mismatches outside the library, on small campaigns."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
import pytest

from bfsensor.diagnose.detect.candidates import PULLED
from bfsensor.diagnose.detect.locate import Finding, Mismatch, locate_mismatch
from bfsensor.diagnose.detect.model_error import ACCURACY, counts, stands_out
from bfsensor.diagnose.explain.edge_terms import edge_names, shifts_of
from bfsensor.diagnose.explain.gaussian_process import process_choice
from bfsensor.diagnose.explain.nonparametric import Columns, compete, explain_outside
from bfsensor.diagnose.explain.stepwise import attribute
from bfsensor.diagnose.explain.terms import Scene
from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model.exchanged_axes import AxesExchanged
from bfsensor.diagnose.report.attribution_words import reported, said_of
from bfsensor.diagnose.report.nonparametric_words import said_freely
from bfsensor.effects.gain_nonlinearity import GainNonlinearity
from bfsensor.effects.interpixel_coupling import InterpixelCoupling
from bfsensor.effects.tearing import Tearing
from bfsensor.effects.trap_serial import TrapSerial
from tests.virtual import (
    SMALL,
    EdgeShifts,
    Geometry,
    OutsideLibrary,
    fit_virtual,
    make_effect,
    measure_virtual,
    virtual_baseline,
)

KINDS = (TrapSerial, InterpixelCoupling, Tearing)


@lru_cache(maxsize=1)
def _null():
    return fit_virtual(seed=9137)[0]


@lru_cache(maxsize=1)
def _null_located():
    _, predictor, fit = fit_virtual(seed=9137)
    return Model(predictor, fit), locate_mismatch(fit)


def _changed(word, change):
    """The null's channels, those of one word changed by code that shares nothing with the models."""
    measured = _null()
    channels = tuple(
        c if c.word != word
        else replace(c, values=c.values + change(c.axes, c.values))
        for c in measured.channels
    )  # fmt: skip
    return replace(measured, channels=channels)


def _located(measured):
    predictor, fit = fit_bounded(measured, virtual_baseline())
    return Model(predictor, fit), locate_mismatch(fit)


def _explained(measured):
    model, mismatch = _located(measured)
    told = explain_outside(model, mismatch)
    return (None if told is None else told[0]), mismatch


def _one(found, part):
    """The coefficient whose name holds a text."""
    return next(c for c in found.coefficients if part in c.name)


def test_of_nothing_there_is_no_free_form():
    model, mismatch = _null_located()
    found = explain_outside(model, mismatch)
    assert found is None and not mismatch.detected


# -- mismatches that none of the models was made for, put on channels


def test_a_lone_lag_is_told_as_one_that_breaks_the_sum_rule():
    # 1e-7 mu^2 at lag (2, 1), about 10 sigma; no shift of boundaries has that alone.
    def change(x, values):
        return np.where((x["i"] == 2) & (x["j"] == 1), 1e-7 * x["level"] ** 2, 0.0)

    found, mismatch = _explained(_changed("flat_cov", change))
    assert mismatch.detected
    assert found.group == "covariances by lag" and "(2, 1)" in said_freely(found)
    own = found.coefficients[0]
    assert [c.where["lags"] for c in found.coefficients] == [[(2, 1)]]
    assert own.where["power"] == 2 and 8 < own.value / own.error < 15
    # At 1e5 e-, to which the coefficient is given.
    assert abs(own.value - 1000.0) < 3 * own.error
    assert (
        found.tests["sum rule"]["p_value"] < 1e-6 and found.tests["sum rule"]["value"] > 0
    )
    before, after = found.chi2dof()
    assert after < before


def test_a_wave_of_the_mean_with_the_time_of_day():
    hours = {s.number: s.hours for s in _null().shots}
    span = max(hours.values())

    def change(x, values):
        time = np.array([hours[int(n)] for n in x["exposure"]])
        return 1.5e-3 * values * np.sin(2 * np.pi * time / (0.31 * span))

    found, _ = _explained(_changed("flat_mean", change))
    assert found.group == "mean in time"
    own = found.coefficients[0]
    assert abs(own.value - 1.5e-3) < 3 * own.error
    assert abs(own.where["period"] - 0.31 * span) < 0.01 * span
    before, after, count = found.folds["held-out"]["flat_mean"]
    assert after - count < 0.1 * (before - count)
    assert own.name in said_freely(found)


def _dimmer(x0, x1, y0, y1):
    """Columns, rows and blocks of flats that are dimmer by 0.4 % in a box."""
    ny, nx = _null().shape

    def change(x, values):
        inside = (x0 <= x["x"]) & (x["x"] < x1), (y0 <= x["y"]) & (x["y"] < y1)
        own = x["map"] == "all"
        block = own & inside[0] & inside[1] & (x["what"] == "block")
        column = (own & inside[0] & (x["what"] == "column")) * (y1 - y0) / ny
        row = own & inside[1] & (x["what"] == "row")
        return -4e-3 * (1.0 * block + column + row * (x1 - x0) / nx)

    return _changed("flat_map", change)


@pytest.mark.slow
def test_a_patch_of_the_sensor_that_is_dimmer_in_all_flats():
    found, _ = _explained(_dimmer(64, 96, 32, 64))
    assert found.group == "pattern of position"
    own = found.coefficients[0]
    assert own.where["power"] == 0 and own.name in said_freely(found)
    assert own.where["x"] == (64, 96) and own.where["y"] == (32, 64)
    assert abs(own.value + 4e-3) < 3 * own.error and not found.alike[found.group]
    before, after, count = found.folds["held-out"]["flat_map"]
    assert after - count < 0.1 * (before - count)


def test_half_of_an_amplifier_may_be_dimmer_or_the_other_brighter():
    # Gains are free, so that flats do not distinguish the two; the report names both.
    found, _ = _explained(_dimmer(64, 128, 64, 128))
    own = found.coefficients[0]
    told = {own.name: own.value, **dict(found.alike["pattern of position"])}
    assert told["box (64, 128), (64, 128)"] == pytest.approx(-4e-3, abs=3 * own.error)
    assert told["box (64, 128), (0, 64)"] == pytest.approx(4e-3, abs=3 * own.error)
    assert all(f"{name}: " in said_freely(found) for name in told)


# -- pixels of the virtual sensor


@dataclass(frozen=True)
class _OddInY(OutsideLibrary):
    """Shifts to +y on either side of a charge, which the virtual sensor has no variant of."""

    variants: ClassVar = {"": {}}

    def shifts(self, shifts, context):
        return EdgeShifts(shifts.kx, shifts.ky + 0.3 * np.abs(shifts.ky))


def _campaign(*effects):
    return measure_virtual(seed=9137, size=SMALL, effects=effects)


@pytest.mark.slow
def test_a_kernel_that_is_odd_in_y():
    found, _ = _explained(_campaign(_OddInY({})))
    assert found.group == "odd boundary shifts"
    own = found.coefficients[0]
    # Among terms that spots do not distinguish, the baseline's own shape comes first.
    assert own.where["shape"] == "baseline" and found.alike["odd boundary shifts"]
    assert own.where["odd"] == "y" and abs(own.value - 0.3) < 4 * own.error + 0.01
    assert found.tests["even in y"]["p_value"] < 1e-6 < found.tests["even in x"]["p_value"]
    assert found.tests["reciprocity"]["p_value"] < 1e-6
    assert found.chi2dof()[1] < found.chi2dof()[0]


@pytest.mark.slow
def test_an_echo_names_no_trap():
    # A trap explains much of an echo without being its cause.
    echo = make_effect("outside_library", {"amp": 3e-4}, "echo")
    model, mismatch = _located(_campaign(echo))
    told = attribute(model.predictor, model.fit, mismatch, kinds=KINDS)
    assert told.open_world and not told.found
    assert next(iter(told.probability)) == "outside_library"
    assert told.free_form.group == "readout filter"
    own = _one(told.free_form, "h_7 S^2")
    assert abs(own.value - 3e-4) < 4 * own.error + 1e-6
    report = reported(told)
    assert report["free_form"]["groups"][0] == "readout filter"
    assert report["effects"] == [{"class": "outside_library", "parameters": {}}]
    assert own.where["lag"] == 7 and f"{own.where['lag']} pixel times" in " ".join(
        said_of(told)
    )
    before, after = told.chi2dof()
    assert after < 1.2 < before


@pytest.mark.slow
def test_pixels_of_two_parities_and_a_ripple_are_told_apart():
    chess = make_effect("outside_library", {"amp": 2e-3}, "checkerboard")
    ripple = make_effect("outside_library", {"amp": 2e-3, "period": 11.3}, "ripple")
    found, _ = _explained(_campaign(chess, ripple))
    assert {"pattern of two-pixel parity", "ripple in readout time"} <= set(found.groups)
    parity = _one(found, "checkerboard x S^1")
    assert abs(abs(parity.value) - 2e-3) < 4 * parity.error + 4e-5
    assert len(found.of_group("ripple in readout time")) == 1
    wave = _one(found, "ripple of")
    assert abs(wave.where["period"] - 11.3) < 0.02
    assert abs(np.sqrt(wave.value * 1e-6) - 2e-3) < 2e-4


def test_the_gain_depends_on_the_exposure_before():
    last = make_effect("outside_library", {"amp": 5e-3}, "last_level")
    found, _ = _explained(_campaign(last))
    assert found.group == "mean by the exposure before"
    own = _one(found, "S^1 of the exposure before")
    # The sensor takes the level of whole frames, dark overscans too; the model that of the light.
    g = Geometry(SMALL.pixels)
    lit = g.pixels * g.width / np.prod(g.raw_shape)
    assert abs(own.value + 5e-3 * lit) < 3 * own.error
    before, after, count = found.folds["held-out"]["flat_mean"]
    assert after - count < 0.1 * (before - count)


# -- the parts


def test_edges_of_a_free_kernel_conserve_charge_and_are_even_or_odd():
    for edge in edge_names():
        kx, ky = shifts_of(edge, (21, 21))
        assert np.allclose(kx[:, 1:-1], -kx[:, -3::-1], atol=0)
        assert np.allclose(kx, kx[::-1]) and np.allclose(ky, ky[:, ::-1])
        assert np.allclose(ky[1:-1], -ky[-3::-1])
        assert np.abs(kx).max() + np.abs(ky).max() > 0
    kx, ky = shifts_of(("x", 0, 0), (21, 21), odd="x")
    assert kx[10, 10] == kx[10, 9] > 0 and not ky.any()


def test_exchanged_axes_are_the_transposes():
    rng = np.random.default_rng(8231)
    kx, ky = rng.normal(size=(2, 5, 5))
    moved = AxesExchanged({"amp": 1.0}).edges(kx, ky, None, None)
    assert np.allclose(moved[0], ky.T) and np.allclose(moved[1], kx.T)


@pytest.mark.parametrize(
    ("word", "counted"), [("flat_cov", True), ("serial_overscan", False)]
)
def test_a_remainder_counts_against_what_is_explained_in_its_channel(word, counted):
    finding = Finding("lags", word, 8.0, 1e-12)
    left = Mismatch(1e-12, 0.5, 1e-12, (finding,), {word: (100.0, 100.0)})
    explained = {"serial_overscan": (1.2 * 8.0 / ACCURACY) ** 2, "flat_cov": 50.0}
    assert counts(finding, left, explained, {}) is counted
    assert stands_out(left, explained) is counted
    # A prediction that is known to be worse may leave as much in either channel.
    assert not stands_out(left, explained, {"flat_cov": 1.2, "serial_overscan": 1.0})


def test_families_compete_on_what_stands_out_alone():
    model, mismatch = _null_located()
    quiet = replace(mismatch, findings=())
    assert compete(Scene(model), quiet) == []


# -- the process over lag and level


def _bumpy(x, values):
    """A change of no simple law: over neighbouring lags, up and down with the level."""
    near = np.exp(-0.5 * ((x["i"] - 3) ** 2 + (x["j"] - 2) ** 2) / 1.5**2)
    level = x["level"] / 4e4
    return 1e-2 * x["level"] * near * np.sin(2.5 * level)


def test_the_process_is_orthogonal_to_what_the_fit_floats():
    model, _ = _located(_changed("flat_cov", _bumpy))
    choice = process_choice(Scene(model))
    assert choice is not None and choice.score > 50
    inside = model.fit.basis.T @ choice.template
    assert np.linalg.norm(inside) < 1e-6 * np.linalg.norm(choice.template)
    # Parameters keep the values and errors that they have without the unmodelled change.
    null, _ = _null_located()
    after = model.with_columns(Columns(choice.terms))
    assert after.fit.total < model.fit.total - 50
    own = len(model.predictor.names)
    moved = (after.fit.values[:own] - null.fit.values[:own]) / null.fit.errors[:own]
    assert np.abs(moved).max() < 1.0
    assert (after.fit.errors[:own] / null.fit.errors[:own]).max() < 1.1


def test_the_process_leaves_to_parameters_what_is_theirs():
    # What a gain and a device parameter other by five of their errors do to covariances.
    null, _ = _null_located()
    point = null.fit.values[: len(null.predictor.names)].copy()
    for name in ("gain 0", null.predictor.names[null.predictor.space.prior_rows[0]]):
        row = null.predictor.names.index(name)
        point[row] += 5 * null.fit.errors[row]
    measured = _null()
    channels = tuple(
        replace(c, values=c.values + null.predictor.predict(c, point)
                - null.predictor.predict(c, null.fit.values[: len(point)]))
        for c in measured.channels
    )  # fmt: skip
    model, _ = _located(replace(measured, channels=channels))
    row = null.predictor.names.index("gain 0")
    moved = (model.fit.values[row] - null.fit.values[row]) / null.fit.errors[row]
    assert moved == pytest.approx(5, abs=0.5)
    assert process_choice(Scene(model)) is None


def _after_bright(amp):
    """The null, means lower by ``amp`` per 1e5 e- (true gain) of the exposure before."""
    level = {s.number: s.level / np.mean(_null().gains) * 2.17 for s in _null().shots}

    def change(x, values):
        last = np.array([level.get(int(n) - 1, 0.0) for n in x["exposure"]])
        return -amp * values * last / 1e5

    return _changed("flat_mean", change)


@pytest.mark.slow
def test_an_effect_that_leaves_nothing_is_not_believed_where_a_free_form_explains_far_more():
    # Levels follow one another up and down a ladder: much looks like the exposure's own.
    model, mismatch = _located(_after_bright(7e-4))
    told = attribute(model.predictor, model.fit, mismatch, kinds=(GainNonlinearity,))
    left = locate_mismatch(
        model.with_effects([GainNonlinearity({"c2": 1e-4, "c3": 0.0})]).fit
    )
    assert not left.detected
    assert told.open_world and not told.found
    assert told.free_form.group == "mean by the exposure before"
    own = _one(told.free_form, "S^1 of the exposure before")
    assert abs(own.value + 7e-4) < 3 * own.error


@pytest.mark.slow
def test_a_nonlinear_gain_is_not_outside_the_library():
    def change(x, values):
        return 2e-3 * values * x["level"] * 2.17 / 1e5

    model, mismatch = _located(_changed("flat_mean", change))
    told = attribute(model.predictor, model.fit, mismatch, kinds=(GainNonlinearity,))
    assert mismatch.detected and not told.open_world
    assert [f.effect.word for f in told.found] == ["gain_nonlinearity"]


@pytest.mark.slow
def test_exchanged_axes_are_found_behind_device_parameters_that_imitate_them():
    exchanged = make_effect("outside_library", {"amp": 1.0}, "axes_exchanged")
    model, mismatch = _located(_campaign(exchanged))
    pulls = {k: abs(v) for k, v in model.fit.pulls.items()}
    assert mismatch.detected and max(pulls.values()) > PULLED
    told = attribute(model.predictor, model.fit, mismatch, kinds=KINDS)
    assert [f.effect.name for f in told.found] == ["outside_library:axes_exchanged"]
    own = told.found[0]
    assert told.open_world and abs(own.effect["amp"] - 1) < 3 * own.errors["amp"]
    assert max(abs(v) for v in told.fit.pulls.values()) < PULLED
