"""The analytic engine fitted to a_ij: known parameters, coverage, what is refused."""

import dataclasses

import numpy as np
import pytest

from bfsensor.errors import MeasurementError
from bfsensor.fit.image_charge_fit import ImageChargeFit, fit_image_charge
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes

TRUE = ImageCharge(0.9, 1.9, 3.4, 1.6, 3.1, drift_field=0.5)
STRENGTH, OFFSET = 0.8, 2e-10


def truth(reach=4, depth=100.0):
    a = area_changes(TRUE, depth=depth, reach=reach)[reach:, reach:]
    return STRENGTH * a + OFFSET


def seconds(model):
    """Combinations that the order after the dipole constrains: a^2 - b^2, z_q^2 - (a^2 + b^2) / 2."""
    a2, b2 = model.half_width_x**2, model.half_width_y**2
    return a2 - b2, model.charge_height**2 - 0.5 * (a2 + b2)


@pytest.fixture(scope="module")
def noiseless():
    a = truth()
    return fit_image_charge(a, np.full(a.shape, 1e-10), base=TRUE)


def test_noiseless_parameters_come_back(noiseless):
    fit = noiseless
    for name in ("row_height", "column_height"):
        assert getattr(fit.model, name) == pytest.approx(getattr(TRUE, name), rel=1e-2)
    assert fit.dipole[0] == pytest.approx(STRENGTH * TRUE.charge_height, rel=1e-3)
    assert seconds(fit.model) == pytest.approx(seconds(TRUE), rel=2e-2)
    assert fit.offset == pytest.approx(OFFSET, rel=2e-2)
    assert fit.chi2 < 0.01 and fit.degrees_of_freedom == 18 and not fit.bounded


def test_a_charge_between_the_two_highest_places_of_the_profile_is_found():
    """The profile ends at 6 um, its last step but one is at 3.5 um, where chi2 is 4,000."""
    true = dataclasses.replace(TRUE, charge_height=4.2, row_height=5.7, column_height=5.7)
    a = area_changes(true, depth=100.0, reach=2)[2:, 2:]
    fit = fit_image_charge(a, np.full(a.shape, 1e-10), base=true, free=["strength"])
    assert fit.profile_heights[-2] < fit.model.charge_height < fit.profile_heights[-1]
    assert fit.chi2 < 0.01 * fit.profile_chi2.min()


def test_the_share_of_the_dipole_is_not_known(noiseless):
    """Errors of 3e-5 of a_00 and yet: chi2 hardly changes over heights of 0.1 to 1.5 um."""
    fit = noiseless
    between = (fit.profile_heights > 0.1) & (fit.profile_heights < 1.5)
    assert between.sum() >= 3
    assert np.all(fit.profile_chi2[between] - fit.chi2 < 1.0)
    assert fit.profile_chi2[-1] > 20  # while a charge above the sealed heights is not one
    assert fit.parameter_errors["charge_height"] > 0.3
    assert fit.dipole[1] < 0.1 * fit.dipole[0]


@pytest.mark.slow
def test_offset_is_found_and_without_it_chi2_says_so():
    """Switched off, an offset of two standard errors cannot hide among 25 lags."""
    a, sigma = truth(), np.full((5, 5), 1e-10)
    without = fit_image_charge(a, sigma, base=TRUE, free=["strength"])
    assert without.offset == 0 and "offset" not in without.values
    assert without.chi2 > 10


