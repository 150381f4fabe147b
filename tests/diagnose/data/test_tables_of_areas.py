"""Tables of a_ij: errors scaled by far lags, an unknown level, one wrong value, several tables."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import binom, chi2

from bfsensor.cli.main import main
from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.reduced_channels import StatedTable, measure_reduced
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.explain.terms import SINGLE
from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from bfsensor.diagnose.fit.error_scale import FAR, scale_errors
from bfsensor.diagnose.fit.fitted_model import LEFT_OUT, Model, compare_held_out
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.free_baseline import free_baseline
from bfsensor.diagnose.model.open_baseline import (
    find_baseline,
    find_reduced_recordings,
    is_device,
)
from bfsensor.diagnose.model.unknown_level import NAME, SPREAD, float_unknown_level
from bfsensor.effects.bf_long_range import BrighterFatterLongRange
from bfsensor.errors import DeviceError, DiagnosisError, RecordingError
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.response.edge_response import LEVEL, area_matrix

ERROR = 3e-9
DEVICE = find_baseline("itl_sta3800c_60")


def areas_at(level=LEVEL, baseline=DEVICE, wavelength=620.0):
    """a_ij of lags from 0 to 4 that a baseline predicts at a level."""
    key = wavelength, baseline.reference[1]
    away = level - baseline.level
    k = [
        baseline.edges[key][n] + away * baseline.slopes[key][n] + away**2 * baseline.bends[key][n]
        for n in range(2)
    ]  # fmt: skip
    plane = area_matrix(*k)
    n = len(plane) // 2
    return plane[n : n + 5, n : n + 5]


def table_of(a, seed, *, error=ERROR, stated=1.0):
    """Table of given a_ij with noise of ``error``, whose stated errors are ``stated`` as large."""
    noise = np.random.default_rng(seed).normal(0, error, a.shape)
    known = np.ones(a.shape, bool)
    return AreaChangeTable(
        Path("drawn"), a + noise, np.full(a.shape, stated * error), known
    )


def fixed(baseline=DEVICE):
    """The baseline at the level of :data:`LEVEL`, without any dependence on it."""
    edges = {
        key: tuple(
            baseline.edges[key][n] + (LEVEL - baseline.level) * baseline.slopes[key][n]
            + (LEVEL - baseline.level) ** 2 * baseline.bends[key][n] for n in range(2)
        ) for key in baseline.edges
    }  # fmt: skip
    return Baseline("fixed", edges, {}, {}, baseline.reference)


@pytest.mark.parametrize("stated", [0.2, 1.0, 5.0])
def test_errors_are_those_of_the_far_lags(stated):
    measured = measure_reduced(table_of(areas_at(), 3, stated=stated), reach=4)
    scaled = scale_errors(measured, fixed())
    (channel,) = scaled.channels
    far = np.hypot(channel.axes["i"], channel.axes["j"]) > FAR
    left = channel.values - areas_at()[channel.axes["j"], channel.axes["i"]]
    square = (channel.axes["i"] ** 2 + channel.axes["j"] ** 2)[far].astype(float)
    n = int(far.sum()) - 2
    smooth = np.linalg.qr(np.array([1 / square, 1 / square**2]).T)[0]
    rough = left[far] - smooth @ (smooth.T @ left[far])
    rms = np.sqrt(np.sum((rough / (stated * ERROR)) ** 2) / n)
    ends = [rms * np.sqrt(n / chi2.ppf(q, n)) for q in (0.975, 0.025)]
    expected = 1.0 if ends[0] < 1 < ends[1] else ends[1]
    assert (expected == 1.0) == (stated == 1.0)
    np.testing.assert_allclose(channel.errors, expected * stated * ERROR, rtol=1e-9)
    assert any("17 far lags" in note for note in scaled.notes)


@pytest.mark.parametrize("effect", [
    BrighterFatterLongRange({"amp": 2e-8, "power": 2.0}),
    BrighterFatterLongRange({"amp": -1e-7, "power": 3.5}),
], ids=["slow", "steep"])  # fmt: skip
def test_a_response_that_reaches_farther_is_no_noise(effect):
    """Far lags that are off by several errors, smoothly, leave the errors as they are."""
    measured = measure_reduced(table_of(areas_at(), 6, error=3e-10), reach=4)
    predictor, _ = fit_bounded(measured, fixed())
    (channel,) = measured.channels
    more = predictor.with_effects((effect,), predictor.start)
    tail = more.predict(channel, more.start) - predictor.predict(channel, predictor.start)
    far = np.hypot(channel.axes["i"], channel.axes["j"]) > FAR
    assert np.sqrt(np.mean(tail[far] ** 2)) > 2 * 3e-10
    drawn = replace(measured, channels=(replace(channel, values=channel.values + tail),))
    for which in (measured, drawn):
        (scaled,) = scale_errors(which, fixed()).channels
        np.testing.assert_allclose(scaled.errors, 3e-10)


@pytest.mark.parametrize("baseline", [fixed(), free_baseline()], ids=["a table", "none"])
def test_far_lags_without_any_scatter_scale_nothing(baseline):
    """A table whose far lags are written as 0, whatever the baseline predicts there."""
    table = table_of(areas_at(), 4)
    j, i = np.indices(table.a.shape)
    a = np.where(np.hypot(i, j) > FAR, 0.0, table.a)
    measured = measure_reduced(replace(table, a=a), reach=4)
    (channel,) = scale_errors(measured, baseline).channels
    assert np.all(channel.errors == ERROR)


def test_a_device_file_that_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("name = 'mine'\n")
    with pytest.raises(DeviceError, match="mine"):
        is_device(path)
    assert (
        is_device("itl_sta3800c")
        and not is_device("lsst_itl_50_32")
        and not is_device(None)
    )


def test_two_tables_have_a_scale_each():
    tables = [StatedTable(table_of(areas_at(), 5, stated=s)) for s in (1.0, 5.0)]
    scaled = scale_errors(measure_reduced(tables, reach=4), fixed())
    (channel,) = scaled.channels
    first = channel.axes["table"] == 0
    assert np.all(channel.errors[first] == ERROR)
    assert np.all(channel.errors[~first] < 2.5 * ERROR)
    assert any("table 2" in note and "multiplied" in note for note in scaled.notes)


@pytest.mark.parametrize("stated", [0.3, 4.0])
def test_nulls_with_wrong_errors_raise_no_more_alarms_than_stated(stated):
    """Forty tables that hold only noise: p-values below 0.05 in no more than chance allows."""
    p = []
    for seed in range(40):
        measured = measure_reduced(table_of(areas_at(), seed, stated=stated), reach=4)
        p.append(diagnose_measured(measured, fixed(), explain=False).mismatch.p_value)
    most = int(binom.ppf(0.999, len(p), 0.05))
    assert (np.array(p) < 0.05).sum() <= most


def test_an_unknown_level_floats():
    """a_ij of another level: no mismatch where the level is not stated, a clear one where it is."""
    level = 60_000.0
    drawn = table_of(areas_at(level), 7, error=1e-9)
    free = diagnose_measured(
        measure_reduced([StatedTable(drawn)], reach=4), DEVICE, explain=False
    )
    assert not free.mismatch.detected
    errors = dict(zip(free.fit.names, free.fit.errors, strict=True))
    found = LEVEL + free.fit.pulls[NAME] * SPREAD
    # Within the curvature that the straight line in level leaves out, and noise.
    assert abs(found - level) < 3 * errors[f"device {NAME}"] * SPREAD + 0.1 * level
    assert any("no table states the level" in note for note in free.notes)
    for stated, seen in ((LEVEL, True), (level, False)):
        measured = measure_reduced([StatedTable(drawn, level=stated)], reach=4)
        result = diagnose_measured(measured, DEVICE, explain=False)
        assert result.mismatch.detected == seen and NAME not in result.fit.pulls


def test_an_unknown_level_stays_between_none_and_twice_the_usual_one():
    """A wrong voltage must not be taken for a level below 0."""
    at50 = find_baseline("itl_sta3800c")
    measured = measure_reduced(table_of(areas_at(2e4), 8, error=1e-10), reach=4)
    found = diagnose_measured(measured, at50, explain=False, scaled=False)
    assert found.mismatch.detected
    assert abs(found.fit.pulls[NAME] * SPREAD) <= LEVEL * (1 + 1e-9)


def test_a_baseline_without_levels_has_no_level_to_float():
    measured = measure_reduced(table_of(areas_at(), 9), reach=4)
    assert float_unknown_level(measured, fixed()) == fixed() or not float_unknown_level(
        measured, fixed()
    ).parameters  # fmt: skip
    stated = measure_reduced([StatedTable(table_of(areas_at(), 9), level=3e4)], reach=4)
    assert float_unknown_level(stated, DEVICE) is DEVICE


def test_one_wrong_value_is_one_wrong_value():
    """a_00 of 3 % too much, with nobody to gain it, is no long-range tail."""
    a = areas_at().copy()
    a[0, 0] *= 1.03
    found = diagnose_measured(measure_reduced(table_of(a, 11), reach=4), fixed())
    assert found.mismatch.detected and found.attribution is not None
    assert found.attribution.found == () and found.attribution.open_world
    world = found.attribution.free_form
    assert world is not None and world.groups == (SINGLE,)
    (one,) = world.coefficients
    assert one.where["lags"] == [(0, 0)]
    assert abs(one.value - 0.03e8 * areas_at()[0, 0]) < 4 * one.error
    assert "One value is off" in found.said() and "no longer add up to 0" in found.said()
    assert any("bf_long_range" in note for note in found.notes)


def test_a_gain_that_is_wrong_for_all_tables_is_one_value():
    """a_00 of every table by the same amount: no coupling, of whatever strength."""
    tables = []
    for n, wavelength in enumerate((620.0, 950.0)):
        a = areas_at(wavelength=wavelength).copy()
        a[0, 0] += 4e-8
        place = Condition(wavelength=wavelength)
        tables.append(StatedTable(table_of(a, 60 + n, error=1e-9), place, LEVEL))
    found = diagnose_measured(measure_reduced(tables, reach=4), fixed())
    assert found.attribution is not None and found.attribution.found == ()
    (one,) = found.attribution.free_form.coefficients
    assert one.where["lags"] == [(0, 0)] and len(one.where["rows"]) == 2
    assert abs(one.value - 4.0) < 4 * one.error
    assert (
        "a_00 in all tables by 4" in found.said()
        or "a_00 in all tables by 3.9" in found.said()
    )


def remembered(a, share):
    """a_ij of flats whose pixels pass a part to the next in the row, in units of the flats' own gain."""
    side, at = 4 * len(a), np.arange(-len(a) + 1, len(a))
    wide, kernel = np.zeros((2, side, side))
    wide[np.ix_(at, at)] = a[np.ix_(abs(at), abs(at))]
    wide[0, 0] += 1 / LEVEL
    kernel[0, :2] = 1 - share, share
    out = np.fft.ifft2(np.fft.fft2(wide) * abs(np.fft.fft2(kernel)) ** 2).real
    out[0, 0] -= (kernel**2).sum() / LEVEL
    return out[: len(a), : len(a)]


