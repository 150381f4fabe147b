"""Pictures of charge transfer, amplifiers, converters and bias levels."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bfsensor.plots.style import BLUE, ORANGE, RED
from effect_figures import parts
from effect_figures.parts import (
    NOISE,
    OFF,
    ON,
    before_and_after,
    curves,
    flat_shot,
    frame,
    make_layout,
    picture,
    row,
    show,
    star,
)


@picture("cti_serial")
def draw_cti_serial() -> Figure:
    """Serial overscan behind flats of three levels: its first pixel holds a fixed part of
    the level, and the signal falls by orders of magnitude a pixel. The CTI is 2e-6 a
    transfer, and rows have 512 columns.
    """
    return _draw_cti("cti_serial", 1)


@picture("cti_parallel")
def draw_cti_parallel() -> Figure:
    """Parallel overscan behind flats of three levels: its first row holds a fixed part of
    the level. The CTI is 2e-6 a transfer, and columns have 512 rows.
    """
    return _draw_cti("cti_parallel", 0)


def _draw_cti(word: str, axis: int) -> Figure:
    figure, panels = row(2)
    layout = make_layout(*((64, 512) if axis else (512, 64)))
    rng = np.random.default_rng(4711)
    name = "pixel of the serial overscan" if axis else "row of the parallel overscan"
    effects = before_and_after(word, {"cti": 2e-6})
    for ax, effect, title in zip(panels, effects, ("without", "CTI 2e-6"), strict=True):
        for level, colour in ((20e3, BLUE), (50e3, ORANGE), (100e3, RED)):
            read = effect.shift(frame(level, layout, rng), 0, layout)
            profile = read[:64].mean(0) if axis else read[:, :64].mean(1)
            ax.plot(
                range(1, 7),
                profile[512:518],
                "o-",
                ms=4,
                color=colour,
                label=f"{level:,.0f} e⁻",
            )
        ax.set_yscale("symlog", linthresh=0.01)
        ax.set(xlabel=name, ylabel="mean signal [e⁻]", ylim=(-0.005, 500), title=title)
    panels[1].legend(frameon=False, fontsize=8, title="flat")
    return figure


@picture("trap_serial")
def draw_trap_serial() -> Figure:
    """Overscan behind flats of three levels: a trap of 60 e- releases the same charge
    behind every level above its depth in the well, and the tail decays over 1.5 pixel
    times.
    """
    figure, panels = row(2)
    layout = make_layout(256, 64)
    effects = before_and_after(
        "trap_serial", {"size": 60.0, "tau": 1.5, "amp": 0, "reach": 100}
    )
    rng = np.random.default_rng(4713)
    for ax, effect, title in zip(
        panels, effects, ("without", "trap of 60 e⁻"), strict=True
    ):
        for level, colour, size in ((1e3, BLUE, 11), (10e3, ORANGE, 7), (100e3, RED, 3)):
            read = effect.shift(frame(level, layout, rng), 0, layout)
            k = np.arange(1, 13)
            profile = read[:256].mean(0)[63 + k]
            ax.plot(k, profile, "o-", ms=size, color=colour, label=f"{level:,.0f} e⁻")
        ax.set(
            xlabel="pixel of the serial overscan", ylabel="mean signal [e⁻]", title=title,
            ylim=(-3, 36),
        )  # fmt: skip
    panels[1].legend(frameon=False, fontsize=8, title="flat")
    return figure


@picture("electronic_memory")
def draw_electronic_memory() -> Figure:
    """Rows that end behind bright light: only the first pixel of the overscan holds a part
    of the last level, 1e-3 here, and stars have a faint copy one pixel later in readout
    order.
    """
    figure, (left, right) = row(2)
    layout = make_layout(256, 64, 1)
    rng = np.random.default_rng(4715)
    profiles, stars = [], []
    for effect in before_and_after("electronic_memory", {"alpha": 1e-3}):
        light = [frame(50e3, layout, rng)]
        profiles.append(effect.amplify(light, flat_shot(), layout)[0][:256].mean(0)[64:72])
        one = star(1e6, (32, 32), 12, 16, 1.0)
        stars.append(effect.amplify([one], flat_shot(), layout)[0])
    curves(left, np.arange(1, 9), *profiles, marker="o")
    left.set(xlabel="pixel of the serial overscan", ylabel="mean signal [e⁻]",
             title="behind a flat of 50,000 e⁻")  # fmt: skip
    change = stars[1] - stars[0]
    show(
        right,
        change,
        "change of a star, readout to the right",
        0,
        change.max(),
        map_="magma",
    )
    return figure


@picture("amp_crosstalk")
def draw_amp_crosstalk() -> Figure:
    """A star in amplifier 1 appears in amplifier 2 at the same pixel of the readout, 1e-3
    as bright.
    """
    figure, panels = row(3)
    layout = make_layout(48, 48)
    rng = np.random.default_rng(4717)
    bright = star(1.2e6, (48, 48), 18, 27)
    noise = NOISE * rng.standard_normal((48, 48))
    off, on = (
        effect.amplify([bright, noise], flat_shot(), layout)[1]
        for effect in before_and_after("amp_crosstalk", {"c": 1e-3})
    )
    show(panels[0], bright, "amplifier 1", 0, 8e4)
    show(panels[1], off, "amplifier 2, without", -20, 80)
    show(panels[2], on, "amplifier 2, with", -20, 80)
    return figure


@picture("correlated_noise")
def draw_correlated_noise() -> Figure:
    """Three biases of the same noise in total: white noise; noise that keeps 0.8 of the
    pixel before (streaks along rows); pickup of a period of 23.3 pixel times (stripes).
    A third variant, common noise, shows the same white noise in all amplifiers.
    """
    figure, panels = row(3)
    layout = make_layout(48, 48, 1)
    empty, rng = np.zeros((48, 48)), np.random.default_rng(4719)
    white = NOISE * rng.standard_normal((48, 48))
    streaks = parts.make_effect("correlated_noise", {"rms": NOISE, "corr": 0.8}, "ar1")
    pickup = parts.make_effect("correlated_noise", {"rms": 3.0, "period": 23.3}, "pickup")
    weaker = white * np.sqrt(1 - (3.0 / NOISE) ** 2)
    show(panels[0], white, "white noise", -15, 15)
    show(panels[1], streaks.noise([empty], layout, rng)[0], "ar1", -15, 15)
    show(panels[2], pickup.noise([weaker], layout, rng)[0], "pickup", -15, 15)
    return figure


@picture("bias_instability")
def draw_bias_instability() -> Figure:
    """A bias without and with a level that moves from row to row by 3 e-, and the mean row
    of biases in which each row begins 20 e- too high. A third variant moves the level
    of whole frames.
    """
    figure, panels = row(3)
    layout = make_layout(48, 48, 1)
    rng = np.random.default_rng(4721)
    white = NOISE * rng.standard_normal((48, 48))
    by_row = parts.make_effect("bias_instability", {"rms": 3.0}, "row")
    ramp = parts.make_effect("bias_instability", {"rms": 20.0, "length": 12.0}, "settling")
    show(panels[0], white, "without", -15, 15, bar=False)
    show(panels[1], by_row.noise([white], layout, rng)[0], "row by row", -15, 15)
    biases = NOISE * rng.standard_normal((512, 48))
    rows = [e.noise([biases], layout, rng)[0].mean(0) for e in (ramp.scaled(0), ramp)]
    curves(panels[2], np.arange(48), *rows)
    panels[2].set(
        xlabel="column [pixel]",
        ylabel="mean of 512 rows [e⁻]",
        title="settling of one frame",
    )
    return figure


@picture("gain_nonlinearity")
def draw_gain_nonlinearity() -> Figure:
    """Signal of flats against the collected charge, and its relative deviation from it,
    for c2 = -0.008 and c3 = 0.002.
    """
    figure, (left, right) = row(2)
    light = np.linspace(1e3, 1.2e5, 60)
    effects = before_and_after("gain_nonlinearity", {"c2": -0.008, "c3": 0.002})
    off, on = (e.amplify([light], flat_shot(), make_layout())[0] for e in effects)
    curves(left, light / 1e3, off / 1e3, on / 1e3)
    left.set(xlabel="collected charge [1000 e⁻]", ylabel="signal [1000 e⁻]", title="signal")
    curves(right, light / 1e3, 100 * (off / light - 1), 100 * (on / light - 1))
    right.set(xlabel="collected charge [1000 e⁻]", ylabel="deviation [%]",
              title="deviation from proportional")  # fmt: skip
    return figure


@picture("adc_bits")
def draw_adc_bits() -> Figure:
    """Frequency of codes under even illumination where bit 4 (16 ADU) is 0.8 ADU too
    heavy: the code before every odd multiple of 16 comes too often, the one before
    every even multiple too rarely.
    """
    figure, (ax,) = row(1)
    rng = np.random.default_rng(4723)
    levels = rng.uniform(950, 1150, 3_000_000)
    edges = np.arange(999.5, 1065.0)
    counts = [
        np.histogram(np.floor(e.convert(levels) + 0.5), edges)[0] / 15_000 - 1
        for e in before_and_after("adc_bits", {"delta": 0.8, "bit": 4})
    ]
    codes = edges[:-1] + 0.5
    ax.step(codes, 100 * counts[0], where="mid", **OFF)
    ax.step(codes, 100 * counts[1], where="mid", **ON)
    ax.legend(frameon=False, fontsize=8)
    ax.set(
        xlabel="code [ADU]", ylabel="frequency, deviation [%]", xticks=range(1008, 1065, 8)
    )
    return figure


@picture("gain_drift")
def draw_gain_drift() -> Figure:
    """Signal of equal flats in the course of a night, for a slope of 5e-3 an hour."""
    figure, (ax,) = row(1)
    hours = np.linspace(0, 8, 30)
    rng = np.random.default_rng(4725)
    shot_noise = 5e4 + 8 * rng.standard_normal(30)
    means = [
        [
            float(e.amplify([np.array([m])], flat_shot(hours=h), make_layout())[0][0])
            for h, m in zip(hours, shot_noise, strict=True)
        ]
        for e in before_and_after("gain_drift", {"slope": 5e-3})
    ]
    curves(ax, hours, *(np.array(m) for m in means), marker="o")
    ax.set(xlabel="time since the first exposure [h]", ylabel="mean of a flat [e⁻]")
    return figure
