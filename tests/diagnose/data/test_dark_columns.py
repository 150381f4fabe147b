"""Columns of darks: errors from the pixels' noise, or from columns that are uneven by nature."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.bench_nuisances import assumed_errors
from bfsensor.diagnose.data.dark_channels import DarkChannels, count_groups
from bfsensor.diagnose.kinds import KINDS

ROWS, COLUMNS, NOISE, BIASES, DARKS = 64, 128, 3.0, 10, 4


HOT = 17
"""Column that is made hot."""


def columns(
    rng: np.random.Generator, uneven: float = 0.0, hot: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Columns of one campaign's darks, and the same over their errors."""
    pattern = uneven * rng.standard_normal(COLUMNS)
    bias = NOISE / np.sqrt(BIASES) * rng.standard_normal((ROWS, COLUMNS))
    darks = DarkChannels({"one": bias}, {"one": NOISE}, biases=BIASES)
    for number in range(DARKS):
        image = NOISE * rng.standard_normal((ROWS, COLUMNS)) + pattern
        image[:, HOT] += rng.poisson(hot, ROWS)
        over = NOISE * rng.standard_normal((ROWS, 24))
        frame = SimpleNamespace(
            name="one", image=image, serial_overscan=over, parallel_overscan=over[:0]
        )
        exposure = SimpleNamespace(
            number=number,
            exposure_time=60.0,
            wavelength=None,
            back_bias=None,
            temperature=None,
        )
        darks.add(exposure, [frame])
    channel = darks.channels()[0]
    own = channel.axes["what"] == "column"
    return channel.values[own], channel.whiten(channel.values)[own]


def pulls(rng: np.random.Generator, uneven: float = 0.0) -> np.ndarray:
    """Whitened columns of one campaign's darks."""
    return columns(rng, uneven)[1]


def test_chi_square_of_columns_scatters_as_it_should() -> None:
    rng = np.random.default_rng(2718)
    squares = np.array([((p := pulls(rng)) - p.mean()) @ (p - p.mean()) for _ in range(60)])
    deviates = (squares - (COLUMNS - 1)) / np.sqrt(2.0 * (COLUMNS - 1))
    # Errors from the columns' own scatter gave deviates of 1.6.
    assert deviates.mean() == pytest.approx(0.0, abs=4 / np.sqrt(60))
    assert deviates.std() == pytest.approx(1.0, abs=4 / np.sqrt(120))


def test_uneven_columns_are_held_against_their_own_scatter() -> None:
    rng = np.random.default_rng(2719)
    mean = np.mean([np.square(pulls(rng, uneven=2.0)).mean() for _ in range(20)])
    # Held against noise alone it would be 14; a scatter is known to 10 %.
    assert mean == pytest.approx(1.0, abs=0.2)


def test_a_hot_column_has_the_noise_of_its_own_charge() -> None:
    """Each of its pixels holds 400 e- of dark current; errors of all others stay as they are."""
    rng = np.random.default_rng(2720)
    values, whitened = np.array([columns(rng, hot=400.0) for _ in range(60)]).swapaxes(0, 1)
    assert np.square(np.delete(whitened, HOT, axis=1)).mean() == pytest.approx(1.0, abs=0.1)
    errors = values[:, HOT] / whitened[:, HOT]
    # Of read noise alone they would be 3 / 20 of it.
    assert errors.mean() == pytest.approx(values[:, HOT].std(ddof=1), rel=0.3)


@pytest.mark.parametrize("amplifiers", [1, 2])
def test_every_column_is_looked_at_also_with_one_amplifier(amplifiers):
    amp = np.repeat(np.arange(amplifiers), 3)
    axes = {
        "amp": amp, "x": np.tile(np.arange(3), amplifiers), "after": np.zeros(len(amp)),
        "what": np.full(len(amp), "column"),
    }  # fmt: skip
    found = [
        p
        for p in KINDS["dark_map"].patterns(SimpleNamespace(axes=axes))
        if p[0] == "dark columns"
    ]
    assert [(w["amp"], w["x"]) for _, _, w in found] == [
        (n, (x, x + 1)) for n in range(amplifiers) for x in range(3)
    ]
    np.testing.assert_array_equal([p[1] for p in found], np.eye(3 * amplifiers))


