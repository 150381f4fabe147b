"""The forward model gives back known truth within its errors, and says what it dropped."""

from __future__ import annotations

import dataclasses
import pickle
import time

import numpy as np
import pytest
from scipy.optimize import least_squares

from bfsensor.errors import BFSensorError
from bfsensor.measure.spot_fit import fit_spots
from bfsensor.measure.spot_model import Shape, integrate_gaussian
from bfsensor.measure.spot_result import REASONS, SpotFit
from bfsensor.measure.spots import Stamps, cut_stamps, find_spots

SHAPE = Shape(1.02, 1.05)
WEIGHTS = ("noise", "equal")


def expect(n, flux, shape=SHAPE, background=100.0, seed=1, size=9):
    """Stamps without noise, and where the spots are."""
    x, y = np.random.default_rng(seed).uniform(-0.5, 0.5, (2, n))
    stamps = np.reshape(flux, (-1, 1, 1)) * integrate_gaussian(x, y, shape, size)
    return stamps + background, x, y


def make_noisy(mean, seed, read_noise=5.0):
    rng = np.random.default_rng(seed)
    return rng.poisson(mean) + rng.normal(0.0, read_noise, mean.shape)


def message(call, *args, **kwargs):
    with pytest.raises(BFSensorError) as caught:
        call(*args, **kwargs)
    return str(caught.value)