@pytest.mark.slow
def test_errors_cover_and_chi2_is_chi2():
    """20 noisy copies: pulls of what is determined, chi2 of its degrees of freedom.

    Mean pulls are 0 within 4 / sqrt(20), mean chi2 / n is 1 within 4 sqrt(2 / (20 x 18)) = 0.3,
    the variance of a pull is 1 within 3 sqrt(2 / 20) = 0.95, and 0.68 of 60 pulls lie within one
    error, to 3 sigma of 0.06.  The other parameters end at bounds now and then.
    """
    a, sigma = truth(), np.full((5, 5), 3e-10)
    rng = np.random.default_rng(90113)
    pulls, reduced, wrong = [], [], []
    for _ in range(20):
        fit = fit_image_charge(a + sigma * rng.normal(size=a.shape), sigma, base=TRUE)
        errors, model = fit.parameter_errors, fit.model
        dipole, spread = fit.dipole
        pulls.append([
            (model.column_height - TRUE.column_height) / errors["column_height"],
            (dipole - STRENGTH * TRUE.charge_height) / spread,
            (fit.offset - OFFSET) / errors["offset"],
        ])  # fmt: skip
        reduced.append(fit.chi2 / fit.degrees_of_freedom)
        wrong.append((fit.predicted - a) / sigma)
    pulls = np.array(pulls)
    print(pulls.mean(0), pulls.std(0), np.mean(reduced), np.mean(np.abs(pulls) < 1))
    assert np.mean(reduced) == pytest.approx(1, abs=0.3)
    assert np.all(np.abs(pulls.mean(0)) < 4 / np.sqrt(20))
    assert np.all(pulls.var(0) < 1.95)
    assert np.mean(np.abs(pulls) < 1) == pytest.approx(0.68, abs=0.18)
    # Seven parameters for 25 lags: predictions err by sqrt(7 / 25) of the noise.
    assert np.std(wrong) == pytest.approx(np.sqrt(7 / 25), abs=0.15)


@pytest.mark.slow
def test_what_ends_at_a_bound_has_no_error():
    """Boundaries between columns sealed at the charge's own height cannot come lower."""
    low = dataclasses.replace(TRUE, column_height=TRUE.charge_height + 0.01)
    a = area_changes(low, depth=100.0, reach=4)[4:, 4:]
    fit = fit_image_charge(a, 1e-3 * np.abs(a), base=TRUE)
    errors = fit.parameter_errors
    assert fit.bounded and all(np.isnan(errors[name]) for name in fit.bounded)
    assert all(np.isfinite(e) for n, e in errors.items() if n not in fit.bounded)
    assert "offset" not in fit.bounded


@pytest.mark.slow
def test_lags_left_out_count_for_nothing(noiseless):
    a, sigma = truth(), np.full((5, 5), 1e-10)
    used = np.ones(a.shape, bool)
    used[0, 2] = False
    spoilt = a.copy()
    spoilt[0, 2] *= 2
    spoilt[4, 4] = np.nan
    fit = fit_image_charge(spoilt, sigma, base=TRUE, used=used)
    assert fit.used.sum() == 23
    assert fit.ratio[0, 2] == pytest.approx(0.5, rel=1e-2)
    assert fit.residuals[0, 2] == pytest.approx(a[0, 2], rel=1e-2)
    assert fit.chi2 < 0.01


@pytest.mark.slow
def test_written_and_read_back_equal(tmp_path):
    line = dataclasses.replace(TRUE, drift_field=((0.0, 0.7), (100.0, 0.4)))
    a = truth(4)
    a[4, 4] = np.nan
    fit = fit_image_charge(a, np.full(a.shape, 1e-9), base=line, depth=90.0)
    fit.write(tmp_path / "fit.ecsv")
    again = ImageChargeFit.read(tmp_path / "fit.ecsv")
    assert again == fit and again.model.drift_field == line.drift_field
    assert dataclasses.replace(again, chi2=again.chi2 + 1) != fit
    with pytest.raises(MeasurementError, match="exists"):
        fit.write(tmp_path / "fit.ecsv")


@pytest.mark.parametrize(
    ("a", "errors", "options", "message"),
    [
        (np.ones((3, 4)), np.ones((3, 4)), {}, r"squares of one shape.*\(3, 4\)"),
        (np.ones((3, 3)), np.ones((2, 2)), {}, "squares of one shape"),
        (np.ones((3, 3)), np.zeros((3, 3)), {}, "errors of fitted lags must be above 0"),
        (np.ones((2, 2)), np.ones((2, 2)), {}, "4 lags do not determine 7 parameters"),
        (
            np.ones((3, 3)),
            np.ones((3, 3)),
            {"free": ["beta"]},
            r"free = \['beta'\] must be some",
        ),
        (
            np.ones((3, 3)),
            np.ones((3, 3)),
            {"used": np.ones(3)},
            r"used has the shape \(3,\)",
        ),
    ],
)
def test_data_that_do_not_fit_are_refused(a, errors, options, message):
    with pytest.raises(MeasurementError, match=message):
        fit_image_charge(a, errors, base=TRUE, **options)
