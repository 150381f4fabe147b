"""Readout effects on small frames against what shares no code with them: loops and closed forms."""

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares

from bfsensor.effects.adc_bits import AdcBits
from bfsensor.effects.dark_hot import HotColumns
from bfsensor.effects.effect import Effect, Layout, Segment, Shot
from bfsensor.effects.library import LIBRARY, make_effect
from bfsensor.effects.transfer import behind_flat, late_shares
from tests.validation.effects.parity import RANDOM
from tests.validation.effects.test_readout_parity import KINDS, NAMES
from validation.concealed.plan import Exposure as Taken
from validation.concealed.plan import Geometry
from validation.concealed.readout import Context, Electronics
from validation.effects.effect_parity import effect_at, own_effect

SEGMENTS = (
    Segment(0, 0, 10, 12, False, False, 3, 8, 8),
    Segment(10, 0, 10, 12, True, False, 3, 8, 8),
)
LAYOUT = Layout(
    (12, 20), SEGMENTS, gains=(2.0, 2.5), offsets=(1000.3, 1017.8), read_noise=(2.5, 2.0)
)
SHAPE = (20, 21)
SHOT = Shot("flat", 3, 5.0, hours=1.5, level=1e4)
CHANNELS = (
    "flat_mean", "serial_overscan", "parallel_overscan", "bias_cov", "bias_level", "dark_map",
    "amp_cross", "code_hist",
)  # fmt: skip


def frames(seed=5):
    rng = np.random.default_rng(seed)
    out = np.zeros((2, *SHAPE), np.float32)
    out[:, :12, 3:13] = rng.poisson(2000, (2, 12, 10))
    return list(out)


def through(effect, seed=7):
    """Frames [e-] and their codes after all stages of readout."""
    given = [effect.shift(f, n, LAYOUT) for n, f in enumerate(frames())]
    given = effect.amplify(given, SHOT, LAYOUT)
    given = effect.noise(given, LAYOUT, np.random.default_rng(seed))
    return given, [effect.convert(f / 2.0 + 1000.3) for f in given]


def axes():
    n = 24
    return {
        "amp": np.arange(n) % 2, "other": 1 - np.arange(n) % 2, "level": np.linspace(10.0, 1e5, n),
        "time": np.ones(n), "hours": np.linspace(0, 2, n), "k": 1.0 + np.arange(n) % 8,
        "lag": np.arange(n), "code": np.where(np.arange(n) < 20, np.arange(n), -1),
        "bit": np.where(np.arange(n) < 20, -1, 6), "share": np.full(n, 0.25),
        "what": np.resize(["rows", "level", "frames", "noise", "crosstalk"], n),
    }  # fmt: skip


def neutral(kind):
    return effect_at(kind, 0.9).scaled(0.0)


