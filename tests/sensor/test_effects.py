"""Effects in the sensor against closed forms and polygons, at every stage."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

from bfsensor.diagnose.model.flat_predictions import flat_covariances_of
from bfsensor.diagnose.model.spot_predictions import grow_spots
from bfsensor.effects.effect import Law
from bfsensor.effects.library import make_effect
from bfsensor.errors import SensorError
from bfsensor.response.edge_response import area_matrix
from bfsensor.response.vertices import vertex_fractions
from bfsensor.sensor.flats import draw_flat
from tests.sensor.contract_cases import blank, draw, photons
from tests.sensor.effect_cases import (
    PLAIN,
    Bent,
    Full,
    Ratio,
    Rough,
    Shade,
    Tail,
    Wide,
    areas_of,
    flat_photons,
    sensor_with,
    single,
)


def plain_shifts(sensor):
    """Mean shifts of right and upper edges per electron, from the vertices of the table."""
    table = sensor.table
    corners, horizontal, vertical = (
        r[0, 0, -1] / np.array(table.pitch) for r in table._responses[:3]
    )
    points = np.concatenate([[0.0], vertex_fractions(table.vertices), [1.0]])
    kx, ky = np.zeros((2, len(corners) + 1, len(corners) + 1))
    for axis, (k, along) in enumerate(((kx, vertical), (ky, horizontal))):
        ends = (
            (corners[:-1], corners[1:]) if axis == 0 else (corners[:, :-1], corners[:, 1:])
        )
        line = np.concatenate([ends[0][..., None, :], along, ends[1][..., None, :]], -2)
        mean = np.trapezoid(line[..., axis], points, axis=-1)
        if axis == 0:
            k[1:-1, :-1] = mean
        else:
            k[:-1, 1:-1] = mean
    return kx, ky


# -- nothing ------------------------------------------------------------------------------


def test_effects_at_their_neutral_values_change_no_bit():
    none = sensor_with()
    neutral = sensor_with(
        Ratio({"eps": 0.0}), Bent({"b": 0.0}), Rough({"amp": 0.0}), Shade({"dt": 0.0}),
        Wide({"var": 0.0, "frac": 0.0}), Tail({"amp": 0.0}),
        make_effect("charge_loss", {"q": 0.0}),
        make_effect("interpixel_coupling", {"ax": 0.0, "ay": 0.0}),
    )  # fmt: skip
    images = []
    for sensor in (none, neutral):
        image = blank()
        sensor.accumulate(photons(full=True), image)
        sensor.finish(image)
        areas = sensor.calculate_pixel_areas(image).array
        images.append((image.array, areas, sensor.rng.raw()))
    for one, other in zip(*images, strict=True):
        np.testing.assert_array_equal(one, other)


# -- shifts of boundaries ------------------------------------------------------------------


def test_ratio_scales_every_vertex():
    """Areas of polygons of the table's vertices, scaled by hand."""
    eps, charge = 0.3, 3e4
    sensor = sensor_with(Ratio({"eps": eps}), **PLAIN)
    table = sensor.table
    scale = charge * np.array([1 - eps / 2, 1 + eps / 2])
    corners, horizontal, vertical = (
        r[0, 0, -1] / np.array(table.pitch) * scale for r in table._responses[:3]
    )
    t = vertex_fractions(table.vertices)
    reach, found = table.reach, areas_of(sensor, single(charge))
    for j, i in ((4, 4), (4, 5), (5, 4), (5, 5), (6, 4)):
        zero, one = np.zeros_like(t), np.ones_like(t)
        # Counter-clockwise from the lower left corner.
        at = np.concatenate([
            [[0, 0]], np.stack([t, zero], -1), [[1, 0]], np.stack([one, t], -1), [[1, 1]],
            np.stack([t, one], -1)[::-1], [[0, 1]], np.stack([zero, t], -1)[::-1],
        ])  # fmt: skip
        moved = at + np.concatenate([
            corners[j, i][None], horizontal[j, i], corners[j, i + 1][None],
            vertical[j, i + 1], corners[j + 1, i + 1][None], horizontal[j + 1, i][::-1],
            corners[j + 1, i][None], vertical[j, i][::-1],
        ])  # fmt: skip
        x, y = moved.T
        area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
        # Weights are in single precision, and shifts of 0.02 pixel.
        assert found[j + 10 - reach, i + 10 - reach] == pytest.approx(area, abs=2e-7)
    assert (
        abs(found[10, 11] / areas_of(sensor_with(**PLAIN), single(charge))[10, 11] - 1)
        > 1e-4
    )


