"""What corrections leave of the growth of stars: two devices, three sizes, skies and bands.

``python -m validation.correction.star_sizes take|show``

take
    Stars with a FWHM of 2, 3 and 4 pixels and 20 to 120 ke- in the peak, on skies of 0, 1000 and
    20,000 e-, in u, r and y, from the same photons with and without the effect; one more star stands
    beside a saturated one, whose charge bled and is masked.  Adaptive moments before and after each
    correction, a row a star in ``validation/results/star_sizes.ecsv``.  Rows that are there are kept.
    ``--device hsc_hamamatsu`` is a sensor of image charges in place of Poisson's equation.
show
    Print what is left of the slope of size against peak, of the ellipticity, and of biases of shear.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path

import click
import galsim
import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray

from bfsensor import BrighterFatterSensor, DistortionTable
from bfsensor.device.shipped import tables_dir
from bfsensor.device.silicon import absorption_length
from bfsensor.measure.correct import correct_edges, correct_kernel
from bfsensor.sensor.table_correction import correct_table
from bfsensor.table.lsst_format import solve_kernel
from bfsensor.table.quadrant_shifts import quadrant_shifts
from validation.common.write_results import write_results
from validation.psf_requirement.shear_bias import Shape, adaptive_shape, shear_bias

RESULTS = Path(__file__).parents[1] / "results"
STARS = RESULTS / "star_sizes.ecsv"
COMMAND = "python -m validation.correction.star_sizes take"
DEVICES = ("itl_sta3800c", "e2v_ccd250")
WIDTHS = (2.0, 3.0, 4.0)
"""FWHM of the light before diffusion [pixel]."""
PEAKS = (20e3, 50e3, 80e3, 120e3)
"""Charge of light in the brightest pixel of a centred star above the sky [e-]."""
SKIES = (0.0, 1e3, 2e4)
BANDS = {
    "u": np.arange(330.0, 401.0, 5.0),
    "r": np.arange(550.0, 691.0, 10.0),
    "y": np.arange(920.0, 1051.0, 5.0),
}
"""Wavelengths [nm] that stand for a band, equally many photons each."""
NEIGHBOUR = 1e9
"""Stands in the column of peaks for a star of 80 ke- beside a saturated one."""
BESIDE = (8.0, 3.0)
"""Place of the saturated star [pixel], whose charge moves boundaries of the star's wings."""
BESIDE_PEAK = 2.5e5
"""Light in its brightest pixel [e-]: its charge bleeds."""
CROP = 5
"""Half side of the part of a stamp in which a star beside a saturated one is measured [pixel]."""
SIDE, SIDE_IN_SKY = 25, 17
"""Sides of stamps [pixel], without and with the brightest sky, whose photons take most of the time."""
BLOCKS = 1000
"""Renewals of the boundaries in an exposure.  Chosen: with 75 they lag behind the charge by 2 % of it in
small stars, and the lag falls with their number."""
TEMPERATURE = 173.15
"""Of both devices [K]."""
UNIT = 50e3
"""Peak for which growths are quoted [e-]."""
BRIGHT = 100e3
"""Peak for which ellipticities and biases of shear are quoted [e-]."""


@lru_cache(maxsize=2)
def table_of(device: str) -> DistortionTable:
    """Give a built-in table."""
    return DistortionTable.read(tables_dir() / device / "table.fits")


@lru_cache(maxsize=2)
def corrections(device: str) -> dict[str, Callable[..., NDArray]]:
    """Give the corrections by name; each takes an image, a mask and a band."""
    table = table_of(device)
    empty = quadrant_shifts(table, tail_slope=None)
    # Tables of image charges have one background, on which nothing depends.
    highest = min(50e3, float(table.backgrounds[-1]))
    level = quadrant_shifts(table, background=highest, tail_slope=None)
    kernel, kernel_level = solve_kernel(empty.areas), solve_kernel(level.areas)

    def own(image: NDArray, mask: NDArray, band: str) -> NDArray:
        return correct_table(image, table, mask=mask, wavelengths=BANDS[band])

    def red(image: NDArray, mask: NDArray, band: str) -> NDArray:
        return correct_table(image, table, mask=mask, wavelengths=BANDS["r"])

    return {
        "none": lambda image, mask, band: image,
        "table": own,
        "table of r": red,
        "kernel": lambda image, mask, band: correct_kernel(image, kernel),
        "edges": lambda image, mask, band: correct_edges(image, *empty),
        "kernel, at 50 ke-": lambda image, mask, band: correct_kernel(image, kernel_level),
        "edges, at 50 ke-": lambda image, mask, band: correct_edges(image, *level),
    }


