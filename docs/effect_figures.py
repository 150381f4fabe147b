"""One picture for each class of effects, drawn by the package's own operations on pixels.

``python docs/effect_figures.py FOLDER [CLASS ...]`` draws into a folder; the documentation draws all
of them when it is built and keeps them while the code that makes them is the same.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import galsim
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bfsensor
from bfsensor.device.device import Device
from bfsensor.diagnose.model.flat_predictions import flat_covariances_of
from bfsensor.diagnose.model.table_baseline import edges_by_depth
from bfsensor.effects.device_parameter import device_parameters
from bfsensor.effects.effect import Effect, Law, Layout, Segment, Shot
from bfsensor.effects.library import make_effect
from bfsensor.plots.style import BLACK, BLUE, GREY, ORANGE, RED, new_figure
from bfsensor.response.edge_response import area_matrix, conversion_weights, solve_response
from bfsensor.sensor.flats import draw_flat
from bfsensor.table.quadrant_shifts import quadrant_shifts
from bfsensor.table.table import DistortionTable
from bfsensor.typing import Edges

Array = np.ndarray[Any, Any]
OFF = {"color": BLACK, "ls": "--", "lw": 1.3, "label": "without"}
ON = {"color": RED, "lw": 1.8, "label": "with the effect"}
NOISE = 5.0  # e-, read noise of the images


class Picture(NamedTuple):
    """A drawing of a class, and its caption."""

    draw: Callable[[], Figure]
    caption: str


PICTURES: dict[str, Picture] = {}


def picture(word: str) -> Callable[[Callable[[], Figure]], Callable[[], Figure]]:
    """Register a function that draws the picture of a class; its docstring is the caption."""

    def keep(draw: Callable[[], Figure]) -> Callable[[], Figure]:
        PICTURES[word] = Picture(draw, " ".join((inspect.getdoc(draw) or "").split()))
        return draw

    return keep


# -- what the pictures share -----------------------------------------------------------


def make_layout(rows: int = 128, columns: int = 64, amplifiers: int = 2) -> Layout:
    """Amplifiers side by side, each with serial and parallel overscan."""
    segments = tuple(
        Segment(n * columns, 0, columns, rows, serial_overscan=24, parallel_overscan=24)
        for n in range(amplifiers)
    )
    return Layout((rows, amplifiers * columns), segments, gains=(1.0,) * amplifiers)


def flat_shot(seconds: float = 10.0, **known: Any) -> Shot:
    """One flat at the reference's settings."""
    usual = {"wavelength": 620.0, "back_bias": -60.0, "temperature": 173.15}
    return Shot("flat", 0, seconds, **{**usual, **known})


def areas(effect: Effect, shot: Shot, layout: Layout) -> Array:
    """Relative change of the light of each pixel by displaced edges [%]."""
    moved = effect.displacements(shot, layout)
    dx, dy = moved or (
        np.zeros((1, layout.shape[1] + 1)),
        np.zeros((layout.shape[0] + 1, 1)),
    )
    return 100 * ((1 + np.diff(dx, axis=1)) * (1 + np.diff(dy, axis=0)) - 1)


def frame(level: float, layout: Layout, rng: np.random.Generator) -> Array:
    """One amplifier's frame of a flat [e-] with its overscans, before it is shifted."""
    s = layout.segments[0]
    out = np.zeros((s.rows + s.parallel_overscan, s.columns + s.serial_overscan))
    out[: s.rows, : s.columns] = rng.poisson(level, (s.rows, s.columns))
    return out


def star(
    flux: float, shape: tuple[int, int], x: float, y: float, sigma: float = 1.5
) -> Array:
    """Mean image of a round star [e-]."""
    j, i = np.indices(shape)
    return np.asarray(
        flux / (2 * np.pi * sigma**2)
        * np.exp(-0.5 * ((i - x) ** 2 + (j - y) ** 2) / sigma**2)
    )  # fmt: skip