def test_ratio_in_covariances_of_flats():
    """Flats from areas against the closed form of shifts that are scaled by hand."""
    eps, level, side = 0.6, 6e4, 384
    sensor = sensor_with(Ratio({"eps": eps}), **PLAIN)
    kx, ky = plain_shifts(sensor)
    sums, count = np.zeros((3, 3)), 0
    for seed in range(6):
        flat = draw_flat(
            sensor, (side, side), level, step=3000.0, rng=galsim.BaseDeviate(seed + 71)
        ).array.astype(float)
        d = flat - flat.mean()
        for j in range(3):
            for i in range(3):
                a, b = d[: side - j, : side - i], d[j:, i:]
                sums[j, i] += (a * b).mean()
        count += 1
    measured = sums / count
    errors = np.full((3, 3), level / np.sqrt(count * side**2))
    errors[0, 0] *= np.sqrt(2)
    chi2 = {}
    for e in (eps, 0.0):
        a = area_matrix((1 - e / 2) * kx, (1 + e / 2) * ky)
        c = flat_covariances_of(a, [level], lags=2)[0]
        chi2[e] = float((((measured - c) / errors) ** 2).sum())
    # 9 degrees of freedom: 33.7 is passed once in 10,000.
    assert chi2[eps] < 33.7 < 60 < chi2[0.0]


def test_added_shifts_move_each_edge_by_their_mean_and_keep_the_area():
    """First order by hand, from shifts that neither are smooth nor know of one another."""
    amp, charge = 1e-8, 1e4
    kx, ky = Tail({"amp": amp}).edges(*np.zeros((2, 15, 15)), None, None)
    added = area_matrix(kx, ky)[
        1:-1, 1:-1
    ]  # 15 x 15: as far as the engine lets charges act
    images = [
        areas_of(sensor_with(*e, **PLAIN), single(charge, 25))
        for e in ((), (Tail({"amp": amp}),))
    ]
    change = (images[1] - images[0])[5:-5, 5:-5]
    # Areas are quadratic in shifts: 5e-3 of the table's times 1e-4 twice; and single precision.
    np.testing.assert_allclose(change, charge * added, atol=3e-6)
    assert np.abs(charge * added).max() > 3e-4


def test_polygons_tile_under_added_shifts():
    """Areas gained and lost are equal to all orders: corners stay common to four pixels."""
    areas = areas_of(sensor_with(Tail({"amp": 1e-6}), **PLAIN), single(2e4, 25))
    # Shifts of 0.02 pixel: where corners part, 4e-4 of area for each of 170 is lost or gained.
    assert np.abs(areas - 1).max() > 0.03
    assert abs((areas - 1).sum()) < 3e-6


def test_added_and_scaled_shifts_follow_one_another():
    """Factors of an effect act on what the one before added."""
    one = areas_of(
        sensor_with(Tail({"amp": 1e-8}), Ratio({"eps": 0.2}), **PLAIN), single(1e4)
    )
    kx, ky = Tail({"amp": 1e-8}).edges(*np.zeros((2, 15, 15)), None, None)
    base = areas_of(sensor_with(Ratio({"eps": 0.2}), **PLAIN), single(1e4))
    expected = 1e4 * area_matrix(0.9 * kx, 1.1 * ky)[1:-1, 1:-1]
    np.testing.assert_allclose((one - base)[3:-3, 3:-3], expected, atol=3e-6)


def test_transposed_sensors_turn_effects():
    charges = np.random.default_rng(8).poisson(2e4, (19, 27)).astype(float)
    tear = make_effect("tearing", {"amp": 0.1, "length": 2.0, "column": 0.5, "open": 1.0})
    layout = {"shape": (19, 27)}
    effects = Ratio({"eps": 0.3}), tear, Rough({"amp": 0.01})
    upright = areas_of(sensor_with(*effects, layout=layout), charges)
    turned = areas_of(sensor_with(*effects, layout=layout, transpose=True), charges.T)
    np.testing.assert_allclose(turned, upright.T, atol=1e-6)


# -- responses that grow with charge -------------------------------------------------------


