"""Spots are found where they are, rejected for the right reason, and cut out unharmed."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from bfsensor.errors import MeasurementError
from bfsensor.measure.spot_model import Shape, integrate_gaussian
from bfsensor.measure.spots import (
    SpotList,
    Stamps,
    cut_stamps,
    find_peaks,
    find_spots,
    largest_around,
)

SHAPE = Shape(1.0, 1.1)


def paint(image, x, y, flux, size=9):
    """Add a spot with its centre at (x, y)."""
    i, j = round(x), round(y)
    stamp = flux * integrate_gaussian([x - i], [y - j], SHAPE, size)[0]
    half = size // 2
    image[j - half : j + half + 1, i - half : i + half + 1] += stamp


def make_grid(n=6, pitch=15, flux=2e5, seed=411):
    rng = np.random.default_rng(seed)
    side = n * pitch
    image = np.full((side, side + 7), 50.0)
    places = []
    for j in range(n):
        for i in range(n):
            # Not nearer to a pixel's edge than 0.1: noise must not choose the pixel.
            x, y = (
                pitch * np.array([i, j]) + pitch // 2 + rng.integers(-1, 2, 2)
            ) + rng.uniform(-0.4, 0.4, 2)
            paint(image, x, y, flux)
            places.append((round(y), round(x)))
    return rng.poisson(image).astype(float), sorted(places)


def message(call, *args, **kwargs):
    with pytest.raises(MeasurementError) as caught:
        call(*args, **kwargs)
    return str(caught.value)


def test_all_spots_of_a_grid_are_found_in_reading_order():
    image, places = make_grid()
    found = find_spots(image, threshold=1000.0)
    assert list(zip(found.y.tolist(), found.x.tolist(), strict=True)) == places
    assert set(found.rejected.values()) == {0}
    assert len(found) == 36


def test_candidates_are_rejected_for_their_reasons():
    image = np.zeros((60, 80))
    paint(image, 20, 20, 1e5)
    paint(image, 26, 17, 5e4)  # six columns from a brighter one
    paint(image, 60, 20, 9e5)
    paint(image, 20, 45, 1e5)
    paint(image, 40, 45, 1e5)
    image[58, 70] = 5e4
    mask = np.zeros(image.shape, bool)
    mask[46, 21] = True
    image[44, 45] = np.nan  # in a stamp, away from its centre
    found = find_spots(image, threshold=2000.0, saturation=1e5, mask=mask)
    assert (found.x.tolist(), found.y.tolist()) == ([20, 40], [20, 45])
    assert dict(found.rejected) == {
        "neighbour": 1, "border": 1, "saturated": 1, "masked": 1
    }  # fmt: skip
    # Each reason goes with its cause.
    found = find_spots(image, threshold=2000.0, separation=5)
    assert len(found) == 5
    assert found.rejected["neighbour"] == 0


def test_equal_pixels_are_one_candidate():
    image = np.zeros((30, 30))
    image[14:16, 14:16] = 5e4
    found = find_spots(image, threshold=1000.0)
    assert (found.x.tolist(), found.y.tolist()) == ([14], [14])


def test_nothing_is_found_below_the_threshold():
    image, _ = make_grid()
    found = find_spots(image, threshold=1e6)
    assert len(found) == 0
    assert "rejected" in message(cut_stamps, image, found)


def test_stamps_hold_the_image_around_each_spot():
    image, _ = make_grid()
    found = find_spots(image, threshold=1000.0)
    mask = np.zeros(image.shape, bool)
    mask[found.y[3] + 2, found.x[3] - 3] = True
    stamps = cut_stamps(image, found, mask=mask, variance=image + 25.0)
    for k in (0, 3, 35):
        j, i = found.y[k], found.x[k]
        part = image[j - 4 : j + 5, i - 4 : i + 5]
        good = stamps.good[k]
        assert np.array_equal(stamps.electrons[k][good], part[good])
        assert np.array_equal(stamps.variance[k][good], part[good] + 25.0)
    assert np.argwhere(~stamps.good).tolist() == [[3, 6, 1]]
    one = stamps.select(np.array([3]))
    assert (one.x[0], one.y[0], len(one)) == (found.x[3], found.y[3], 1)
    assert not one.good[0, 6, 1]


def test_values_that_are_not_finite_are_never_used():
    data = np.ones((2, 5, 5))
    data[1, 0, 0] = np.nan
    data[0, 1, 1] = np.inf
    variance = np.ones_like(data)
    variance[1, 0, 0] = np.nan
    stamps = Stamps(data, variance=variance)
    assert np.argwhere(~stamps.good).tolist() == [[0, 1, 1], [1, 0, 0]]
    assert np.all(np.isfinite(stamps.electrons))
    assert np.all(stamps.variance > 0)
    assert np.isnan(data[1, 0, 0])


def test_lists_pickle():
    found = SpotList(np.array([3]), np.array([4]), {"border": 2})
    again = pickle.loads(pickle.dumps(found))
    assert (again.x[0], again.y[0], again.rejected["border"]) == (3, 4, 2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"threshold": np.nan}, "threshold = nan"),
        ({"saturation": 500.0}, "saturation = 500 e- must be above the threshold, 1000"),
        ({"separation": 1}, "separation = 1"),
        ({"stamp": 8}, "stamp = 8"),
        ({"stamp": 41}, "stamp of 41 x 41"),
        ({"mask": np.zeros((3, 3))}, r"mask has the shape (3, 3), not (30, 40)"),
    ],
)
def test_wrong_searches_are_refused(change, words):
    assert words in message(find_spots, np.zeros((30, 40)), **{"threshold": 1e3, **change})


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Stamps(np.zeros((9, 9))), "must be (spots, rows, columns)"),
        (lambda: Stamps(np.zeros((2, 9, 8))), "9 x 8 pixels"),
        (lambda: Stamps(np.zeros((2, 9, 9)), good=np.ones((9, 9))), "good has the shape"),
        (lambda: Stamps(np.ones((2, 9, 9)), variance=np.zeros((2, 9, 9))), "above 0 e-^2"),
        (lambda: Stamps(np.ones((2, 9, 9)), x=np.arange(3)), "x has the shape (3,)"),
        (lambda: find_spots(np.zeros(9), threshold=1.0), "rows and columns"),
        (
            lambda: cut_stamps(np.zeros((20, 20)), SpotList(*np.array([[3], [9]]), {})),
            "leave the image of 20 x 20",
        ),
    ],
)
def test_wrong_arrays_are_refused(make, words):
    assert words in message(make)


@pytest.mark.parametrize("size", [3, 9])
def test_peaks_are_those_of_a_filter_of_the_whole_image(size):
    """Also where neighbours are equal and at the rims: scipy's filter looks at every pixel."""
    image = np.random.default_rng(611).integers(0, 30, (90, 70)).astype(float)
    wanted = (image > 15) & (image == maximum_filter(image, size))
    y, x = find_peaks(image, 15.0, size)
    assert len(y) > 50
    np.testing.assert_array_equal(np.column_stack([y, x]), np.argwhere(wanted))
    around = maximum_filter(image, 5)[y, x]
    np.testing.assert_array_equal(largest_around(image, y, x, 5), around)