def light_of(
    device: str, width: float, peak: float, sky: float, band: str, seed: int
) -> galsim.PhotonArray:
    """Photons of a star somewhere in the middle pixel, of its sky, and of a saturated star beside it."""
    beside = peak == NEIGHBOUR
    rng = np.random.default_rng([seed, int(peak), int(10 * width), int(sky)])
    place = np.random.default_rng([seed, 5077]).random(2) - 0.5
    sigma = width / np.sqrt(8 * np.log(2))
    # Of red light a part crosses the silicon: there are more photons than charge.
    lengths = absorption_length(BANDS[band], TEMPERATURE)
    more = 1 / np.mean(-np.expm1(-table_of(device).thickness / lengths))
    one = 2 * np.pi * sigma**2 * more

    def star(charge: float, at: NDArray) -> NDArray:
        return at[:, None] + rng.normal(0, sigma, (2, rng.poisson(charge * one)))

    parts = [star(8e4 if beside else peak, place)]
    if beside:
        parts.append(star(BESIDE_PEAK, np.array(BESIDE)))
    side = side_of(sky)
    parts.append(rng.uniform(-side / 2, side / 2, (2, rng.poisson(sky * more * side**2))))
    x, y = rng.permutation(np.concatenate(parts, axis=1), axis=1)
    return galsim.PhotonArray(
        len(x), x, y, np.ones(len(x)), wavelength=rng.choice(BANDS[band], len(x))
    )


def side_of(sky: float) -> int:
    """Side of the stamps in a sky [pixel]."""
    return SIDE_IN_SKY if sky == max(SKIES) else SIDE


def draw(
    device: str, strength: float, photons: galsim.PhotonArray, seed: int, side: int
) -> NDArray:
    """Draw a stamp; what is random is the same for all strengths."""
    camera = BrighterFatterSensor(
        table=table_of(device), strength=strength, rng=galsim.BaseDeviate(seed),
        nrecalc=max(photons.size() / BLOCKS, 20.0), surroundings="mirrored",
    )  # fmt: skip
    image = galsim.ImageD(side, side)
    image.setCenter(0, 0)
    camera.accumulate(photons, image)
    return image.array


def size_of(pixels: NDArray) -> NDArray:
    """Second moments in x and y [pixel^2] and the ellipticity."""
    shape: Shape = adaptive_shape(pixels)
    return np.array(
        [0.5 * shape.trace * (1 + shape.e1), 0.5 * shape.trace * (1 - shape.e1), shape.e1]
    )


