"""Corrections against closed forms and against a forward model that shares no code."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.errors import ConvergenceError, MeasurementError
from bfsensor.measure.correct import correct_edges, correct_kernel


def kernel_like(side=9, *, across=1.0, size=4e-7):
    at = np.arange(side) - side // 2
    return -size / (1.0 + 1.5 * (at[:, None] ** 2 + across * at**2)) ** 1.5


def edges_like(n=4):
    """Upper and right edges, larger in y; no gradient of any potential."""
    k = np.arange(n)
    north = -4e-7 * (k[:, None] + 0.5) / (0.5 + (k[:, None] + 0.5) ** 2 + k**2) ** 1.7
    return north, 0.7 * north.T * (1 + 0.1 * k)


def blob(side, sigma, total, *, at=(0.0, 0.0)):
    y, x = np.indices((side, side)) - side // 2
    r2 = (x - at[0]) ** 2 + (y - at[1]) ** 2
    return total / (2 * np.pi * sigma**2) * np.exp(-r2 / (2 * sigma**2))


def plain_edges(image, north, east):
    """Pixel by pixel, edge by edge, charge by charge; far from the border."""
    n, (ny, nx) = len(north), image.shape
    out = image.copy()

    def shift(upper, along, across):
        """Shift of the edge between pixels at ``along`` and ``along`` + 1 from the charge."""
        if abs(across) >= n or not -n <= along < n:
            return 0.0
        if along >= 0:
            return upper[along, abs(across)]
        return -upper[-along - 1, abs(across)]

    for y in range(ny):
        for x in range(nx):
            up = right = 0.0
            for v in range(max(0, y - n), min(ny, y + n + 1)):
                for u in range(max(0, x - n), min(nx, x + n + 1)):
                    up += image[v, u] * shift(north, y - v, x - u)
                    right += image[v, u] * shift(east.T, x - u, y - v)
            for moved, (b, a) in ((up, (y + 1, x)), (right, (y, x + 1))):
                if b < ny and a < nx:
                    # Half the shift on average, half the sum as the light between.
                    charge = 0.5 * moved * 0.5 * (image[y, x] + image[b, a])
                    out[y, x] -= charge
                    out[b, a] += charge
    return out


def test_edges_against_the_plain_sum():
    north, east = edges_like(3)
    image = np.zeros((15, 15))
    image[4:11, 4:11] = np.random.default_rng(771).uniform(0, 9e4, (7, 7))
    found = correct_edges(image, north, east)
    # Round-off of the transforms, of 1e5 e-.
    np.testing.assert_allclose(found, plain_edges(image, north, east), atol=1e-9)
    assert np.abs(found - image).max() > 500


@pytest.mark.parametrize("conserving", [True, False])
def test_a_blob_and_a_blob_of_a_kernel(conserving):
    r"""The convolution of broad Gaussians and its derivatives are Gaussians.

    F of width s, K of width t: phi has the width w of both, F div grad phi + grad F grad phi
    is F phi [(r^2 / w^4 - 2 / w^2) + r^2 / (s^2 w^2)].
    """
    s, t, side = 7.0, 5.0, 81
    image = blob(side, s, 4e6)
    kernel = -blob(61, t, 2e-5)
    w2 = s**2 + t**2
    phi = -2e-5 * blob(side, np.sqrt(w2), 4e6)
    y, x = np.indices(image.shape) - side // 2
    r2 = x**2 + y**2
    expected = 0.5 * image * phi * (r2 / w2**2 - 2 / w2 + r2 / (s**2 * w2))
    found = correct_kernel(image, kernel, conserving=conserving, threshold=np.inf) - image
    # Second differences lack 1 / (4 w^2) of the largest, means of two pixels 1 / (4 s^2).
    size = np.abs(expected).max()
    assert size > 30
    np.testing.assert_allclose(found, expected, atol=(0.25 / w2 + 0.26 / s**2) * size)


def test_a_gradient_of_a_potential_is_the_same_to_both():
    kernel = np.pad(kernel_like(7), 1)
    n = kernel.shape[0] // 2
    potential = np.pad(kernel, 1)[n + 1 :, n + 1 :]
    north, east = potential[:-1] - potential[1:], potential[:, :-1] - potential[:, 1:]
    image = blob(41, 2.0, 2e6, at=(0.3, -0.4))
    edges = correct_edges(image, north[:, :-1], east[:-1])
    once = correct_kernel(image, kernel, threshold=np.inf)
    np.testing.assert_allclose(edges, once, atol=1e-8)
    assert np.abs(edges - image).max() > 100


def test_nothing_changes_no_bit():
    image = np.random.default_rng(772).normal(3e4, 200, (20, 30))
    for conserving in (True, False):
        found = correct_kernel(image, np.zeros((5, 5)), conserving=conserving)
        assert found.tobytes() == image.tobytes()
    found = correct_edges(image, np.zeros((3, 3)), np.zeros((3, 3)))
    assert found.tobytes() == image.tobytes()
    assert found is not image


def test_a_flat_stays_flat_to_the_border():
    image = np.full((20, 30), 5e4)
    for found in (
        correct_kernel(image, kernel_like()),
        correct_kernel(image, kernel_like(), conserving=False),
        correct_edges(image, *edges_like()),
    ):
        np.testing.assert_allclose(found, image, rtol=1e-13)


def test_charge_is_conserved():
    image = np.random.default_rng(773).uniform(0, 8e4, (40, 40))
    for found in (
        correct_kernel(image, kernel_like()), correct_edges(image, *edges_like())
    ):  # fmt: skip
        assert found.sum() == pytest.approx(image.sum(), rel=1e-14)
        assert np.abs(found - image).max() > 100
    # The expanded form keeps it only up to gradients from pixel to pixel.
    lost = correct_kernel(image, kernel_like(), conserving=False).sum() - image.sum()
    assert abs(lost) > 1.0


def test_symmetric_images_stay_symmetric():
    image = blob(31, 1.5, 1e6)
    for found in (
        correct_kernel(image, kernel_like(across=1.0)),
        correct_edges(image, *edges_like()),
    ):
        np.testing.assert_allclose(found, found[::-1], atol=1e-9)
        np.testing.assert_allclose(found, found[:, ::-1], atol=1e-9)
    square = correct_kernel(image, kernel_like(across=1.0))
    np.testing.assert_allclose(square, square.T, atol=1e-9)
    north = edges_like()[0]
    np.testing.assert_allclose(
        correct_edges(image, north, north.T), correct_edges(image, north, north.T).T,
        atol=1e-9,
    )  # fmt: skip


def test_exchanged_axes_are_noticed():
    image = blob(31, 1.5, 1e6)
    kernel = kernel_like(across=2.5)
    north, east = edges_like()
    right = correct_edges(image, north, east) - image
    wrong = correct_edges(image, east.T, north.T) - image
    np.testing.assert_allclose(wrong, right.T, atol=1e-9)
    assert np.abs(wrong - right).max() > 0.05 * np.abs(right).max()
    right = correct_kernel(image, kernel) - image
    wrong = correct_kernel(image, kernel.T) - image
    np.testing.assert_allclose(wrong, right.T, atol=1e-6)
    assert np.abs(wrong - right).max() > 0.05 * np.abs(right).max()
    # An image as exposed through the transposed sensor, and its kernel.
    np.testing.assert_allclose(
        correct_edges(image.T, east.T, north.T), correct_edges(image, north, east).T,
        atol=1e-9,
    )  # fmt: skip


def test_a_star_shrinks():
    image = blob(31, 1.5, 1e6)
    y, _ = np.indices(image.shape) - 15
    for found in (
        correct_kernel(image, kernel_like()),
        correct_edges(image, *edges_like()),
    ):
        assert np.sum(found * y**2) < 0.995 * np.sum(image * y**2)
        assert found[15, 15] > image[15, 15]


def test_iterating_solves_the_implicit_equation():
    image, kernel = blob(31, 1.5, 1e6), kernel_like()
    found = correct_kernel(image, kernel, threshold=1e-3)
    once = correct_kernel(image, kernel, threshold=np.inf)
    # One more step from the solution goes nowhere: what it adds to the image it added before.
    again = correct_kernel(found, kernel, threshold=np.inf) - found
    np.testing.assert_allclose(again, found - image, atol=1e-3)
    assert np.abs(again - (once - image)).max() > 10


def test_what_does_not_converge_is_not_given():
    with pytest.raises(ConvergenceError, match="after 2 steps") as caught:
        correct_kernel(blob(31, 1.5, 1e6), kernel_like(), threshold=1e-9, iterations=2)
    assert len(caught.value.history) == 2
    assert caught.value.history[1] < caught.value.history[0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda i: correct_kernel(i, np.zeros((4, 5))), "two odd sides"),
        (lambda i: correct_kernel(i, np.full((3, 3), np.nan)), "kernel holds values"),
        (lambda i: correct_kernel(i, np.zeros((3, 3)), threshold=0.0), "threshold = 0.0"),
        (lambda i: correct_kernel(i, np.zeros((3, 3)), iterations=0), "iterations = 0"),
        (lambda i: correct_kernel(i[0], np.zeros((3, 3))), r"image of shape \(9,\)"),
        (
            lambda i: correct_kernel(np.where(i > -1, np.nan, i), np.zeros((3, 3))),
            "image holds 81 values that are not finite",
        ),
        (
            lambda i: correct_edges(i, np.zeros((2, 2)), np.zeros((3, 3))),
            r"north and east have the shapes \(2, 2\) and \(3, 3\)",
        ),
        (
            lambda i: correct_edges(i, np.full((2, 2), np.inf), np.zeros((2, 2))),
            "north or east holds values",
        ),
    ],
)
def test_refusals(call, message):
    with pytest.raises(MeasurementError, match=message):
        call(np.zeros((9, 9)))
