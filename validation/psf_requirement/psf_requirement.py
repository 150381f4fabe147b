r"""What the brighter-fatter effect, and each of its parts, does to the size and shape of stars.

``python -m validation.psf_requirement.psf_requirement [--only PART]`` draws Kolmogorov stars of 0.7
arcsec on pixels of 0.2 arcsec (10 um) from the same photons with and without the effect, by
:class:`bfsensor.BrighterFatterSensor` as it is, with each part of its physics left out, and by
galsim.SiliconSensor with the table GalSim ships for the same operating point.  Parts of the run:

peaks
    all models, r band, dark sky, 10,000 to 130,000 e- in the peak;
skies
    from no sky to 10,000 e-, at 100,000 e-;
bands
    u to y, at 100,000 e-;
range
    models that differ in how far charge acts, at 100,000 e- in r.

One row a star and model is appended to ``validation/results/psf_requirement.ecsv``; what is there
is not done again.  Changes are of adaptive moments (``size``: of the trace, relative; ``e1``, ``e2``:
distortions), of moments without weights in a circle of 8 pixels (``open_``), and, for some, the shear
bias of re-Gaussianisation where the changed star serves as PSF of a Gaussian galaxy of equal trace
(``m``, ``c``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import click
import galsim
import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor import BrighterFatterSensor, DistortionTable, SiliconSensor
from bfsensor.device.shipped import tables_dir
from bfsensor.device.silicon import absorption_length
from bfsensor.errors import MeasurementError
from bfsensor.sensor.drift_field import solve_drift
from validation.common.write_results import write_results
from validation.psf_requirement.shear_bias import (
    Bias,
    adaptive_shape,
    open_shape,
    regaussianised_bias,
)

PATH = Path(__file__).parents[1] / "results" / "psf_requirement.ecsv"
DEVICE = "itl_sta3800c"
FWHM, SCALE = 0.7, 0.2  # arcsec
SIDE, RADIUS = 33, 8.0  # pixel
IN_PEAK = 0.05568  # part of the star in its central pixel
DARK = 800.0  # e-; 30 s in r, 21.2 mag/arcsec^2
PEAKS = {10e3: 16, 30e3: 14, 60e3: 8, 100e3: 8, 130e3: 6}
"""Stars for each peak [e-]."""
SKIES = {0.0: 5, 3e3: 5, 10e3: 4}
BANDS = dict.fromkeys("ugizy", 6)
AT = 100e3  # e-; peak of the stars on other skies and in other bands
RING = (0.05, 40.0)  # pixel; amplitude and period, not those of a sensor


@dataclass(frozen=True)
class Model:
    """What a row was drawn with.

    Attributes
    ----------
    options : dict
        For the sensor.
    parts : tuple of str
        Of the run in which it is drawn.
    half : bool
        No feedback: half of the final charge acts throughout.
    engine : type
        Class of the sensor; those named SiliconSensor take the table of GalSim, lsst_itl_50_8.
    """

    options: dict[str, Any] = field(default_factory=dict)
    parts: tuple[str, ...] = ("peaks",)
    half: bool = False
    engine: type = BrighterFatterSensor

    def sensor(self, seed: int, strength: float) -> galsim.Sensor:
        """Make the sensor; the same seed gives the same diffusion at every strength."""
        rng = galsim.BaseDeviate(seed)
        if self.engine is not BrighterFatterSensor:
            # GalSim divides by the strength.
            return self.engine(rng=rng, strength=max(strength, 1e-9), **self.options)
        options: dict[str, Any] = {"diffusion": "einstein"} | {
            name: value()
            if callable(value) and name in ("table", "treering_func")
            else value
            for name, value in self.options.items()
        }
        factor = options.pop("strength", 1.0)
        if "table" not in options:
            options = {"name": DEVICE, **options}
        return BrighterFatterSensor(rng=rng, strength=strength * factor, **options)

    @property
    def light(self) -> str:
        """Models that are told apart by no star without the effect share this."""
        own = ("diffusion_factor", "diffusion", "treering_func", "absorption", "name")
        kept = [name for name in own if name in self.options]
        return f"{self.engine} {[(name, str(self.options[name])) for name in kept]}"


@lru_cache(maxsize=1)
def isotropic_table() -> DistortionTable:
    """The mean of the table and of itself with x and y exchanged."""
    table = DistortionTable.read(tables_dir() / DEVICE / "table.fits")

    def turned(array: NDArray[np.floating], first: int) -> NDArray[np.floating]:
        return array.swapaxes(first, first + 1)[..., ::-1]

    return replace(
        table,
        corners=0.5 * (table.corners + turned(table.corners, -3)),
        horizontal=0.5 * (table.horizontal + turned(table.vertical, -4)),
        vertical=0.5 * (table.vertical + turned(table.horizontal, -4)),
    )


def rings() -> galsim.LookupTable:
    """Weak tree rings around a far centre."""
    return galsim.SiliconSensor.simple_treerings(RING[0], RING[1], r_max=1000.0)


# All models but 'wide diffusion' have Einstein's width, with which more of the effect is left in a star.
ALL = ("peaks", "skies", "bands", "range")
SHEARED = ("whole", "GalSim", "nearest pixels", "E2V")
"""Models whose m and c are measured, at AT on a dark sky in r."""
MODELS = {
    "whole": Model(parts=ALL),
    "GalSim": Model(engine=galsim.SiliconSensor, parts=ALL),
    "GalSim's table, our engine": Model(engine=SiliconSensor),
    "GalSim's table, 4 pixels": Model(
        {"qdist": 4}, parts=("range",), engine=SiliconSensor
    ),
    "linear": Model({"charge_response": False}, parts=("peaks", "skies")),
    "no background": Model({"background": False}, parts=("peaks", "skies")),
    "no depth": Model({"depth": False}, parts=("peaks", "bands")),
    "GalSim's absorption": Model({"absorption": "galsim"}, parts=("bands",)),
    "no diffusion": Model({"diffusion_factor": 0.0}),
    "wide diffusion": Model({"diffusion": "device"}),
    # Half the charge is in the image before: together with the star it must not spill.
    "no feedback": Model({"nrecalc": 0.0, "full_well": np.inf}, half=True),
    "no prediction": Model({"predict": False}),
    "nearest pixels": Model({"qdist": 1}),
    "3 pixels": Model({"qdist": 3}, parts=("range",)),
    "isotropic": Model({"table": isotropic_table}),
    "x and y exchanged": Model({"transpose": True}),
    "tree rings": Model(
        {"treering_func": rings, "treering_center": galsim.PositionD(507.0, 0.0)}
    ),
    "nine tenths": Model({"strength": 0.9}),
    "half the strength": Model({"strength": 0.5}),
    "never renewed": Model({"nrecalc": 0.0}),
    "E2V": Model({"name": "e2v_ccd250"}),
}  # fmt: skip


@lru_cache(maxsize=16)
def converting_part(band: str, law: str = "law") -> float:
    """Part of a band's light that converts, by our absorption lengths or GalSim's."""
    waves = np.empty(20000)
    probe = galsim.PhotonArray(len(waves))
    make_sampler(band).applyTo(probe, rng=galsim.BaseDeviate(911))
    waves[:] = probe.wavelength
    table = DistortionTable.read(tables_dir() / DEVICE / "table.fits")
    if law == "galsim":
        lengths = galsim.SiliconSensor().abs_length_table(waves)
    else:
        lengths = absorption_length(waves, BrighterFatterSensor(table=table).temperature)
    return float(np.mean(-np.expm1(-table.thickness / np.asarray(lengths))))


def make_sampler(band: str) -> galsim.WavelengthSampler:
    """Photons spread evenly in wavelength over a band of LSST."""
    bandpass = galsim.Bandpass(f"LSST_{band}.dat", "nm")
    return galsim.WavelengthSampler(galsim.SED("1", "nm", "fphotons"), bandpass)


def share_light(model: Model, photons: galsim.PhotonArray, band: str) -> galsim.PhotonArray:
    """Leave photons out for models that absorb more, so that all collect the same charge."""
    if model.engine is BrighterFatterSensor and model.options.get("absorption") != "galsim":
        return photons
    share = converting_part(band) / converting_part(band, "galsim")
    if share > 0.999:
        return photons
    n = round(share * len(photons))
    x, y, flux = photons.x[:n], photons.y[:n], photons.flux[:n]
    return galsim.PhotonArray(n, x, y, flux, wavelength=photons.wavelength[:n])


@lru_cache(maxsize=1)
def true_psf() -> galsim.GSObject:
    """The star before pixels, with diffusion from the back surface."""
    table = DistortionTable.read(tables_dir() / DEVICE / "table.fits")
    sensor = BrighterFatterSensor(table=table)
    drift = solve_drift(table.device_text, sensor.temperature, float(table.depths[1]))
    width = float(np.sqrt(drift.variance[-1])) / table.pitch[0]
    return galsim.Convolve(
        galsim.Kolmogorov(fwhm=FWHM / SCALE), galsim.Gaussian(sigma=width)
    )


def star_light(
    peak: float, sky: float, band: str, seed: int
) -> tuple[galsim.PhotonArray, tuple[float, float], float]:
    """Photons of a star anywhere in its pixel and of its sky, in any order.

    Parameters
    ----------
    peak : float
        Electrons in the central pixel of a star in the middle of it.
    sky : float
        Electrons in a pixel.
    band : str
        u, g, r, i, z or y of LSST; photons are spread evenly in wavelength.
    seed : int

    Returns
    -------
    photons : galsim.PhotonArray
    centre : tuple of float
        (x, y) of the star [pixel].
    electrons : float
        Of the star, as far as they are collected.
    """
    rng = np.random.default_rng([seed, int(peak), int(sky), ord(band)])
    deviate = galsim.BaseDeviate(int(rng.integers(1, 2**31)))
    kept = converting_part(band)
    stars, skies = round(peak / IN_PEAK / kept), round(sky * SIDE**2 / kept)
    centre = tuple(rng.random(2) - 0.5)
    shot = galsim.Kolmogorov(fwhm=FWHM / SCALE).shoot(stars, deviate)
    x = np.concatenate([shot.x + centre[0], (rng.random(skies) - 0.5) * SIDE])
    y = np.concatenate([shot.y + centre[1], (rng.random(skies) - 0.5) * SIDE])
    order = rng.permutation(len(x))
    photons = galsim.PhotonArray(len(x), x[order], y[order], np.ones(len(x)))
    make_sampler(band).applyTo(photons, rng=deviate)
    return photons, centre, peak / IN_PEAK


def collect(sensor: galsim.Sensor, photons: galsim.PhotonArray, before=None) -> NDArray:
    """Electrons that a sensor makes of photons, in an image that may hold charge before."""
    image = galsim.ImageD(SIDE, SIDE)
    image.setCenter(0, 0)
    if before is not None:
        image.array[...] = before
    sensor.accumulate(photons, image)
    return image.array if before is None else image.array - before


def draw_models(
    models: dict[str, Model], peak: float, sky: float, band: str, seed: int
) -> list[dict[str, Any]]:
    """Draw one star by several models; one row each."""
    photons, centre, electrons = star_light(peak, sky, band, seed)
    key = 7_000_000 + seed
    plain: dict[str, NDArray] = {}
    rows = []
    for name, model in models.items():
        began = time.process_time()
        light = share_light(model, photons, band)
        if model.light not in plain:
            plain[model.light] = collect(model.sensor(key, 0.0), light)
        off = plain[model.light]
        on = collect(model.sensor(key, 1.0), light, 0.5 * off if model.half else None)
        (t0, p0, q0), (t1, p1, q1) = (adaptive_shape(a - sky) for a in (off, on))
        (u0, v0, _), (u1, v1, _) = (open_shape(a - sky, centre, RADIUS) for a in (off, on))
        bias = Bias(np.nan, np.nan)
        if name in SHEARED and (peak, sky, band) == (AT, DARK, "r"):
            bias = regaussianised_bias(true_psf(), (on - off) / electrons, centre=centre)
        rows.append({
            "model": name, "band": band, "sky": sky, "peak": peak, "seed": seed,
            "top": round(float((off - sky).max())), "trace": round(t0, 6),
            **{name: round(value, 7) for name, value in (
                ("size", t1 / t0 - 1), ("e1", p1 - p0), ("e2", q1 - q0),
                ("open_size", u1 / u0 - 1), ("open_e1", v1 - v0), ("m", bias.m), ("c", bias.c),
            )},
            "cpu_s": round(time.process_time() - began, 2),
        })  # fmt: skip
    return rows


def plan_stars(part: str) -> list[tuple[float, float, str, int]]:
    """Peak, sky, band and seed of the stars of a part of the run."""
    if part == "peaks":
        cells = [(peak, DARK, "r", n) for peak, n in PEAKS.items()]
    elif part == "range":
        cells = [(AT, DARK, "r", PEAKS[AT])]
    elif part == "skies":
        cells = [(AT, sky, "r", n) for sky, n in SKIES.items()]
    else:
        cells = [(AT, DARK, band, n) for band, n in BANDS.items()]
    return [(p, s, b, 3101 + k) for p, s, b, n in cells for k in range(n)]


def run(path: Path, part: str, report: Callable[[str], None] = print) -> None:
    """Draw the stars of a part that are not in the file yet."""
    models = {name: model for name, model in MODELS.items() if part in model.parts}
    rows = []
    if path.exists():
        table = Table.read(path, format="ascii.ecsv")
        rows = [dict(zip(table.colnames, row, strict=True)) for row in table]
    names = ("peak", "sky", "band", "seed", "model")
    done = {tuple(row[name] for name in names) for row in rows}
    for star in plan_stars(part):
        missing = {name: m for name, m in models.items() if (*star, name) not in done}
        if not missing:
            continue
        rows += draw_models(missing, *star)
        write_results(
            Table(rows=rows), path, "python -m validation.psf_requirement.psf_requirement",
            added=True, device=DEVICE, fwhm_arcsec=FWHM, pixel_arcsec=SCALE,
        )  # fmt: skip
        report(f"{part}: {star} {len(missing)} models")


def mean_change(
    table: Table, model: str, name: str, *, less: str | None = None, peak: float = AT,
    sky: float = DARK, band: str = "r",
) -> tuple[float, float]:  # fmt: skip
    """Mean of a change over stars and its standard error.

    Parameters
    ----------
    table : Table
        Rows as this module writes them.
    model, name : str
        Whose change, and of what: a column.
    less : str, optional
        The change by this model is taken off star by star, so that the photons' noise in
        common does not count.
    peak, sky, band
        Which stars.

    Raises
    ------
    MeasurementError
        Fewer than two stars.
    """
    here = (table["peak"] == peak) & (table["sky"] == sky) & (table["band"] == band)
    values = {}
    for one in (model,) if less is None else (model, less):
        rows = table[here & (table["model"] == one)]
        if len(rows) < 2:
            raise MeasurementError(
                f"no rows of {one!r} at a peak of {peak:.0f} e-, {sky:.0f} e- of sky in {band}; "
                f"there are {', '.join(sorted(set(table['model'])))}"
            )
        values[one] = dict(zip(rows["seed"], rows[name], strict=True))
    each = np.array(
        [v - (values[less][s] if less else 0.0) for s, v in values[model].items()]
    )
    return float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each)))


def over_peaks(
    table: Table, model: str, name: str, *, less: str | None = None
) -> tuple[float, float]:
    """Mean change of stars evenly spread in magnitude over all peaks there are, r, dark sky."""
    here = (table["model"] == model) & (table["sky"] == DARK) & (table["band"] == "r")
    peaks = np.unique(table["peak"][here])
    found = np.array([mean_change(table, model, name, less=less, peak=p) for p in peaks])
    # Trapezoids in the logarithm of the peak would overdo what is in proportion to it.
    width = np.log(peaks[1:] / peaks[:-1])
    low = np.diff(peaks) / width - peaks[:-1]
    share = low / np.diff(peaks)
    weights = np.zeros(len(peaks))
    weights[1:] += share * width
    weights[:-1] += (1 - share) * width
    weights /= weights.sum()
    return float(weights @ found[:, 0]), float(np.sqrt(weights**2 @ found[:, 1] ** 2))


@click.command()
@click.option(
    "--only", type=click.Choice(ALL), multiple=True, help="Parts; by default all."
)
@click.option("-o", "--output", type=click.Path(path_type=Path), default=PATH)
def main(only: tuple[str, ...], output: Path) -> None:
    """Draw what is missing and append it."""
    for part in only or ALL:
        run(output, part, click.echo)


if __name__ == "__main__":
    main()
