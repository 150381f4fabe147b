"""Each effect, switched on alone, leaves what its definition says to first order.

Twins share all noise, so what is left of it is the rounding of codes (0.6 e-) and what the
effect itself makes of the noise.
"""

import numpy as np
import pytest

from tests.validation.concealed.twins import (
    electrons,
    exposure,
    image_twins,
    take_twins,
)
from validation.concealed.library import EFFECTS, make_effect
from validation.concealed.plan import Geometry, Size, exposures_of
from validation.concealed.sensor import VirtualSensor

GEOMETRY = Geometry(128)
LAST = GEOMETRY.prescan + GEOMETRY.width  # first overscan column
FLAT = exposure("FLAT", 40.0)
BIAS = exposure("BIAS", 0.0)
TINY = Size(64, 1, 1, dithers=1, flat_seconds=(1.0, 60.0), spot_seconds=(30.0,))


def _one_of_each():
    """The first exposure of each kind, time and condition, in the order of time."""
    kinds = {}
    for e in exposures_of(TINY):
        key = (e.kind, e.seconds, e.wavelength, e.back_bias, e.temperature)
        kinds.setdefault(key, e)
    return list(kinds.values())


def _frames(*effects):
    sensor = VirtualSensor(Geometry(64), seed=4711, effects=effects)
    return [sensor.take(e).frames for e in _one_of_each()]


@pytest.fixture(scope="module")
def reference():
    return _frames()


@pytest.mark.parametrize(
    ("word", "variant"), [(w, v) for w, e in EFFECTS.items() for v in e.variants]
)
def test_off_changes_no_bit_and_on_changes_some(word, variant, reference):
    effect = EFFECTS[word].draw(np.random.default_rng(12), 0.8, variant)
    off = _frames(effect.neutral())
    assert all(
        np.array_equal(a, b)
        for x, y in zip(reference, off, strict=True)
        for a, b in zip(x, y, strict=True)
    )
    on = _frames(effect)
    assert any(
        (a != b).any()
        for x, y in zip(reference, on, strict=True)
        for a, b in zip(x, y, strict=True)
    )


def test_serial_cti_in_the_first_overscan_pixel():
    (off, on), *_ = take_twins(make_effect("cti_serial", {"cti": 5e-6}), [FLAT])
    for a, b in zip(off, on, strict=True):
        signal = a[: GEOMETRY.pixels, LAST - 1].mean()
        left = (b - a)[: GEOMETRY.pixels, LAST].mean()
        assert left == pytest.approx(5e-6 * LAST * signal, rel=0.01)
        # what a column loses and gains: f N S there, f (N - 1) S from the one before
        assert (b - a)[: GEOMETRY.pixels, LAST - 1].mean() == pytest.approx(
            -5e-6 * signal, abs=0.3
        )


def test_parallel_cti_in_the_first_overscan_row():
    (off, on), *_ = take_twins(make_effect("cti_parallel", {"cti": 5e-6}), [FLAT])
    n, columns = GEOMETRY.pixels, slice(GEOMETRY.prescan, LAST)
    signal = off[0][n - 1, columns].mean()
    assert (on[0] - off[0])[n, columns].mean() == pytest.approx(5e-6 * n * signal, rel=0.02)


def test_serial_trap_releases_by_its_time():
    effect = make_effect("trap_serial", {"size": 60.0, "tau": 2.0, "amp": 1.0})
    for seconds in (1.0, 40.0):  # the same at any signal
        (off, on), *_ = take_twins(effect, [exposure("FLAT", seconds)])
        tail = (on[1] - off[1])[: GEOMETRY.pixels, LAST : LAST + 4].mean(axis=0)
        expected = 60 * (1 - np.exp(-0.5)) * np.exp(-0.5 * np.arange(4))
        assert tail == pytest.approx(expected, abs=0.3)
        assert np.array_equal(on[0], off[0])


def test_memory_is_the_same_in_all_columns():
    (off, on), *_ = take_twins(make_effect("electronic_memory", {"alpha": 5e-4}), [FLAT])
    light = off[0][: GEOMETRY.pixels]
    change = (on[0] - off[0])[: GEOMETRY.pixels]
    for column in (GEOMETRY.prescan + 1, GEOMETRY.prescan + 30, LAST):
        assert change[:, column].mean() == pytest.approx(
            5e-4 * light[:, column - 1].mean(), rel=0.01
        )