# -- exact --------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("shape", [SHAPE, Shape(0.6, 0.7), Shape(1.3, 0.9, 0.25)])
def test_spots_without_noise_give_their_truth(shape, weights):
    flux = np.array([2e4, 1e5, 3e5, 1e6, 2e5])
    mean, x, y = expect(5, flux, shape, background=np.arange(5.0)[:, None, None], seed=8)
    free = None if shape.correlation else 0.0
    fit = fit_spots(Stamps(mean), correlation=free, weights=weights, correct_bias=False)
    # Widths rest to 1e-8, and so do fluxes in proportion.
    assert np.allclose(
        [fit.sigma_x, fit.sigma_y, fit.correlation], shape, rtol=0, atol=3e-8
    )
    assert np.allclose(fit.centre_x, x, rtol=0, atol=1e-6)
    assert np.allclose(fit.centre_y, y, rtol=0, atol=1e-6)
    assert np.allclose(fit.flux, flux, rtol=1e-6)
    assert np.allclose(fit.background, np.arange(5.0), rtol=0, atol=0.01)
    assert fit.chi2 < 1e-6
    if free is None:
        matrix = np.array([[1.69, 0.25 * 1.17], [0.25 * 1.17, 0.81]])
        axis = np.linalg.eigh(matrix)[1][:, 1]
        assert fit.tilt == pytest.approx(
            np.degrees(np.arctan2(axis[1], axis[0])) % 180, abs=1e-4
        )


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("background", [None, 100.0])
def test_the_arrow_gives_what_one_dense_fit_gives(background, weights):
    n, flux = 3, 4e4
    mean, _, _ = expect(n, flux)
    data = make_noisy(mean, 93)
    known = mean + 25.0
    fit = fit_spots(
        Stamps(data, variance=known), background=background, weights=weights,
        correct_bias=False,
    )  # fmt: skip
    root = np.ones_like(known) if weights == "equal" else np.sqrt(known)

    def model(p):
        own = p[2:].reshape(n, -1)
        below = own[:, 3] if background is None else np.full(n, 100.0)
        spots = integrate_gaussian(own[:, 1], own[:, 2], Shape(p[0], p[1]), 9)
        return own[:, 0, None, None] * 1e4 * spots + below[:, None, None]

    start = np.tile([4.0, 0.0, 0.0, 90.0][: 4 if background is None else 3], n)
    dense = least_squares(
        lambda p: ((data - model(p)) / root).ravel(), [1.0, 1.0, *start], x_scale="jac",
        xtol=1e-14, ftol=1e-14, gtol=1e-14,
    )  # fmt: skip
    hat = np.linalg.inv(dense.jac.T @ dense.jac) @ dense.jac.T
    noise = (known / root**2).ravel()
    covariance = (hat * noise) @ hat.T
    assert np.allclose([fit.sigma_x, fit.sigma_y], dense.x[:2], rtol=0, atol=1e-6)
    assert np.allclose(fit.covariance[:2, :2], covariance[:2, :2], rtol=1e-3)
    assert np.allclose(fit.flux, dense.x[2 :: len(start) // n] * 1e4, rtol=1e-5)
    if weights == "noise":
        assert fit.chi2 == pytest.approx(2 * dense.cost, rel=1e-6)
        assert fit.dof == data.size - dense.x.size
    else:
        assert fit.chi2 < np.sum((data - model(dense.x)) ** 2 / known)


def test_result_does_not_depend_on_the_order_of_spots_nor_on_the_axes_name():
    data = make_noisy(expect(40, 1e5)[0], 71)
    one = fit_spots(Stamps(data), read_noise=5.0)
    other = fit_spots(Stamps(data[::-1].transpose(0, 2, 1)), read_noise=5.0)
    assert one.sigma_x == pytest.approx(other.sigma_y, abs=1e-9)
    assert one.sigma_x_error == pytest.approx(other.sigma_y_error, rel=1e-6)
    assert np.allclose(one.centre_x, other.centre_y[::-1], rtol=0, atol=1e-6)
    again = fit_spots(Stamps(data), read_noise=5.0)
    assert again == one


# -- truth with noise ---------------------------------------------------------------------


@pytest.mark.parametrize("weights", WEIGHTS)
def test_errors_cover_the_truth(weights):
    mocks, n = 60, 40
    mean, x, _ = expect(n, 1.3e5, seed=44)
    pulls, centres, scatter = [], [], []
    for seed in range(mocks):
        fit = fit_spots(
            Stamps(make_noisy(mean, 3000 + seed)), read_noise=5.0, weights=weights
        )
        pulls.append((fit.sigma_x - SHAPE.sigma_x) / fit.sigma_x_error)
        pulls.append((fit.sigma_y - SHAPE.sigma_y) / fit.sigma_y_error)
        centres.append((fit.centre_x - x) / fit.centre_x_error)
        centres.append((fit.flux - 1.3e5) / fit.flux_error)
        scatter.append(fit.scatter_covariance[0, 0] / fit.covariance[0, 0])
    count = 2 * mocks
    # Three standard errors of the mean, of the scatter and of a fraction of 0.683.
    assert abs(np.mean(pulls)) < 3 / np.sqrt(count)
    assert abs(np.std(pulls) - 1) < 3 / np.sqrt(2 * count)
    assert abs(np.mean(np.abs(pulls) < 1) - 0.683) < 3 * np.sqrt(0.683 * 0.317 / count)
    assert abs(np.std(centres) - 1) < 3 / np.sqrt(2 * count * n)
    # Each ratio scatters by sqrt(2 / 40).
    assert abs(np.mean(scatter) - 1) < 3 * np.sqrt(2 / n / mocks)


def test_thrown_electrons_give_back_their_width():
    # No line of the model is in these: normal deviates, counted by pixel.
    rng = np.random.default_rng(7281)
    n, flux = 60, 30_000
    x, y = rng.uniform(-0.5, 0.5, (2, n))
    edges = np.arange(10) - 4.5
    stamps = [
        np.histogram2d(
            rng.normal(y[k], 1.05, flux), rng.normal(x[k], 1.02, flux), [edges, edges]
        )[0]
        for k in range(n)
    ]
    fit = fit_spots(Stamps(np.array(stamps)), background=0.0)
    # All light of a Gaussian: sigma / sqrt(2 N), a little more for the pixels.
    least = 1.02 / np.sqrt(2 * n * flux)
    assert least < fit.sigma_x_error < 1.2 * least
    assert abs(fit.sigma_x - 1.02) < 3 * fit.sigma_x_error
    assert abs(fit.sigma_y - 1.05) < 3 * fit.sigma_y_error


@pytest.mark.parametrize("weights", WEIGHTS)
def test_many_faint_spots_do_not_look_narrower(weights):
    # Noise in the centres takes more than half an error of 1000 spots.
    pulls, bare = [], []
    for seed in range(30):
        mean, _, _ = expect(1000, 1.2e3, background=10.0, seed=900 + seed)
        stamps = Stamps(make_noisy(mean, 9900 + seed))
        fit = fit_spots(stamps, read_noise=5.0, weights=weights)
        assert fit.bias_x > 0
        for width, bias, error, truth in (
            (fit.sigma_x, fit.bias_x, fit.sigma_x_error, 1.02),
            (fit.sigma_y, fit.bias_y, fit.sigma_y_error, 1.05),
        ):
            pulls.append((width - truth) / error)
            bare.append((width - bias - truth) / error)
    assert abs(np.mean(pulls)) < 3 / np.sqrt(60)
    assert np.mean(bare) < -3 / np.sqrt(60)


def test_bias_without_background_is_the_textbooks():
    # The variance about a mean of N is smaller by 1 / N.
    mean, _, _ = expect(50, 1e5, Shape(2.0, 3.0), background=0.0, size=31)
    fit = fit_spots(Stamps(mean), background=0.0)
    # The pixel's own 1/12 makes it 4 % more in x, 2 % in y.
    assert fit.bias_x == pytest.approx(2.0 / 2e5, rel=0.08)
    assert fit.bias_y == pytest.approx(3.0 / 2e5, rel=0.08)


def test_thousands_of_spots_take_seconds():
    stamps = Stamps(make_noisy(expect(3000, 1.3e5)[0], 17))
    began = time.process_time()
    fit = fit_spots(stamps, read_noise=5.0)
    # 0.2 s here; a dense normal matrix of 12002 parameters would take minutes.
    assert time.process_time() - began < 5
    assert fit.used.all()


# -- what is wrong with spots --------------------------------------------------------------


def spoil():
    """60 spots, five of them bad, and why."""
    mean, _, _ = expect(60, 1.3e5, seed=5)
    rng = np.random.default_rng(6)
    mean[10] += 6e4 * integrate_gaussian([2.6], [1.8], SHAPE, 9)[0]  # a neighbour
    mean[20] = 1.3e5 * integrate_gaussian([0.1], [0.2], Shape(1.5, 1.5), 9)[0] + 100
    mean[30] = 100.0  # nothing
    mean[40] = 1.3e5 * integrate_gaussian([1.3], [0.0], SHAPE, 9)[0] + 100
    data = rng.poisson(mean) + rng.normal(0, 5.0, mean.shape)
    data[50, 7, 1] += 8000.0  # a cosmic ray
    good = np.ones(data.shape, bool)
    good[55, 4, 5] = False
    good[56, 0, 0:3] = False
    data[56, 0, 0:3] = 1e7
    return data, good


@pytest.mark.parametrize("weights", WEIGHTS)
def test_bad_spots_are_dropped_and_named(weights):
    data, good = spoil()
    fit = fit_spots(Stamps(data, good), read_noise=5.0, weights=weights)
    bad = {10: "chi2", 20: "chi2", 30: "faint", 40: "centre", 50: "chi2", 55: "masked"}
    assert {int(k): str(fit.status[k]) for k in np.nonzero(~fit.used)[0]} == bad
    assert fit.dropped == {
        "masked": 1, "diverged": 0, "faint": 1, "centre": 1, "chi2": 3, "width": 0
    }  # fmt: skip
    # The good ones alone give the same.
    alone = fit_spots(Stamps(data, good).select(fit.used), read_noise=5.0, weights=weights)
    assert fit.sigma_x == pytest.approx(alone.sigma_x, abs=1e-7)
    assert fit.dof == alone.dof == int(good[fit.used].sum()) - 4 * 54 - 2
    assert abs(fit.sigma_x - SHAPE.sigma_x) < 3.5 * fit.sigma_x_error
    # With no limit they would have carried it away.
    loose = fit_spots(Stamps(data, good), read_noise=5.0, weights=weights, limit=1e6)
    assert abs(loose.sigma_x - SHAPE.sigma_x) > 5 * loose.sigma_x_error


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("seed", [2, 12, 17])
def test_a_third_of_the_spots_may_be_struck_by_anything(weights, seed):
    rng = np.random.default_rng(seed)
    mean, _, _ = expect(60, 1.3e5, seed=seed)
    data = rng.poisson(mean).astype(float)
    for k in range(20):
        # Up to twenty times the light of a spot, in one pixel.
        data[k, rng.integers(0, 9), rng.integers(0, 9)] += 10 ** rng.uniform(4, 6.5)
    fit = fit_spots(Stamps(data), weights=weights)
    assert np.nonzero(fit.used)[0].tolist() == list(range(20, 60))
    assert abs(fit.sigma_x - SHAPE.sigma_x) < 3.5 * fit.sigma_x_error
    assert abs(fit.sigma_y - SHAPE.sigma_y) < 3.5 * fit.sigma_y_error


def test_a_spot_that_is_a_little_wider_is_dropped_for_its_width():
    mean, _, _ = expect(80, 3e4, background=0.0, seed=21)
    # Seven errors of one spot, 1.02 / sqrt(2 * 3e4): 49 in chi2, where 6 sigma are 74.
    mean[7] = 3e4 * integrate_gaussian([0.1], [0.2], Shape(1.05, 1.05), 9)[0]
    fit = fit_spots(Stamps(np.random.default_rng(25).poisson(mean)), background=0.0)
    assert np.nonzero(~fit.used)[0].tolist() == [7]
    assert fit.status[7] == "width"


def test_half_the_spots_must_agree():
    mean, _, _ = expect(30, 1.3e5)
    data = make_noisy(mean, 3)
    data[:12] = 100.0
    fit = fit_spots(Stamps(data), read_noise=5.0)
    assert fit.dropped["faint"] == 12
    assert fit.used[12:].all()
    data[:20] = 100.0
    assert "of 30 spots agree" in message(fit_spots, Stamps(data), read_noise=5.0)
    good = np.ones(data.shape, bool)
    good[:, 4, 4] = False
    assert "30 have too few good pixels" in message(fit_spots, Stamps(data, good))


def test_wings_are_reported_by_chi2_and_equal_weights_do_not_mind_the_peak():
    def moffat(flux):
        u = (np.arange(9 * 8) + 0.5) / 8 - 4.5
        x, y = np.random.default_rng(2).uniform(-0.5, 0.5, (2, 60))
        square = ((u - x[:, None]) ** 2)[:, None, :] + ((u - y[:, None]) ** 2)[:, :, None]
        fine = (1 + square / 6) ** -4.0
        stamps = fine.reshape(60, 9, 8, 9, 8).sum(axis=(2, 4))
        return flux * stamps / stamps.sum(axis=(1, 2)).mean()

    widths = {}
    for weights in WEIGHTS:
        fits = [
            fit_spots(
                Stamps(make_noisy(moffat(flux) + 100.0, 4)), read_noise=5.0, weights=weights
            )
            for flux in (1.3e5, 1.3e6)
        ]
        assert all(fit.chi2 / fit.dof > 10 for fit in fits)
        # Noise explains the scatter between spots at most for the smaller part.
        assert fits[1].scatter_covariance[0, 0] > 1.5 * fits[1].covariance[0, 0]
        errors = [np.sqrt(fit.scatter_covariance[0, 0]) for fit in fits]
        widths[weights] = (fits[1].sigma_x - fits[0].sigma_x) / np.hypot(*errors)
    assert widths["noise"] > 20
    assert abs(widths["equal"]) < 3


def test_a_spot_alone_has_errors_but_no_scatter():
    fit = fit_spots(Stamps(make_noisy(expect(1, 1e6)[0], 2)), read_noise=5.0)
    assert np.isnan(fit.scatter_covariance[:2, :2]).all()
    assert abs(fit.sigma_x - SHAPE.sigma_x) < 4 * fit.sigma_x_error < 0.01


# -- from the image to the file ------------------------------------------------------------


def test_the_road_from_an_image_to_a_size():
    rng = np.random.default_rng(640)
    image = np.full((170, 170), 30.0)
    for j in range(10):
        for i in range(10):
            x, y = rng.uniform(-0.5, 0.5, 2)
            spot = 2e5 * integrate_gaussian([x], [y], SHAPE, 15)[0]
            image[17 * j + 1 : 17 * j + 16, 17 * i + 1 : 17 * i + 16] += spot
    image = rng.poisson(image) + rng.normal(0, 5, image.shape)
    spots = find_spots(image, threshold=3000.0)
    assert len(spots) == 100
    fit = fit_spots(cut_stamps(image, spots), read_noise=5.0)
    assert abs(fit.sigma_x - SHAPE.sigma_x) < 3.5 * fit.sigma_x_error
    assert abs(fit.sigma_y - SHAPE.sigma_y) < 3.5 * fit.sigma_y_error
    assert np.array_equal(fit.x, spots.x)
    assert fit.used.all()


def test_peaks_are_of_a_centred_spot():
    mean, _, _ = expect(400, 1e5, Shape(1.0, 1.0), background=0.0)
    fit = fit_spots(Stamps(mean), background=0.0, correct_bias=False)
    # erf(1 / sqrt(8)) squared of the light.
    assert np.allclose(fit.peaks, 1e5 * 0.38292492254802624**2, rtol=1e-6)
    assert fit.peak == pytest.approx(fit.peaks.mean())


def test_what_rounding_leaves_drops_no_spot():
    mean, _, _ = expect(400, 1e5, Shape(1.0, 1.0), background=0.0)
    # Unlike noise, rounding differs from spot to spot by powers of two.
    rng = np.random.default_rng(5)
    rounding = rng.standard_normal(mean.shape) * np.exp(
        2 * rng.standard_normal((400, 1, 1))
    )
    fit = fit_spots(Stamps(mean * (1 + 1e-13 * rounding)), background=0.0)
    assert fit.used.all()
    assert 0 < fit.chi2 / fit.dof < 1e-15


@pytest.mark.parametrize("known", [True, False])
def test_files_give_back_what_was_written(known, tmp_path):
    data, good = spoil()
    variance = np.full(data.shape, 900.0) if known else None
    stamps = Stamps(data, good, variance, x=np.arange(60) * 7, y=np.arange(60) * 3)
    fit = fit_spots(stamps, read_noise=5.0, correlation=None)
    fit.write(tmp_path / "fit.ecsv")
    again = SpotFit.read(tmp_path / "fit.ecsv")
    assert again == fit
    assert again.covariance.tobytes() == fit.covariance.tobytes()
    assert again.status.dtype.kind == "U"
    assert pickle.loads(pickle.dumps(fit)) == fit
    assert dataclasses.replace(fit, sigma_x=np.nextafter(fit.sigma_x, 2)) != fit
    changed = fit.flux.copy()
    changed[3] *= 1 + 1e-15
    assert dataclasses.replace(fit, flux=changed) != fit
    assert [p.name for p in tmp_path.iterdir()] == ["fit.ecsv"]
    assert set(fit.status) <= {"used", *REASONS}


def test_foreign_files_are_refused(tmp_path):
    fit = fit_spots(Stamps(make_noisy(expect(5, 1e5)[0], 2)), read_noise=5.0)
    path = tmp_path / "fit.ecsv"
    fit.write(path)
    text = path.read_text()
    for old, new, words in (
        ("SpotFit 1", "SpotFit 9", "its schema is 'bfsensor.SpotFit 9', not"),
        ("bias_x", "bias_q", "bias_x missing"),
        ("%ECSV", "%NONE", "not readable as ECSV"),
        ("covariance:", "covariance: 3 #", "fit.ecsv: "),
    ):
        path.write_text(text.replace(old, new))
        assert words in message(SpotFit.read, path)
    assert "not readable" in message(SpotFit.read, tmp_path / "none.ecsv")
    assert "cannot be written" in message(fit.write, tmp_path / "no" / "fit.ecsv")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"read_noise": -1.0}, "read_noise = -1.0 e-"),
        ({"weights": "poisson"}, "weights = 'poisson' must be 'noise' or 'equal'"),
        ({"background": np.nan}, "background = nan"),
        ({"correlation": 0.95}, "correlation = 0.95"),
        ({"largest_offset": 0.0}, "largest_offset = 0.0"),
        ({"limit": 0.0}, "limit = 0.0"),
    ],
)
def test_wrong_settings_are_refused(change, words):
    assert words in message(fit_spots, Stamps(np.ones((2, 9, 9))), **change)


def test_stamps_without_spots_are_refused():
    noise = np.random.default_rng(5).normal(0.0, 5.0, (20, 9, 9))
    for stamps in (noise, np.zeros((4, 9, 9))):
        assert "spots agree" in message(fit_spots, Stamps(stamps), read_noise=5.0)