@cache
def shifts(wavelength: float = 620.0) -> Edges:
    """Shifts of edges per electron of the shipped ITL device about 40,000 e- [pixel/e-]."""
    table, (kx, ky) = by_depth()
    weights = conversion_weights(table.depths, table.thickness, wavelength, 173.0)
    return np.tensordot(weights, kx, 1), np.tensordot(weights, ky, 1)


@cache
def by_depth() -> tuple[DistortionTable, Edges]:
    """The device's table, and its shifts by depth of conversion."""
    table = DistortionTable.load("itl_sta3800c_60")
    return table, edges_by_depth(table, background=40e3)


def wide_shifts(reach: int) -> Edges:
    """Shifts of the same device, continued beyond its table as for corrections [pixel/e-]."""
    table, _ = by_depth()
    quadrant = quadrant_shifts(table, background=40e3, lags=reach + 1)
    i = np.arange(-reach, reach + 1)
    # The right edge of a pixel left of the charge moves as the left edge of its mirror image.
    beside, sign = np.where(i < 0, -i - 1, i), np.where(i < 0, -1.0, 1.0)
    kx = sign * quadrant.east[np.abs(i)[:, None], beside]
    ky = sign[:, None] * quadrant.north[beside[:, None], np.abs(i)]
    return kx, ky


def with_edges(effect: Effect, shot: Shot, layout: Layout) -> Array:
    """Change of areas per electron with an effect [1/e-], the charge in the middle."""
    kx, ky = shifts()
    return area_matrix(*effect.edges(kx, ky, shot, layout))


def lag(a: Array, i: int, j: int) -> float:
    """Element of a matrix of areas."""
    middle = len(a) // 2
    return float(a[middle + j, middle + i])


def row(count: int) -> tuple[Figure, list[Axes]]:
    """Panels beside one another."""
    figure = new_figure((5.0, 7.6, 9.6)[count - 1], 2.8)
    return figure, list(np.atleast_1d(figure.subplots(1, count)))


def show(
    ax: Axes, image: Array, title: str, low: float, high: float, *, map_: str = "gray",
    unit: str = "e⁻", origin: tuple[int, int] = (0, 0), bar: bool = True,
) -> None:  # fmt: skip
    """An image with its scale."""
    ny, nx = image.shape
    x, y = origin
    drawn = ax.imshow(
        image, origin="lower", cmap=map_, vmin=low, vmax=high, interpolation="nearest",
        extent=(x - 0.5, x + nx - 0.5, y - 0.5, y + ny - 0.5), aspect="equal",
    )  # fmt: skip
    ax.set(xlabel="x [pixel]", ylabel="y [pixel]")
    ax.set_title(title, fontsize=10)
    if bar:
        ax.figure.colorbar(drawn, ax=ax, label=f"[{unit}]", fraction=0.046, pad=0.03)


def curves(ax: Axes, x: Array, off: Array, on: Array, marker: str = "") -> None:
    """A curve without and one with the effect."""
    ax.plot(x, off, marker=marker, ms=4, **OFF)
    ax.plot(x, on, marker=marker, ms=4, **ON)
    ax.legend(frameon=False, fontsize=8)


def from_zero(ax: Axes) -> None:
    """Let an axis begin at 0 and end above its curves."""
    ax.set_ylim(0, 1.12 * max(float(np.max(line.get_ydata())) for line in ax.lines))


def before_and_after(
    word: str, values: dict[str, float], variant: str = ""
) -> tuple[Effect, Effect]:
    """An effect switched off, and the same with given values."""
    on = make_effect(word, values, variant)
    return on.scaled(0.0), on


