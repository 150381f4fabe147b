"""Curves of known truth: recovered, with errors that hold, and what does not belong found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import binom

from bfsensor.errors import ConvergenceError, MeasurementError
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.measure.covariance_fit import CovarianceFit, fit_covariances
from bfsensor.measure.covariance_model import model_covariances
from bfsensor.measure.curve import (
    CovarianceCurve,
    measure_curve,
)
from validation.measurement_errors.flat_mocks import (
    draw_field_pairs,
    draw_pixel_pairs,
    make_truth,
    measure_mock,
    parameters_of,
    truth_of,
)

TRUTH = make_truth(lags=2)
LEVELS = np.repeat(np.linspace(2e3, 1.1e5, 20), 2)


def scattered(seed, *, levels=LEVELS, pixels=1_000_000, truth=TRUTH):
    """A curve in ADU with Gaussian errors drawn from the full matrix."""
    rng = np.random.default_rng(seed)
    true = model_covariances(
        levels, truth.a, b=truth.b, noise=truth.noise_matrix(False), gain=truth.gain
    )
    noisy = []
    for one in true:
        root = np.linalg.cholesky(bartlett_matrix(one, np.full(one.shape, pixels)))
        noisy.append(one + (root @ rng.standard_normal(one.size)).reshape(one.shape))
    return CovarianceCurve.from_arrays(
        levels, noisy, pixels=pixels, unit="adu", region="C00"
    )


def spoiled(curve, at, factor):
    """Variance and covariances of some pairs multiplied."""
    c = curve.covariances.copy()
    c[at] *= factor
    return dataclasses.replace(curve, covariances=c)


def pulls(fit, truth=TRUTH):
    """Departures from the truth in stated errors."""
    values, errors = parameters_of(fit)
    return {k: (values[k] - v) / errors[k] for k, v in truth_of(truth, "fields").items()}


def test_errors_and_chi_square_hold():
    """60 curves drawn from Bartlett's matrix: the fit's own algebra, no images."""
    fits = [fit_covariances(scattered(4100 + k), level_range=(0, 1e6)) for k in range(60)]
    every = np.array([list(pulls(fit).values()) for fit in fits])
    # 60 x 29 pulls, correlated within a curve: as for a quarter of them.
    inside = (np.abs(every) < 1).mean()
    assert abs(inside - 0.683) < 4 * np.sqrt(0.683 * 0.317 / (every.size / 4))
    assert np.abs(every.mean(0)).max() < 4 / np.sqrt(60)
    chi2 = np.array([fit.chi2 for fit in fits])
    dof = fits[0].dof
    assert dof == 40 * 9 - 28
    assert chi2.mean() == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / 60))
    assert sum(len(fit.dropped) for fit in fits) <= 2


def test_off_diagonal_weights_matter():
    """Ties between lags are part of the error matrix: without them chi-square is off."""
    curve = scattered(4200)
    full = [
        bartlett_matrix(c, n) for c, n in zip(curve.covariances, curve.pairs, strict=True)
    ]
    tie = np.abs(full[-1] / np.sqrt(np.outer(np.diag(full[-1]), np.diag(full[-1]))))
    np.fill_diagonal(tie, 0)
    assert tie.max() > 0.15


@pytest.mark.slow
def test_images_to_parameters_with_coverage():
    """24 campaigns of Gaussian flats, 15 levels twice, 96 x 96 pixels (200 in validation/)."""
    fits = [measure_mock("fields", TRUTH, 96, 5200 + k) for k in range(24)]
    rows = [pulls(fit) for fit in fits]
    for name in ("gain", "a_00", "a_10", "a_01", "a_11", "noise_00"):
        each = np.array([row[name] for row in rows])
        # Chance below 1e-4 of such a count, and of such a mean.
        assert binom.cdf((np.abs(each) < 1).sum(), 24, 0.683) > 1e-4, name
        assert binom.cdf((np.abs(each) < 1.96).sum(), 24, 0.95) > 1e-4, name
        assert abs(each.mean()) < 4 / 24**0.5, name
    # And they see the effect: with a = 0 the fits would lie many errors away.
    assert np.mean([fit.a[0, 0] / fit.a_errors[0, 0] for fit in fits]) < -4


def test_pixels_that_follow_their_charge():
    """No Gaussian, no series, no Fourier truth: one campaign of Poisson steps."""
    truth = dataclasses.replace(TRUTH, levels=np.repeat([4e3, 2e4, 5e4, 9e4], 3))
    curve = measure_curve(
        draw_pixel_pairs(truth, 160, 5301, step=2500.0), lags=2, unit="adu"
    )
    fit = fit_covariances(curve, constant_a=True)
    values, errors = parameters_of(fit)
    known = truth_of(truth, "pixels")
    assert fit.a[0, 0] < -15 * fit.a_errors[0, 0]
    assert fit.p_value > 1e-3
    for name, value in known.items():
        if not name.startswith("c_"):
            # b is held at zero: 3 % of a_00 at 9e4 e-, about one sigma.
            assert abs(values[name] - value) < 4.5 * errors[name], name


def test_light_without_feedback_has_no_area_change():
    """The effect switched off: a is within its errors of zero, gain and noise stay."""
    truth = dataclasses.replace(
        make_truth(strength=0.0), levels=np.repeat([4e3, 2e4, 5e4, 9e4], 3)
    )
    fit = fit_covariances(
        measure_curve(draw_field_pairs(truth, 160, 5302), lags=2, unit="adu")
    )
    assert np.abs(fit.a / fit.a_errors).max() < 4
    assert fit.gain == pytest.approx(truth.gain, abs=4 * fit.gain_error)


def test_outlier_pairs_are_dropped_and_named():
    curve = scattered(4300)
    clean = fit_covariances(curve)
    fit = fit_covariances(spoiled(curve, [7, 21], [[[1.05]], [[0.9]]]))
    assert (clean.dropped, fit.dropped) == ((), (7, 21))
    kept = np.delete(np.arange(len(curve)), [7, 21])
    without = fit_covariances(curve.select(kept))
    np.testing.assert_allclose(fit.a, without.a, rtol=1e-4, atol=1e-13)
    assert fit.dof == clean.dof - 2 * 9
    with pytest.raises(MeasurementError, match="of 40 pairs do not fit the model"):
        fit_covariances(
            spoiled(curve, np.arange(0, 40, 3), 1 + 0.3 * np.arange(14)[:, None, None]),
            level_range=(0, 1e6),
        )


@pytest.mark.parametrize("loss", [0.01, 0.05])
def test_the_turnoff_is_found(loss):
    """Above 8e4 ADU the variance falls, as blooming makes it, by 1 or 5 % per 5e3 ADU."""
    curve = scattered(4400, levels=np.repeat(np.linspace(2e3, 1.1e5, 40), 2))
    above = np.maximum(curve.levels - 8e4, 0) / 5e3
    turned = spoiled(curve, slice(None), (1 - loss * above)[:, None, None])
    fit = fit_covariances(turned)
    assert fit.range_reason == "found"
    # From the level where the loss is some five errors, 1.4e-3 each.
    assert 7e4 < fit.level_range[1] < 8e4 + 5e3 * 0.012 / loss
    found = pulls(fit)
    assert max(abs(found[name]) for name in ("gain", "a_00", "a_01")) < 4
    whole = fit_covariances(curve)
    assert whole.range_reason == "whole curve"
    assert whole.level_range[1] == curve.levels[-1]
    # Using all of it anyway: the model takes some of it up, and chi-square tells.
    if loss == 0.05:
        forced = pulls_or_none(turned)
        assert forced is None or abs(forced["a_00"]) > 10


def pulls_or_none(curve):
    try:
        return pulls(fit_covariances(curve, level_range=(0, 1e6)))
    except (MeasurementError, ConvergenceError):
        return None


@pytest.mark.slow
def test_no_turnoff_is_found_where_there_is_none():
    """The next level is far away and the fit below it poor: its error must count."""
    levels = np.geomspace(3e3, 1.1e5, 18)
    for seed in range(25):
        fit = fit_covariances(scattered(4450 + seed, levels=levels, pixels=4_000_000))
        assert fit.range_reason == "whole curve", seed


def test_what_is_held():
    curve = scattered(4500)
    free = fit_covariances(curve)
    fixed = fit_covariances(curve, gain=TRUTH.gain)
    assert fixed.gain == TRUTH.gain and fixed.gain_error == 0.0
    assert fixed.held == ("gain",) and fixed.dof == free.dof + 1
    # a_00 and the gain are tied: knowing one makes the other better.
    assert fixed.a_errors[0, 0] < 0.9 * free.a_errors[0, 0]
    linear = fit_covariances(curve, constant_a=True)
    assert linear.held == ("c",)
    assert not linear.c.any() and not linear.c_errors.any() and not linear.b.any()
    fewer = fit_covariances(curve, lags=1)
    assert fewer.a.shape == (2, 2)


def test_sum_rule():
    fit = fit_covariances(scattered(4600, pixels=4_000_000))
    total, error = fit.sum_rule
    assert abs(total) < 4 * error
    # Its error is not that of independent entries: the gain moves a_00 alone.
    weights = np.array([[1, 2, 2], [2, 4, 4], [2, 4, 4]])
    assert error != pytest.approx(np.sqrt(((weights * fit.a_errors) ** 2).sum()), rel=0.02)
    assert total == pytest.approx((weights * fit.a).sum())


def test_model_of_the_fit():
    curve = scattered(4700)
    fit = fit_covariances(curve)
    residual = (curve.covariances - fit.model(curve.levels)) / curve.errors
    assert np.sqrt((residual**2).mean()) == pytest.approx(1.0, abs=0.15)


def test_reading_what_was_written(tmp_path):
    curve = scattered(4900)
    fit = fit_covariances(spoiled(curve, [5], 1.1), constant_a=False)
    for one, kind in ((curve, CovarianceCurve), (fit, CovarianceFit)):
        path = tmp_path / f"{kind.__name__}.ecsv"
        one.write(path)
        assert kind.read(path) == one
        with pytest.raises(MeasurementError, match="exists; say overwrite"):
            one.write(path)
        with pytest.raises(
            MeasurementError, match=r"schema is 'bfsensor .*', not 'bfsensor "
        ):
            (CovarianceFit if kind is not CovarianceFit else CovarianceCurve).read(path)
    assert fit.dropped == (5,)
    assert CovarianceFit.read(tmp_path / "CovarianceFit.ecsv").sum_rule == fit.sum_rule
    assert dataclasses.replace(fit, gain=fit.gain * 1.001) != fit


def test_curves_are_sorted_and_checked():
    curve = scattered(4950)
    assert curve.select([5, 3]).levels.tolist() == sorted(curve.levels[[3, 5]])
    with pytest.raises(ValueError, match="read-only"):
        curve.covariances[0] = 0
    shape = (2, 3, 3)
    good = {"levels": [1.0, 2.0], "covariances": np.ones(shape), "errors": np.ones(shape),
            "pairs": np.ones(shape, int)}  # fmt: skip
    for change, message in (
        ({"levels": [1.0]}, r"covariances of shape \(2, 3, 3\) must be"),
        ({"errors": np.zeros(shape)}, "errors must be above 0"),
        ({"covariances": np.full(shape, np.nan)}, "covariances must be finite"),
        ({"levels": []}, "levels must be a list of finite numbers, not empty"),
        ({"unit": "DN"}, "unit = 'DN' is not one of electron, adu"),
    ):
        with pytest.raises(MeasurementError, match=message):
            CovarianceCurve(**{**good, **change})
    with pytest.raises(MeasurementError, match="no pair of flats was given"):
        measure_curve([])


def test_refusals():
    curve = scattered(4960)
    for options, message in (
        ({"lags": 3}, "lags = 3 must be from 0 to 2, the curve's"),
        ({"gain": -1.0}, "gain = -1.0 e-/adu must be above 0"),
        ({"level_range": (1e3, 6e3)}, "2 pairs from 1000 to 6000 adu .* 4 levels"),
    ):
        with pytest.raises(MeasurementError, match=message):
            fit_covariances(curve, **options)
    dark = dataclasses.replace(
        curve, covariances=np.where(curve.covariances == curve.covariances[:, :1, :1], 50.0, 0.0)
        - curve.levels[:, None, None] * 1e-3 * (np.arange(9).reshape(3, 3) == 0),
    )  # fmt: skip
    with pytest.raises(MeasurementError, match="the variance does not grow with the level"):
        fit_covariances(dark)