@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_off_changes_no_bit_of_pixels(kind):
    (plain, codes), (same, same_codes) = through(Effect({})), through(neutral(kind))
    assert all(np.array_equal(a, b) for a, b in zip(plain, same, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(codes, same_codes, strict=True))
    assert all(a.dtype == b.dtype for a, b in zip(plain, same, strict=True))
    changed, wrong = through(effect_at(kind, 0.9))
    if kind is AdcBits:
        assert any(
            (np.rint(a) != np.rint(b)).any() for a, b in zip(codes, wrong, strict=True)
        )
    else:
        assert any((a != b).any() for a, b in zip(plain, changed, strict=True))


@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_off_changes_no_bit_of_predictions(kind):
    effect, on = neutral(kind), effect_at(kind, 0.9)
    x = axes()
    for word in CHANNELS:
        assert not np.any(getattr(effect, word)(x, LAYOUT)), word
        if np.any(getattr(on, word)(x, LAYOUT)):
            assert word in kind.touches, word
    rng = np.random.default_rng(3)
    c = rng.standard_normal((24, 16, 16))
    images = rng.uniform(0, 1e4, (3, 21, 21))
    assert np.array_equal(effect.signal(x["level"], x, LAYOUT), x["level"])
    assert np.array_equal(effect.covariances(c, x, LAYOUT), c)
    assert np.array_equal(effect.spot_image(images, {}, LAYOUT), images)
    pattern = effect.pattern(SHOT, LAYOUT)
    assert pattern is None or not pattern.any()


@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_pixels_are_those_of_the_sensors_own_effect(kind):
    """Noise apart, that each draws for itself."""
    effect = effect_at(kind, 0.9)
    geometry = Geometry(32, 2, 3, 8, 8)
    own = own_effect(effect)
    taken = Taken("FLAT", 3, 60000.0 + 1.5 / 24, 5.0)
    context = Context(
        taken, geometry, lambda word: np.random.default_rng(7),
        Electronics((2.0, 2.5), (5.0, 5.0), (1000.3, 1017.8)), {},
    )  # fmt: skip
    given = frames()
    for stage in ("shift", "amplifier", "noise"):
        given = getattr(own, stage)(given, context)
    ours, codes = through(effect)
    gain = own.gain(context)
    if effect.word in RANDOM and effect.variant != "ramp":
        both = [np.subtract(f, frames()).ravel() for f in (ours, given)]
        # A frame's level is one draw of each amplifier; of the others there are 20 rows at least.
        bound = 10 if effect.variant == "frame" else 2
        assert 1 / bound < np.abs(both[0]).mean() / np.abs(both[1]).mean() < bound
        return
    for a, b in zip(ours, given, strict=True):
        np.testing.assert_allclose(a, gain * b, rtol=2e-6, atol=2e-3)
    theirs = own.converter([f / 2.0 + 1000.3 for f in ours], context)
    for a, b in zip(codes, theirs, strict=True):
        assert np.array_equal(np.rint(a), np.rint(b))


@pytest.mark.parametrize("word", ["cti_serial", "cti_parallel"])
def test_transfers_one_by_one(word):
    """A line of pixels, each of which keeps a part at each clock."""
    cti = 2e-3
    frame = np.zeros((9, 14))
    frame[2:6, 3:9] = np.random.default_rng(2).uniform(1e3, 1e4, (4, 6))
    lines = frame if word == "cti_serial" else frame.T
    brute = np.zeros_like(lines)
    for line, out in zip(lines, brute, strict=True):
        pixels = line.copy()
        for clock in range(len(line)):
            out[clock] = (1 - cti) * pixels[0]
            pixels = cti * pixels + (1 - cti) * np.append(pixels[1:], 0.0)
    found = make_effect(word, {"cti": cti}).shift(frame, 0, LAYOUT)
    found = found if word == "cti_serial" else found.T
    # What is later than six packets: 9 transfers have 3e3 ways of losing 7 times.
    np.testing.assert_allclose(found, brute, rtol=1e-9, atol=1e4 * 6.5e3 * cti**7)
    assert np.abs(found - lines).max() > 10


def test_late_shares_add_up_and_are_late_by_what_theory_says():
    n, cti = 500, 1e-4
    shares = late_shares(n, cti)
    assert abs(shares.sum() - 1) < 1e-9
    # Mean of the negative binomial.
    assert np.arange(len(shares)) @ shares == pytest.approx(n * cti / (1 - cti), rel=1e-6)


def test_behind_flat_is_the_overscan_of_a_flat_frame():
    cti, level = 1e-3, 5e4
    frame = np.zeros((1, 21))
    frame[:, 3:13] = level
    read = make_effect("cti_serial", {"cti": cti}).shift(frame, 0, LAYOUT)[0, 13:]
    k = np.arange(1.0, 9.0)
    found = level * behind_flat(k, np.full(8, 10.0), np.full(8, 3.0), cti)
    np.testing.assert_allclose(found[:6], read[:6], rtol=1e-9, atol=1e-12)
    x = {"amp": np.zeros(8, int), "level": np.full(8, level), "k": k}
    np.testing.assert_allclose(
        make_effect("cti_serial", {"cti": cti}).serial_overscan(x, LAYOUT), found
    )


def test_trap_lowers_the_first_column_and_fills_the_overscan():
    effect = make_effect(
        "trap_serial", {"size": 50.0, "tau": 2.0, "amp": 1.0, "reach": 0.0}
    )
    frame = np.zeros((4, 21))
    frame[:, 3:13] = 3000.0
    assert effect.shift(frame, 0, LAYOUT) is frame
    out = effect.shift(frame, 1, LAYOUT)
    assert np.allclose(out[:, 3], 2950.0) and np.allclose(out[:, 4:13], 3000.0)
    x = {"amp": np.ones(8, int), "level": np.full(8, 3000.0), "k": np.arange(1.0, 9.0)}
    np.testing.assert_allclose(effect.serial_overscan(x, LAYOUT), out[0, 13:])
    np.testing.assert_allclose(effect.flat_mean(x, LAYOUT), out[0, 3:13].mean() - 3000.0)
    pattern = effect.pattern(SHOT._replace(level=3000.0), LAYOUT)
    # Read from the high end: that column is the first.
    assert np.allclose(pattern[:, 19], -50.0 / 3000.0)
    assert np.count_nonzero(pattern) == 12
    assert effect.is_neutral() is False


def test_memory_of_flats_is_a_mean_of_two():
    """Covariances against a long row of white noise."""
    effect = make_effect("electronic_memory", {"alpha": 0.2})
    rng = np.random.default_rng(8)
    frame = rng.standard_normal((400, 500)).astype(np.float32)
    (out,) = effect.amplify([frame], SHOT, LAYOUT)
    slope = 1.2  # of smooth light, which the chain multiplies with
    seen = [np.mean(out[:, : 500 - k] * out[:, k:]) / slope**2 for k in range(3)]
    c = np.zeros((1, 16, 16))
    c[0, 0, 0] = 1.0
    found = effect.covariances(c, {"amp": np.zeros(1)}, LAYOUT)[0, 0, :3]
    np.testing.assert_allclose(found, seen, atol=4 / 200_000**0.5)
    assert found[1] > 0.1


@pytest.mark.parametrize(
    ("variant", "values"),
    [
        ("ar1", {"rms": 3.0, "corr": 0.8}),
        ("common", {"rms": 3.0}),
        ("pickup", {"rms": 3.0, "period": 7.3}),
    ],
)
def test_noise_has_the_covariance_that_is_said(variant, values):
    effect = make_effect("correlated_noise", values, variant)
    rng = np.random.default_rng(4)
    total, width = np.zeros(6), 21
    cross = 0.0
    frames_of = 40
    rows = 0.0
    for _ in range(frames_of):
        a, b = effect.noise([np.zeros((200, width))] * 2, LAYOUT, rng)
        series = a.ravel()
        total += [np.mean(series[: series.size - k] * series[k:]) for k in range(6)]
        cross += np.mean(a * b)
        rows += a.mean(1).var()
        for k in range(1, width // 2 + 1):
            rows -= 2 / width**2 * (a[:, k:] * a[:, :-k]).sum() / len(a)
    lag = np.arange(6)
    said = effect.bias_cov({"amp": np.zeros(6, int), "lag": lag}, LAYOUT)
    # Of 168,000 pixels, tied to ten neighbours each, the covariance is known to 3 %.
    np.testing.assert_allclose(total / frames_of, said, atol=0.35)
    x = {
        "amp": np.zeros(2, int),
        "other": np.ones(2, int),
        "what": np.array(["noise", "rows"]),
    }
    shared = effect.amp_cross(x, LAYOUT)[0]
    assert cross / frames_of == pytest.approx(shared, abs=0.35)
    more = effect.bias_level(x, LAYOUT)[1]
    assert rows / frames_of - 9.0 / width == pytest.approx(more, abs=0.08)
    if variant == "pickup":
        assert abs(more) > 0.05


def test_rows_have_the_covariance_that_is_said():
    effect = make_effect("bias_instability", {"rms": 2.0}, "row")
    rng = np.random.default_rng(6)
    total = np.zeros(6)
    for _ in range(40):
        series = effect.noise([np.zeros((200, 21))], LAYOUT, rng)[0].ravel()
        total += [np.mean(series[: series.size - k] * series[k:]) for k in range(6)]
    said = effect.bias_cov({"amp": np.zeros(6, int), "lag": np.arange(6)}, LAYOUT)
    # 8000 rows: 1.6 % of 4.
    np.testing.assert_allclose(total / 40, said, atol=0.3)
    c = effect.covariances(np.zeros((1, 8, 8)), {"amp": np.zeros(1, int)}, LAYOUT)[0]
    assert np.allclose(c[0], 4.0) and not c[1:].any()


@pytest.mark.parametrize(
    ("variant", "delta", "bit"),
    [
        ("", 0.6, 2), ("", -0.6, 2), ("", 1.7, 5), ("", -1.7, 4), ("", 2.0, 7),
        ("shifted", 3.0, 5), ("shifted", -2.0, 4), ("shifted", 1.0, 2), ("shifted", -2.0, 7),
        ("wide", 0.4, 3), ("wide", -0.4, 4), ("wide", 0.8, 2),
    ],
)  # fmt: skip
def test_codes_are_as_wide_as_is_said(variant, delta, bit):
    """Codes of a fine ramp, counted."""
    place = {"place": -1.0} if variant == "wide" else {}
    effect = make_effect("adc_bits", {"delta": delta, "bit": float(bit)} | place, variant)
    fine = np.arange(0, 2048, 1 / 64) + 1 / 128 - 0.5
    codes = np.rint(effect.convert(fine)).astype(int)
    width = np.bincount(np.maximum(codes, 0), minlength=2048)[:2048] / 64
    assert width.sum() == pytest.approx(2048, abs=abs(delta) + 1 / 64)
    folded = width.reshape(-1, 64).mean(0)
    multiple = np.arange(64, 2048, 64)
    powers = np.minimum(np.log2(multiple & -multiple).astype(int), 10)
    share = {b: np.mean(powers == b) for b in range(6, 11)}
    n = 64 - 1
    bits = np.repeat(list(share), 2)
    x = {
        "amp": np.zeros(n + 10, int), "code": np.concatenate([np.arange(n), np.tile([-1, -2], 5)]),
        "bit": np.concatenate([np.full(n, -1), bits]),
        "share": np.concatenate([np.zeros(n), [share[b] for b in bits]]),
    }  # fmt: skip
    said = effect.code_hist(x, LAYOUT)
    # Of 32 multiples of 64 one is 0, where no code is below.
    np.testing.assert_allclose(said[:n], folded[:-1] - 1, atol=abs(delta) / 31 + 1 / 64)
    for b, k, value in zip(bits, x["code"][n:], said[n:], strict=True):
        seen = width[multiple[powers == b] + k].mean() - 1
        # Those around are a 64th wider or narrower.
        assert value == pytest.approx(seen, abs=3 * abs(delta) / 64 + 1 / 32)
    assert np.abs(said[:n]).max() > 0.3 or np.abs(said[n:]).max() > 0.3


def test_mean_codes_of_wide_and_narrow_levels():
    """Means over a Gaussian of what the converter gives, point by point."""
    effect = make_effect("adc_bits", {"delta": 1.5, "bit": 5.0})
    level = np.array([0.0, 40.0, 900.0, 3e4])
    amp = np.zeros(4, int)
    found = effect.signal(level, {"amp": amp}, LAYOUT)
    place = np.linspace(-7, 7, 40_001)
    weight = np.exp(-(place**2) / 2)
    weight /= weight.sum()

    def mean(true, sigma):
        return weight @ np.rint(effect.convert(true + sigma * place))

    # The true level whose codes have the mean that is known.
    start = brentq(lambda true: mean(true, 2.5) - 1000.3, 995.0, 1005.0)
    for s, value in zip(level, found, strict=True):
        sigma = (2.5**2 + s / 4.0) ** 0.5
        exact = 2.0 * (mean(start + s / 2.0, sigma) - mean(start, 2.5))
        # Codes are whole: half of one where a step of a period of 64 is met, over 2.5 of noise.
        assert value == pytest.approx(exact, abs=0.15)
    assert np.abs(found - level).max() > 0.4


def test_crosstalk_is_told_in_the_gains_of_both():
    effect = make_effect("amp_crosstalk", {"c": 1e-3})
    a, b = np.full((2, 3), 1e4, np.float32), np.zeros((2, 3), np.float32)
    out = effect.amplify([a, b], SHOT, LAYOUT)
    seen = (out[1] / 2.5 / (out[0] / 2.0))[0, 0]
    x = {"amp": np.array([0]), "other": np.array([1]), "what": np.array(["crosstalk"])}
    assert effect.amp_cross(x, LAYOUT)[0] == pytest.approx(seen, rel=1e-5)


@pytest.mark.parametrize("period", np.geomspace(5, 60, 23).tolist())
def test_waves_begin_close_enough_for_a_fit_to_arrive(period):
    """From one of its starts, the nearest in frequency, noiseless lags lead to any period."""
    kind = next(k for k in LIBRARY if k.variant == "pickup")
    lag = np.arange(33)
    wave = np.cos(2 * np.pi * lag / period)
    starts = kind.starts(LAYOUT)
    near = min(starts, key=lambda s: abs(1 / s["period"] - 1 / period))
    fit = least_squares(
        lambda p: p[0] ** 2 * np.cos(2 * np.pi * lag / p[1]) - wave, [2.0, near["period"]]
    )
    assert fit.cost < 1e-12
    assert abs(fit.x[1] / period - 1) < 1e-6


@pytest.mark.parametrize(
    ("level", "reach"), [(0.0, 0.0), (8.0, 0.0), (40.0, 0.0), (8.0, 100.0)]
)
def test_a_trap_meets_spots_as_the_background_leaves_it(level, reach):
    """A spot of few electrons on a background, against long rows that begin with that background."""
    values = {"size": 30.0, "tau": 1.5, "amp": 0.0, "reach": reach}
    effect = make_effect("trap_serial", values)
    alone = Layout((12, 20), SEGMENTS[:1])
    x = np.arange(15) - 7.0
    spot = np.exp(-np.add.outer(x**2, x**2) / 4.0)[None]
    spot *= 8000 / spot.sum()
    axes = {"background": level / spot.sum()}
    seen = effect.spot_image(spot, axes, alone)[0] - spot[0]
    rows = np.concatenate([np.full((15, 300), level), spot[0] + level], axis=1)
    frame = effect.shift(rows, 0, alone)
    np.testing.assert_allclose(seen, frame[:, 300:] - rows[:, 300:], atol=1e-9)
    # A background that keeps the trap full leaves it nothing to take; small packets pass it by.
    full = level > 30.0
    assert (np.abs(seen).max() < 1e-9) == full
    if reach:
        none = effect.spot_image(spot * reach / spot.max(), {"background": 0.0}, alone)
        np.testing.assert_allclose(none, spot * reach / spot.max(), atol=1e-9)


def test_beside_a_hot_column_others_are_not_hot():
    """What a hot column adds to the mean makes all others look cold, far beyond noise."""
    seen = [
        {"word": "dark_map", "what": "column", "x": (x, x + 1), "amp": 0, "z": z}
        for x, z in ((3, 900.0), (1, -40.0), (5, -39.0))
    ]
    starts = HotColumns.starts(LAYOUT, seen)
    assert {s["columns"] for s in starts} == {1.0}
    place = float(LAYOUT.segments[0].sensor_column(np.array(3)))
    assert {s["x1"] for s in starts} == {place}


def test_hot_columns_have_rates_of_their_own():
    """Columns of pixels, and the channel of darks, have the parts that the effect states."""
    seen = [
        {"word": "dark_map", "what": "column", "x": (x, x + 1), "amp": 0, "z": z}
        for x, z in ((3, 8.0), (5, 40.0), (1, -2.0), (7, 20.0))
    ]
    start = next(s for s in HotColumns.starts(LAYOUT, seen) if s["columns"] == 3)
    assert (start["part2"], start["part3"]) == (0.5, 0.2)
    hot = HotColumns(start | {"rate": 0.4})
    places = [int(LAYOUT.segments[0].sensor_column(np.array(x))) for x in (5, 7, 3)]
    shot, shape = Shot("dark", 0, 10.0, temperature=173.15), (20_000, LAYOUT.shape[1])
    stored = hot.store(np.zeros(shape), shot, LAYOUT, np.random.default_rng(5), {})
    mean = stored.mean(0)
    np.testing.assert_allclose(mean[places], [4.0, 2.0, 0.8], rtol=0.03)
    assert not np.delete(mean, places).any()
    axes = {
        "amp": np.zeros(9), "time": np.full(9, 10.0), "temperature": np.full(9, 173.15),
        "what": np.array(["column"] * 9), "x": np.arange(9), "y": np.full(9, -1),
    }  # fmt: skip
    predicted = hot.dark_map(axes, LAYOUT)
    np.testing.assert_allclose(predicted[[5, 7, 3]], mean[places], rtol=0.04)
    assert not np.delete(predicted, [5, 7, 3]).any()