# -- charge transfer and readout -------------------------------------------------------


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
    streaks = make_effect("correlated_noise", {"rms": NOISE, "corr": 0.8}, "ar1")
    pickup = make_effect("correlated_noise", {"rms": 3.0, "period": 23.3}, "pickup")
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
    by_row = make_effect("bias_instability", {"rms": 3.0}, "row")
    ramp = make_effect("bias_instability", {"amp": 20.0, "length": 12.0}, "ramp")
    show(panels[0], white, "without", -15, 15, bar=False)
    show(panels[1], by_row.noise([white], layout, rng)[0], "row by row", -15, 15)
    biases = NOISE * rng.standard_normal((512, 48))
    rows = [e.noise([biases], layout, rng)[0].mean(0) for e in (ramp.scaled(0), ramp)]
    curves(panels[2], np.arange(48), *rows)
    panels[2].set(xlabel="column [pixel]", ylabel="mean of 512 rows [e⁻]", title="ramp")
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


# -- light -----------------------------------------------------------------------------


@picture("illumination_turbulence")
def draw_illumination_turbulence() -> Figure:
    """Difference of two flats of 100,000 e- in means of 8 x 8 pixels, without and with
    light that varies by 1e-3 over some 40 pixels.
    """
    figure, panels = row(2)
    layout = make_layout(512, 512, 1)
    effects = before_and_after("illumination_turbulence", {"rms": 1e-3, "corr": 40.0})
    for ax, effect, title in zip(panels, effects, ("without", "with"), strict=True):
        rng = np.random.default_rng(4727)
        pair = []
        for _ in range(2):
            factor = effect.turbulence(flat_shot(), layout, rng)
            light = 1e5 * (1.0 if factor is None else factor)
            pair.append(light + np.sqrt(1e5) * rng.standard_normal(layout.shape))
        boxes = (pair[0] - pair[1]).reshape(64, 8, 64, 8).mean((1, 3))
        wide = boxes.repeat(8, 0).repeat(8, 1)
        show(ax, wide, f"difference of a pair, {title}", -300, 300, map_="RdBu_r")
    return figure


@picture("fringing")
def draw_fringing() -> Figure:
    """Relative map of flats at 620 nm, which no fringe touches, and at 950 nm, for an
    amplitude of 1 % and 30 pixels from fringe to fringe.
    """
    figure, panels = row(2)
    layout = make_layout(256, 256, 1)
    effect = make_effect("fringing", {"amp": 0.01, "period": 30.0, "tilt": 0.6, "xx": 0.8,
                                      "xy": -0.7, "yy": 1.1, "phase": 0.1})  # fmt: skip
    rng = np.random.default_rng(4729)
    noise = 100 * rng.standard_normal(layout.shape) / np.sqrt(20 * 5e4)
    for ax, wavelength in zip(panels, (620.0, 950.0), strict=True):
        factor = effect.light_map(flat_shot(wavelength=wavelength), layout)
        seen = noise + 100 * (0.0 if factor is None else factor - 1)
        show(ax, seen, f"20 flats at {wavelength:.0f} nm", -1.5, 1.5, unit="%")
    return figure


@picture("shutter_timing")
def draw_shutter_timing() -> Figure:
    """Signal over commanded exposure time of flats: a shutter that stays open 20 ms longer
    shows in short exposures; one side of the sensor sees more of it than the other.
    """
    figure, (ax,) = row(1)
    layout = make_layout(8, 200, 1)
    times = np.geomspace(0.5, 30, 25)
    effect = make_effect("shutter_timing", {"dt": 0.02, "shade": 0.4})
    columns = [effect.light_map(flat_shot(t), layout) for t in times]
    sides = np.array([(m[0, 0], m[0, -1]) for m in columns if m is not None])
    ax.axhline(0, **OFF)
    ax.plot(
        times, 100 * (sides[:, 0] - 1), color=BLUE, marker="o", ms=4, label="first column"
    )
    ax.plot(
        times, 100 * (sides[:, 1] - 1), color=RED, marker="o", ms=4, label="last column"
    )
    ax.set(
        xscale="log", xlabel="commanded exposure time [s]", ylabel="excess of signal [%]"
    )
    ax.legend(frameon=False, fontsize=8)
    return figure


