"""Scans of a fit's residuals: families of statistics, decomposition into parts, false alarms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import Axes
from bfsensor.diagnose.detect.locate import FAMILY, Known, Locator
from bfsensor.diagnose.fit.baseline_fit import BaselineFit

HERE = Condition(wavelength=620.0, back_bias=-60.0, temperature=173.15)
LEVELS = 1e4, 3e4, 6e4, 9e4
COLUMNS = 64


def flats() -> Channel:
    """Covariances of two amplifiers at four levels."""
    j, i = (index.ravel() for index in np.indices((3, 3)))
    axes, values = Axes(), []
    for level in LEVELS:
        for amp in (0, 1):
            axes.add(9, HERE, amp=amp, time=level / 2e3, level=level, i=i, j=j)
            near = 1e-6 * level**2 / (1.0 + i**2 + j**2) ** 2
            values.append(np.where((i == 0) & (j == 0), level - 8 * near, near))
    error = tuple(np.array([[400.0**2]]) for _ in range(9 * 8))
    return Channel("flat_cov", np.concatenate(values), error, axes.columns(), "adu2")


def columns() -> Channel:
    """Mean columns of a map."""
    axes = Axes()
    axes.add(COLUMNS, HERE, map="all", what="column", x=np.arange(COLUMNS), y=-1.0, k=-1.0)
    error = tuple(np.array([[1e-8]]) for _ in range(COLUMNS))
    return Channel("flat_map", np.zeros(COLUMNS), error, axes.columns(), "")


def crosstalk() -> Channel:
    """Crosstalk of one pair of amplifiers: a channel of one value."""
    axes = Axes()
    axes.add(1, HERE, amp=0, other=1, what="crosstalk")
    return Channel("amp_cross", np.zeros(1), (np.array([[1e-10]]),), axes.columns(), "")


def a_fit(seed: int, signal: NDArray[np.float64] | None = None) -> BaselineFit:
    """Noise and a signal, three parameters fitted away."""
    channels = flats(), columns(), crosstalk()
    starts = np.concatenate([[0], np.cumsum([len(c) for c in channels])])
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(np.random.default_rng(77).standard_normal((starts[-1], 3)))[0]
    left = rng.standard_normal(starts[-1]) + (0.0 if signal is None else signal)
    return BaselineFit(
        channels=channels, names=(), values=np.zeros(0), errors=np.zeros(0),
        residuals=left - basis @ (basis.T @ left), basis=basis, starts=starts, pulls={},
    )  # fmt: skip


def pattern(fit: BaselineFit, word: str, shape: NDArray[np.float64], z: float) -> NDArray:
    """A signal of a shape in one channel, whose best amplitude is z standard deviations."""
    out = np.zeros(len(fit.residuals))
    out[fit.of(word)] = z * shape / np.sqrt(shape @ shape)
    return out


@pytest.fixture(scope="module")
def judge() -> Locator:
    return Locator(a_fit(311), seed=5)


def test_correlations_are_those_of_drawn_noise(judge: Locator) -> None:
    scanner = judge.scanner
    z = scanner.templates_z(scanner.fit.draw(np.random.default_rng(12), 4000))
    assert z.std(0) == pytest.approx(1.0, abs=0.06)  # 5 sigma of 4000 draws
    for n in (3, 40, len(scanner.templates) - 1):
        # A product of unit normals scatters by at most sqrt(2) / sqrt(4000) = 0.022.
        assert scanner.correlations(n) == pytest.approx((z * z[:, [n]]).mean(0), abs=0.11)


def test_noise_alarms_as_often_as_it_says(judge: Locator) -> None:
    fit = judge.scanner.fit
    found = [judge.locate(r) for r in fit.draw(np.random.default_rng(91), 400)]
    for name in ("p_value", "p_chi2", "p_scans"):
        p = np.array([getattr(f, name) for f in found])
        for level in (0.05, 0.3):
            # Calibrated on 500 draws, tested on 400: both scatter.
            low, high = binom.ppf([1e-4, 1 - 1e-4], 400, level)
            spread = 3 * np.sqrt(level * (1 - level) / 500) * 400
            assert low - spread <= (p < level).sum() <= high + spread, (name, level)


def test_a_lone_number_is_not_hidden_by_many_templates(judge: Locator) -> None:
    fit = judge.scanner.fit
    quiet = fit.residuals.copy()
    signal = pattern(fit, "amp_cross", np.ones(1), 4.0)
    signal -= fit.basis @ (fit.basis.T @ signal)
    quiet[fit.of("amp_cross")] = 0.0
    found = judge.locate(quiet + signal)
    # On one scale of deviates 4 would be nothing special among so many.
    draws = judge.scanner.templates_z(fit.draw(np.random.default_rng(4), 300))
    assert np.quantile(np.abs(draws).max(1), 0.99) > 4.0
    assert found.p_scans < 0.01
    assert [part.word for part in found.parts] == ["amp_cross"]


def test_a_deviate_at_a_familys_alarm_is_one(judge: Locator) -> None:
    """A lone number a little beyond its family's deviate alarms, a little below it does not."""
    fit = judge.scanner.fit
    alarms = judge.alarms()
    assert set(alarms) == {"chi-square", "flat_cov", "flat_map", "amp_cross"}
    # Of more templates noise gives farther ones.
    assert 2.5 < alarms["amp_cross"] < alarms["flat_map"] < 6
    (row,) = (k for k, t in enumerate(judge.scanner.templates) if t.word == "amp_cross")
    unit = pattern(fit, "amp_cross", np.ones(1), 1.0)
    unit -= fit.basis @ (fit.basis.T @ unit)
    unit /= judge.scanner.templates_z(unit)[row]
    for part, alarmed in ((0.98, False), (1.02, True)):
        assert (judge.locate(part * alarms["amp_cross"] * unit).p_value < 0.01) == alarmed


