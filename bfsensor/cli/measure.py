"""``bfsensor measure``: spot sizes with B-F slopes, and covariances of flat pairs, from FITS files."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bfsensor.errors import BFSensorError, MeasurementError
from bfsensor.files import written_whole

if TYPE_CHECKING:
    from bfsensor.measure.covariance_fit import CovarianceFit
    from bfsensor.measure.curve import CovarianceCurve
    from bfsensor.measure.flat_pairs import FlatCovariances
    from bfsensor.recording.raw.images import AmplifierImage


def _no_folders(
    ctx: click.Context, param: click.Parameter, values: tuple[Path, ...]
) -> tuple[Path, ...]:
    """Refuse a folder, which has to be written as its files."""
    for path in values:
        if path.is_dir():
            raise click.BadParameter(
                f"{path} is a folder: give its files, such as {path}/flat_*.fits "
                f"('bfsensor check {path}' lists what a folder holds)"
            )
    return values


_FILES = click.argument(
    "files", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True),
    callback=_no_folders,
)  # fmt: skip
"""Argument of one file or more; -1 is click's definition of any number."""

_GAIN = click.option(
    "--gain", type=float,
    help="Gain of all amplifiers [e-/ADU].  [default: that of campaign.yaml or of the "
    "header, as 'bfsensor check' shows it]",
)  # fmt: skip
_OVERSCAN = click.option(
    "--overscan", default="row median", show_default=True,
    type=click.Choice(["row median", "row mean", "median", "none"]),
    help="Level subtracted: median or mean of each row's overscan, or median of all of it.",
)  # fmt: skip
_SECTION_ENTRIES = ("name", "hdu", "window", "data", "bias", "detector")


def _sections(
    ctx: click.Context, param: click.Parameter, values: Sequence[str]
) -> tuple[dict[str, Any], ...]:
    """Parse ``--sections`` into entries of amplifiers like those of campaign.yaml."""
    out: list[dict[str, Any]] = []
    for number, text in enumerate(values):
        parts = re.findall(r"(\w+)=(\[[^\]]*\]|[^,\[\]]+)(?:,|$)", text)
        entry: dict[str, Any] = dict(parts)
        whole = ",".join(f"{key}={value}" for key, value in parts) == text
        if not whole or set(entry) - set(_SECTION_ENTRIES) or "data" not in entry:
            raise click.BadParameter(
                f"{text!r} is not of the form data=[1:512,1:2000],bias=[513:576,1:2000], with "
                f"data and of {', '.join(_SECTION_ENTRIES)} only"
            )
        if "hdu" in entry:
            if not entry["hdu"].isdecimal():
                raise click.BadParameter(f"{text!r}: hdu = {entry['hdu']!r} is no number")
            entry["hdu"] = int(entry["hdu"])
        out.append({"name": str(number + 1) if len(values) > 1 else "image", **entry})
    names = [entry["name"] for entry in out]
    if len(set(names)) < len(names):
        raise click.BadParameter(f"names of amplifiers {names} must differ")
    return tuple(out)


_SECTIONS = click.option(
    "--sections", multiple=True, callback=_sections, metavar="KEY=[X1:X2,Y1:Y2],...",
    help="FITS sections of an amplifier's data and overscan, such as "
    "data=[1:512,1:2000],bias=[513:576,1:2000]; also name, hdu, window, detector. Repeat it for each "
    "amplifier.  [default: campaign.yaml or headers]",
)  # fmt: skip
_OUTPUT = click.option(
    "-o", "--output", type=click.Path(path_type=Path),
    help="ECSV file to write, replaced if it exists.  [default: none]",
)  # fmt: skip
_JSON = click.option(
    "--json", "as_json", is_flag=True, help="Print rows and summary as JSON."
)


@click.group(short_help="Measure spots or flats in FITS files.")
def measure() -> None:
    """Measure spots or flats in FITS files: raw ones with overscan, or images in electrons.

    The amplifiers, keywords and masks that a campaign.yaml in the folder of a file states are used.

    \b
    Example:
      bfsensor measure flats flat_*.fits --gain 4.8 -o covariances.ecsv
    """


@measure.command("spots", short_help="Fit sizes and slopes of spots.")
@_FILES
@click.option("--threshold", type=float, required=True,
              help="Least signal of a spot's brightest pixel [e-].")  # fmt: skip
@click.option("--saturation", type=float, default=float("inf"),
              help="Leave out spots with a pixel at or above this signal [e-].  [default: "
              "no limit]")  # fmt: skip