def test_memory_that_is_off_in_all_tables_is_memory():
    """A lag that deviates alike in all tables is one value only where no simple effect makes it so."""
    share = 1e-3
    tables = []
    for n, wavelength in enumerate((620.0, 950.0)):
        a = remembered(areas_at(wavelength=wavelength), share)
        place = Condition(wavelength=wavelength)
        tables.append(StatedTable(table_of(a, 70 + n, error=1e-9), place, LEVEL))
    found = diagnose_measured(measure_reduced(tables, reach=4), fixed())
    assert found.attribution is not None
    (one,) = found.attribution.found
    assert one.effect.word == "electronic_memory"
    assert one.effect["alpha"] == pytest.approx(share, rel=0.1)


def test_a_long_range_tail_is_not_one_value():
    """Many lags gain what a_00 lacks: the tail is seen without a_00, too."""
    effect = BrighterFatterLongRange({"amp": 2.5e-8, "power": 2.0})
    measured = measure_reduced(table_of(areas_at(), 13, error=1e-9), reach=4)
    predictor, _ = fit_bounded(measured, fixed())
    (channel,) = measured.channels
    more = predictor.with_effects((effect,), predictor.start)
    tail = more.predict(channel, more.start) - predictor.predict(channel, predictor.start)
    drawn = replace(measured, channels=(replace(channel, values=channel.values + tail),))
    found = diagnose_measured(drawn, fixed())
    assert found.attribution is not None
    world = found.attribution.free_form
    assert world is None or SINGLE not in world.groups