def test_parts_are_what_was_put_in_and_no_correlated_template(judge: Locator) -> None:
    fit = judge.scanner.fit
    x = fit.channels[0].axes
    lag = np.where((x["i"] == 2) & (x["j"] == 1), x["level"].astype(float) ** 2, 0.0)
    place = np.arange(COLUMNS) + 0.5 - 20
    tear = np.sign(place) * np.exp(-np.abs(place) / 4.0)
    signal = pattern(fit, "flat_cov", lag, 30.0) + pattern(fit, "flat_map", tear, 15.0)
    found = judge.locate(a_fit(311, signal).residuals)
    parts = {p.word: p for p in found.parts}
    assert found.detected and len(found.parts) == len(parts) == 2
    assert parts["flat_cov"].where["lags"] == [(2, 1)]
    assert "amp" not in parts["flat_cov"].where
    low, high = parts["flat_map"].where["x"]
    assert low < 20 < high and high - low <= 14
    # The findings hold correlated templates: single columns, other powers, each amplifier.
    assert len(found.findings) > 10


def test_one_amplifiers_lag_is_that_amplifiers(judge: Locator) -> None:
    fit = judge.scanner.fit
    x = fit.channels[0].axes
    lag = np.where((x["i"] == 1) & (x["j"] == 0) & (x["amp"] == 1), x["level"] ** 2.0, 0.0)
    found = judge.locate(a_fit(311, pattern(fit, "flat_cov", lag, 15.0)).residuals)
    assert found.parts[0].where["amp"] == 1


def test_levels_are_where_the_evidence_is(judge: Locator) -> None:
    cubic = [t for t in judge.scanner.templates if t.family == "lag x power"
             and t.where["power"] == 3]  # fmt: skip
    constant = [t for t in judge.scanner.templates if t.family == "lag x power"
                and t.where["power"] == 0]  # fmt: skip
    # Of cubes 92 % of the square lies at the highest of four levels, 8 % at the next.
    assert all(t.where["level"] == (6e4, 9e4) for t in cubic)
    assert all(t.where["level"] == (1e4, 9e4) for t in constant)