def star_row(
    device: str, width: float, peak: float, sky: float, band: str, seed: int
) -> dict:
    """Draw one star with and without the effect and correct it every way."""
    began = time.process_time()
    photons = light_of(device, width, peak, sky, band, seed)
    on, off = (
        draw(device, strength, photons, seed, side_of(sky)) for strength in (1.0, 0.0)
    )
    mask = on > 0.9 * table_of(device).full_well
    row: dict[str, object] = {
        "device": device, "width": width, "peak": peak, "sky": sky, "band": band, "seed": seed,
        "masked": int(mask.sum()),
    }  # fmt: skip
    middle = slice(None)
    if peak == NEIGHBOUR:
        middle = slice(SIDE // 2 - CROP, SIDE // 2 + CROP + 1)
    without = size_of((off - sky)[middle, middle])
    for name, correct in corrections(device).items():
        found = size_of((correct(on, mask, band) - sky)[middle, middle])
        row[f"x {name}"], row[f"y {name}"] = 100 * (found[:2] / without[:2] - 1)
        row[f"e {name}"] = found[2] - without[2]
    row["cpu_s"] = round(time.process_time() - began, 2)
    return row


def cases(count: int, devices: tuple[str, ...] = DEVICES) -> Iterator[dict[str, object]]:
    """Give the keys of all rows, one star of each kind before the second."""
    for seed in range(9101, 9101 + count):
        for device, width in itertools.product(devices, WIDTHS):
            for sky, band in itertools.product(SKIES, BANDS):
                peaks = (*PEAKS, NEIGHBOUR) if (sky, band) == (1e3, "r") else PEAKS
                for peak in peaks:
                    yield {"device": device, "width": width, "peak": peak, "sky": sky,
                           "band": band, "seed": seed}  # fmt: skip


def take(
    path: Path, count: int, skies: tuple[float, ...] = SKIES,
    devices: tuple[str, ...] = DEVICES,
) -> None:  # fmt: skip
    """Make the rows that are not there, in some of the skies."""
    old = Table.read(path, format="ascii.ecsv") if path.exists() else None
    names = ("device", "width", "peak", "sky", "band", "seed")
    there = set() if old is None else {tuple(row[n] for n in names) for row in old}
    made: list[dict] = []
    for key in cases(count, devices):
        if key["sky"] not in skies or tuple(key[n] for n in names) in there:
            continue
        made.append(star_row(**key))
        if len(made) >= 4:
            old = _added(old, made, path)
            made = []
    if made:
        _added(old, made, path)


def _added(old: Table | None, made: list[dict], path: Path) -> Table:
    """Write a file with more rows."""
    new = Table(rows=made)
    if old is not None:
        new = vstack([old, new], metadata_conflicts="silent")
    write_results(new, path, COMMAND, added=True)
    return new


# -- what the rows say -----------------------------------------------------------------


def slopes(rows: Table, name: str, what: str) -> NDArray:
    """Slopes of a growth against the peak, through the origin, a star of each peak each [per e-]."""
    out = []
    for seed in sorted(set(rows["seed"])):
        part = rows[rows["seed"] == seed]
        peaks = np.array(part["peak"])
        if len(peaks) == len(PEAKS):
            out.append(peaks @ np.array(part[f"{what} {name}"]) / (peaks @ peaks))
    return np.array(out)


def left(rows: Table, name: str, what: str) -> tuple[float, float]:
    """What is left of the slope [%], and its error from the scatter among stars."""
    before, after = slopes(rows, "none", what), slopes(rows, name, what)
    ratio = after.mean() / before.mean()
    error = (
        np.std(after - ratio * before, ddof=1) / np.sqrt(len(before)) / abs(before.mean())
    )
    return 100 * float(ratio), 100 * float(error)


def together(rows: Table, name: str, what: str) -> tuple[float, float]:
    """Mean of what is left over all skies and bands of the rows [%], and its error among seeds."""
    each = []
    for seed in sorted(set(rows["seed"])):
        before, after = 0.0, 0.0
        for sky, band in itertools.product(SKIES, BANDS):
            part = select(rows, seed=seed, sky=sky, band=band)
            if len(part) == len(PEAKS):
                before += float(slopes(part, "none", what)[0])
                after += float(slopes(part, name, what)[0])
        if before:
            each.append((before, after))
    if len(each) < 2:
        return np.nan, np.nan
    before, after = np.transpose(each)
    ratio = after.sum() / before.sum()
    error = np.std(after - ratio * before, ddof=1) / np.sqrt(len(each)) / before.mean()
    return 100 * float(ratio), 100 * float(error)


def shape_left(rows: Table, name: str) -> tuple[float, float]:
    """Ellipticity left at :data:`BRIGHT`, and its error."""
    found = BRIGHT * slopes(rows, name, "e")
    return float(found.mean()), float(found.std(ddof=1) / np.sqrt(len(found)))


def bias_left(rows: Table, name: str) -> tuple[float, float]:
    """Biases m and c of a shear whose PSF is a star of :data:`BRIGHT`, as large as the galaxy."""
    growths = [BRIGHT * slopes(rows, name, axis).mean() / 100 for axis in "xy"]
    found = shear_bias(np.mean(growths), shape_left(rows, name)[0])
    return float(found.m), float(found.c)


def select(rows: Table, **given: object) -> Table:
    """Rows with these values, and stars without a neighbour only."""
    keep = np.asarray(rows["peak"] != NEIGHBOUR)
    for name, value in given.items():
        keep &= np.asarray(rows[name] == value)
    return rows[keep]


def show(path: Path, devices: tuple[str, ...] = DEVICES) -> None:
    """Print what is left, by device, width, sky and band."""
    rows = Table.read(path, format="ascii.ecsv")
    names = list(corrections(devices[0]))[1:]
    for device, width in itertools.product(devices, WIDTHS):
        for sky, band in itertools.product(SKIES, BANDS):
            part = select(rows, device=device, width=width, sky=sky, band=band)
            if len(slopes(part, "none", "x")) < 2:
                continue
            text = f"{device[:3]} {width:.0f} sky {sky:5.0f} {band}"
            for name in names:
                (x, dx), (y, dy) = (left(part, name, axis) for axis in "xy")
                text += f" | {name} {x:+.1f} {y:+.1f} ({dx:.1f} {dy:.1f})"
            e, error = shape_left(part, "table")
            m, c = bias_left(part, "table")
            print(f"{text} | e {e:+.1e} ({error:.0e}) m {m:+.1e} c {c:+.1e}")
        part = select(rows, device=device, width=width)
        text = f"{device[:3]} {width:.0f} all skies and bands"
        for name in names:
            (x, dx), (y, dy) = (together(part, name, axis) for axis in "xy")
            text += f" | {name} {x:+.2f} {y:+.2f} ({dx:.2f} {dy:.2f})"
        print(text)
        beside = rows[(rows["peak"] == NEIGHBOUR) & (rows["device"] == device)]
        beside = beside[beside["width"] == width]
        if len(beside):
            text = ", ".join(
                f"{name} {np.mean(beside[f'x {name}']):+.3f} {np.mean(beside[f'y {name}']):+.3f}"
                for name in ("none", *names)
            )
            print(f"{device[:3]} {width:.0f} beside a saturated star, growth [%]: {text}")


@click.command(help=__doc__)
@click.argument("what", type=click.Choice(["take", "show"]))
@click.option("--count", default=8, help="Stars of each kind.")
@click.option("--sky", type=float, multiple=True, help="Skies [e-], by default all.")
@click.option(
    "--device", multiple=True, help="Devices, by default two of Poisson's equation."
)
@click.option("--folder", default=str(RESULTS))
def main(
    what: str, count: int, sky: tuple[float, ...], device: tuple[str, ...], folder: str
) -> None:
    """Take rows, or print what they say."""
    path = Path(folder) / STARS.name
    if what == "take":
        take(path, count, sky or SKIES, device or DEVICES)
    else:
        show(path, device or DEVICES)


if __name__ == "__main__":
    main()