@pytest.mark.parametrize("b", [-3e-6, 2e-6])
def test_bend_is_that_of_the_law(b):
    """Charges of a linear sensor, changed by hand to Q (1 + b Q / 2)."""
    charges = np.random.default_rng(61).uniform(0, 6e4, (21, 21))
    bent = areas_of(sensor_with(Bent({"b": b}), **PLAIN), charges)
    by_hand = areas_of(sensor_with(**PLAIN), charges * (1 + b * charges / 2))
    straight = areas_of(sensor_with(**PLAIN), charges)
    # Steps of 1000 e- leave |b| 1000^2 / 8 electrons, 0.4 of them; a is 3e-6 per electron.
    np.testing.assert_allclose(bent, by_hand, atol=3e-6)
    assert np.abs(bent - straight).max() > 1e-3


def test_bend_of_the_whole_table_is_differential():
    """Fluctuations about a background B act (1 + b B) times, whatever the table's own law."""
    b, level = -3e-6, 5e4
    charges = level + 500.0 * np.random.default_rng(62).normal(size=(41, 41))
    changes = [
        areas_of(sensor_with(*e), charges)[8:-8, 8:-8] - 1 for e in ((), (Bent({"b": b}),))
    ]
    ratio = (changes[0] * changes[1]).sum() / (changes[0] ** 2).sum()
    # The next order is b times the fluctuations; all modes interpolate in the background.
    assert ratio == pytest.approx(1 + b * level, abs=3e-3)


def test_bend_in_growth_of_spots():
    """Photons of spots against the diagnosis' own deterministic spots, and its error from spots."""
    b, flux, sigma, spots = -6e-6, 500_000, 1.0, 8
    rng = np.random.default_rng(404)
    phases = rng.uniform(-0.5, 0.5, (spots, 2))
    plain = {**PLAIN, "diffusion_factor": 0.0}
    sensors = sensor_with(**plain), sensor_with(Bent({"b": b}), **plain)
    side = np.arange(21) - 10.0
    changes = np.zeros((spots, 2))
    for n, (px, py) in enumerate(phases):
        x, y = rng.normal(0, sigma, (2, flux))
        light = galsim.PhotonArray(flux, x + px, y + py, np.ones(flux))
        moments = []
        for sensor in sensors:
            # The same photons fall in both: what differs is what boundaries moved.
            image = draw(sensor, light, dtype=np.float64)
            mx, my = (image @ side).sum() / flux, (side @ image).sum() / flux
            moments.append([(image @ side**2).sum() / flux - mx**2,
                            (side**2 @ image).sum() / flux - my**2])  # fmt: skip
        changes[n] = np.subtract(*moments[::-1])
    kx, ky = plain_shifts(sensors[0])
    said = []
    for law in (Law(), Law(bend=b)):
        images = grow_spots(
            kx, ky, sigma=(sigma, sigma), phases=phases, flux=float(flux), steps=32, law=law
        )[-1] / flux  # fmt: skip
        half = np.arange(images.shape[-1]) - images.shape[-1] // 2
        columns, rows = images.sum(1), images.sum(2)
        said.append(np.stack([
            columns @ half**2 - (columns @ half) ** 2, rows @ half**2 - (rows @ half) ** 2
        ], 1).mean(0))  # fmt: skip
    expected = said[1] - said[0]
    found, error = changes.mean(0), changes.std(0, ddof=1) / np.sqrt(spots)
    # The deterministic spots leave out what two shifts share at a corner: 2 % of the change.
    assert np.all(np.abs(found - expected) < 4 * error + 0.02 * np.abs(expected))
    assert np.all(np.abs(expected) > 15 * error)


# -- loss and full well --------------------------------------------------------------------


def test_charge_loss_of_photons():
    r"""dm/dL = exp(-q m): m = log(1 + q L) / q, and dC/dm = 1 - 2 q C."""
    q, light, shape = 1e-4, 1e4, (40, 40)
    loss = make_effect("charge_loss", {"q": q})
    sensor = sensor_with(loss, strength=0.0, diffusion_factor=0.0)
    count = int(light * shape[0] * shape[1])
    image = galsim.ImageF(shape[1], shape[0])
    added = sensor.accumulate(flat_photons(shape, count, 515), image)
    lost = sensor.diagnostics["lost"]
    assert added + lost == count
    assert image.array.sum() == pytest.approx(added, rel=1e-6)
    mean = np.log1p(q * light) / q
    variance = -np.expm1(-2 * q * mean) / (2 * q)
    pixels = image.array.size
    # The number of photons is fixed, which takes their common part away: 1 / pixels of it.
    assert image.array.mean() == pytest.approx(mean, abs=4 * np.sqrt(variance / pixels))
    assert image.array.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / pixels))
    assert variance < 0.6 * mean  # without loss it is the mean


