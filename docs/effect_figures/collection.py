"""Pictures of stored charge and of the brighter-fatter effect."""

from __future__ import annotations

from collections.abc import Iterable

import galsim
import numpy as np
from matplotlib.figure import Figure

import bfsensor
from bfsensor.device.device import Device
from bfsensor.diagnose.model.flat_predictions import (
    flat_covariances_of,
    periodic_covariances,
)
from bfsensor.effects.dark_hot import HotColumns
from bfsensor.effects.device_parameter import device_parameters
from bfsensor.effects.effect import Effect, Law, Layout, Shot
from bfsensor.plots.style import GREY
from bfsensor.response.edge_response import area_matrix, solve_response
from bfsensor.sensor.flats import draw_flat
from effect_figures import parts
from effect_figures.parts import (
    NOISE,
    Array,
    before_and_after,
    curves,
    flat_shot,
    from_zero,
    lag,
    make_layout,
    picture,
    row,
    shifts,
    show,
    star,
    wide_shifts,
    with_edges,
)


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
    hot = HotColumns({"rate": 2.0, "columns": 3.0, "x1": 11.0, "x2": 12.0, "x3": 47.0})
    dark = parts.make_effect("dark_hot", {"rate": 0.5}, "dark")
    shot, empty = Shot("dark", 0, 60.0, temperature=173.15), np.zeros((64, 64))
    drawn = (hot.scaled(0), "without"), (hot, "hot columns"), (dark, "dark current")
    for ax, (effect, title) in zip(panels, drawn, strict=True):
        show(ax, _stored(effect, empty, shot, layout, 4735), title, -20, 140)
    return figure


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
    on = parts.make_effect("interpixel_coupling", {"ax": 3e-3, "ay": 1e-3})
    lit = np.zeros((7, 7))
    lit[3, 3] = 1e5
    rng = np.random.default_rng(4741)
    show(left, on.store(lit, flat_shot(), make_layout(), rng, {}), "one pixel of 100,000 e⁻",
         0, 350, map_="magma")  # fmt: skip
    levels = np.linspace(2e3, 1e5, 30)
    plain = periodic_covariances(area_matrix(*shifts()), levels)
    seen = [
        e.covariances(plain, {"level": levels}, make_layout()) for e in (on.scaled(0), on)
    ]
    curves(right, levels / 1e3, *(1e3 * c[:, 0, 1] / levels for c in seen))
    right.set(xlabel="level [1000 e⁻]", ylabel="C₁₀ / level [10⁻³ e⁻]", title="flats")
    return figure


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
    loss = parts.make_effect("charge_loss", {"q": 3e-7})
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
    full = parts.make_effect("saturation", {"full_well": 8e4})
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