@click.option(
    "--stamp",
    default=9,
    show_default=True,
    help="Side of the square postage stamps [pixel], odd.",
)
@click.option("--weights", default="equal", show_default=True,
              type=click.Choice(["equal", "noise"]),
              help="Weights of the pixels: 'equal', as published, for B-F slopes; 'noise', the "
              "inverse variance, has the smallest errors for Gaussian spots.")  # fmt: skip
@_GAIN
@_OVERSCAN
@_SECTIONS
@_OUTPUT
@_JSON
def spots(
    files: Sequence[Path],
    threshold: float,
    saturation: float,
    stamp: int,
    weights: str,
    gain: float | None,
    overscan: str,
    sections: tuple[dict[str, Any], ...],
    output: Path | None,
    as_json: bool,
) -> None:
    """Fit the size of the spots in each amplifier of each of FILES, and their B-F slopes.

    All spots of one amplifier in one file share one (sigma_x, sigma_y) [pixel]; each has its own
    peak [e-], centre and background.  With five files or more of different peaks, the B-F slope
    (change of sigma with the peak [% per 50,000 e-]) is fitted over its linear range.

    \b
    Example:
      bfsensor measure spots ladder_*.fits --threshold 2000 --gain 4.8 -o spots.ecsv
    """
    from bfsensor.measure.spot_fit import fit_spots
    from bfsensor.measure.spots import cut_stamps, find_spots

    rows = []
    gains: dict[str, dict[str, None]] = {}
    for path in files:
        for amplifier in _read(path, gain, overscan, sections):
            if amplifier.unit != "electron":
                raise MeasurementError(
                    f"{path}: {amplifier.name}: {amplifier.no_gain}, and slopes are against "
                    "electrons: give --gain"
                )
            gains.setdefault(amplifier.name, {})[_gain(amplifier)] = None
            found = find_spots(
                amplifier.image, threshold=threshold, saturation=saturation,
                separation=stamp, mask=amplifier.mask, stamp=stamp,
            )  # fmt: skip
            if not len(found.x):
                raise MeasurementError(
                    f"{path}: {amplifier.name}: no spot above {threshold:g} "
                    f"{amplifier.unit}; rejected: {dict(found.rejected)}"
                )
            stamps = cut_stamps(amplifier.image, found, size=stamp, mask=amplifier.mask)
            try:
                fit = fit_spots(stamps, weights=weights)
            except MeasurementError as error:
                raise MeasurementError(f"{path}: {amplifier.name}: {error}") from None
            # Scatter among spots also holds for shapes that are not Gaussian, but takes two spots.
            errors = fit.scatter_covariance if fit.used.sum() > 1 else fit.covariance
            rows.append(
                {
                    "file": str(path), "amplifier": amplifier.name, "unit": amplifier.unit,
                    "spots": int(fit.used.sum()), "dropped": int((~fit.used).sum()),
                    "peak": fit.peak, "sigma_x": fit.sigma_x,
                    "sigma_x_error": float(errors[0, 0] ** 0.5), "sigma_y": fit.sigma_y,
                    "sigma_y_error": float(errors[1, 1] ** 0.5),
                    "chi2_per_dof": fit.chi2 / fit.dof,
                }
            )  # fmt: skip
    _finish(rows, {**_gains(gains), **_slopes(rows)}, output, as_json)


def _read(
    path: Path, gain: float | None, overscan: str, sections: tuple[dict[str, Any], ...]
) -> tuple[AmplifierImage, ...]:
    """Read the amplifiers of a file with the settings of a campaign.yaml beside it."""
    from bfsensor.recording.campaign.settings import read_settings
    from bfsensor.recording.raw.headers import scan_file
    from bfsensor.recording.raw.images import read_images
    from bfsensor.recording.raw.masks import read_masks

    settings = read_settings(path.parent)
    scan = scan_file(
        path, amplifiers=sections or settings.amplifiers, overrides=settings.overrides
    )
    return read_images(
        scan, gain=gain, overscan=None if overscan == "none" else overscan,
        masks=read_masks(path.parent, settings.masks, scan.amplifiers),
    )  # fmt: skip


def _gain(amplifier: AmplifierImage) -> str:
    """Text of the gain of an amplifier [e-/ADU], or of the reason that it is not known."""
    if amplifier.unit == "electron":
        return f"{amplifier.gain:.6g} e-/ADU"
    return f"not known ({amplifier.no_gain}), levels are in ADU"


