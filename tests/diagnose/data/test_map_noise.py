"""Noise in common of columns, rows and blocks of a map, against noise that is drawn."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel, Common, join_channels
from bfsensor.diagnose.data.map_channels import LOW, MapChannels, block_side
from bfsensor.diagnose.data.map_noise import block_noise
from bfsensor.diagnose.kinds.map_shapes import Places
from bfsensor.errors import DiagnosisError

DRAWS = 6000


def whole(ny=33, nx=48):
    return np.ones((ny, nx), bool)


def with_dead_corner():
    good = whole()
    good[:15, 24:36] = False
    return good


def with_dead_column():
    good = whole()
    good[:, 5] = False
    good[3, 17] = False
    return good


def reduced(images, good, kept):
    """Means of columns, rows and kept blocks of many images, shape (values, images)."""
    side = block_side(good.shape)
    ny, nx = (n // side * side for n in good.shape)
    images = np.where(good, images, 0.0)

    def blocks(of):
        return of[..., :ny, :nx].reshape(*of.shape[:-2], ny // side, side, nx // side, side)

    count = np.maximum(blocks(good).sum((1, 3)), 1)
    means = (blocks(images).sum((2, 4)) / count).reshape(len(images), -1)[:, kept]
    columns = images.sum(1) / np.maximum(good.sum(0), 1)
    rows = images.sum(2) / np.maximum(good.sum(1), 1)
    return np.concatenate([columns, rows, means], axis=1).T


def channel_of(good, sigma=1.0):
    side = block_side(good.shape)
    noise = block_noise(good, side)
    ny, nx = good.shape
    lines = [
        *(sigma**2 / np.maximum(good.sum(0), 1)),
        *(sigma**2 / np.maximum(good.sum(1), 1)),
    ]
    down, across = np.divmod(noise.kept, nx // side)
    middle = (side - 1) / 2
    axes = {
        "what": np.repeat(["column", "row", "block"], [nx, ny, len(down)]),
        "x": np.concatenate([np.arange(nx), np.full(ny, -1), across * side + middle]),
        "y": np.concatenate([np.full(nx, -1), np.arange(ny), down * side + middle]),
    }
    blocks = (*(np.array([[v]]) for v in lines), sigma**2 * noise.covariance)
    return noise, Channel(
        "flat_map", np.zeros(nx + ny + len(down)), blocks, axes, "", common=noise.common()
    )


@pytest.mark.parametrize(
    "good", [whole(), whole(35, 50), with_dead_corner(), with_dead_column()]
)
def test_whitened_noise_of_pixels_is_white(good):
    rng = np.random.default_rng(6)
    noise, channel = channel_of(good, 2.0)
    drawn = reduced(2 * rng.standard_normal((DRAWS, *good.shape)), good, noise.kept)
    white = channel.whiten(drawn)
    lines = sum(good.shape)
    apart = white[lines:] @ white.T / DRAWS
    expected = np.eye(len(white))[lines:]
    # 6 sigma of a covariance of so many draws, 4 of a variance.
    np.testing.assert_allclose(apart, expected, atol=6 / np.sqrt(DRAWS))
    np.testing.assert_allclose(channel.unwhiten(white[:, 0]), drawn[:, 0], atol=1e-12)
    read = drawn.std(1) > 0
    np.testing.assert_allclose(channel.errors[read], drawn.std(1)[read], rtol=0.06)


def test_a_pattern_along_an_axis_counts_once():
    """Its amplitude scatters by its error; if values were independent, by 2^(1/2) times that."""
    rng = np.random.default_rng(7)
    good = whole(256, 256)
    noise, channel = channel_of(good)
    wave = np.cos(2 * np.pi * np.arange(256) / 128)
    shape = Places.of(channel.axes, good.shape).product(np.ones(256), wave, len(channel))
    drawn = np.concatenate(
        [
            reduced(rng.standard_normal((40, *good.shape)), good, noise.kept)
            for _ in range(10)
        ],
        axis=1,
    )

    def deviates(whiten):
        white = whiten(shape)
        return white @ whiten(drawn) / np.sqrt(white @ white)

    # Of 400 draws a standard deviation scatters by 0.035.
    assert deviates(channel.whiten).std() == pytest.approx(1.0, abs=0.12)

    def apart(values):
        return (values.T / channel.errors).T

    assert deviates(apart).std() > 1.3


def test_what_is_dropped_follows_from_the_rest():
    noise, _ = channel_of(whole())
    side = block_side((33, 48))
    rows, columns = 33 // side, 48 // side
    assert len(noise.kept) == (rows - 1) * (columns - 1)
    assert not np.isin(noise.kept % columns, columns - 1).any()
    least = np.linalg.eigvalsh(noise.covariance).min()
    assert least == pytest.approx(1 / (side**2 * rows * columns))


def test_channels_join_with_what_they_have_in_common():
    _, one = channel_of(whole())
    plain = Channel("flat_map", np.zeros(2), (np.eye(2),), {
        k: v[:2] for k, v in one.axes.items()
    }, "")  # fmt: skip
    both = join_channels([plain, one])
    values = np.random.default_rng(8).standard_normal(len(both))
    np.testing.assert_allclose(both.whiten(values)[2:], one.whiten(values[2:]))
    assert join_channels([plain, plain]).common is None


def test_refuses_what_does_not_match():
    with pytest.raises(DiagnosisError, match=r"\(3, 2\) and \(1, 3\)"):
        Common(csr_array((3, 2)), csr_array((1, 3)))
    ones = csr_array(np.ones((3, 1)))
    with pytest.raises(DiagnosisError, match="both a source and a target"):
        Common(ones, csr_array(ones.T))
    with pytest.raises(DiagnosisError, match=r"flat_map: .* 3 values, not 2"):
        Channel("flat_map", np.zeros(2), (np.eye(2),), {"x": np.arange(2)}, "",
                common=Common.none(3))  # fmt: skip


def test_noise_over_blocks_is_larger_than_over_boxes_where_charge_repels_charge() -> None:
    """Area changes fall with the third power of distance: noise of long waves is the largest."""
    side = 256
    here = Condition(wavelength=620.0, back_bias=-60.0, temperature=173.0)
    fy, fx = np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)[None]
    rest = 1 - 0.9 * np.hypot(fy, fx)

    def over(size: int) -> float:
        """Variance of a box's mean times its pixels, from the spectrum."""
        box = np.zeros((side, side))
        box[:size, :size] = 1.0 / size
        return float(np.mean(np.abs(np.fft.fft2(box)) ** 2 * rest**2))

    maps = MapChannels((side, side), {here: 10.0})
    rng = np.random.default_rng(8660)
    for _ in range(40):
        pair = [
            np.fft.ifft2(
                np.fft.fft2(rng.normal(0.0, 5e-3, (side, side))) * rest
            ).real.astype(np.float32)
            for _ in range(2)
        ]
        maps.add_pair(here, 10.0, *pair, level=1e4)
    (group,) = maps._groups
    wanted = over(block_side((side, side))) / over(LOW)
    # The third power leaves a quarter of the excess: its sum over a box ends slowly.
    assert group.wide / group.low - 1 == pytest.approx(0.75 * (wanted - 1), abs=0.01)
    assert wanted > 1.05