@picture("psf_wings")
def draw_psf_wings() -> Figure:
    """Profile of a spot without and with 2 % of its light in a halo, 5 pixels wide."""
    figure, (ax,) = row(1)
    on = make_effect("psf_wings", {"frac": 0.02, "sigma": 5.0})
    profiles = []
    for effect in (on.scaled(0), on):
        _, part, wide = effect.spot_light(flat_shot(), make_layout())
        light = (1 - part) * star(1e5, (49, 49), 24, 24)
        profiles.append(
            light + part * star(1e5, (49, 49), 24, 24, float(np.hypot(1.5, wide)))
        )
    curves(ax, np.arange(-24, 25), *(p[24] for p in profiles))
    ax.set(yscale="log", ylim=(0.05, 2e4), xlabel="distance from the centre [pixel]",
           ylabel="signal [e⁻/pixel]")  # fmt: skip
    return figure


@picture("lateral_diffusion")
def draw_lateral_diffusion() -> Figure:
    """Left: profile of a spot that is 0.15 pixel^2 wider in variance. Right: its width
    against the back bias; the width of the optics does not depend on it.
    """
    figure, (left, right) = row(2)
    layout, effects = make_layout(), before_and_after("lateral_diffusion", {"var": 0.15})

    def width(effect: Effect, bias: float) -> float:
        added, _, _ = effect.spot_light(flat_shot(back_bias=bias), layout)
        return float(np.sqrt(1.0 + added))

    spots = [star(1e5, (15, 15), 7, 7, width(e, -60.0))[7] for e in effects]
    curves(left, np.arange(-7, 8), *spots, marker="o")
    left.set(xlabel="distance from the centre [pixel]", ylabel="signal [e⁻/pixel]",
             title="back bias -60 V")  # fmt: skip
    bias = np.linspace(-80, -30, 26)
    curves(right, bias, *(np.array([width(e, b) for b in bias]) for e in effects))
    right.set(xlabel="back bias [V]", ylabel="sigma of the spot [pixel]", title="width")
    return figure


# -- edges that stand off --------------------------------------------------------------