def darks_of(
    images: np.ndarray,
    times: list[float],
    over: bool = True,
    temperature: float | Sequence[float] | None = None,
) -> DarkChannels:
    """Darks of two amplifiers, shape (darks, 2, rows, columns)."""
    rng = np.random.default_rng(12)
    names = "one", "two"
    darks = DarkChannels(
        dict.fromkeys(names, np.zeros((ROWS, COLUMNS))), dict.fromkeys(names, NOISE)
    )
    kelvin = np.broadcast_to(np.array(temperature, object), (len(times),))
    for number, (pair, seconds) in enumerate(zip(images, times, strict=True)):
        zero = NOISE * rng.standard_normal((ROWS, 24 if over else 0))
        darks.add(
            SimpleNamespace(
                number=number, exposure_time=seconds, wavelength=None, back_bias=None,
                temperature=kelvin[number],
            ),
            [
                SimpleNamespace(
                    name=name, image=image, serial_overscan=zero, parallel_overscan=zero[:0]
                )
                for name, image in zip(names, pair, strict=True)
            ],
        )  # fmt: skip
    return darks


def test_one_track_of_many_pixels_is_one_event() -> None:
    images = NOISE * np.random.default_rng(3).standard_normal((4, 2, ROWS, COLUMNS))
    for k in range(60):
        images[1, 0, k, 20 + k : 22 + k] += 400.0
    channel = darks_of(images, [60.0] * 4).channels()[0]
    what = channel.axes["what"]
    assert channel.values[what == "tracks"] == [1.0]
    # Counted pixel by pixel it is 11 standard deviations.
    assert (
        np.abs(channel.whiten(channel.values)[np.isin(what, ("struck", "tracks"))]).max()
        < 1.1
    )


def test_without_an_overscan_the_zero_of_a_dark_is_not_known() -> None:
    """The bias level drifts, in both amplifiers by the same in the unit of their gains."""
    rng = np.random.default_rng(4)
    drift = np.array([0.4, 1.0, 0.6, -1.5, -2.5, -4.5])[:, None] * np.array([1.0, 1.25])
    images = NOISE * rng.standard_normal((6, 2, ROWS, COLUMNS)) + drift[..., None, None]
    times = [60.0, 60.0, 60.0, 15.0, 15.0, 15.0]
    for over in (False, True):
        channel = darks_of(images, times, over).channels()[0]
        level = channel.axes["what"] == "level"
        square = float(np.square(channel.whiten(channel.values)[level]).sum())
        assert square < 25 if not over else square > 1000


@pytest.mark.parametrize(
    ("times", "over", "said"),
    [((60.0, 60.0), False, 1), ((60.0, 15.0), False, 0), ((60.0, 60.0), True, 0)],
)
def test_a_dark_current_that_cannot_be_seen_is_said(times, over, said) -> None:
    images = NOISE * np.random.default_rng(5).standard_normal((2, 2, ROWS, COLUMNS))
    notes = darks_of(images, times, over).notes
    assert len(notes) == said
    assert all("two exposure times" in note for note in notes)


@pytest.mark.parametrize(
    ("kelvin", "gains", "sigma"),
    [(173.15, (2.0, 2.0), 1.3), (183.15, (2.0, 2.0), 10.5), (None, (2.0, 2.0), None),
     (173.15, (), None)],
)  # fmt: skip
def test_levels_of_darks_are_held_against_the_dark_current_of_usual_sensors(
    kelvin: float | None, gains: tuple[float, ...], sigma: float | None
) -> None:
    images = NOISE * np.random.default_rng(3).standard_normal((4, 2, ROWS, COLUMNS)) + 10.0
    channel = darks_of(images, [60.0] * 4, temperature=kelvin).channels(gains)[0]
    what = channel.axes["what"]
    if sigma is None:
        assert not np.char.startswith(what.astype(str), "usual").any()
        return
    # 20 e- in 60 s are 0.33 e-/s; both amplifiers have a dark current of their own.
    columns = KINDS["dark_map"].columns(channel, {}, None)
    known = np.isin(what, ("level", "usual", "usual offset"))
    design = channel.whiten(np.column_stack(list(columns.values())))[known]
    data = channel.whiten(channel.values)[known]
    left = data - design @ np.linalg.lstsq(design, data, rcond=None)[0]
    assert left @ left == pytest.approx(2 * (20 / sigma) ** 2, rel=0.1, abs=8.0)