def test_crosstalk_goes_to_the_other_amplifier():
    (off, on), *_ = take_twins(
        make_effect("amp_crosstalk", {"c": -4e-4}), [exposure("SPOT", 25.0)]
    )
    for victim in (0, 1):
        aggressor = off[1 - victim].ravel()
        slope = aggressor @ (on[victim] - off[victim]).ravel() / (aggressor @ aggressor)
        assert slope == pytest.approx(-4e-4, rel=0.02)


@pytest.mark.parametrize("variant", ["ar1", "common", "pickup"])
def test_correlated_noise(variant):
    """RMS 3 e-: std to 3 % (2e4 pixels, 0.8 after 1/(1-corr) fewer independent ones: 1.5 %)."""
    values = {"ar1": {"corr": 0.5}, "common": {}, "pickup": {"period": 11.0}}[variant]
    effect = make_effect("correlated_noise", {"rms": 3.0, **values}, variant)
    (off, on), *_ = take_twins(effect, [BIAS])
    one, two = ((b - a).ravel() for a, b in zip(off, on, strict=True))
    rounding = 2 * 2.2**2 / 12
    assert np.sqrt(one.var() - rounding) == pytest.approx(3.0, rel=0.04)
    lag = np.mean(one[1:] * one[:-1]) / 9
    between = np.mean(one * two) / 9
    expected = {"ar1": (0.5, 0), "common": (0, 1), "pickup": (np.cos(2 * np.pi / 11), 1)}
    assert (lag, between) == pytest.approx(expected[variant], abs=0.05)


def test_bias_instability():
    biases = [exposure("BIAS", 0.0, k) for k in range(40)]
    twins = take_twins(make_effect("bias_instability", {"rms": 3.0}, "frame"), biases)
    moved = [(on[0] - off[0]).mean() for off, on in twins]
    assert np.std(moved) == pytest.approx(3.0, rel=0.4)  # 40 frames: 11 %
    (off, on), *_ = take_twins(
        make_effect("bias_instability", {"rms": 3.0}, "row"), biases[:1]
    )
    assert (on[0] - off[0]).mean(axis=1).std() == pytest.approx(3.0, rel=0.25)
    ramp = make_effect("bias_instability", {"amp": 20.0, "length": 10.0}, "ramp")
    (off, on), *_ = take_twins(ramp, biases[:1])
    shape = (on[0] - off[0]).mean(axis=0)
    assert shape[[0, 10, 40]] == pytest.approx(20 * np.exp([0, -1, -4]), abs=0.4)


def test_nonlinearity_gain_drift_and_last_level():
    effect = make_effect("gain_nonlinearity", {"c2": 0.01, "c3": -0.004})
    (off, on), *_ = image_twins(effect, [FLAT])
    s = off.mean() / 1e5
    assert on.mean() / off.mean() - 1 == pytest.approx(0.01 * s - 0.004 * s * s, rel=0.01)
    late = [exposure("FLAT", 20.0, k) for k in (0, 2)]
    for (off, on), change in zip(
        image_twins(make_effect("gain_drift", {"slope": 0.01}), late),
        (0.0, 0.02),
        strict=True,
    ):
        assert on.mean() / off.mean() - 1 == pytest.approx(change, abs=1e-6)
    twins = image_twins(make_effect("outside_library", {"amp": 0.01}, "last_level"), late)
    assert twins[0][1].mean() == twins[0][0].mean()
    raw = 40_000 * GEOMETRY.pixels * GEOMETRY.width / np.prod(GEOMETRY.raw_shape)
    assert twins[1][1].mean() / twins[1][0].mean() - 1 == pytest.approx(
        -0.01 * raw / 1e5, rel=0.1
    )


def test_converter_bits_widen_codes():
    effect = make_effect("adc_bits", {"delta": 0.5, "bit": 4})
    ramp = np.arange(1000, 1256, 0.01)
    code = effect.converter([ramp], None)[0]
    widths = np.bincount(code.astype(int))[1001:1250] * 0.01
    numbers = np.arange(1001, 1250)
    before = numbers % 32 == 15  # the code before bit 4 sets is wider by delta
    assert widths[before] == pytest.approx(1.5, abs=0.02)
    after = numbers % 32 == 31  # and the one before it clears narrower
    assert widths[after] == pytest.approx(0.5, abs=0.02)
    assert widths[~before & ~after] == pytest.approx(1.0, abs=0.02)