def test_lags_left_out_are_predicted_by_the_others():
    """An effect that is there lowers the chi-square of lags that its fit has not seen."""
    effect = BrighterFatterLongRange({"amp": 2.5e-8, "power": 2.0})
    measured = measure_reduced(table_of(areas_at(), 17, error=1e-9), reach=4)
    predictor, _ = fit_bounded(measured, fixed())
    (channel,) = measured.channels
    more = predictor.with_effects((effect,), predictor.start)
    tail = more.predict(channel, more.start) - predictor.predict(channel, predictor.start)
    drawn = replace(measured, channels=(replace(channel, values=channel.values + tail),))
    base = Model(*fit_bounded(drawn, fixed()))
    right = compare_held_out(base, base.with_effects([effect]))["flat_cov"]
    assert right[2] == 25 and right[1] < 2 * 25 < right[0]
    null = Model(*fit_bounded(measured, fixed()))
    before, after, _ = compare_held_out(null, null.with_effects([effect]))["flat_cov"]
    assert after > before - 4  # what is not there does not predict
    assert LEFT_OUT == 5


def test_no_power_of_the_charge_from_a_table_of_one_level():
    a = areas_at().copy()
    a[0, 2] *= 1.8
    a[2, 0] *= 1.8
    found = diagnose_measured(
        measure_reduced(table_of(a, 19, error=1e-9), reach=4), fixed()
    )
    world = found.attribution.free_form
    assert world is not None
    assert not any(c.where.get("power") for c in world.coefficients)
    assert "its square" not in found.said() and "the square" not in found.said()