def test_charge_loss_of_flats_from_areas():
    q, light = 3e-6, 8e4
    loss = make_effect("charge_loss", {"q": q})
    sensor = sensor_with(loss, strength=0.0)
    flat = draw_flat(sensor, (256, 256), light, rng=galsim.BaseDeviate(19)).array.astype(
        float
    )
    mean = np.log1p(q * light) / q
    variance = -np.expm1(-2 * q * mean) / (2 * q)
    assert flat.mean() == pytest.approx(mean, abs=4 * np.sqrt(variance) / 256)
    assert flat.var() == pytest.approx(variance, rel=4 * np.sqrt(2) / 256)
    assert variance < 0.9 * mean


def test_full_well_of_effects_spills_along_the_column():
    well = 3000.0
    sensor = sensor_with(Full({"full_well": well}))
    image = blank()
    added = sensor.accumulate(photons(100_000, width=1.0), image)
    assert image.array.max() == well
    assert image.array.sum() == pytest.approx(added)
    assert sensor.diagnostics["spilled"] > 1000
    without = draw(sensor_with(), photons(100_000, width=1.0))
    assert without.max() > 1.5 * well
    # Along y alone: columns keep their electrons but for those that other boundaries caught.
    np.testing.assert_allclose(image.array.sum(0), without.sum(0), rtol=0.05, atol=100)
    with pytest.raises(SensorError, match="do not spill"):
        draw_flat(sensor, (32, 32), 2990.0)


# -- standing displacements ----------------------------------------------------------------


def test_tearing_in_areas_of_columns():
    tear = make_effect("tearing", {"amp": 0.1, "length": 2.0, "column": 0.5, "open": 1.0})
    sensor = sensor_with(
        tear, layout={"shape": (24, 64)}, strength=0.0, diffusion_factor=0.0
    )
    moved = 0.1 * np.exp(-np.abs(np.arange(65) - 32) / 2.0)
    areas = areas_of(sensor, np.zeros((24, 64)))
    np.testing.assert_allclose(areas, np.tile(1 + np.diff(moved), (24, 1)), atol=2e-6)
    count = 3_000_000
    image = galsim.ImageD(64, 24)
    sensor.accumulate(flat_photons((24, 64), count, 44), image)
    columns = image.array.sum(0) / (count / 64) - 1
    pulls = (columns - np.diff(moved)) / np.sqrt(64 / count)
    # 64 columns: a chi-square above 120 comes once in 30,000; the tear is 7 sigma in some.
    assert (pulls**2).sum() < 120 < (columns**2).sum() * count / 64
    # On stamps: the place on the sensor counts.
    stamp = areas_of(sensor, np.zeros((9, 9)), galsim.PositionI(28, 5))
    np.testing.assert_allclose(stamp, areas[5:14, 28:37], atol=1e-7)


def test_edges_without_order_move_by_just_as_much():
    """Means along each edge, however unlike its neighbours', in areas and by photons."""
    shape, amp = (20, 20), 0.02
    effect = Rough({"amp": amp})
    sensor = sensor_with(
        effect, layout={"shape": shape}, strength=0.0, diffusion_factor=0.0
    )
    x, y = effect.displacements(None, sensor.layout)
    first = np.diff(x, axis=1) + np.diff(y, axis=0)
    areas = areas_of(sensor, np.zeros(shape))
    # What is left is second order: 0.02^2 of several products each.
    assert (areas - 1 - first).std() < 4 * amp**2 < 0.05 * first.std()
    count = 4_000_000
    image = galsim.ImageD(*shape[::-1])
    sensor.accumulate(flat_photons(shape, count, 45), image)
    # Rims count the light that falls beside the sensor too, or lose it.
    inside = np.s_[1:-1, 1:-1]
    found = image.array * (shape[0] * shape[1] / count)
    pulls = (found - areas)[inside] / np.sqrt(400 / count)
    assert (pulls**2).sum() < 324 + 4 * np.sqrt(2 * 324)