def test_charge_loss_and_saturation():
    q = 3e-7
    (off, on), *_ = image_twins(
        make_effect("charge_loss", {"q": q}), [exposure("FLAT", 60.0)]
    )
    light = off.mean()
    # dQ = exp(-q Q) dL: Q = ln(1 + q L) / q
    assert on.mean() - light == pytest.approx(np.log1p(q * light) / q - light, rel=0.01)
    (off, on), *_ = image_twins(
        make_effect("saturation", {"full_well": 7e4}), [exposure("SPOT", 30.0)]
    )
    assert on.max() < 7e4 + 60 < off.max()
    assert on.sum() == pytest.approx(off.sum(), rel=1e-3)
    y, x = np.indices(on.shape)
    spread = [((on - off) * (c % 30 - 18) ** 2).sum() / off.sum() for c in (x, y)]
    assert spread[1] > 0.05 and spread[1] > 3 * abs(
        spread[0]
    )  # up the column, not along the row


def test_persistence_decays_by_exposure():
    effect = make_effect("persistence", {"frac": 1e-3, "tau": 1.5})
    order = [exposure("FLAT", 40.0, 0)] + [exposure("DARK", 15.0, k) for k in (1, 2, 3)]
    twins = image_twins(effect, order)
    signal = twins[0][0].mean()
    for k in (1, 2, 3):
        left = (twins[k][1] - twins[k][0]).mean()
        # 16384 pixels of Poisson: 0.4 to 1 %
        assert left == pytest.approx(1e-3 * signal * np.exp(-k / 1.5), rel=0.04)


def test_dark_current_shutter_fringes_and_turbulence():
    (off, on), *_ = image_twins(
        make_effect("dark_hot", {"rate": 0.5}, "dark"), [exposure("DARK", 60.0)]
    )
    assert (on - off).mean() == pytest.approx(30.0, rel=0.01)
    hot = make_effect("dark_hot", {"rate": 5.0, "columns": 3}, "hot")
    (off, on), *_ = image_twins(hot, [exposure("DARK", 60.0)])
    columns = (on - off).mean(axis=0)
    assert (columns > 150).sum() == 3 and np.sort(columns)[:-3] == pytest.approx(0, abs=0.5)
    effect = make_effect("shutter_timing", {"dt": 0.05, "shade": 0.4})
    (off, on), *_ = image_twins(effect, [exposure("FLAT", 1.0)])
    ratio = (on.sum(axis=0) / off.sum(axis=0) - 1) / 0.05
    # the left half has 1 - 0.2, the right one 1 + 0.2; shot noise of the extra light 0.8 %
    assert (ratio[:64].mean(), ratio[64:].mean()) == pytest.approx((0.8, 1.2), rel=0.05)
    red, blue = exposure("FLAT", 20.0, wavelength=950.0), exposure("FLAT", 20.0)
    effect = make_effect("fringing", {"amp": 0.02, "period": 30.0})
    (off, on), (off_blue, on_blue) = image_twins(effect, [red, blue])
    assert np.array_equal(off_blue, on_blue)
    assert np.std((on - off) / off.mean()) == pytest.approx(0.02 / np.sqrt(2), rel=0.1)
    effect = make_effect("illumination_turbulence", {"rms": 2e-3, "corr": 10.0})
    order = [exposure("FLAT", 40.0, k) for k in range(6)]
    maps = [(on - off) / off.mean() for off, on in image_twins(effect, order)]
    assert np.mean([np.mean(m**2) for m in maps]) == pytest.approx(4e-6, rel=0.3)
    lagged = np.mean([np.mean(m[:, 10:] * m[:, :-10]) for m in maps])
    assert lagged / np.mean([np.mean(m**2) for m in maps]) == pytest.approx(0.61, abs=0.15)
    assert abs(np.corrcoef(maps[0].ravel(), maps[1].ravel())[0, 1]) < 0.3


def test_cosmic_rays():
    darks = [exposure("DARK", 55.0, k) for k in range(20)]
    twins = image_twins(make_effect("cosmic_rays", {"rate": 16.0}), darks)
    number = [((on - off) > 0).any() and (on - off).sum() for off, on in twins]
    total = np.sum(number)
    # 4 a minute and frame of 128 x 128; at least 100 um at 80 e-/um each; tails outside
    assert 20 * 4 * 8e3 < total < 20 * 4 * 8e3 * 5