def test_tables_at_their_voltages_are_compared_jointly(tmp_path):
    """A table of -50 V contradicts the response at -60 V, unless its voltage is stated."""
    at50 = find_baseline("itl_sta3800c")
    edges = {**fixed(DEVICE).edges, **fixed(at50).edges}
    both = Baseline("two voltages", edges, {}, {}, DEVICE.reference)
    for name, a, seed in (("a60", areas_at(), 23), ("a50", areas_at(baseline=at50), 29)):
        write(tmp_path / f"{name}.csv", table_of(a, seed, error=1e-9))
    paths = [tmp_path / "a60.csv", tmp_path / "a50.csv"]
    given = [("", {"level": str(LEVEL)}), ("a50.csv", {"back_bias": "-50 V"})]
    for settings, seen in ((given, False), (given[:1], True)):
        tables = find_reduced_recordings(paths, settings)
        found = diagnose_measured(measure_reduced(tables, reach=4), both, explain=False)
        assert found.mismatch.detected == seen
        assert len(found.fit.channels[0]) == 50
    assert tables[0].condition == Condition() and tables[0].level == LEVEL


def write(path, table):
    """Write a table as published ones are."""
    j, i = np.indices(table.a.shape)
    columns = (i, j, table.a, table.errors)
    lines = ["i_serial,j_parallel,cov_per_e,err_per_e"]
    lines += [
        f"{int(a)},{int(b)},{float(c)!r},{float(d)!r}"
        for a, b, c, d in zip(*(np.ravel(v) for v in columns), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")


def test_what_cannot_be_stated_is_refused(tmp_path):
    one, two = tmp_path / "one.csv", tmp_path / "two.csv"
    for path in (one, two):
        write(path, table_of(areas_at(), 31))
    for settings, text in (
        (
            [("three.csv", {"level": "1e4"})],
            "not one of the given recordings one.csv, two.csv",
        ),
        ([("", {"level": "much"})], "number of electrons above 0"),
        ([("", {"level": "-3"})], "number of electrons above 0"),
        ([("", {"gate_high": "3 V"})], "gate voltages are those of the baseline's device"),
    ):
        with pytest.raises(DiagnosisError, match=text):
            find_reduced_recordings([one, two], settings)
    with pytest.raises(RecordingError, match="'doping' is not a condition"):
        find_reduced_recordings([one], [("", {"doping": "3"})])
    (tmp_path / "run").mkdir()
    with pytest.raises(DiagnosisError, match="allowed for tables of a_ij only"):
        find_reduced_recordings([one, tmp_path / "run"])


def test_text_among_the_numbers_is_named(tmp_path):
    path = tmp_path / "one.csv"
    write(path, table_of(areas_at(), 37))
    path.write_text(path.read_text() + "5,0,about 1e-8,1e-9\n")
    result = CliRunner().invoke(main, ["diagnose", str(path), "--baseline", "none"])
    assert result.exit_code == 1
    assert "row 26: cov_per_e" in result.output and "about 1e-8" in result.output


@pytest.mark.parametrize(("kelvin", "warming"), [((173, 173), False), ((173, 193), True)])
def test_temperature_floats_where_recordings_differ_in_it(
    tmp_path, monkeypatch, kelvin, warming
):
    import bfsensor.diagnose.model.open_baseline as sources

    class Asked(Exception):
        pass

    def simulate(given, parameters, back_biases, *, keep, warming, progress):
        raise Asked(warming)

    monkeypatch.setattr(sources, "simulate_baseline", simulate)
    command = ["diagnose", "--baseline", "itl_sta3800c_60", "-o", str(tmp_path / "out")]
    for name, one in zip(("one", "two"), kelvin, strict=True):
        path = tmp_path / f"{name}.csv"
        write(path, table_of(areas_at(5e4), 41))
        command += [str(path), "--at", f"{name}:back_bias=-60V,temperature={one}K"]
    result = CliRunner().invoke(main, command)
    assert isinstance(result.exception, Asked), result.output
    assert result.exception.args == (warming,)


def test_the_command_asks_the_quantities_of_a_device(tmp_path, monkeypatch):
    """Without --no-device all quantities float; conditions of --at reach the tables."""
    import bfsensor.diagnose.model.open_baseline as sources

    asked = []

    def simulate(given, parameters, back_biases, *, keep, warming, progress):
        asked.append((given, tuple(parameters), list(back_biases)))
        return DEVICE

    monkeypatch.setattr(sources, "simulate_baseline", simulate)
    path = tmp_path / "one.csv"
    write(path, table_of(areas_at(5e4), 41))
    command = [
        "diagnose", str(path), "--baseline", "itl_sta3800c_60", "-o", str(tmp_path / "out"),
        "--locate-only", "--at", "back_bias=-60V,level=50000",
    ]  # fmt: skip
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    assert asked == [("itl_sta3800c_60", ("all",), [-60.0])]
    assert not json.loads((tmp_path / "out" / "report.json").read_text())["detected"]
    result = CliRunner().invoke(main, [*command, "--no-device"])
    assert result.exit_code == 0 and len(asked) == 1
