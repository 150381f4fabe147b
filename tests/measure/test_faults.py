"""Data that measure nothing: one error that says what and where, and no number."""

import numpy as np
import pytest

from bfsensor.errors import MeasurementError
from bfsensor.measure.arrays import to_floats
from bfsensor.measure.covariance_fit import fit_covariances
from bfsensor.measure.covariance_model import model_covariances
from bfsensor.measure.curve import CovarianceCurve, measure_curve
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.measure.growth import measure_growth
from bfsensor.measure.spot_model import Shape, integrate_gaussian
from bfsensor.measure.spot_moments import measure_moments
from bfsensor.measure.spots import Stamps, find_spots

A = np.array([[-1e-6, 2e-7], [2e-7, 5e-8]])


def flats(seed=6100, level=900.0, side=80):
    return np.random.default_rng(seed).poisson(level, (2, side, side))


def refusal(call, *args, **kwargs):
    with pytest.raises(MeasurementError) as caught:
        call(*args, **kwargs)
    return str(caught.value)


# -- arrays ----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [">u2", "<i4", ">f4", "<f8"])
def test_any_number_type_measures_the_same(kind):
    first, second = flats()
    plain = flat_covariances(first, second, lags=2)
    assert flat_covariances(first.astype(kind), second.astype(kind), lags=2) == plain


def test_arrays_that_are_no_numbers_are_refused():
    for values in (np.ones(3) + 1j, ["a", "b"], [[1.0, 2.0], [3.0]], [{}]):
        assert refusal(to_floats, values, "image").startswith("image: not an array of real")
    given = np.ones(3)
    assert to_floats(given, "image") is not given


def test_a_masked_array_hides_its_pixels():
    """The hidden signal of 1e6 electrons made a variance of 5.6e6."""
    first, second = flats()
    hidden = np.ma.array(first.astype(float))
    hidden[10:20] = np.ma.masked
    hidden.data[10:20] = 1e6
    mask = np.zeros(first.shape, bool)
    mask[10:20] = True
    expected = flat_covariances(first, second, mask=mask, lags=2)
    assert flat_covariances(hidden, second, lags=2) == expected

    image = np.zeros((40, 40))
    image[6:15, 16:25] = 1e5 * integrate_gaussian([0.1], [0.2], Shape(1.0, 1.0), 9)[0]
    masked = np.ma.masked_inside(image, 8e3, 1e4)
    assert masked.mask.any()
    assert find_spots(image, threshold=1000.0).rejected["masked"] == 0
    assert find_spots(masked, threshold=1000.0).rejected["masked"] == 1
    stamps = Stamps(np.ma.masked_less(image[None, 6:15, 16:25], 10.0))
    np.testing.assert_array_equal(stamps.good[0], image[6:15, 16:25] >= 10.0)


# -- flats -----------------------------------------------------------------------------


def test_flats_without_noise_are_refused():
    first, second = flats()
    for pair in ((first, first), (2 * first, first), (np.full((80, 80), 5.0),) * 2):
        assert "the flats do not differ" in refusal(flat_covariances, *pair, lags=2)
    assert flat_covariances(first, second, lags=2).covariances[0, 0] > 0


def test_noise_below_one_step_of_the_digits_is_not_clipped_away():
    """Its median deviation is 0: all that differs was an outlier, and the variance 0."""
    rng = np.random.default_rng(6101)
    coarse = np.full((2, 80, 80), 1000.0) + (rng.random((2, 80, 80)) < 0.05)
    message = refusal(flat_covariances, *coarse, lags=2)
    assert message.startswith("10 % of the pixels differ by more than 5 sigma")
    assert "clip=inf" in message
    found = flat_covariances(*coarse, lags=2, clip=np.inf)
    # 0.05 x 0.95 e-^2, of 6400 pixels in each: fourth moments give 3.3 %.
    assert found.covariances[0, 0] == pytest.approx(0.0475, rel=0.15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"grow": 1.5}, "grow = 1.5 must be a whole number"),
        ({"lags": 2.0}, "lags = 2.0 must be from 0"),
        ({"clip": np.nan}, "clip = nan must be at least 3 sigma"),
    ],
)
def test_settings_of_flats(options, message):
    assert message in refusal(flat_covariances, *flats(), **options)


# -- curves ----------------------------------------------------------------------------