def test_coupling_spreads_spots():
    effect = make_effect("interpixel_coupling", {"ax": 3e-3, "ay": 1e-3})
    (off, on), *_ = image_twins(effect, [exposure("SPOT", 25.0)])
    for axis, alpha in ((1, 3e-3), (0, 1e-3)):
        other = 1 - axis
        template = np.roll(off, 1, axis) + np.roll(off, -1, axis) - 2 * off
        line = (on - off).sum(axis=other)
        shape = template.sum(axis=other)
        assert line @ shape / (shape @ shape) == pytest.approx(alpha, rel=0.03)
    assert on.sum() == pytest.approx(off.sum(), rel=1e-5)


def _moments(stamp_image, centre=18, pitch=30, reach=9):
    """Sums over spots on the grid: flux, mean x and y, variance in x and y."""
    total = np.zeros(5)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    for row in range(centre, stamp_image.shape[0] - reach, pitch):
        for column in range(centre, stamp_image.shape[1] - reach, pitch):
            spot = stamp_image[
                row - reach : row + reach + 1, column - reach : column + reach + 1
            ]
            flux = spot.sum()
            mx, my = (spot * x).sum() / flux, (spot * y).sum() / flux
            total += (
                flux,
                mx,
                my,
                (spot * (x - mx) ** 2).sum() / flux,
                (spot * (y - my) ** 2).sum() / flux,
            )
    return total / len(range(centre, stamp_image.shape[0] - reach, pitch)) ** 2


def test_diffusion_and_wings_of_spots():
    effect = make_effect("lateral_diffusion", {"var": 0.2})
    (off, on), *_ = image_twins(effect, [exposure("SPOT", 7.5)])
    change = _moments(on) - _moments(off)
    assert change[3:] == pytest.approx([0.2, 0.2], abs=0.03)  # less brighter-fatter: 1 %
    warm = exposure("SPOT", 7.5, back_bias=-40.0, temperature=-80.0)
    (off, on), *_ = image_twins(effect, [warm])
    more = 0.2 * (68 / 48) * (193.15 / 173.15)
    assert (_moments(on) - _moments(off))[3:] == pytest.approx([more, more], abs=0.04)
    effect = make_effect("psf_wings", {"frac": 0.05, "sigma": 4.0})
    (off, on), *_ = image_twins(effect, [exposure("SPOT", 7.5)])
    assert on.sum() == pytest.approx(off.sum(), rel=2e-3)
    y, x = np.indices(on.shape)
    far = np.hypot((x - 3) % 30 - 15, (y - 3) % 30 - 15) > 6
    outside = np.exp(-36 / 2 / (16 + 1.1))  # of a Gaussian of two dimensions beyond r = 6
    assert (on - off)[far].sum() / off.sum() == pytest.approx(0.05 * outside, rel=0.05)


def test_standing_edges_change_areas():
    flat = exposure("FLAT", 5.0)
    n = 128
    effect = make_effect("mask_stitch", {"amp": 0.01, "period": 32})
    (off, on), *_ = image_twins(effect, [flat])
    columns = (on - off).mean(axis=0) / off.mean()
    # brighter-fatter gives back 2 % at 1e4 e-; noise of the difference 1e-3 / sqrt(128)
    assert columns[[31, 32, 63, 64]] == pytest.approx([0.01, -0.01] * 2, abs=5e-4)
    assert abs(np.delete(columns, [31, 32, 63, 64, 95, 96])).max() < 6e-4
    effect = make_effect("tearing", {"amp": 0.2, "length": 2.0, "column": 0.5})
    (off, on), *_ = image_twins(effect, [flat])
    columns = (on - off)[:40].mean(axis=0) / off.mean()
    step = 0.2 * (1 - np.exp(-0.5))
    assert columns[[63, 64]] == pytest.approx([step, -step], rel=0.06)
    effect = make_effect("edge_rolloff", {"amp": 0.3, "length": 3.0})
    (off, on), *_ = image_twins(effect, [flat])
    change = (on - off)[30:-30, 30:-30].mean() / off.mean()
    columns = (on - off)[30:-30].mean(axis=0) / off.mean()
    step = 0.3 * (1 - np.exp(-1 / 3))
    assert abs(change) < 1e-3
    assert columns[[0, -1]] == pytest.approx([step, step], rel=0.08)
    values = {"amp": 0.05, "period": 24.0, "xc": -60.0, "yc": 300.0, "chirp": 0.0}
    (off, on), *_ = image_twins(make_effect("tree_rings", values), [flat])
    y, x = np.indices((n, n))
    r = np.hypot(x + 60, y - 300)
    rings = 2 * np.pi * 0.05 / 24 * np.cos(2 * np.pi * r / 24)
    seen = (on - off) / off.mean()
    assert (seen * rings).sum() / (rings**2).sum() == pytest.approx(1, abs=0.06)