def _gains(found: Mapping[str, Mapping[str, None]]) -> dict[str, str]:
    """Gain of each amplifier for the summary; several where its files differ."""
    return {f"{name} gain": ", ".join(words) for name, words in found.items()}


def _slopes(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """B-F slopes [% per 50,000 e-] of each amplifier that has five files or more."""
    from bfsensor.measure.slopes import bf_slopes

    out: dict[str, Any] = {}
    for name in dict.fromkeys(row["amplifier"] for row in rows):
        part = sorted(
            (row for row in rows if row["amplifier"] == name), key=lambda r: r["peak"]
        )
        if len(part) < 5:
            continue
        for axis in "xy":
            line = bf_slopes(
                [r["peak"] for r in part], [r[f"sigma_{axis}"] for r in part],
                [r[f"sigma_{axis}_error"] for r in part],
            )  # fmt: skip
            out[f"{name} slope {axis} [% per 50,000]"] = (
                f"{line.slope:.4f} +- {line.slope_error:.4f} (range {line.range_error:.4f}), "
                f"{line.low:.0f} to {line.high:.0f}"
            )
    return out


@measure.command("flats", short_help="Measure covariances of flats.")
@_FILES
@click.option("--lags", default=8, show_default=True, help="Largest lag [pixel].")
@click.option("--fit/--no-fit", default=None,
              help="Fit a_ij, b_ij, gain and noise to the covariances.  [default: --fit for "
              "amplifiers with six pairs or more]")  # fmt: skip
@_GAIN
@_OVERSCAN
@_SECTIONS
@_OUTPUT
@click.option("--figure", type=click.Path(path_type=Path), metavar="FILE",
              help="Draw the photon transfer curve, variance and nearest correlations against the "
              "level, to a .png or .pdf; needs bfsensor[plots].  [default: none]")  # fmt: skip
@_JSON
def flats(
    files: Sequence[Path],
    lags: int,
    fit: bool | None,
    gain: float | None,
    overscan: str,
    sections: tuple[dict[str, Any], ...],
    output: Path | None,
    figure: Path | None,
    as_json: bool,
) -> None:
    """Measure the pixel covariances of pairs of flats: FILES 1 and 2, 3 and 4, and so on.

    The two flats of a pair have equal exposures.  Prints variances and nearest correlations of each
    pair and amplifier; OUTPUT has the covariance of every lag with its error [e-^2, or ADU^2
    without a gain].

    \b
    Examples:
      bfsensor measure flats flat_*.fits --gain 4.8 -o covariances.ecsv --figure ptc.png
      bfsensor measure flats flat_*.fits --sections 'data=[1:512,1:2000],bias=[513:576,1:2000]'
    """
    from bfsensor.measure.curve import CovarianceCurve

    if len(files) % 2:
        raise MeasurementError(
            f"{len(files)} files are no pairs of flats: give an even number, files 1 and 2 a pair"
        )
    pairs: dict[str, list[FlatCovariances]] = {}
    gains: dict[str, dict[str, None]] = {}
    rows = []
    for first, second in zip(files[::2], files[1::2], strict=True):
        one, other = (
            {a.name: a for a in _read(path, gain, overscan, sections)}
            for path in (first, second)
        )
        if set(one) != set(other):
            raise MeasurementError(
                f"{first} and {second} hold different amplifiers: {sorted(one)} and "
                f"{sorted(other)}"
            )
        for name in one:
            for amplifier in (one[name], other[name]):
                gains.setdefault(name, {})[_gain(amplifier)] = None
            try:
                pair = _measure_pair(one[name], other[name], lags)
            except MeasurementError as error:
                raise MeasurementError(f"{first} and {second}: {name}: {error}") from None
            pairs.setdefault(name, []).append(pair)
            of = {"first": str(first), "second": str(second), "amplifier": name}
            rows += [{**of, **row} for row in _covariance_rows(pair)]
    fits = _fits(pairs, fit)
    summary = {**_gains(gains), **_covariances(pairs, fits)}
    if figure is not None:
        curves = {name: CovarianceCurve.from_pairs(found) for name, found in pairs.items()}
        summary["figure"] = _draw(curves, fits, figure)
    _finish(rows, summary, output, as_json)


def _measure_pair(one: AmplifierImage, other: AmplifierImage, lags: int) -> FlatCovariances:
    """Measure the covariances of one amplifier in a pair of flats; refuses unlike images."""
    from bfsensor.measure.flat_pairs import flat_covariances

    if one.image.shape != other.image.shape or one.unit != other.unit:
        raise MeasurementError(
            f"{one.image.shape} pixels in {one.unit} and {other.image.shape} in {other.unit} "
            "are no pair"
        )
    return flat_covariances(
        one.image, other.image, mask=one.mask | other.mask, lags=lags, unit=one.unit,
        region=one.name,
    )  # fmt: skip


def _covariance_rows(pair: FlatCovariances) -> list[dict[str, Any]]:
    """List a row of the output for each lag of a pair."""
    return [
        {
            "unit": pair.unit, "level": pair.level, "lag_x": i, "lag_y": j,
            "covariance": float(pair.covariances[j, i]), "error": float(pair.errors[j, i]),
        }
        for j in range(pair.covariances.shape[0])
        for i in range(pair.covariances.shape[1])
    ]  # fmt: skip


def _fits(
    pairs: Mapping[str, Sequence[FlatCovariances]], fit: bool | None
) -> dict[str, CovarianceFit]:
    """Fit all amplifiers (True), none (False), or those with six pairs or more (None)."""
    from bfsensor.measure.covariance_fit import fit_covariances
    from bfsensor.measure.curve import CovarianceCurve

    return {
        name: fit_covariances(CovarianceCurve.from_pairs(found))
        for name, found in pairs.items()
        if fit or (fit is None and len(found) >= 6)
    }


def _draw(
    curves: Mapping[str, CovarianceCurve], fits: Mapping[str, CovarianceFit], target: Path
) -> str:
    """Draw the photon transfer curve to a file and return its path."""
    from bfsensor.plots.photon_transfer import figure_for_photon_transfer
    from bfsensor.plots.style import save_figure

    try:
        drawn = figure_for_photon_transfer(curves, fits)
        save_figure(drawn, target)
    except (
        BFSensorError,
        ValueError,
    ) as error:  # no matplotlib; an ending it does not know
        raise MeasurementError(f"{target}: no figure: {error}") from None
    return str(target)


def _covariances(
    pairs: Mapping[str, Sequence[FlatCovariances]], fits: Mapping[str, CovarianceFit]
) -> dict[str, str]:
    """Summary of each pair of each amplifier, and of its fit."""
    out = {}
    for name, found in pairs.items():
        for measured in sorted(found, key=lambda p: p.level):
            c, e = measured.covariances, measured.errors
            out[f"{name} at {measured.level:.0f} {measured.unit}"] = (
                f"C00 {c[0, 0]:.1f} +- {e[0, 0]:.1f}, C10/C00 {c[0, 1] / c[0, 0]:.5f} +- "
                f"{e[0, 1] / c[0, 0]:.5f}, C01/C00 {c[1, 0] / c[0, 0]:.5f} +- "
                f"{e[1, 0] / c[0, 0]:.5f}"
            )
        if name in fits:
            result = fits[name]
            a, da = result.a, result.a_errors
            out[f"{name} fit"] = (
                f"a00 {a[0, 0]:.3e} +- {da[0, 0]:.1e}, a10 {a[0, 1]:.3e} +- {da[0, 1]:.1e}, a01 "
                f"{a[1, 0]:.3e} +- {da[1, 0]:.1e} per electron, gain {result.gain:.4f} +- "
                f"{result.gain_error:.4f}, chi2 {result.chi2:.1f} of {result.dof}"
            )
    return out


def _finish(
    rows: list[dict[str, Any]], summary: dict[str, Any], output: Path | None, as_json: bool
) -> None:
    """Write the rows as ECSV, print the summary."""
    if output is not None:
        from astropy.table import Table

        table = Table(rows=rows)
        table.meta = {"summary": summary}
        with written_whole(output, MeasurementError) as beside:
            table.write(beside, format="ascii.ecsv", overwrite=True)
    if as_json:
        click.echo(json.dumps({"rows": rows, "summary": summary}, indent=1))
        return
    if len(rows) <= 60 and "sigma_x" in rows[0]:
        for row in rows:
            click.echo(
                f"{row['file']} {row['amplifier']}: {row['spots']} spots, peak {row['peak']:.0f} "
                f"{row['unit']}, sigma {row['sigma_x']:.4f} +- {row['sigma_x_error']:.4f}, "
                f"{row['sigma_y']:.4f} +- {row['sigma_y_error']:.4f} pixel, chi2/dof "
                f"{row['chi2_per_dof']:.2f}"
            )
    for key, value in summary.items():
        click.echo(f"{key}: {value}")