def curve(levels, noise=25.0, **changes):
    covariances = model_covariances(levels, A, noise=np.diag([noise, 0.0]))
    return CovarianceCurve.from_arrays(levels, covariances, pixels=250_000, **changes)


def test_campaigns_of_one_pair():
    one = measure_curve([flats()], lags=2)
    assert "1 pairs from" in refusal(fit_covariances, one)
    # Without gain and b two parameters a lag are left.
    assert "2 levels" in refusal(fit_covariances, one, gain=1.0, constant_a=True)


def test_the_pair_that_fails_is_named():
    first, second = flats()
    good = (first, second)
    assert (
        refusal(measure_curve, [good, (first, second, first)])
        == "pair 1 holds 3 flats, not 2"
    )
    assert refusal(measure_curve, [good, good, (first, first)]).startswith(
        "pair 2: the flats"
    )


def test_a_pair_without_light():
    """A bias pair fixes the noise."""
    dark = curve(np.linspace(0, 8e4, 12))
    fit = fit_covariances(dark)
    np.testing.assert_allclose(fit.a, A, atol=1e-12)
    assert fit.noise[0, 0] == pytest.approx(25.0, rel=1e-6)


def test_choices_from_a_curve():
    whole = curve(np.linspace(1e3, 8e4, 6))
    assert whole.select(lags=0).lags == 0
    for lags in (-1, 2):
        assert refusal(whole.select, lags=lags) == (
            f"lags = {lags} must be from 0 to 1, the curve's"
        )
    assert "a choice of shape (3,) for 6 pairs" in refusal(
        whole.select, [True, False, True]
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: model_covariances(1e4, A), "levels of shape ()"),
        (lambda: model_covariances([1e4], A[:1]), "a of shape (1, 2) is not"),
        (
            lambda: model_covariances([1e4], A, b=np.ones(3)),
            "b has the shape (3,), a (2, 2)",
        ),
        (
            lambda: model_covariances([1e4], A, noise=np.ones((3, 3))),
            "noise has the shape (3, 3)",
        ),
        (lambda: model_covariances([1e4], A, powers=2.5), "powers = 2.5 must be a whole"),
        (
            lambda: CovarianceCurve.from_arrays([1e4], np.ones((1, 2, 2)), pixels=0),
            "pixels = 0 must be at least 1",
        ),
        (
            lambda: CovarianceCurve.from_arrays([1e4], np.ones((1, 2, 3)), pixels=9),
            "covariances of shape (1, 2, 3) are not (n, j, i)",
        ),
        (
            lambda: fit_covariances(curve(np.linspace(1e3, 8e4, 6)), outlier_chance=0.0),
            "outlier_chance = 0.0 must be between 0 and 1",
        ),
        (
            lambda: fit_covariances(curve(-np.linspace(1e3, 8e4, 6), noise=1e6)),
            "no pair has a level above 0, the highest is -1000",
        ),
    ],
)
def test_shapes_and_ranges(call, message):
    assert message in refusal(call)


# -- spots -----------------------------------------------------------------------------


def test_images_without_a_value_have_no_spot():
    found = find_spots(np.full((30, 30), np.nan), threshold=1.0)
    assert len(found) == 0 and not any(found.rejected.values())


def test_a_separation_is_whole():
    assert "separation = 2.5 must be a whole number" in refusal(
        find_spots, np.ones((30, 30)), threshold=0.5, separation=2.5
    )


def test_a_background_that_is_not_finite():
    stamps = Stamps(integrate_gaussian([0.0], [0.0], Shape(1.0, 1.0), 9))
    for background in (np.nan, np.array([np.inf])):
        assert "must be finite" in refusal(measure_moments, stamps, background=background)


def test_growth_names_the_level_and_needs_a_middle():
    x, y = np.random.default_rng(6102).uniform(-0.5, 0.5, (2, 4))
    off = 3e5 * integrate_gaussian(x, y, Shape(1.0, 1.0), 11)[:, None]
    empty = np.concatenate([off, 0 * off], axis=1)
    assert refusal(measure_growth, empty, empty).startswith(
        "level 1: only 0 of 4 spots agree"
    )
    even = np.ones((3, 2, 10, 11))
    assert "images of 10 x 11 pixels" in refusal(measure_growth, even, even)