def test_darks_of_two_temperatures_have_one_dark_current() -> None:
    """Trap-assisted generation is 57 times as large at -80 C as at -100 C: .01 and .57 e-/s are one."""
    images = NOISE * np.random.default_rng(3).standard_normal((4, 2, ROWS, COLUMNS))
    images[2:] += 0.57 * 60 / 2
    images[2:, 0, :, 7] += 40.0
    images[:2, 0, :, 7] += 40.0 / 57.4
    channel = darks_of(
        images, [60.0] * 4, temperature=[173.15] * 2 + [193.15] * 2
    ).channels((2.0, 2.0))[0]
    columns = KINDS["dark_map"].columns(channel, {}, None)
    level = np.isin(channel.axes["what"], ("level", "usual", "usual offset"))
    design = channel.whiten(np.column_stack(list(columns.values())))[level]
    data = channel.whiten(channel.values)[level]
    left = data - design @ np.linalg.lstsq(design, data, rcond=None)[0]
    assert left @ left < 20.0
    hot = (
        (channel.axes["what"] == "column")
        & (channel.axes["x"] == 7)
        & (channel.axes["amp"] == 0)
    )
    assert channel.values[hot] == pytest.approx([40.0], abs=4 * channel.errors[hot][0])
    assert channel.axes["temperature"][hot] == [193.15]


def test_a_track_is_counted_once_and_warm_pixels_are_none() -> None:
    images = NOISE * np.random.default_rng(3).standard_normal((4, 2, ROWS, COLUMNS))
    images[:, 1, 5, 10:14] += 300.0
    for n in range(3):
        images[n, n % 2, 20 + n, 30:39] += 300.0
    channel = darks_of(images, [60.0] * 4).channels()[0]
    what = channel.axes["what"]
    assert channel.values[what == "tracks"] == [3.0]
    usual = 0.15 * 4 * 2 * ROWS * COLUMNS / 256**2
    assert channel.errors[what == "tracks"] == pytest.approx(np.sqrt(1 + usual + usual**2))
    struck = (what == "struck") & (channel.axes["amp"] == 1)
    np.testing.assert_array_equal(channel.values[struck], [4.0] * 4)


def test_tracks_in_other_biases_are_not_groups_of_a_bias() -> None:
    """A track of one bias is a tenth as dark a group in the nine others, by the mean bias."""
    rng = np.random.default_rng(8)
    images = NOISE * rng.standard_normal((BIASES, ROWS, COLUMNS))
    images[0, 5, 10:20] += 500.0
    zero = np.zeros((ROWS, 24))
    counts = [
        count_groups(
            [SimpleNamespace(
                name="one", image=image, serial_overscan=zero, parallel_overscan=zero[:0]
            )],
            {"one": images.mean(0)}, {"one": NOISE}, BIASES,
        )
        for image in images
    ]  # fmt: skip
    assert counts == [1] + [0] * 9


def test_the_assumed_dark_current_is_told_with_what_it_costs() -> None:
    images = NOISE * np.random.default_rng(3).standard_normal((4, 2, ROWS, COLUMNS))
    darks = darks_of(images, [60.0] * 4, temperature=173.15)
    (told,) = assumed_errors(darks.channels((2.0, 2.0)))
    assert "dark current 0.01 ADU/s at -100 C (effects on levels of darks look 8" in told
    assert not assumed_errors(darks.channels())