def test_foreign_signals():
    (off, on), *_ = take_twins(
        make_effect("outside_library", {"amp": 5e-3}, "echo"), [FLAT]
    )
    light = off[0][: GEOMETRY.pixels]
    seen = (on[0] - off[0])[: GEOMETRY.pixels]
    assert seen[:, LAST + 6].mean() == pytest.approx(
        5e-3 * light[:, LAST - 1].mean() ** 2 / 1e5, rel=0.01
    )
    assert seen[:, LAST + 7].mean() == pytest.approx(0, abs=0.2)
    effect = make_effect("outside_library", {"amp": 5e-3}, "checkerboard")
    (off, on), *_ = image_twins(effect, [FLAT])
    y, x = np.indices(off.shape)
    even = (x + y) % 2 == 0
    step = (on - off)[even].mean() - (on - off)[~even].mean()
    assert step == pytest.approx(5e-3 * np.mean(off**2) / 1e5, rel=0.02)
    effect = make_effect("outside_library", {"amp": 5e-3, "period": 9.0}, "ripple")
    (off, on), *_ = take_twins(effect, [FLAT])
    time = np.arange(off[0].size).reshape(off[0].shape)
    wave = np.sin(2 * np.pi * time / 9.0) * off[0]
    assert ((on[0] - off[0]) * wave).sum() / (wave**2).sum() == pytest.approx(
        5e-3, rel=0.01
    )


def test_odd_kernel_moves_spots_and_leaves_flats():
    effect = make_effect("outside_library", {"amp": 0.4}, "odd_kernel")
    spots, flat = exposure("SPOT", 30.0), exposure("FLAT", 40.0)
    (off, on), (flat_off, flat_on) = image_twins(effect, [spots, flat])
    change = _moments(on) - _moments(off)
    assert change[1] < -0.005  # edges to +x on both sides: charge lands in lower columns
    assert abs(change[2]) < abs(change[1]) / 10

    def neighbours(picture):
        d = picture - picture.mean()
        return np.mean(d[:, 1:] * d[:, :-1]) + np.mean(d[:, 2:] * d[:, :-2])

    even = neighbours(flat_on) - neighbours(flat_off)
    assert abs(even) < 0.1 * np.var(flat_off)


def test_electronics_are_recovered_by_simple_statistics():
    """Gain from pairs at 5e3 e- (brighter-fatter lowers the variance by 1.7 %), noise, offset."""
    sensor = VirtualSensor(Geometry(256), seed=8086)
    bias = [sensor.take(exposure("BIAS", 0.0, k)).frames for k in range(2)]
    pairs = [sensor.take(exposure("FLAT", 2.5, k)).frames for k in range(2, 6)]
    g = Geometry(256)
    light = np.s_[: g.pixels, g.prescan : g.prescan + g.width]
    for k in range(2):
        e = sensor.electronics
        assert bias[0][k].mean() == pytest.approx(e.offset[k], abs=0.06)
        noise = np.std(bias[0][k].astype(float) - bias[1][k]) / np.sqrt(2)
        assert np.sqrt(noise**2 - 1 / 12) * e.gain[k] == pytest.approx(e.noise[k], rel=0.02)
        flats = [p[k][light].astype(float) - e.offset[k] for p in pairs]
        mean = np.mean(flats)
        var = np.mean([np.var(flats[i] - flats[i + 1]) / 2 for i in (0, 2)]) - noise**2
        mu = mean * e.gain[k]
        assert mu == pytest.approx(
            sensor.lamp.flat_rate * 2.5, rel=5e-3
        )  # gradient, lamp walk
        # 2 pairs of 32768 pixels: 0.55 %; brighter-fatter 3.6e-6 mu
        assert mean / var == pytest.approx(
            e.gain[k] ** -1 * e.gain[k] ** 2 / (1 - 3.6e-6 * mu), rel=0.025
        )


def test_frames_in_electrons_have_the_level_of_the_truth():
    sensor = VirtualSensor(Geometry(64), seed=3)
    frames = electrons(sensor, sensor.take(exposure("FLAT", 20.0)))
    assert frames[0][:64, 8:40].mean() == pytest.approx(
        20 * sensor.lamp.flat_rate, rel=0.01
    )
    assert abs(frames[0][:, 40:].mean()) < 0.5