def _draw_map(
    word: str, values: dict[str, float], limit: float, *, size: int = 200, flats: int = 50
) -> Figure:
    """Mean map of flats without and with displaced edges, and one row of it."""
    figure, panels = row(3)
    layout = make_layout(size, size, 1)
    change = areas(make_effect(word, values), flat_shot(), layout)
    rng = np.random.default_rng(4731)
    noise = 100 * rng.standard_normal(layout.shape) / np.sqrt(flats * 1e5)
    show(panels[0], noise, f"{flats} flats, without", -limit, limit, bar=False)
    show(panels[1], noise + change, "with the effect", -limit, limit, unit="%")
    middle = np.s_[size // 2 - 4 : size // 2 + 4]
    means = [m[middle].mean(0) for m in (noise, noise + change)]
    curves(panels[2], np.arange(size), *means)
    panels[2].set(
        xlabel="x [pixel]", ylabel="relative signal [%]", ylim=(-limit, 1.5 * limit)
    )
    panels[2].set_title("mean of 8 rows in the middle", fontsize=10)
    return figure


@picture("tree_rings")
def draw_tree_rings() -> Figure:
    """Mean map of flats with rings about a centre outside the sensor, for an amplitude of
    0.03 pixel.
    """
    return _draw_map("tree_rings", {"amp": 0.03, "period": 24.0, "xc": -60.0, "yc": -40.0,
                                    "chirp": 0.02, "phase": 0.0}, 1.5)  # fmt: skip


@picture("edge_rolloff")
def draw_edge_rolloff() -> Figure:
    """Mean map of flats whose pixels at the rim are wider: edges stand outwards by 0.1
    pixel at the rim and less with exp(-d / 5 pixels).
    """
    return _draw_map("edge_rolloff", {"amp": 0.1, "length": 5.0}, 2.5)


@picture("mask_stitch")
def draw_mask_stitch() -> Figure:
    """Mean map of flats whose every 40th boundary between columns is off by 0.008 pixel:
    one column is wider, the next narrower.
    """
    return _draw_map("mask_stitch", {"amp": 0.008, "period": 40, "phase": 17}, 1.0)


@picture("tearing")
def draw_tearing() -> Figure:
    """Single flats of 100,000 e-, without and with edges beside one boundary that stand
    off by 0.05 pixel; the tear ends at another row in each exposure.
    """
    figure, panels = row(3)
    layout = make_layout(120, 120, 1)
    effect = make_effect(
        "tearing", {"amp": 0.05, "length": 2.5, "column": 0.5, "open": 0.3}
    )
    rng = np.random.default_rng(4733)
    for k, ax in enumerate(panels):
        noise = 100 * rng.standard_normal(layout.shape) / np.sqrt(1e5)
        shot = flat_shot()._replace(number=k + 2)
        change = areas(effect, shot, layout) if k else 0.0
        title = f"flat {k}, with" if k else "without"
        show(ax, noise + change, title, -2.5, 2.5, unit="%", bar=k == 2)
    return figure


# -- stored charge ---------------------------------------------------------------------


def _stored(effect: Effect, charge: Array, shot: Shot, layout: Layout, seed: int) -> Array:
    """Charge after an effect on what is stored, with read noise [e-]."""
    rng = np.random.default_rng(seed)
    noise = NOISE * rng.standard_normal(charge.shape)
    return effect.store(charge, shot, layout, rng, {}) + noise


@picture("dark_hot")
def draw_dark_hot() -> Figure:
    """A dark of 60 s without and with three hot columns of 2 e- a second, and with dark
    current of 0.5 e- a second in all pixels.
    """
    figure, panels = row(3)
    layout = make_layout(64, 64, 1)
    places = {f"x{n}": 0.0 for n in range(1, 9)} | {"x1": 11.0, "x2": 12.0, "x3": 47.0}
    hot = _hot_columns(places)
    dark = make_effect("dark_hot", {"rate": 0.5}, "dark")
    shot, empty = Shot("dark", 0, 60.0, temperature=173.15), np.zeros((64, 64))
    drawn = (hot.scaled(0), "without"), (hot, "hot columns"), (dark, "dark current")
    for ax, (effect, title) in zip(panels, drawn, strict=True):
        show(ax, _stored(effect, empty, shot, layout, 4735), title, -20, 140)
    return figure


def _hot_columns(places: dict[str, float]) -> Effect:
    """Three hot columns, with as many places as the class has."""
    from bfsensor.effects.dark_hot import HotColumns

    known = {p.name: 0.0 for p in HotColumns.parameters} | {"rate": 2.0, "columns": 3.0}
    return HotColumns({**known, **{n: v for n, v in places.items() if n in known}})


@picture("cosmic_rays")
def draw_cosmic_rays() -> Figure:
    """A dark of 120 s, without and with 20 tracks a minute on 256 x 256 pixels: straight
    tracks of about 80 e- a micrometre.
    """
    figure, panels = row(2)
    layout = make_layout(256, 256, 1)
    shot, empty = Shot("dark", 0, 120.0), np.zeros((256, 256))
    effects = before_and_after("cosmic_rays", {"rate": 20.0})
    for ax, effect, title in zip(panels, effects, ("without", "with"), strict=True):
        show(ax, _stored(effect, empty, shot, layout, 4737), title, -20, 400)
    return figure


@picture("persistence")
def draw_persistence() -> Figure:
    """The dark after an exposure with a bright star, without and with a part of 5e-4 of
    the charge that shows again, and its signal in later darks.
    """
    figure, panels = row(3)
    layout = make_layout(48, 48, 1)
    bright = star(1.5e6, (48, 48), 22, 26, 2.0)
    effects = before_and_after("persistence", {"frac": 5e-4, "tau": 2.0})
    means = []
    for ax, effect, title in zip(panels, effects, ("without", "with"), strict=False):
        rng, memory = np.random.default_rng(4739), {}
        effect.store(bright, flat_shot(), layout, rng, memory)
        darks = []
        for _ in range(8):
            charge = effect.store(
                np.zeros((48, 48)), Shot("dark", 0, 1.0), layout, rng, memory
            )
            darks.append(charge + NOISE * rng.standard_normal((48, 48)))
        show(ax, darks[0], f"first dark, {title}", -15, 40)
        means.append([float(d[24:29, 20:25].mean()) for d in darks])
    curves(panels[2], np.arange(1, 9), *(np.array(m) for m in means), marker="o")
    panels[2].set(xlabel="dark after the star", ylabel="mean of 5 x 5 pixels [e⁻]")
    return figure


@picture("interpixel_coupling")
def draw_interpixel_coupling() -> Figure:
    """Left: one bright pixel gives 3e-3 of its charge to each neighbour in the row and
    1e-3 to each in the column. Right: covariance of neighbours over the level; coupling
    adds a constant, the brighter-fatter effect a slope.
    """
    figure, (left, right) = row(2)
    on = make_effect("interpixel_coupling", {"ax": 3e-3, "ay": 1e-3})
    lit = np.zeros((7, 7))
    lit[3, 3] = 1e5
    rng = np.random.default_rng(4741)
    show(left, on.store(lit, flat_shot(), make_layout(), rng, {}), "one pixel of 100,000 e⁻",
         0, 350, map_="magma")  # fmt: skip
    levels = np.linspace(2e3, 1e5, 30)
    plain = periodic(area_matrix(*shifts()), levels)
    seen = [
        e.covariances(plain, {"level": levels}, make_layout()) for e in (on.scaled(0), on)
    ]
    curves(right, levels / 1e3, *(1e3 * c[:, 0, 1] / levels for c in seen))
    right.set(xlabel="level [1000 e⁻]", ylabel="C₁₀ / level [10⁻³ e⁻]", title="flats")
    return figure


def periodic(a: Array, levels: Array) -> Array:
    """Covariances of flats at all lags of a periodic array [e-^2]."""
    from bfsensor.diagnose.model.flat_predictions import periodic_covariances

    return periodic_covariances(a, levels)


# -- collection: the brighter-fatter effect otherwise ----------------------------------


def _covariances(a: Array, levels: Array, law: Law | None = None) -> Array:
    return flat_covariances_of(a, levels, lags=2, law=law or Law())


@picture("bf_anisotropy")
def draw_bf_anisotropy() -> Figure:
    """Covariances of flats with the nearest neighbours in x and in y, for eps = 0.25:
    shifts in x are weaker and those in y stronger than simulated.
    """
    figure, panels = row(2)
    levels = np.linspace(1e3, 1e5, 40)
    effects = before_and_after("bf_anisotropy", {"eps": 0.25})
    found = [
        _covariances(with_edges(e, flat_shot(), make_layout()), levels) for e in effects
    ]
    for ax, (j, i), name in zip(panels, ((0, 1), (1, 0)), ("C₁₀", "C₀₁"), strict=True):
        curves(ax, levels / 1e3, *(c[:, j, i] for c in found))
        ax.set(xlabel="level [1000 e⁻]", ylabel=f"{name} [e⁻²]",
               title=f"neighbour in {'x' if i else 'y'}")  # fmt: skip
    return figure


@picture("bf_nonlinear")
def draw_bf_nonlinear() -> Figure:
    """Covariance with the neighbour in x over the level squared, for b = 3e-6 an electron:
    the response grows with the level where the simulation lets it be constant. The fall
    without the effect comes from areas that follow the charge.
    """
    figure, (ax,) = row(1)
    levels = np.linspace(5e3, 1e5, 40)
    a = area_matrix(*shifts())
    seen = [
        1e7 * _covariances(a, levels, e.law())[:, 0, 1] / levels**2
        for e in before_and_after("bf_nonlinear", {"b": 3e-6})
    ]
    curves(ax, levels / 1e3, *seen)
    ax.set(xlabel="level [1000 e⁻]", ylabel="C₁₀ / level² [10⁻⁷]")
    from_zero(ax)
    return figure


@picture("bf_long_range")
def draw_bf_long_range() -> Figure:
    """Change of the area of pixels by one electron against distance along x, for an added
    tail of 3e-8 / r^2 an electron.
    """
    figure, (ax,) = row(1)
    layout = make_layout(200, 200, 1)
    effects = before_and_after("bf_long_range", {"amp": 3e-8, "power": 2.0})
    far = wide_shifts(24)
    off, on = (area_matrix(*e.edges(*far, flat_shot(), layout)) for e in effects)
    distance = np.arange(1, 20)
    values = (np.array([lag(a, i, 0) for i in distance]) for a in (off, on))
    curves(ax, distance, *values, marker="o")
    ax.set(xscale="log", yscale="log", xlabel="distance in x [pixel]", ylabel="a_i0 [1/e⁻]")
    return figure


@picture("bf_chromatic")
def draw_bf_chromatic() -> Figure:
    """Area that a pixel loses by one electron against the wavelength, for kappa = 0.15 in
    addition to what the depth of conversion does.
    """
    waves = np.linspace(400.0, 1000.0, 25)
    layout = make_layout()

    def loss(effect: Effect, wave: float) -> float:
        kx, ky = effect.edges(*shifts(wave), flat_shot(wavelength=wave), layout)
        return -1e6 * lag(area_matrix(kx, ky), 0, 0)

    figure, (ax,) = row(1)
    effects = before_and_after("bf_chromatic", {"kappa": 0.15})
    curves(ax, waves, *(np.array([loss(e, w) for w in waves]) for e in effects))
    ax.set(xlabel="wavelength [nm]", ylabel="-a₀₀ [10⁻⁶/e⁻]")
    from_zero(ax)
    return figure


@picture("voltage_dependence")
def draw_voltage_dependence() -> Figure:
    """Area that a pixel loses by one electron against the back bias, for delta = 0.2. The
    change counts from the reference (grey line); the simulation's own dependence is
    left out here.
    """
    bias, layout = np.linspace(-80.0, -30.0, 26), make_layout()
    figure, (ax,) = row(1)
    values = [
        np.array(
            [-1e6 * lag(with_edges(e, flat_shot(back_bias=v), layout), 0, 0) for v in bias]
        )
        for e in before_and_after("voltage_dependence", {"delta": 0.2})
    ]
    curves(ax, bias, *values)
    from_zero(ax)
    ax.axvline(layout.reference[1], color=GREY, lw=1)
    ax.set(xlabel="back bias [V]", ylabel="-a₀₀ [10⁻⁶/e⁻]")
    return figure


@picture("device_parameter")
def draw_device_parameter() -> Figure:
    """Change of the area of pixels along x by one electron, for the shipped ITL device of
    100 um and for one that is 20 um thicker; the mesh is coarse.
    """
    device = Device.load("itl_sta3800c")
    thicker = device.with_value("thickness", "101 um")
    solved = solve_response(device, cells=8, refine_z=0, changed=[(thicker, 1.0)])
    top = len(solved.depths) - 1
    slopes = {"thickness": {(620.0, -50.0): (solved.dkx[0, top], solved.dky[0, top])}}
    (kind,) = device_parameters(slopes, {"thickness": 5.0}, {"thickness": 100.0})
    edges, shot = (solved.kx[top], solved.ky[top]), flat_shot()
    matrices = [
        area_matrix(*kind({"thickness": t}).edges(*edges, shot, make_layout()))
        for t in (100, 120)
    ]
    figure, (left, right) = row(2)
    i = np.arange(1, 5)
    curves(left, i, *(np.array([lag(a, n, 0) for n in i]) for a in matrices), marker="o")
    left.set(yscale="log", xlabel="distance in x [pixel]", ylabel="a_i0 [1/e⁻]", xticks=i)
    middle = len(matrices[0]) // 2
    inner = np.s_[middle - 3 : middle + 4, middle - 3 : middle + 4]
    change = 100 * (matrices[1][inner] / matrices[0][inner] - 1)
    limit = float(np.abs(change).max())
    show(right, change, "change of a_ij by 20 um", -limit, limit, map_="RdBu_r", unit="%",
         origin=(-3, -3))  # fmt: skip
    right.set(xlabel="i [pixel]", ylabel="j [pixel]")
    return figure


def _flat_mean(light: float, effects: Iterable[Effect] = ()) -> float:
    """Mean of a flat that the sensor draws, for so much light in a pixel."""
    sensor = bfsensor.BrighterFatterSensor(
        "itl_sta3800c", effects=list(effects), layout={"shape": (32, 32)},
        rng=galsim.BaseDeviate(4743), full_well=1e6,
    )  # fmt: skip
    flat = draw_flat(sensor, (32, 32), light, step=2500.0, rng=galsim.BaseDeviate(4744))
    return float(flat.array.mean())


@picture("charge_loss")
def draw_charge_loss() -> Figure:
    """Mean of flats against the light, for q = 3e-7 an electron: light is collected the
    less, the more charge is there, and no neighbour gains.
    """
    figure, (left, right) = row(2)
    light = np.array([5e3, 2e4, 4e4, 6e4, 8e4, 1e5])
    loss = make_effect("charge_loss", {"q": 3e-7})
    off, on = (np.array([_flat_mean(v, e) for v in light]) for e in ([], [loss]))
    curves(left, light / 1e3, 100 * (off / light - 1), 100 * (on / light - 1), marker="o")
    left.set(xlabel="light [1000 e⁻/pixel]", ylabel="mean over light - 1 [%]", title="mean")
    levels = np.linspace(2e3, 1e5, 30)
    a = area_matrix(*shifts())
    seen = [_covariances(a, levels, law)[:, 0, 0] / levels for law in (Law(), loss.law())]
    curves(right, levels / 1e3, *seen)
    right.set(xlabel="level [1000 e⁻]", ylabel="variance / level", title="variance")
    return figure


@picture("saturation")
def draw_saturation() -> Figure:
    """A star of 2.6e6 e- without and with a full well of 80,000 e-: charge beyond it
    spills along the column.
    """
    figure, panels = row(2)
    light = galsim.Gaussian(sigma=0.35, flux=2.6e6)
    full = make_effect("saturation", {"full_well": 8e4})
    for ax, effects, title in zip(panels, ([], [full]), ("without", "full well of 80,000 e⁻"),
                                  strict=True):  # fmt: skip
        sensor = bfsensor.BrighterFatterSensor(
            "itl_sta3800c", effects=effects, layout={"shape": (31, 31)},
            rng=galsim.BaseDeviate(4745),
        )  # fmt: skip
        image = light.drawImage(
            nx=31,
            ny=31,
            scale=0.2,
            method="phot",
            sensor=sensor,
            rng=galsim.BaseDeviate(4746),
        )
        sensor.finish(image)
        show(ax, image.array, title, 0, 1.4e5, map_="magma")
    return figure


# -- all of them -----------------------------------------------------------------------


def digest() -> str:
    """Digest of the code that pictures depend on."""
    root = Path(bfsensor.__file__).parent
    found = hashlib.sha256()
    for path in [Path(__file__), *sorted((root / "effects").glob("*.py"))]:
        found.update(path.read_bytes())
    return found.hexdigest()


def draw_all(folder: Path, words: Iterable[str] | None = None) -> None:
    """Draw the pictures of some or of all classes into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for word in words or PICTURES:
        PICTURES[word].draw().savefig(folder / f"{word}.png", dpi=110)


def draw_once(folder: Path) -> None:
    """Draw all pictures unless the folder has those of the same code."""
    mark = folder / "digest.txt"
    if mark.is_file() and mark.read_text() == digest():
        return
    draw_all(folder)
    mark.write_text(digest())


if __name__ == "__main__":
    draw_all(Path(sys.argv[1]), sys.argv[2:])
