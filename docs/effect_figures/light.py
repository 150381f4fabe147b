"""Pictures of light, and of edges that stand off their places."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bfsensor.effects.effect import Effect
from bfsensor.plots.style import BLUE, RED
from effect_figures import parts
from effect_figures.parts import (
    OFF,
    areas,
    before_and_after,
    curves,
    flat_shot,
    make_layout,
    picture,
    row,
    show,
    star,
)


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
    effect = parts.make_effect("fringing", {"amp": 0.01, "period": 30.0, "tilt": 0.6, "xx": 0.8,
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
    effect = parts.make_effect("shutter_timing", {"dt": 0.02, "shade": 0.4})
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
    """Profile of a spot without and with 2 % of its light in a halo: one 5 pixels wide, one that
    falls exponentially within 5 pixels, and an aureole that falls as the square of the distance.
    """
    figure, (ax,) = row(1)
    on = parts.make_effect("psf_wings", {"frac": 0.02, "sigma": 5.0})
    far = {"frac": 0.02, "length": 5.0}
    others = [
        parts.make_effect("psf_wings", far, law) for law in ("exponential", "aureole")
    ]
    profiles = []
    for effect in (on.scaled(0), on, *others):
        _, halo = effect.spot_light(flat_shot(), make_layout())
        light = (1 - sum(part for part, _ in halo)) * star(1e5, (49, 49), 24, 24)
        for part, wide in halo:
            sigma = float(np.hypot(1.5, wide))
            light = light + part * star(1e5, (49, 49), 24, 24, sigma)
        profiles.append(light)
    curves(ax, np.arange(-24, 25), *(p[24] for p in profiles[:2]))
    for profile, name in zip(profiles[2:], ("exponential", "aureole"), strict=True):
        ax.plot(np.arange(-24, 25), profile[24], "--", lw=1, label=name)
    ax.legend()
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
        added, _ = effect.spot_light(flat_shot(back_bias=bias), layout)
        return float(np.sqrt(1.0 + added))

    spots = [star(1e5, (15, 15), 7, 7, width(e, -60.0))[7] for e in effects]
    curves(left, np.arange(-7, 8), *spots, marker="o")
    left.set(xlabel="distance from the centre [pixel]", ylabel="signal [e⁻/pixel]",
             title="back bias -60 V")  # fmt: skip
    bias = np.linspace(-80, -30, 26)
    curves(right, bias, *(np.array([width(e, b) for b in bias]) for e in effects))
    right.set(xlabel="back bias [V]", ylabel="sigma of the spot [pixel]", title="width")
    return figure


def _draw_map(
    word: str, values: dict[str, float], limit: float, *, size: int = 200, flats: int = 50
) -> Figure:
    """Mean map of flats without and with displaced edges, and one row of it."""
    figure, panels = row(3)
    layout = make_layout(size, size, 1)
    change = areas(parts.make_effect(word, values), flat_shot(), layout)
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
    return _draw_map(
        "mask_stitch", {"amp": 0.008, "period": 40, "phase": 17, "along": 0}, 1.0
    )


@picture("tearing")
def draw_tearing() -> Figure:
    """Single flats of 100,000 e-, without and with edges beside one boundary that stand
    off by 0.05 pixel; the tear ends at another row in each exposure.
    """
    figure, panels = row(3)
    layout = make_layout(120, 120, 1)
    effect = parts.make_effect(
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
