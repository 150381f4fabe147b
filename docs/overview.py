"""Draw the pictures of README.md and of the Start pages: ``python docs/overview.py``."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from bfsensor.device.shipped import tables_dir
from bfsensor.diagnose.data.measure_channels import measure_channels
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.table.table import DistortionTable
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.concealed.library import make_effect
from validation.quoted_numbers import read_rows

CHARGE, EXAGGERATED = 100e3, 4.0
BLUE, RED, GREY = "#2b6ca3", "#c1432e", "0.55"


def draw_boundaries(ax: Axes) -> None:
    """Outlines of pixels about a full one, displacements drawn larger than they are."""
    table = DistortionTable.read(tables_dir() / "e2v_ccd250" / "table.fits")
    reach = 2
    for j in range(-reach, reach + 1):
        for i in range(-reach, reach + 1):
            moved = table.polygon(i, j, charge=CHARGE, depth=95.0)
            still = table.polygon(i, j, charge=1e-3, depth=95.0)
            shape = (still + EXAGGERATED * (moved - still)) / table.pitch
            full = i == j == 0
            ax.fill(*shape.T, fc="#f3c9a8" if full else "#eef3f7", ec=BLUE, lw=1.0)
    ax.set(
        aspect="equal", xlabel="x [pixel]", ylabel="y [pixel]",
        title=f"Pixel boundaries about {CHARGE:,.0f} e-\n(E2V, displacements x {EXAGGERATED:.0f})",
    )  # fmt: skip


def draw_growth(ax: Axes) -> None:
    """Growth of stars in y: GalSim's sensor, ours with the same physics, ours with the whole table."""
    ladder = read_rows("sensor_ladder")
    ladder = ladder[(ladder["device"] == "itl_sta3800c") & (ladder["sky"] == 0.0)]
    styles = {
        "galsim": ("galsim.SiliconSensor", "k", "s", "none"),
        "same physics": ("ours, the same table", BLUE, "o", BLUE),
        "whole table": ("ours, by charge and depth", RED, "o", RED),
    }
    for variant, (label, colour, marker, face) in styles.items():
        own = ladder[ladder["variant"] == variant]
        peaks = sorted(set(own["peak"]))
        tops, means, errors = [], [], []
        for peak in peaks:
            stars = own[own["peak"] == peak]
            growth = 100 * (stars["sy"] / stars["sy_off"] - 1)
            tops.append(stars["top_off"].mean() / 1e3)
            means.append(growth.mean())
            errors.append(growth.std(ddof=1) / np.sqrt(len(stars)))
        ax.errorbar(
            tops,
            means,
            errors,
            color=colour,
            marker=marker,
            mfc=face,
            ms=5,
            lw=1,
            label=label,
        )
    ax.legend(frameon=False, loc="upper left")
    ax.set(
        xlabel="peak of the star [1000 e-]", ylabel="growth of its width in y [%]",
        title="Bright stars come out wider\n(ITL, GalSim's photon shooting)",
    )  # fmt: skip


def draw_diagnosis(ax: Axes) -> None:
    """Charge after the last column: recorded, simulated without and with the trap that is named."""
    trap = make_effect("trap_serial", {"size": 30.0, "tau": 1.5, "amp": 1})
    measured = measure_channels(VirtualSource(seed=815, effects=[trap]))
    found = diagnose_measured(measured, virtual_baseline())
    assert found.attribution is not None and found.predictor is not None
    after = found.attribution
    channel = next(
        c
        for c in found.fit.channels
        if c.word == "serial_overscan" and c.axes["k"].max() > 6
    )
    x = channel.axes
    level = np.max(x["level"][x["amp"] == 1])
    rows = np.flatnonzero((x["amp"] == 1) & (x["level"] == level) & (x["k"] <= 12))
    # The first names of a fit are those of its predictor's non-linear parameters.
    before_all = found.predictor.predict(
        channel, found.fit.values[: len(found.predictor.names)]
    )
    after_all = after.predictor.predict(
        channel, after.fit.values[: len(after.predictor.names)]
    )
    k = x["k"][rows]
    ax.errorbar(
        k, channel.values[rows], channel.errors[rows], fmt="ko", ms=4, label="recorded"
    )
    ax.plot(k, before_all[rows], color=GREY, lw=1.5, label="simulated, as known")
    named = after.found[0].effect
    size, tau = named["size"], named["tau"]
    label = f"with the trap that was named:\n{size:.1f} e-, {tau:.2f} pixel times"
    ax.plot(k, after_all[rows], color=RED, lw=1.5, label=label)
    ax.legend(frameon=False)
    ax.set(
        xlabel="pixel after the last column", ylabel=f"charge left behind [{channel.unit}]",
        title="What was left out is named\n(truth: 30 e-, 1.50 pixel times)",
    )  # fmt: skip


def main() -> None:
    """Write docs/figures/overview.png, and each of its parts by its name."""
    mpl.rcParams.update(
        {
            "font.size": 11,
            "axes.titlesize": 12,
            "axes.spines.top": False,
            "axes.spines.right": False,
        }
    )
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.6), constrained_layout=True)
    folder = Path(__file__).parent / "figures"
    parts = {
        "boundaries": draw_boundaries,
        "growth": draw_growth,
        "diagnosis": draw_diagnosis,
    }
    for (name, draw), ax in zip(parts.items(), axes, strict=True):
        draw(ax)
        alone, panel = plt.subplots(figsize=(6, 4.6), constrained_layout=True)
        draw(panel)
        alone.savefig(folder / f"{name}.png", dpi=110)
    figure.savefig(folder / "overview.png", dpi=110)


if __name__ == "__main__":
    main()
