"""Covariances of a pair: brute force, closed forms, and what must not bias them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from bfsensor.errors import MeasurementError
from bfsensor.measure.bartlett import bartlett_matrix, image_weights, unfold
from bfsensor.measure.flat_pairs import FlatCovariances, flat_covariances, measure_regions
from bfsensor.measure.products import sum_products

PLAIN = {"clip": np.inf, "box": None}


def correlated(rng, shape, coefficients):
    """Gaussian field of unit variance: sum of white noise at the given (dy, dx) offsets."""
    ny, nx = shape
    white = rng.standard_normal((ny + 8, nx + 8))
    field = sum(
        c * white[4 + dy : 4 + dy + ny, 4 + dx : 4 + dx + nx]
        for (dy, dx), c in coefficients.items()
    )
    return field / np.sqrt(sum(c**2 for c in coefficients.values()))


def brute_force(d, good, lags):
    """Sums over all pairs, one by one: [sign of j, j, i]."""
    out = np.zeros((2, lags + 1, lags + 1))
    pairs = np.zeros_like(out, int)
    ny, nx = d.shape
    for s, sign in enumerate((1, -1)):
        for j in range(lags + 1):
            for i in range(lags + 1):
                for y in range(ny):
                    for x in range(nx):
                        v, u = y + sign * j, x + i
                        if 0 <= v < ny and 0 <= u < nx and good[y, x] and good[v, u]:
                            out[s, j, i] += d[y, x] * d[v, u]
                            pairs[s, j, i] += 1
    return out, pairs


def test_products_by_brute_force():
    rng = np.random.default_rng(11)
    d = rng.standard_normal((13, 17))
    good = rng.random(d.shape) > 0.2
    d[~good] = 0.0
    products, pairs = sum_products(d, good, 4)
    expected, count = brute_force(d, good, 4)
    np.testing.assert_array_equal(pairs, count)
    np.testing.assert_allclose(products, expected, atol=1e-12)


def test_axes_and_both_diagonals():
    """x + 1 shares half with x; one diagonal alone is seen, by half."""
    rng = np.random.default_rng(12)
    for offset, at, expected in (((0, 1), (0, 1), 0.5), ((1, 0), (1, 0), 0.5),
                                 ((1, 1), (1, 1), 0.25), ((1, -1), (1, 1), 0.25)):  # fmt: skip
        pair = [
            1e4 + 100 * correlated(rng, (500, 500), {(0, 0): 1, offset: 1})
            for _ in range(2)
        ]
        found = flat_covariances(*pair, lags=2, **PLAIN)
        # Bartlett: 1 + 2 x 0.25 for the neighbour's variance, in units of 1 / N.
        error = 1.5**0.5 / 500
        assert found.correlations[at] == pytest.approx(expected, abs=4 * error)
        rest = found.correlations.copy()
        rest[0, 0] = rest[at] = 0.0
        assert np.abs(rest).max() < 5 * error


def exact_gaussian(rng, shape):
    """Gaussian numbers without sampling error: all quantiles once, in random order."""
    n = shape[0] * shape[1]
    return rng.permutation(norm.ppf((np.arange(n) + 0.5) / n)).reshape(shape)


@pytest.mark.parametrize("clip", [3.0, 3.5, 4.0, 5.0, 6.0])
def test_clipping_does_not_bias_the_variance(clip):
    rng = np.random.default_rng(13)
    first = 1e4 + 100 * exact_gaussian(rng, (1000, 1000))
    second = np.full(first.shape, 1e4)
    options = {"lags": 1, "box": None, "grow": 0}
    whole = flat_covariances(first, second, clip=np.inf, **options)
    found = flat_covariances(first, second, clip=clip, **options)
    assert found.clipped == pytest.approx(2e6 * norm.sf(clip), abs=2)
    bias = found.covariances[0, 0] / whole.covariances[0, 0] - 1
    assert abs(bias) < 3e-5
    lost = 2 * clip * norm.pdf(clip) / (2 * norm.cdf(clip) - 1)
    assert whole.covariances[0, 0] == pytest.approx(5000.0, rel=2e-5)
    if clip <= 4:
        # What the bias would be without the correction.
        assert lost > 1e-3


def test_clipping_does_not_bias_strong_correlations():
    rng = np.random.default_rng(14)
    pair = [
        1e4 + 100 * correlated(rng, (1500, 1500), {(0, 0): 1, (0, 1): 0.35}) for _ in "ab"
    ]
    whole = flat_covariances(*pair, lags=1, clip=np.inf, grow=0, box=None)
    found = flat_covariances(*pair, lags=1, clip=3.0, grow=0, box=None)
    change = found.correlations - whole.correlations
    # 2.25e6 pixels; the clipped ones hold 0.33 of x^4 (E[x^4; |x| > 3]): sqrt(0.33 x 0.1 /
    # 2.25e6) = 1.2e-4 for products with a neighbour; without correction -2.7 % of 0.31.
    assert abs(change[0, 1]) < 5e-4
    assert found.correlations[0, 1] == pytest.approx(0.35 / 1.1225, abs=4e-3)


@pytest.mark.parametrize(
    "coefficients", [{(0, 0): 1}, {(0, 0): 1, (0, 1): 0.2, (2, 0): -0.3}]
)
def test_box_means_do_not_bias(coefficients):
    """Boxes of 400 pixels take 2.5e-3 of the sum of all covariances, put back to 3 %."""
    rng = np.random.default_rng(15)
    whole, found = [], []
    for _ in range(6):
        pair = [1e4 + 100 * correlated(rng, (700, 700), coefficients) for _ in "ab"]
        options = {"lags": 3, "clip": np.inf}
        whole.append(flat_covariances(*pair, box=None, **options).covariances)
        found.append(flat_covariances(*pair, box=20, **options).covariances)
    change = (np.mean(found, 0) - np.mean(whole, 0)) / 1e4
    # 6 x 1225 boxes, each taking the square of its mean: (S / 400) sqrt(2 / 7350), S = 1 or
    # 0.9 / 1.13; the gap between one box's and many boxes' edges is 1e-4 of that.
    assert np.abs(change).max() < 5 * (1 / 400) * np.sqrt(2 / 7350)


def test_a_changing_lamp_is_taken_off():
    """A gradient of 1 % across the frame between the flats: 2.5 sigma from end to end."""
    rng = np.random.default_rng(16)
    tilt = 1 + 0.01 * (np.arange(600) / 600 - 0.5)
    first, second = rng.poisson(6e4, (600, 600)), rng.poisson(6e4 * tilt, (600, 600))
    found = flat_covariances(first, second, lags=2, box=50)
    expected = np.zeros((3, 3))
    expected[0, 0] = found.level
    # In a box of 50 the gradient leaves (600 x 50 / 600)^2 / 12 = 2e2, 2.9e-3 / 2.
    np.testing.assert_allclose(
        found.covariances, expected, atol=5 * 6e4 * 2**0.5 / 600 + 110
    )
    without = flat_covariances(first, second, lags=2, box=None)
    assert without.covariances[2, 0] > 10_000


@pytest.mark.parametrize("ratio", [1.0, 1.1, 1.5])
def test_unequal_pairs_give_the_covariance_of_the_stated_level(ratio):
    rng = np.random.default_rng(17)
    pattern = 1 + 0.05 * rng.standard_normal((800, 800))
    pair = [rng.poisson(mu * pattern) for mu in (2e4, 2e4 * ratio)]
    found = flat_covariances(*pair, lags=1)
    assert found.covariances[0, 0] / found.level == pytest.approx(1.0, abs=4 * 2**0.5 / 800)
    assert found.means == pytest.approx((2e4, 2e4 * ratio), rel=1e-3)
    if ratio > 1:
        # A difference without scaling sees the pattern: (5 % of 2,000 e-)^2 / 2 and more.
        difference = pair[0] - pair[1]
        assert difference.var() / 2 > 1.2 * found.level


def test_tracks_and_bad_pixels():
    rng = np.random.default_rng(18)
    first, second = rng.poisson(1e4, (2, 500, 500)).astype(float)
    clean = flat_covariances(first, second, lags=3)
    for y, x in rng.integers(5, 490, (60, 2)):
        first[y : y + 3, x : x + 4] += 3000.0
        first[y + 3, x : x + 4] += 250.0
    bad = np.zeros(first.shape, bool)
    bad[100:120] = True
    first[100:120] += 40_000.0
    second[300, 300] = np.nan
    found = flat_covariances(first, second, mask=bad, lags=3)
    assert found.clipped >= 60 * 12
    assert found.pixels + found.clipped == 500 * 480 - 1
    difference = (found.covariances - clean.covariances) / clean.errors
    # A tenth of the pixels went: the estimates share nine tenths, so 0.5 of an error.
    assert np.abs(difference).max() < 2
    spoiled = flat_covariances(first, second, mask=bad, lags=3, clip=np.inf)
    assert spoiled.covariances[0, 1] > 50 * clean.errors[0, 1]


def test_a_mask_of_diagonal_stripes_does_not_bias():
    """Of the pairs along one diagonal two thirds are good, of those along the other one third."""
    rng = np.random.default_rng(23)
    coefficients = {(0, 0): 1.0, (1, -1): 0.5}
    pair = [1e4 + 100 * correlated(rng, (600, 600), coefficients) for _ in "ab"]
    y, x = np.mgrid[:600, :600]
    found = flat_covariances(*pair, mask=(x - y) % 3 == 0, lags=1, **PLAIN)
    # Half of C(1, -1) = 0.5 / 1.25, as (1, 1) has none, in 120,000 pairs: 30 % less with the
    # other diagonal's number of pairs.
    expected = 1e4 * np.array([[1.0, 0.0], [0.0, 0.2]])
    np.testing.assert_allclose(found.covariances, expected, atol=5 * 1e4 / 120_000**0.5)


def test_bartlett_by_monte_carlo():
    """Also between lags; 1500 fields, correlated by up to 0.4."""
    rng = np.random.default_rng(19)
    coefficients = {(0, 0): 1.0, (0, 1): 0.5, (0, -1): 0.5, (1, 0): -0.3, (-1, 0): -0.3}
    lags, side, fields = 3, 48, 1500
    # True covariances: the coefficients' own correlation, folded to a quadrant.
    true = np.zeros((lags + 1, lags + 1))
    total = sum(c**2 for c in coefficients.values())
    for (y1, x1), c1 in coefficients.items():
        for (y2, x2), c2 in coefficients.items():
            dy, dx = y1 - y2, x1 - x2
            if dy >= 0 and dx >= 0:
                true[dy, dx] += c1 * c2 / total
    good = np.ones((side, side), bool)
    rows = []
    for _ in range(fields):
        products, pairs = sum_products(
            correlated(rng, good.shape, coefficients), good, lags
        )
        rows.append(0.5 * (products[0] / pairs[0] + products[1] / pairs[1]).ravel())
    predicted = bartlett_matrix(true, pairs[0])
    residual = np.array(rows) - true.ravel()
    n = true.size
    assert np.abs(residual.mean(0)).max() < 5 * np.sqrt(np.diag(predicted).max() / fields)
    chi2 = np.einsum("fi,ij,fj->f", residual, np.linalg.inv(predicted), residual)
    # Mean n, error sqrt(2 n / fields) for Gaussian estimates; the finite field's edges and
    # the estimates' own skewness are of order lags / side, 6 %.
    assert chi2.mean() == pytest.approx(n, rel=0.06 + 4 * np.sqrt(2 / n / fields))
    found = np.cov(np.array(rows).T)
    ratio = np.diag(found) / np.diag(predicted)
    assert np.abs(ratio - 1).max() < 0.06 + 4 * np.sqrt(2 / fields)
    # Between lags: (0, 0) and (2, 0) are tied by 0.5 here, and white noise would say 0.
    tie = predicted[0, 2] / np.sqrt(predicted[0, 0] * predicted[2, 2])
    assert abs(tie) > 0.3
    measured = found[0, 2] / np.sqrt(found[0, 0] * found[2, 2])
    assert measured == pytest.approx(tie, abs=0.1)


def test_stated_errors_are_bartletts():
    rng = np.random.default_rng(20)
    found = flat_covariances(*rng.poisson(1e4, (2, 300, 300)), lags=2)
    c = found.covariances[0, 0]
    expected = (
        c
        / 300
        * np.array([[2**0.5, 1, 1], [1, 0.5**0.5, 0.5**0.5], [1, 0.5**0.5, 0.5**0.5]])
    )
    # Pairs at a lag are fewer by 1 %, noise covariances add 1e-4.
    np.testing.assert_allclose(found.errors, expected, rtol=0.015)
    np.testing.assert_allclose(np.diag(found.error_matrix()), found.errors.ravel() ** 2)


def test_folding():
    quadrant = np.arange(9.0).reshape(3, 3)
    plane = unfold(quadrant, 3)
    assert plane.shape == (7, 7) and plane[3, 3] == 0.0
    assert plane[3 - 2, 3 + 1] == quadrant[2, 1] == plane[3 + 2, 3 - 1]
    assert (image_weights(2) * quadrant).sum() == plane.sum()


def test_regions():
    rng = np.random.default_rng(21)
    first, second = rng.poisson(1e4, (2, 200, 300)).astype(float)
    first[:, 150:] *= 2
    second[:, 150:] *= 2
    at = {"C00": np.s_[:, :150], "C01": np.s_[:, 150:]}
    found = measure_regions(first, second, at, lags=1)
    assert found["C01"].region == "C01"
    assert found["C01"].level == pytest.approx(2 * found["C00"].level, rel=0.01)
    alone = flat_covariances(first[:, :150], second[:, :150], lags=1, region="C00")
    assert found["C00"] == alone


def test_reading_what_was_written(tmp_path):
    rng = np.random.default_rng(22)
    found = flat_covariances(
        *rng.poisson(900.0, (2, 90, 80)), lags=3, unit="adu", region="C07"
    )
    path = tmp_path / "pair.ecsv"
    found.write(path)
    assert FlatCovariances.read(path) == found
    other = FlatCovariances(
        found.covariances, found.errors, found.pairs, found.level, found.means,
        found.pixels + 1, found.clipped, found.unit, found.region,
    )  # fmt: skip
    assert other != found
    with pytest.raises(MeasurementError, match=r"pair\.ecsv exists.*overwrite"):
        found.write(path)
    assert "adu2" in path.read_text()
    path.write_text(
        path.read_text()
        .replace("name: covariance,", "name: covarianza,")
        .replace("j covariance", "j covarianza")
    )
    with pytest.raises(MeasurementError, match=r"pair\.ecsv: covariance missing"):
        FlatCovariances.read(path)
    (tmp_path / "other.ecsv").write_text("nothing")
    with pytest.raises(MeasurementError, match=r"other\.ecsv: "):
        FlatCovariances.read(tmp_path / "other.ecsv")


FLAT = np.full((40, 40), 100.0)


@pytest.mark.parametrize(
    ("first", "second", "options", "message"),
    [
        (FLAT, FLAT[:20], {}, r"shapes \(40, 40\) and \(20, 40\)"),
        (FLAT, FLAT, {"lags": 20}, r"lags = 20 .*\(40, 40\)"),
        (FLAT, FLAT, {"clip": 2.5}, "clip = 2.5 .* 3 sigma, or inf"),
        (FLAT, FLAT, {"box": 16}, "box = 16 pixels .*, 8$"),
        (FLAT, FLAT, {"grow": -1}, "grow = -1 "),
        (FLAT, FLAT, {"mask": FLAT}, r"mask of shape \(40, 40\) and type float64 .*bool"),
        (FLAT, FLAT, {"mask": FLAT > 0}, "no pixel is finite .*not masked"),
        (-1e6 * FLAT, FLAT, {}, r"mean -1e\+08 electron.* above 0"),
        (FLAT, FLAT, {"unit": "DN"}, "unit = 'DN' .*electron, adu"),
        (
            FLAT[:18, :18], FLAT[:18, :18], {"lags": 8, "mask": np.arange(324).reshape(18, 18) % 2 > 0},
            r"162 good pixels of \(18, 18\) leave 0 pairs at a lag of 8.* 100 ",
        ),
    ],
)  # fmt: skip
def test_refusals(first, second, options, message):
    rng = np.random.default_rng(23)
    noise = rng.standard_normal((40, 40))
    first = first + noise[: first.shape[0], : first.shape[1]]
    with pytest.raises(MeasurementError, match=message):
        flat_covariances(first, second, **options)
