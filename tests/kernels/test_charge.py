"""Electrons into pixels, spilling, and the charge that moves the boundaries."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor._kernels import charge as kernel
from bfsensor._kernels.charge import TILE
from bfsensor._kernels.compile_options import from_python
from bfsensor._kernels.deposit import close_block, deposit
from bfsensor._kernels.shifts import MODES
from bfsensor.sensor.image_exposure import as_pixels
from tests.kernels.plain_edges import (
    charge_planes,
    effective_charges,
    expose,
    lows_by_tile,
    make_image,
    response_grids,
    silicon_sensor,
    table_sensor,
)

close_block, deposit = from_python(close_block), from_python(deposit)


def put(
    exposure, image, i, j, *, flux=1.0, words=None, z=None, full_well=np.inf, along_y=True,
    loss=0.0,
):  # fmt: skip
    """Deposit electrons in pixels (i, j); returns what stays."""
    count = len(i)
    before = exposure.ledger.sums[kernel.ADDED]
    deposit(
        as_pixels(image), exposure.charges, exposure.ledger,
        np.ascontiguousarray(np.broadcast_to(np.asarray(flux, float), count)), 0,
        np.asarray(i, np.int32), np.asarray(j, np.int32),
        np.full(count, 50.0, np.float32) if z is None else np.asarray(z, np.float32),
        np.zeros(count, np.uint32) if words is None else np.asarray(words, np.uint32),
        0, count, float(full_well), along_y, loss,
    )  # fmt: skip
    return exposure.ledger.sums[kernel.ADDED] - before


def close(sensor, exposure, image, ahead=0.0, crowd=np.inf):
    p = sensor.physics
    close_block(
        as_pixels(image), exposure.charges, exposure.ledger, p.response, p.edges, exposure.hot,
        np.float32(ahead), np.float32(crowd), np.float32(1.0),
    )  # fmt: skip


def inside(charges, array):
    """Pixels of the image of a padded array."""
    rows = charges.ny + 2 * charges.pad
    grid = array[: rows * charges.stride].reshape(rows, charges.stride)
    return grid[
        charges.pad : charges.pad + charges.ny, charges.pad : charges.pad + charges.nx
    ]


# -- deposit ---------------------------------------------------------------------------


@pytest.mark.parametrize("start", [1e5, 0.0])
def test_single_precision_images_carry_what_they_lose(start):
    image = np.full((3, 4), start, np.float32)
    exposure = expose(silicon_sensor(), image)
    count = 100_000
    added = put(exposure, image, np.full(count, 2), np.full(count, 1), flux=0.37)
    exact = start + 0.37 * count
    # What is carried, at most half a last place of 1.4e5 (2^-7), rounds to 2^-24 of it
    # at every addition; double precision adds 1.4e5 x 2^-53 each.
    error = count * (2.0**-7 * 2.0**-24 + 1.4e5 * 2.0**-53)
    carried = float(image[1, 2]) + float(exposure.ledger.carry[1, 2])
    assert abs(carried - exact) < error
    # The image is that rounded once, unless it lies next to the middle of two numbers.
    assert abs(float(image[1, 2]) - exact) < 2.0**-7 + error
    assert abs(added - 0.37 * count) < 1e-6
    # Without the carry single precision is off by more, at 1e5 by tens of electrons.
    plain = np.float32(start)
    for _ in range(count):
        plain += np.float32(0.37)
    assert abs(float(plain) - exact) > 100 * 2.0**-7
    others = np.ones((3, 4), bool)
    others[1, 2] = False
    assert np.all(image[others] == np.float32(start))


@pytest.mark.kernels
def test_a_few_carried_electrons():
    image = np.full((2, 2), 2.0**24, np.float32)
    exposure = expose(silicon_sensor(), image)
    # Single precision knows no 2^24 + 1.
    put(exposure, image, [1] * 5, [0] * 5)
    assert float(image[0, 1]) + float(exposure.ledger.carry[0, 1]) == 2.0**24 + 5
    assert image[0, 1] in (2.0**24 + 4, 2.0**24 + 6)
    assert image[0, 0] == 2.0**24


@pytest.mark.kernels
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_deposit_adds_in_place_and_keeps_the_books(dtype):
    # Any strides: every second pixel of a larger array.
    image = np.zeros((6, 10), dtype)[::2, ::2]
    exposure = expose(silicon_sensor(), np.ascontiguousarray(image))
    i = [0, 4, -1, 2, -1, 0, 3]
    j = [0, 2, 0, 1, 1, 0, 0]
    flux = np.array([1.0, 2.0, 4.0, -8.0, 16.0, 32.0, 0.5])
    z = np.array([50.0, 50.0, -1.0, 50.0, 50.0, 0.0, 50.0])
    added = put(exposure, image, i, j, flux=flux, z=z)
    expected = np.zeros((3, 5))
    expected[0, 0], expected[2, 4], expected[1, 2], expected[0, 3] = 33, 2, -8, 0.5
    assert np.array_equal(image, expected)
    assert added == 27.5
    assert exposure.ledger.sums[kernel.CROSSED] == 4.0
    assert exposure.ledger.sums[kernel.OFF_IMAGE] == 16.0
    listed = exposure.ledger.listed[: exposure.ledger.counters[kernel.LISTED]]
    assert sorted(listed) == sorted(
        {5 * b + a for a, b in zip(i, j, strict=True) if a >= 0}
    )


@pytest.mark.kernels
def test_electrons_that_meet_charge_are_lost_one_by_one():
    """The plain law, electron by electron, of the charge that is there at its turn."""
    rng, loss = np.random.default_rng(711), 0.02
    i, j = rng.integers(0, 3, 300), rng.integers(0, 2, 300)
    words = rng.integers(0, 2**32, 300, dtype=np.uint32)
    image = np.zeros((2, 3))
    exposure = expose(silicon_sensor(), image)
    added = put(exposure, image, i, j, words=words, loss=loss)
    plain = np.zeros((2, 3))
    for column, row, word in zip(i, j, words, strict=True):
        chance = (int(word) // 2 + 0.5) / 2**31
        plain[row, column] += chance < np.exp(-loss * plain[row, column])
    assert np.array_equal(image, plain)
    assert added == plain.sum() < 220
    assert exposure.ledger.sums[kernel.LOST] == 300 - added


# -- effective charge ------------------------------------------------------------------


def throw(exposure, image, count, seed, flux=(1.0, 0.5, 3.0, -0.25)):
    """Deposit a star, with some electrons anywhere."""
    rng = np.random.default_rng(seed)
    ny, nx = image.shape
    i = np.clip(np.rint(rng.normal(9.0, 2.5, count)), 0, nx - 1)
    j = np.clip(np.rint(rng.normal(8.0, 2.5, count)), 0, ny - 1)
    anywhere = rng.uniform(0, 1, count) < 0.02
    i[anywhere] = rng.integers(0, nx, anywhere.sum())
    j[anywhere] = rng.integers(0, ny, anywhere.sum())
    put(exposure, image, i, j, flux=rng.choice(flux, count))


def same_charges(exposure, fresh):
    """Whether two exposures hold the same charges, bit for bit."""
    a, b = exposure.charges, fresh.charges
    return np.array_equal(a.first, b.first) and np.array_equal(a.near, b.near)


@pytest.mark.parametrize("predict", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_listed_pixels_give_the_charge_of_the_image(predict, dtype):
    sensor = silicon_sensor(predict)
    image = make_image("bright corner", (20, 37)).astype(dtype)
    exposure = expose(sensor, image)
    for seed in (771, 772, 773):
        throw(exposure, image, 3000, seed)
        close(sensor, exposure, image)
        assert exposure.ledger.counters[kernel.LISTED] == 0
        assert same_charges(exposure, expose(sensor, image))
        check_ranges(sensor, exposure)


@pytest.mark.kernels
@pytest.mark.parametrize("make", [silicon_sensor, table_sensor])
def test_a_small_block_gives_the_charge_of_the_image(make):
    sensor = make()
    image = np.zeros((3, 4))
    exposure = expose(sensor, image)
    put(exposure, image, [1, 1, 2], [1, 1, 2], flux=[600.0, 700.0, 90.0])
    close(sensor, exposure, image)
    fresh = expose(sensor, image)
    # See below; nothing is stale, for every neighbour of the brightest was renewed.
    assert np.abs(exposure.charges.first - fresh.charges.first).max() < 0.05
    assert inside(exposure.charges, exposure.charges.first)[1, 1] > 1000


def check_ranges(sensor, exposure):
    """The ranges of tiles enclose what they hold, and margins follow from ranges."""
    charges, ledger = exposure.charges, exposure.ledger
    all_lows, all_highs = lows_by_tile(charges), ledger.highs.reshape(-1, MODES)
    for values, low, high in zip(
        charge_planes(charges), all_lows.T, all_highs.T, strict=False
    ):
        pixels = inside(charges, values)
        tiles_x = -(-charges.nx // kernel.TILE)
        tiles_y = -(-charges.ny // kernel.TILE)
        for tile in range(tiles_x * tiles_y):
            row, column = divmod(tile, tiles_x)
            part = pixels[
                row * kernel.TILE : (row + 1) * kernel.TILE,
                column * kernel.TILE : (column + 1) * kernel.TILE,
            ]
            assert low[tile] <= part.min()
            assert high[tile] >= part.max()
            # Outside the image there is no charge.
            if row in (0, tiles_y - 1) or column in (0, tiles_x - 1):
                assert low[tile] <= 0 <= high[tile]
    assert not ledger.flags.any() and ledger.counters[kernel.FLAGGED] == 0
    # The margins are those of these ranges: the bound for the tile and its neighbours.
    shape = (-(-charges.ny // kernel.TILE), -(-charges.nx // kernel.TILE))
    lows = all_lows[:, 0].reshape(shape)
    highs = all_highs[:, 0].reshape(shape)
    margins = charges.margins.reshape(shape)
    for row in range(shape[0]):
        for column in range(shape[1]):
            near = (
                slice(max(row - 1, 0), row + 2),
                slice(max(column - 1, 0), column + 2),
            )
            size = highs[near].max() - lows[near].min()
            # Single precision, 2^-23 of the product.
            assert margins[row, column] >= sensor.physics.edges.normal * size * (1 - 2e-7)


@pytest.mark.parametrize("make", [silicon_sensor, table_sensor])
@pytest.mark.parametrize("room", [0, 4, 50])
def test_blocks_that_touch_too_many_pixels_are_taken_over_whole(make, room):
    sensor = make()
    image = make_image("random", (20, 37)) / 10
    exposure = expose(sensor, image)
    ledger = exposure.ledger
    exposure.ledger = ledger._replace(
        listed=ledger.listed[:room].copy(), gained=ledger.gained[:room].copy()
    )
    throw(exposure, image, 3000, 1234)
    assert exposure.ledger.counters[kernel.DENSE] == 1
    close(sensor, exposure, image)
    assert exposure.ledger.counters[kernel.DENSE] == 0
    # The same function on the same charges.
    assert same_charges(exposure, expose(sensor, image))
    check_ranges(sensor, exposure)


@pytest.mark.parametrize("make", [lambda: silicon_sensor(True), table_sensor])
@pytest.mark.parametrize("room", [4, 5000])
def test_prediction_adds_the_gain_and_is_taken_back(make, room):
    sensor = make()
    image = make_image("bright pixel", (20, 37))
    exposure = expose(sensor, image)
    before = image.copy()
    ledger = exposure.ledger
    exposure.ledger = ledger._replace(
        listed=ledger.listed[:room].copy(), gained=ledger.gained[:room].copy(),
        listed_before=ledger.listed_before[:room].copy(),
    )  # fmt: skip
    throw(exposure, image, 40_000, 4321, (1.0, 0.5, 3.0))
    close(sensor, exposure, image, 0.5)
    gained = image - before
    found = inside(exposure.charges, exposure.charges.first)
    expected = predicted(sensor, image, 0.5 * gained)
    # Pixels that gained have the background of now.
    listed = gained != 0
    assert listed.sum() > 100
    assert np.abs(found - expected)[listed].max() < ROUNDING
    assert np.abs(found - expected).max() < tolerance_of(sensor, 0)
    plain = predicted(sensor, image, 0 * gained)
    assert np.abs(plain - expected).max() > 300
    # The next block brings nothing and predicts nothing: the charge of the image is left.
    close(sensor, exposure, image, 0.0)
    fresh = expose(sensor, image)
    found = inside(exposure.charges, exposure.charges.first)
    expected = inside(fresh.charges, fresh.charges.first)
    if room == 4 or sensor.layers == 1:
        assert np.array_equal(found, expected)
    assert np.abs(found - expected)[listed].max() < ROUNDING
    assert np.abs(found - expected).max() < tolerance_of(sensor, 0)


def test_a_pixel_that_comes_back_to_its_charge_keeps_its_prediction():
    # Negative flux brings a pixel back to where it was: the next electron lists it again.
    sensor = silicon_sensor(True)
    image = np.full((4, 5), 1000.0)
    exposure = expose(sensor, image)
    put(exposure, image, [2] * 4, [1] * 4, flux=[1.0, -1.0, 1.0, 400.0])
    close(sensor, exposure, image, 0.5)
    found = inside(exposure.charges, exposure.charges.first)[1, 2]
    assert image[1, 2] == 1401
    assert found == 1401 + 0.5 * 401


def predicted(sensor, image, ahead):
    """Effective charges with ``ahead`` added to each pixel, not to its neighbours."""
    if sensor.physics.response.first.size == 0:
        return image + ahead
    out = np.array(effective_charges(sensor, image)[0])
    r = sensor.physics.response
    padded = np.pad(image, 1)
    ny, nx = image.shape
    backgrounds = np.arange(r.first.shape[1]) * r.background_step
    charges = np.arange(r.first.shape[0]) * r.charge_step
    for j in range(ny):
        for i in range(nx):
            if ahead[j, i] != 0:
                around = (padded[j : j + 3, i : i + 3].sum() - image[j, i]) / 8
                at_b = [
                    np.interp(around, backgrounds, row) for row in r.first.astype(float)
                ]
                q = image[j, i] + ahead[j, i]
                out[j, i] = np.interp(q, charges, at_b)
                if q < 0:
                    out[j, i] = at_b[0] + q / r.charge_step * (at_b[1] - at_b[0])
    return out


ROUNDING = 0.15
"""Positions on the grid of up to 150 rounded to 2^-17 of a step of 1000 e-, at slopes up to
some 2; four products of 1.5e5 at 2^-24, each rounded thrice [e-]."""


STALE = 512.0
"""Charge that a pixel gains before the background of its neighbours is found again [e-]: chosen."""


def tolerance_of(sensor, mode):
    """Error [e-] of the effective charge of a pixel that was not renewed.

    While its neighbours gain less than STALE each, their mean does, times the largest
    slope of the response with the background.
    """
    r = sensor.physics.response
    if r.first.size == 0:
        return ROUNDING
    grid = response_grids(sensor)[mode]
    slope = np.abs(np.diff(grid, axis=1)).max() / r.background_step
    return ROUNDING + STALE * slope


@pytest.mark.parametrize("seed", [8801, 8802])
def test_the_background_of_listed_pixels_is_stale_by_its_bound_at_most(seed):
    sensor = table_sensor()
    image = make_image("random", (20, 37)) / 5
    exposure = expose(sensor, image)
    largest = 0.0
    rng = np.random.default_rng(seed)
    for _ in range(12):
        throw(exposure, image, 9000, int(rng.integers(1000, 10**6)))
        close(sensor, exposure, image, 0.0)
        fresh = expose(sensor, image)
        planes = charge_planes(exposure.charges), charge_planes(fresh.charges)
        for mode, stale in enumerate(np.abs(planes[0] - planes[1])):
            largest = max(largest, stale.max())
            assert stale.max() < tolerance_of(sensor, mode)
        check_ranges(sensor, exposure)
    # Something is stale, or the bound was not put to the test.
    assert largest > ROUNDING


def test_a_pixel_that_gains_nothing_has_its_background_renewed():
    sensor = table_sensor()
    image = np.full((17, 18), 2e3)
    image[8, 9] = 1.2e5
    exposure = expose(sensor, image)
    before = inside(exposure.charges, exposure.charges.first)[8, 9]
    ring = [(8, 7), (9, 7), (10, 7), (8, 8), (10, 8), (8, 9), (9, 9), (10, 9)]
    i, j = np.repeat(ring, 100, axis=0).T
    largest = 0.0
    for _ in range(60):
        put(exposure, image, i, j)
        close(sensor, exposure, image)
        found = inside(exposure.charges, exposure.charges.first)[8, 9]
        fresh = expose(sensor, image)
        expected = inside(fresh.charges, fresh.charges.first)[8, 9]
        largest = max(largest, abs(found - expected))
    # Its background grew by 6000 e-, and was never behind by more than 512 and a block's
    # 100: it moved in proportion, to a fifth where the response is curved.
    assert largest > ROUNDING
    assert largest < 1.2 * 612 / 6000 * abs(expected - before) + ROUNDING


@pytest.mark.parametrize("name", ["random", "bright corner", "negative"])
def test_effective_charges_are_those_of_the_plain_twin(name):
    sensor = table_sensor()
    image = make_image(name, (20, 37))
    charges = expose(sensor, image).charges
    for found, expected in zip(
        charge_planes(charges), effective_charges(sensor, image), strict=True
    ):
        assert np.abs(inside(charges, found) - expected).max() < ROUNDING
        # Outside the image there is none.
        assert found.astype(float).sum() == pytest.approx(
            inside(charges, found).astype(float).sum(), abs=1e-6
        )


# -- spilling --------------------------------------------------------------------------


def plain_spill(image, i, j, flux, words, full_well, along_y):
    """One electron after another; returns image, flux off the image, flux that stays."""
    image = image.copy()
    off = kept = 0.0
    for a, b, w, word in zip(i, j, flux, words, strict=True):
        step = 1 if word & 1 else -1
        rest = w
        while rest > 0:
            if not (0 <= a < image.shape[1] and 0 <= b < image.shape[0]):
                off += rest
                break
            part = min(max(full_well - image[b, a], 0.0), rest)
            image[b, a] += part
            kept += part
            rest -= part
            a, b = (a, b + step) if along_y else (a + step, b)
    return image, off, kept


def make_star(shape, count, seed):
    rng = np.random.default_rng(seed)
    i = np.clip(np.rint(rng.normal(shape[1] / 2 - 1, 0.8, count)), 0, shape[1] - 1)
    j = np.clip(np.rint(rng.normal(shape[0] / 2 - 1, 1.1, count)), 0, shape[0] - 1)
    words = rng.integers(0, 2**32, count, dtype=np.uint32)
    return i.astype(int), j.astype(int), words


def check_spill(shape, count, full_well, seed, along_y, dtype, flux=None):
    i, j, words = make_star(shape, count, seed)
    flux = np.ones(count) if flux is None else flux
    image = np.zeros(shape, dtype)
    exposure = expose(silicon_sensor(), image)
    expected, off, kept = plain_spill(
        np.zeros(shape), i, j, flux, words.tolist(), full_well, along_y
    )
    added = put(
        exposure, image, i, j, flux=flux, words=words, full_well=full_well, along_y=along_y
    )
    sums = exposure.ledger.sums
    # Whole electrons, or halves: nothing is rounded.
    assert np.array_equal(image, expected)
    assert sums[kernel.SPILLED_OFF] == off
    assert added == kept
    assert image.sum(dtype=float) + sums[kernel.SPILLED_OFF] == flux.sum()
    assert sums[kernel.SPILLED] > 0
    assert image.max() == full_well
    return image, sums


@pytest.mark.kernels
@pytest.mark.parametrize("along_y", [True, False])
def test_a_few_electrons_spill_like_the_plain_twin(along_y):
    check_spill((7, 6), 150, 9, 3301, along_y, np.float64)


@pytest.mark.parametrize("along_y", [True, False])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("full_well", [40, 2500])
def test_electrons_spill_like_the_plain_twin(along_y, dtype, full_well):
    image, sums = check_spill((23, 19), 20_000, full_well, 3302, along_y, dtype)
    # The smaller well floods columns to the border, the larger one does not.
    assert (sums[kernel.SPILLED_OFF] > 0) == (full_well == 40)
    # Charge leaves along its column alone: sums across it are those of the star.
    i, j, _ = make_star((23, 19), 20_000, 3302)
    if full_well == 2500:
        place, size = (i, 19) if along_y else (j, 23)
        columns = np.bincount(place, minlength=size)
        assert np.array_equal(image.sum(0 if along_y else 1), columns)


def test_unequal_electrons_spill_like_the_plain_twin():
    flux = np.random.default_rng(3303).choice([0.5, 1.0, 2.5, 70.0], 5000)
    check_spill((31, 19), 5000, 800, 3303, True, np.float32, flux)


def test_columns_along_x_give_the_transposed_image():
    i, j, words = make_star((23, 19), 20_000, 3304)
    upright = np.zeros((23, 19))
    flat = np.zeros((19, 23))
    put(expose(silicon_sensor(), upright), upright, i, j, words=words, full_well=90)
    put(
        expose(silicon_sensor(), flat), flat, j, i, words=words, full_well=90, along_y=False
    )
    assert np.array_equal(upright, flat.T)
    assert upright.max() == 90


@pytest.mark.kernels
def test_trails_of_equal_shares_are_symmetric():
    image = np.zeros((11, 3))
    exposure = expose(silicon_sensor(), image)
    count = 10 + 2 * 33
    words = np.arange(count)
    put(exposure, image, np.full(count, 1), np.full(count, 5), words=words, full_well=10)
    # The pixel itself, and 33 electrons each way: three full pixels and three electrons.
    assert image[:, 1].tolist() == [0, 3, 10, 10, 10, 10, 10, 10, 10, 3, 0]
    assert image[:, [0, 2]].sum() == 0


def test_trails_of_drawn_shares_are_symmetric_within_their_spread():
    image = np.zeros((61, 3))
    exposure = expose(silicon_sensor(), image)
    count = 20_000
    words = np.random.default_rng(3305).integers(0, 2**32, count, dtype=np.uint32)
    full = np.full(count, 1), np.full(count, 30)
    put(exposure, image, *full, words=words, full_well=500)
    up, down = image[31:, 1].sum(), image[:30, 1].sum()
    assert up + down == count - 500
    # Half of the electrons each, binomial.
    assert abs(up - down) < 5 * np.sqrt(count)
    assert exposure.ledger.sums[kernel.SPILLED] == count - 500


def test_charge_there_before_fills_the_column_as_well():
    image = np.zeros((12, 3))
    image[[2, 3, 8], 1] = [25, 10, 7]
    i, j = np.full(90, 1), np.full(90, 5)
    words = np.random.default_rng(3306).integers(0, 2**32, 90, dtype=np.uint32)
    expected, off, _ = plain_spill(image, i, j, np.ones(90), words.tolist(), 10, True)
    exposure = expose(silicon_sensor(), image)
    put(exposure, image, i, j, words=words, full_well=10)
    assert np.array_equal(image, expected)
    assert exposure.ledger.sums[kernel.SPILLED_OFF] == off
    # What is above the full well stays: it is not for the sensor to remove.
    assert image[2, 1] == 25


def test_two_sources_in_a_column_share_their_trails():
    rng = np.random.default_rng(3307)
    image = np.zeros((40, 2))
    j = rng.choice([11, 12, 20, 29], 3000, p=[0.4, 0.1, 0.2, 0.3])
    i = np.ones(3000, int)
    words = rng.integers(0, 2**32, 3000, dtype=np.uint32)
    expected, off, _ = plain_spill(image, i, j, np.ones(3000), words.tolist(), 100, True)
    exposure = expose(silicon_sensor(), image)
    # In several calls: what columns remember holds on.
    for part in np.split(np.arange(3000), (700, 701, 2000)):
        put(exposure, image, i[part], j[part], words=words[part], full_well=100)
    assert np.array_equal(image, expected)
    assert exposure.ledger.sums[kernel.SPILLED_OFF] == off


def test_a_hole_in_a_trail_is_filled_again():
    image = np.zeros((20, 2))
    exposure = expose(silicon_sensor(), image)
    put(exposure, image, [1] * 60, [5] * 60, words=[1] * 60, full_well=10)
    assert image[5:11, 1].tolist() == [10] * 6
    put(exposure, image, [1] * 4, [8] * 4, flux=-1.0, full_well=10)
    put(exposure, image, [1] * 4, [5] * 4, words=[1] * 4, full_well=10)
    assert image[5:12, 1].tolist() == [10] * 6 + [0]


def test_edges_of_full_pixels_are_hot_though_they_gain_nothing():
    sensor = replace(table_sensor().physics, full_well=100.0)
    image = np.zeros((40, 40))
    image[5:35, 20] = 100.0
    exposure = expose(SimpleNamespace(physics=sensor), image)
    count = 400
    i, j = np.full(count, 20), np.full(count, 20)
    put(exposure, image, i, j, full_well=100.0)
    assert exposure.ledger.strikes[20, 20] == count
    before = image[20, 20]
    close(SimpleNamespace(physics=sensor), exposure, image, crowd=1e-3)
    assert image[20, 20] == before == 100.0
    hot, tiles_x = exposure.hot, 3
    page = hot.page_of[(20 // TILE) * tiles_x + 20 // TILE]
    assert page >= 0
    at = (20 % TILE) * TILE + 20 % TILE
    for side, place in ((0, at), (0, at + 1), (1, at), (1, at + TILE)):
        assert hot.pages[page, side, place] >= 0
    assert not exposure.ledger.strikes.any()
    assert exposure.ledger.counters[kernel.STRUCK] == 0
