"""Laws of readout effects against pixels that loops of a few lines make, at three strengths each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.ndimage import gaussian_filter

from bfsensor.diagnose.data.bias_channels import _row_excess
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.diagnose.model.flat_predictions import periodic_covariances
from bfsensor.effects.dark_pixels import usual_noise
from bfsensor.effects.effect import Layout, Segment, Shot
from bfsensor.effects.library import LIBRARY, make_effect
from bfsensor.effects.transfer import PIVOT

COLUMNS, PRESCAN, OVERSCAN = 40, 3, 20
SEGMENTS = (Segment(0, 0, COLUMNS, 30, False, False, PRESCAN, OVERSCAN, 12),)
SHOTS = tuple(
    Shot("flat" if level else "bias", n, 5.0, hours=0.25 * n, level=level)
    for n, level in enumerate([0.0, 6e4, 0.0, 0.0, 1e5, 2e4, 0.0, 0.0])
)
LAYOUT = Layout((30, COLUMNS), SEGMENTS, shots=SHOTS, gains=(1.0,), read_noise=(4.0,))
LEVELS = np.array([3e3, 2e4, 9e4])
STRENGTHS = (0.3, 1.0, 3.0)


def overscan_axes(level: float, count: int = OVERSCAN) -> dict[str, np.ndarray]:
    k = np.arange(1.0, count + 1)
    return {"amp": np.zeros(count, int), "level": np.full(count, level), "k": k}


def row_of(level: float, columns: int = COLUMNS) -> np.ndarray:
    return np.concatenate([np.zeros(PRESCAN), np.full(columns, level), np.zeros(OVERSCAN)])


def species(values: dict[str, float]) -> list[tuple[float, float]]:
    slow = values.get("slow", 0.0)
    return [(1 - slow, values["tau"]), (slow, values.get("slow_tau", 1.0))]


# -- transfers and traps

TRAPS = {
    "traps": {"cti": 2e-6, "power": 0.6, "tau": 2.5},
    "two_traps": {"cti": 2e-6, "power": 0.8, "tau": 0.8, "slow": 0.4, "slow_tau": 5.0},
}


def late(row: np.ndarray, values: dict[str, float]) -> np.ndarray:
    """A row whose packets each leave charge to those behind them, packet by packet."""
    out = row.copy()
    for n, charge in enumerate(row):
        lost = (n + 1) * values["cti"] * PIVOT * (charge / PIVOT) ** values["power"]
        out[n] -= lost
        for part, tau in species(values):
            for d in range(1, len(row) - n):
                out[n + d] += part * lost * (np.exp(-(d - 1) / tau) - np.exp(-d / tau))
    return out


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("variant", TRAPS)
@pytest.mark.parametrize("word", ["cti_serial", "cti_parallel"])
def test_traps_of_a_register(word, variant, strength):
    values = TRAPS[variant] | {"cti": strength * TRAPS[variant]["cti"]}
    effect = make_effect(word, values, variant)
    serial = word == "cti_serial"
    for level in LEVELS:
        row = row_of(level) if serial else np.append(np.full(30, level), np.zeros(12))
        read = late(row, values)
        frame = np.tile(row, (3, 1)) if serial else np.tile(row[:, None], (1, 3))
        out = effect.shift(frame, 0, LAYOUT)
        np.testing.assert_allclose(
            out[0] if serial else out[:, 0], read, atol=1e-3 * level * values["cti"] * 50
        )
        behind = read[-OVERSCAN:] if serial else read[-12:]
        said = getattr(effect, "serial_overscan" if serial else "parallel_overscan")(
            overscan_axes(level, len(behind)), LAYOUT
        )
        # Predicted is that all packets had as many transfers as the last, which falls short by
        # the release time over their number.
        slack = 1.5 * max(tau for part, tau in species(values) if part) / 30
        np.testing.assert_allclose(behind, said, rtol=slack, atol=slack * said[0])
        assert said[0] > 0.02


def test_traps_without_delay_and_with_power_one_are_the_plain_law():
    plain = make_effect("cti_serial", {"cti": 1e-6})
    near = make_effect("cti_serial", {"cti": 1e-6, "power": 1.0, "tau": 0.02}, "traps")
    x = overscan_axes(5e4)
    np.testing.assert_allclose(
        near.serial_overscan(x, LAYOUT), plain.serial_overscan(x, LAYOUT), atol=1e-4 * 2.2
    )
    rng = np.random.default_rng(4)
    images = rng.uniform(0, 1e4, (2, 21, 21))
    both = [e.spot_image(images, {}, LAYOUT) - images for e in (plain, near)]
    # The image's own rim differs: the plain law wraps it.
    np.testing.assert_allclose(both[0][..., 1:-1], both[1][..., 1:-1], atol=1e-6)
    assert np.abs(both[0]).max() > 0.05


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize(
    ("word", "values", "axis", "share"),
    [
        # A charge at column c has c + 1 transfers after the prescan: 3 + 20.5 in the mean of 40.
        ("cti_serial", {"cti": 1e-4}, 2, 1e-4 * (PRESCAN + 20.5)),
        ("cti_parallel", {"cti": 1e-4}, 1, 1e-4 * 15.5),
        ("electronic_memory", {"alpha": 2e-3}, 2, 2e-3 / 1.002),
    ],
)
def test_centroids_of_spots_move_along_the_register_only(word, values, axis, share, flip):
    """The first moment is exact: a share of the charge is read one pixel later, none is lost."""
    segment = SEGMENTS[0]._replace(**{"flip_x" if axis == 2 else "flip_y": flip})
    layout = replace(LAYOUT, segments=(segment,))
    spot = np.zeros((1, 15, 15))
    spot[0, 5:10, 6:9] = np.random.default_rng(77).uniform(100, 200, (5, 3))
    moved = make_effect(word, values).spot_image(spot, {}, layout)
    assert moved.sum() == pytest.approx(spot.sum(), rel=1e-12)
    for along in (1, 2):
        place = np.arange(15.0).reshape((-1, 1) if along == 1 else -1)
        change = ((moved - spot) * place).sum() / spot.sum()
        wanted = share * (-1 if flip else 1) if along == axis else 0.0
        assert change == pytest.approx(wanted, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("strength", STRENGTHS)
def test_fluctuations_of_flats_are_delayed_by_the_slope_of_the_loss(strength):
    """White noise through traps, against the predicted correlations."""
    values = {"cti": strength * 3e-5, "power": 0.5, "tau": 1.5}
    effect = make_effect("cti_serial", values, "traps")
    rng = np.random.default_rng(12)
    level, width = 1e4, 400
    layout = Layout((500, width), (Segment(0, 0, width, 500),))
    flat = level + 100 * rng.standard_normal((500, width))
    out = effect.shift(flat, 0, layout)
    seen, same = (
        [np.mean((f - f.mean())[:, : width - k] * (f - f.mean())[:, k:]) for k in range(4)]
        for f in (out, flat)
    )
    c = np.zeros((1, 16, 16))
    c[0, 0, 0] = 1e4
    x = {"amp": np.zeros(1, int), "level": np.full(1, level)}
    said = effect.covariances(c, x, layout)[0, 0, :4] - c[0, 0, :4]
    # To first order in a loss of 2e-2 at most; 400 columns lose what their last packets hold.
    np.testing.assert_allclose(
        np.subtract(seen, same), said, atol=0.03 * abs(said[0]) + 0.5
    )
    assert said[1] > 8 * strength


GRADUAL = {"size": 80.0, "tau": 2.0, "amp": 0.0, "middle": 2e4, "power": 1.2, "corner": 3.0}


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("variant", ["gradual", "two_times"])
def test_a_trap_that_larger_packets_fill_further(variant, strength):
    values = GRADUAL | {"size": strength * 80.0}
    if variant == "two_times":
        values |= {"slow": 0.3, "slow_tau": 7.0}
    effect = make_effect("trap_serial", values, variant)
    for level in LEVELS:
        x = level / 2e4
        full = values["size"] * x**1.2 / (1 + x**3.6) ** (1 / 3)
        row, held = row_of(level), [0.0, 0.0]
        for n in range(len(row)):
            for s, (part, tau) in enumerate(species(values)):
                free = held[s] * (1 - np.exp(-1 / tau))
                own = part * full if PRESCAN <= n < PRESCAN + COLUMNS else 0.0
                taken = max(own - (held[s] - free), 0.0)
                row[n] += free - taken
                held[s] += taken - free
        frame = np.tile(row_of(level), (2, 1))
        np.testing.assert_allclose(
            effect.shift(frame, 0, LAYOUT)[0], row, atol=1e-6 * level
        )
        said = effect.serial_overscan(overscan_axes(level), LAYOUT)
        np.testing.assert_allclose(said, row[-OVERSCAN:], rtol=1e-6, atol=1e-9)
        assert said[0] > 0.5 * strength
        mean = effect.flat_mean(overscan_axes(level), LAYOUT)[0]
        assert mean == pytest.approx(row[PRESCAN:-OVERSCAN].mean() - level, rel=1e-4)


# -- memory of the amplifier


@pytest.mark.parametrize("strength", [*STRENGTHS, -1.0])
def test_settling_of_a_slow_stage(strength):
    values = {"alpha": strength * 1e-3, "tau": 3.0}
    effect = make_effect("electronic_memory", values, "settling")
    row = row_of(2e4)
    slow, read = 0.0, []
    for signal in row:
        read.append(signal + slow)
        slow = slow * np.exp(-1 / 3.0) + values["alpha"] * signal
    (out,) = effect.amplify([row[None]], SHOTS[1], LAYOUT)
    np.testing.assert_allclose(out[0], read, rtol=1e-12)
    said = effect.serial_overscan(overscan_axes(2e4), LAYOUT)
    np.testing.assert_allclose(said, read[-OVERSCAN:], rtol=1e-4)
    level = effect.signal(np.array([2e4]), {}, LAYOUT)[0]
    map_ = level * (1 + effect.pattern(SHOTS[1], LAYOUT)[0])
    np.testing.assert_allclose(map_, read[PRESCAN:-OVERSCAN], rtol=2e-6)
    assert abs(said[0]) > 10 * abs(strength)


@pytest.mark.parametrize("strength", STRENGTHS)
def test_an_offset_that_bright_pixels_drive(strength):
    values = {"scale": strength * 1e-3, "threshold": 1e4, "tau": 6.0}
    effect = make_effect("electronic_memory", values, "offset_drift")
    rng = np.random.default_rng(3)
    row = row_of(2e4) + np.where(
        row_of(1.0) > 0, rng.uniform(-1.5e4, 3e4, len(row_of(1.0))), 0
    )
    for signal in (row_of(2e4), row):
        offset, read = 0.0, []
        for s in signal:
            offset = max(values["scale"] * (s - 1e4), offset * np.exp(-1 / 6.0), 0.0)
            read.append(s + offset)
        (out,) = effect.amplify([signal[None]], SHOTS[1], LAYOUT)
        np.testing.assert_allclose(out[0], read, rtol=1e-12, atol=1e-12)
    (out,) = effect.amplify([row_of(2e4)[None]], SHOTS[1], LAYOUT)
    said = effect.serial_overscan(overscan_axes(2e4), LAYOUT)
    np.testing.assert_allclose(out[0, -OVERSCAN:], said, rtol=1e-9)
    assert effect.signal(np.array([2e4]), {}, LAYOUT)[0] == pytest.approx(out[0, PRESCAN])
    # A spot of one row: what is driven at a pixel itself is part of `signal`.
    image = np.zeros((1, 1, 21))
    image[0, 0, 8:12] = 2e4, 5e4, 4e4, 1.5e4
    after = effect.signal(effect.spot_image(image, {}, LAYOUT), {}, LAYOUT)
    (plain,) = effect.amplify([image[0]], SHOTS[1], LAYOUT)
    # The driven offset is added to a signal with its own offset: of second order.
    np.testing.assert_allclose(after[0], plain, atol=2e-3 * values["scale"] * 4e4)
    assert said[0] > 5 * strength


# -- losses, response, drift


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize(
    ("variant", "shape"), [("power", {"power": 0.5}), ("filling", {"knee": 2e4})]
)
def test_losses_with_the_stored_charge(variant, shape, strength):
    """Electrons that arrive in small groups, each kept with the efficiency of the charge there."""
    q = strength * 2e-7
    law = make_effect("charge_loss", {"q": q} | shape, variant).law()

    def kept(charge):
        if variant == "power":
            return np.exp(-q * 1e5 * np.sqrt(charge / 1e5))
        return np.exp(-q * charge / (1 + charge / 2e4))

    rng = np.random.default_rng(9)
    charge, light = np.zeros(60_000), 0.0
    for _ in range(300):
        charge += rng.poisson(200 * kept(charge))
        light += 200
    mean = charge.mean()
    exact = quad(lambda m: 1 / kept(m), 0, mean)[0]
    assert law.light(np.array([mean]))[0] == pytest.approx(exact, rel=1e-8)
    # Steps of 200 of 60,000 electrons leave 1 / 300 of the deficit.
    assert light - mean == pytest.approx(exact - mean, rel=0.02)
    said = periodic_covariances(np.zeros((3, 3)), [mean], law=law)[0]
    # A variance from 60,000 pixels is known to 0.6 %.
    assert charge.var() == pytest.approx(said[0, 0], rel=0.02)
    assert light - mean > 80 * strength
    assert 1 - said[0, 0] / mean > 0.3 * (light - mean) / mean


RESPONSES = {
    "kink": ({"slope": 0.01, "level": 3e4}, lambda s, a: s + (0.01 * a * (s - 3e4) if s > 3e4 else 0)),
    "low_signal": (
        {"deficit": 20.0, "length": 2e3}, lambda s, a: s - 20 * a * (1 - np.exp(-s / 2e3)),
    ),
    "curve": (
        {f"f{n}": 1e-3 * x for n, x in enumerate((0.05, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2), 1)},
        lambda s, a: s * (1 + 1e-3 * a * s / 1e5),
    ),
}  # fmt: skip


@pytest.mark.parametrize("strength", [*STRENGTHS, -1.0])
@pytest.mark.parametrize("variant", RESPONSES)
def test_responses(variant, strength):
    values, law = RESPONSES[variant]
    effect = make_effect("gain_nonlinearity", values, variant).scaled(strength)
    exact = [law(s, strength) for s in LEVELS]
    np.testing.assert_allclose(effect.signal(LEVELS, {}, LAYOUT), exact, rtol=1e-9)
    (out,) = effect.amplify([LEVELS[None]], SHOTS[1], LAYOUT)
    np.testing.assert_allclose(out[0], exact, rtol=1e-9)
    assert np.abs(exact - LEVELS).max() > 1


DRIFTS = {
    "warming": ({"amp": 0.003, "tau": 0.7}, lambda t: 0.003 * (1 - np.exp(-t / 0.7))),
    "cycle": (
        {"amp": 0.002, "period": 0.9, "phase": 0.1},
        lambda t: 0.002 * np.sin(2 * np.pi * (t / 0.9 + 0.1)),
    ),
    # Of a straight line, which every spline follows, over 1.75 h.
    "curve": ({f"g{n}": 1e-3 * n for n in range(1, 7)}, lambda t: 6e-3 * t / 1.75),
}


@pytest.mark.parametrize("strength", [*STRENGTHS, -1.0])
@pytest.mark.parametrize("variant", DRIFTS)
def test_drifts(variant, strength):
    values, law = DRIFTS[variant]
    effect = make_effect("gain_drift", values, variant).scaled(strength)
    for shot in SHOTS:
        exact = 1e4 * (1 + strength * law(shot.hours))
        (out,) = effect.amplify([np.full((2, 2), 1e4)], shot, LAYOUT)
        np.testing.assert_allclose(out, exact, rtol=1e-9)
        found = effect.signal(np.array([1e4]), {"hours": np.array([shot.hours])}, LAYOUT)
        np.testing.assert_allclose(found, exact, rtol=1e-9)
    assert abs(exact - 1e4) > 1


# -- persistence, glow, noise

LATE = {
    "power": (
        {"frac": 1e-3, "exponent": 1.4, "tau": 12.0}, 0.0,
        lambda k: 1e-3 * k**-1.4 * np.exp(-k / 12),
    ),
    "two_times": (
        {"frac": 1e-3, "tau": 0.8, "slow": 0.3, "slow_tau": 6.0, "threshold": 3e4}, 3e4,
        lambda k: 1e-3 * (0.7 * np.exp(-k / 0.8) + 0.3 * np.exp(-k / 6.0)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("variant", LATE)
def test_charge_from_earlier_exposures(variant, strength):
    values, threshold, share = LATE[variant]
    effect = make_effect("persistence", values, variant).scaled(strength)
    numbers = np.array([s.number for s in SHOTS], float)
    exact = [
        sum(strength * share(n - s.number) * max(s.level - threshold, 0.0)
            for s in SHOTS if s.number < n)
        for n in numbers
    ]  # fmt: skip
    x = {"exposure": numbers, "what": np.full(len(numbers), "level")}
    np.testing.assert_allclose(effect.bias_level(x, LAYOUT), exact, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(effect.flat_mean(x, LAYOUT), exact, rtol=1e-9, atol=1e-12)
    rng, memory, seen = np.random.default_rng(5), {}, []
    for shot in SHOTS:
        lit = np.full((100, 100), shot.level, np.float32)
        seen.append(effect.store(lit, shot, LAYOUT, rng, memory).mean() - shot.level)
    # Poisson noise of up to 300 e- in 10,000 pixels; 32-bit numbers of 1e5.
    np.testing.assert_allclose(seen, exact, atol=0.8)
    assert max(exact) > 8 * strength


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("corner", range(4))
def test_glow_of_a_corner(corner, strength):
    values = {"rate": 2.0 * strength, "length": 15.0, "corner": float(corner)}
    effect = make_effect("dark_hot", values, "glow")
    shot = Shot("dark", 0, 30.0)
    rng = np.random.default_rng(2)
    dark = effect.store(np.zeros((30, COLUMNS)), shot, LAYOUT, rng, {})
    exact = np.empty((30, COLUMNS))
    x0, y0 = COLUMNS * (corner % 2), 30 * (corner // 2)
    for y in range(30):
        for x in range(COLUMNS):
            exact[y, x] = (
                60 * strength * np.exp(-np.hypot(x + 0.5 - x0, y + 0.5 - y0) / 15.0)
            )
    assert dark.mean() == pytest.approx(exact.mean(), rel=5 / exact.sum() ** 0.5)
    assert np.argmax(exact) == np.argmax(effect._light(LAYOUT))
    # What is measured: pixels beyond 6 sigma of neighbours' differences from the median of their
    # column are counted, those closer to the median of all are averaged.
    many = np.random.default_rng(3)
    struck, level, known = [], [], []
    limit = 6.0 * usual_noise(exact, 4.0)
    usual = (np.abs(exact - np.median(exact)) > limit).mean(0) <= 0.5
    for _ in range(60):
        seen = many.poisson(exact) + 4.0 * many.standard_normal(exact.shape)
        noise = 1.4826 / 2**0.5 * np.median(np.abs(np.diff(seen)))
        out = np.abs(seen - np.median(exact)) > 6.0 * max(noise, 4.0)
        own = np.abs(seen - np.median(seen, axis=0)) > 6.0 * max(noise, 4.0)
        struck.append((own & (out.mean(0) <= 0.5)).sum())
        level.append(seen[~out].mean())
        known.append(((np.abs(seen - np.median(exact, axis=0)) > limit) & usual).sum())
    axes = {
        "amp": np.zeros(2, int), "time": np.full(2, 30.0), "what": np.array(["struck", "level"]),
        "x": np.full(2, -1), "temperature": np.full(2, 173.15),
    }  # fmt: skip
    said = effect.dark_map(axes, LAYOUT)
    # The light rises by up to 4 e- from pixel to pixel here, which adds 2 % to differences of
    # neighbours, and so to the limit: 4 % of the number beyond it.  Which columns are hot differs
    # between draws of 30 pixels: 4 % more.  With limit and hot columns as predicted it is exact.
    # 60 draws of 71 pixels are known to 1.5 %.
    assert np.mean(known) == pytest.approx(said[0], rel=0.05, abs=0.5)
    assert np.mean(struck) == pytest.approx(said[0], rel=0.1, abs=1.0)
    assert np.mean(level) == pytest.approx(said[1], rel=0.03)
    assert said[1] > 2 * strength


@pytest.mark.parametrize("strength", STRENGTHS)
def test_rows_that_remember_the_row_before(strength):
    effect = make_effect("bias_instability", {"rms": strength, "corr": 0.6}, "row_memory")
    rng = np.random.default_rng(6)
    out = effect.noise([np.zeros((40_000, 21))], LAYOUT, rng)[0]
    assert np.ptp(out, axis=1).max() == 0
    rows, series = out[:, 0], out.ravel()
    seen = [np.mean(rows[: rows.size - k] * rows[k:]) for k in range(4)]
    near = np.mean(series[:-4] * series[4:])
    said = effect.on_frame(np.zeros(4), np.arange(4), 21.0)
    # 40,000 rows, of which every other is independent: 1 %.
    np.testing.assert_allclose(seen, said, atol=0.03 * strength**2)
    assert near == pytest.approx(
        float(effect.in_order(np.array(4), np.array(21))), abs=0.03 * strength**2
    )
    assert said[1] > 0.5 * strength**2


@pytest.mark.parametrize("strength", STRENGTHS)
def test_settling_that_differs_between_frames(strength):
    effect = make_effect("bias_instability", {"rms": strength, "length": 6.0}, "settling")
    rng = np.random.default_rng(8)
    width, total = 30, np.zeros(8)
    for _ in range(4000):
        frame = effect.noise([np.zeros((4, width))], LAYOUT, rng)[0]
        series = (frame - frame.mean()).ravel()
        total += [np.mean(np.roll(series, -k) * series) for k in range(8)]
    said = effect.in_order(np.arange(8), np.full(8, width))
    # Sizes of 4000 frames: their mean square is known to 2 %.
    np.testing.assert_allclose(total / 4000, said, rtol=0.1, atol=0.005 * strength**2)
    assert said[0] > 0.05 * strength**2


@pytest.mark.parametrize("strength", STRENGTHS)
def test_scatter_of_darks_by_settling(strength):
    """Levels and columns of three darks less the mean of four biases, as they are measured."""
    effect = make_effect("bias_instability", {"rms": strength, "length": 6.0}, "settling")
    rng = np.random.default_rng(8)
    layout, seen = replace(LAYOUT, biases=(0, 2, 3, 6)), []
    blank = np.zeros((2, PRESCAN + COLUMNS + OVERSCAN))
    for _ in range(4000):
        frames = np.array(effect.noise([blank] * 7, layout, rng))[:, 0]
        frames -= frames[:, PRESCAN + COLUMNS :].mean(1, keepdims=True)
        image = (frames[4:] - frames[:4].mean(0))[:, PRESCAN : PRESCAN + COLUMNS]
        columns = image[1:].mean(0)
        seen.append([*image.mean(1), *(columns - np.median(columns))])
    axes = {
        "amp": np.zeros(3 + COLUMNS, int), "what": np.repeat(["level", "column"], [3, COLUMNS]),
        "x": np.append(np.full(3, -1), np.arange(COLUMNS)),
        "time": np.append([5.0, 30.0, 30.0], np.full(COLUMNS, 30.0)),
        "exposure": np.append([10, 11, 12], np.full(COLUMNS, -1)),
    }  # fmt: skip
    modes = effect.modes("dark_map", axes, layout)
    covariance = np.cov(np.array(seen).T)
    np.testing.assert_allclose(modes @ modes.T, covariance, atol=0.03 * covariance.max())


def test_settling_is_no_scatter_of_rows():
    """The variance of the means of rows as :func:`_row_excess` measures it, near lags left out."""
    effect = make_effect("bias_instability", {"rms": 40.0, "length": 30.0}, "settling")
    rng, width = np.random.default_rng(8), 300
    layout = replace(
        LAYOUT, segments=(SEGMENTS[0]._replace(columns=width - PRESCAN - OVERSCAN),)
    )
    frames = effect.noise([np.zeros((60, width))] * 600, layout, rng)
    measured = []
    for frame in frames:
        noise = frame + rng.standard_normal(frame.shape)
        excess, _, white = _row_excess(noise)
        measured.append(excess * white)
    axes = {"amp": np.zeros(1, int), "what": np.array(["rows"])}
    assert np.mean(measured) == pytest.approx(effect.bias_level(axes, layout)[0], rel=0.1)


@pytest.mark.parametrize("strength", STRENGTHS)
def test_flicker_noise(strength):
    values = {"rms": strength, "exponent": 1.1, "memory": 40.0}
    effect = make_effect("correlated_noise", values, "flicker")
    rng = np.random.default_rng(7)
    total, frames = np.zeros(6), 60
    for _ in range(frames):
        series = effect.noise([np.zeros((200, 50))], LAYOUT, rng)[0].ravel()
        total += [np.mean(series[: series.size - k] * series[k:]) for k in range(6)]
    said = effect.in_order(np.arange(6), np.full(6, 50))
    # 6e5 pixels of a correlation length of 40: 15,000 independent ones, 1.2 %.
    np.testing.assert_allclose(total / frames, said, atol=0.05 * strength**2)
    assert said[0] == pytest.approx(strength**2) and said[3] > 0.2 * strength**2


def test_every_law_is_off_at_zero():
    """No law changes predictions or pixels when its amplitudes are neutral."""
    x = overscan_axes(2e4) | {"hours": np.linspace(0, 1, OVERSCAN)}
    frame = np.random.default_rng(2).uniform(0, 5e4, (42, PRESCAN + COLUMNS + OVERSCAN))
    for kind in LIBRARY:
        if kind.word not in (
            "cti_serial", "cti_parallel", "trap_serial", "electronic_memory", "charge_loss",
            "gain_nonlinearity", "gain_drift",
        ):  # fmt: skip
            continue
        off = kind(kind.starts(LAYOUT)[0]).scaled(0.0)
        assert off.is_neutral()
        for word in ("serial_overscan", "parallel_overscan", "flat_mean"):
            assert not np.any(getattr(off, word)(x, LAYOUT)), (kind, word)
        assert np.array_equal(off.signal(x["level"], x, LAYOUT), x["level"]), kind
        assert np.array_equal(off.amplify([frame], SHOTS[1], LAYOUT)[0], frame), kind
        assert np.array_equal(off.shift(frame, 0, LAYOUT), frame), kind
        assert not off.law().lost(5e4), kind


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("first", [0, 17])
def test_columns_before_a_trap_do_not_meet_it(first, flip):
    layout = replace(LAYOUT, segments=(SEGMENTS[0]._replace(flip_x=flip),))
    values = {"size": 80.0, "tau": 2.0, "amp": 0, "reach": 0.0, "column": float(first)}
    effect = make_effect("trap_serial", values)
    frame = np.tile(row_of(2e4), (30, 1))
    change = (effect.shift(frame, 0, layout) - frame)[0, PRESCAN:-OVERSCAN]
    # Full after its first packet: each later one refills what was released.
    assert not change[:first].any() and change[first] == pytest.approx(-80.0)
    np.testing.assert_allclose(change[first + 1 :], 0.0, atol=1e-9)
    seen = effect.pattern(SHOTS[5], layout)
    np.testing.assert_allclose(
        seen[:, ::-1] if flip else seen, np.tile(change / 2e4, (30, 1)), atol=1e-12
    )
    place = COLUMNS - 1 - first if flip else first
    strip = {"word": "flat_map", "what": "column", "x": (place, place + 1)}
    assert first in {s["column"] for s in effect.starts(layout, [strip])}
    assert {s["column"] for s in effect.starts(layout)} == {0.0}


@pytest.mark.parametrize("kind", LIBRARY, ids=lambda k: k.__name__)
def test_predictions_are_numbers_at_the_ends_of_ranges(kind):
    """A power of a negative base is none: fits that went there lost the candidate."""
    for start in kind.starts(LAYOUT)[:1]:
        plain = kind(start)
        for p in fitted(plain):
            for end in p.widest:
                if p.amplitude or not np.isfinite(end):
                    continue
                effect = plain.with_values(**{p.name: end})
                with np.errstate(all="ignore"):
                    image = effect.spot_image(np.ones((1, 1, 5, 5)), {"level": 1e4}, LAYOUT)
                    lost = effect.law().lost(np.array([0.0, 1e3, 1e5]))
                assert np.isfinite(image).all() and np.isfinite(lost).all(), (p.name, end)


@pytest.mark.parametrize(
    ("variant", "law", "lengths"),
    [
        ("exponential", lambda r, length: np.exp(-r / length), (2.5, 5.0)),
        ("aureole", lambda r, length: 1 / (length**2 + r**2), (2.0, 8.0)),
    ],
)
def test_halos_are_sums_of_gaussians(variant, law, lengths):
    y, x = np.mgrid[-200:201, -200:201]
    r = np.hypot(x, y)
    for length in lengths:
        effect = make_effect("psf_wings", {"frac": 0.02, "length": length}, variant)
        _, parts = effect.spot_light(SHOTS[1], LAYOUT)
        assert sum(f for f, _ in parts) == pytest.approx(0.02)
        said = sum(f * np.exp(-((r / w) ** 2) / 2) / (2 * np.pi * w**2) for f, w in parts)
        exact = law(r, length)
        inside = (r > 2) & (r < min(4 * length, 16))
        ratio = gaussian_filter(said, 1.25)[inside] / gaussian_filter(exact, 1.25)[inside]
        assert ratio.std() / ratio.mean() < 0.04
        if variant == "exponential":
            assert ratio.mean() * exact.sum() == pytest.approx(0.02, rel=0.03)
    assert make_effect("psf_wings", {"frac": 0.0, "length": 3.0}, variant).spot_light(
        SHOTS[1], LAYOUT
    ) == (0.0, ())