def test_own_shape_is_the_prediction_with_its_sum_rule(judge: Locator) -> None:
    own = [t for t in judge.scanner.templates if t.family == "own shape x power"]
    assert {t.where["power"] for t in own} <= {2, 3, 4} and own
    channel = judge.scanner.fit.channels[0]
    shape = np.zeros(len(channel))
    first = next(t for t in own if t.where["power"] == 2)
    shape[first.rows] = first.weights * 400.0
    x = channel.axes
    weight = np.where(x["i"] > 0, 2.0, 1.0) * np.where(x["j"] > 0, 2.0, 1.0)
    for level in LEVELS:
        rows = (x["level"] == level) & (x["amp"] == 0)
        assert (weight * shape)[rows].sum() == pytest.approx(
            0.0, abs=1e-6 * np.abs(shape).max()
        )


def known(fit: BaselineFit, n: int, *, signed: bool) -> list[Known]:
    """Two effects, one with a single shape, one with many that are alike."""
    rng = np.random.default_rng(n)
    out = []
    base = rng.standard_normal(len(fit.basis))
    for k in range(n):
        shape = base + 0.5 * rng.standard_normal(len(fit.basis)) * (k > 0)
        shape -= fit.basis @ (fit.basis.T @ shape)
        shape = (shape / np.sqrt(shape @ shape)).astype(np.float32)
        out.append(Known("one" if k == 0 else "many", "flat_cov", shape, signed))
    return out


@pytest.mark.parametrize("signed", [True, False])
def test_shapes_of_effects_alarm_as_seldom_as_is_said(judge: Locator, signed: bool) -> None:
    fit = judge.scanner.fit
    both = judge.with_library(known(fit, 30, signed=signed))
    drawn = fit.draw_all(np.random.default_rng(5), 400)
    p = np.array([both.locate(r).p_value for r in drawn])
    for level in (0.05, 0.2, 0.5):
        low, high = binom.interval(0.999, 400, level)
        assert low - 6 <= (p < level).sum() <= high + 6
    # A shape that is there is found, and its opposite only where that may be.
    shape = both.library[0].weights.astype(float)
    found = both.locate(drawn[0] + (7.0 - shape @ drawn[0]) * shape)
    assert found.p_value < 1e-3
    first = found.findings[0]
    assert (first.family, first.where) == (FAMILY, {"effect": "one"})
    assert first.z == pytest.approx(7.0, abs=1e-4)
    against = both.locate(drawn[0] - (7.0 + shape @ drawn[0]) * shape)
    assert any(f.family == FAMILY for f in against.findings) == signed


def test_without_shapes_nothing_changes(judge: Locator) -> None:
    residuals = judge.scanner.fit.draw(np.random.default_rng(6), 1)[0]
    with_none, plain = judge.with_library([]).locate(residuals), judge.locate(residuals)
    assert with_none.p_value == plain.p_value and with_none.findings == plain.findings


def test_parts_account_for_what_their_templates_explain(judge: Locator) -> None:
    """Squares of the deviates of parts that overlap add up to the chi-square that both remove."""
    scanner = judge.scanner
    step, slope = np.arange(COLUMNS) > 30, np.exp(-np.arange(COLUMNS) / 20.0)
    signal = pattern(scanner.fit, "flat_map", 1.0 * step, 25.0)
    signal += pattern(scanner.fit, "flat_map", slope, 25.0)
    left = a_fit(311, signal).residuals
    parts = judge.locate(left).parts
    assert len(parts) >= 2
    z = scanner.templates_z(left)
    rows = [
        next(
            n for n, t in enumerate(scanner.templates)
            if (t.family, t.word, dict(t.where)) == (p.family, p.word, p.where)
        )
        for p in parts
    ]  # fmt: skip
    alike = np.array([scanner.correlations(n)[rows] for n in rows])
    assert np.abs(alike - np.eye(len(rows))).max() > 0.2
    removed = z[rows] @ np.linalg.solve(alike, z[rows])
    assert sum(p.z**2 for p in parts) == pytest.approx(removed, rel=1e-6)
