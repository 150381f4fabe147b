"""``bfsensor export``: distortion tables as the corrections of LSST's pipelines."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from bfsensor.cli.common import check_targets, overwrite_option, summary_option
from bfsensor.errors import TableError

if TYPE_CHECKING:
    from bfsensor.table.table import DistortionTable

Command = TypeVar("Command", bound=Callable[..., Any])

SEGMENTS = tuple(f"C{row}{column}" for row in (1, 0) for column in range(8))
"""Names of the amplifiers of LSST's science sensors."""


@click.group()
def export() -> None:
    """Write a distortion table in the formats that pipelines correct images with."""


def _common(command: Command) -> Command:
    """Take what both formats need."""
    for option in reversed(
        [
            click.argument("table"),
            click.option("--detector", type=click.IntRange(min=0), metavar="N", required=True,
                         help="Number of the detector in the camera: card DETECTOR."),
            click.option("--instrument", metavar="NAME",
                         help="Name of the camera, such as LSSTCam: card INSTRUME."),
            click.option("--gain", "gains", multiple=True, metavar="[AMP=]GAIN", callback=_gains,
                         help="Gain [e-/ADU] of an amplifier, C10=1.65, repeatable; a number alone is "
                         "that of all 16 of an LSST sensor. Recorded: shifts are per electron."),
            click.option("--ptc", type=click.Path(path_type=Path), metavar="FILE",
                         help="Take names, gains and noise of the amplifiers from LSST's photon "
                         "transfer dataset instead."),
            click.option("--level", default=0.0, show_default=True, metavar="ELECTRONS",
                         help="Charge of all pixels [e-] at which shifts by one more electron are "
                         "taken, within the backgrounds of the table."),
            click.option("--lags", default=8, show_default=True, type=click.IntRange(min=2),
                         help="Lags from 0 on; 8 is what cp_pipe has."),
            click.option("--tail/--no-tail", default=True,
                         help="Beyond the table shifts fall off as cp_pipe's (areas as the power "
                         "-1.35 of the squared distance), or end there."),
            click.option("-o", "--output", type=click.Path(path_type=Path), required=True,
                         help="File to write: FITS, or ECSV by its ending."),
            overwrite_option,
            summary_option,
        ]
    ):  # fmt: skip
        command = option(command)
    return command


def _gains(
    ctx: click.Context, param: click.Parameter, values: Sequence[str]
) -> dict[str, float]:
    """Gains by amplifier."""
    out: dict[str, float] = {}
    for value in values:
        name, _, number = value.rpartition("=")
        try:
            gain = float(number)
        except ValueError:
            raise click.BadParameter(
                f"{value!r} is not a gain such as 1.65, or C10=1.65"
            ) from None
        out.update(dict.fromkeys(SEGMENTS, gain) if not name else {name: gain})
    return out


@export.command("bfk")
@_common
@click.option("--wavelength", "wavelengths", type=float, multiple=True, metavar="NM",
              help="Vacuum wavelength of the light [nm]; several weigh alike; repeatable. By default "
              "all light converts at the back surface, as in blue flats.")  # fmt: skip
@click.option("--zero-sum", is_flag=True,
              help="Take the sum over all lags from a_00 first, as cp_pipe's forceZeroSum.")  # fmt: skip
def bfk(
    table: str,
    detector: int,
    instrument: str | None,
    gains: dict[str, float],
    ptc: Path | None,
    level: float,
    lags: int,
    tail: bool,
    output: Path,
    overwrite: bool,
    as_json: bool,
    wavelengths: tuple[float, ...],
    zero_sum: bool,
) -> None:
    """Write LSST's BrighterFatterKernel (version 1.1) from a TABLE (.fits, or built-in name).

    The scalar kernel of Coulton et al. 2018, the same for every amplifier, in electrons.

    \b
    Examples:
      bfsensor export bfk itl.fits --detector 94 --gain 1.65 -o bfk.fits
      bfsensor export bfk e2v_ccd250 --detector 23 --ptc ptc.fits --wavelength 620 -o bfk.fits
    """
    from bfsensor.table.lsst_format import make_kernel

    loaded, (gains, noises) = _prepare(table, gains, ptc, output, overwrite)
    shifts = _shifts(loaded, level, lags, tail, wavelengths)
    made = make_kernel(
        shifts, gains, noises=noises, zero_sum=zero_sum, meta=_cards(detector, instrument)
    )
    made.write(output, overwrite=overwrite)
    side = made.columns["KERNEL"].shape[-1]
    valid = bool(made.columns["VALID"].all())
    summary = {
        "written": str(output), "kernel": f"{side} x {side}", "amplifiers": len(gains),
        "a_00 [1/e-]": float(shifts.areas[0, 0]), "a_10 [1/e-]": float(shifts.areas[0, 1]),
        "a_01 [1/e-]": float(shifts.areas[1, 0]), "valid": valid,
    }  # fmt: skip
    _finish(summary, as_json)


@export.command("edm")
@_common
@click.option("--filter", "filters", multiple=True, metavar="NAME=NM[,NM...]",
              help="A physical filter of the pipeline and the vacuum wavelengths of its light [nm], "
              "of equal weight: y_10=950,1000,1050; repeatable. Without any the file is of version "
              "1.0, which has light that converts at the back surface only.")  # fmt: skip
def edm(
    table: str,
    detector: int,
    instrument: str | None,
    gains: dict[str, float],
    ptc: Path | None,
    level: float,
    lags: int,
    tail: bool,
    output: Path,
    overwrite: bool,
    as_json: bool,
    filters: tuple[str, ...],
) -> None:
    """Write LSST's electrostatic distortion matrix from a TABLE (.fits, or built-in name).

    The shifts of the four edges of a pixel by one electron (Astier & Regnault 2023), from the
    table instead of from a fit to covariances.

    \b
    Examples:
      bfsensor export edm itl.fits --detector 94 --gain 1.65 -o edm.fits
      bfsensor export edm e2v_ccd250 --detector 23 --ptc ptc.fits \\
        --filter g_6=480 --filter y_10=950,1000,1050 -o edm.fits
    """
    from bfsensor.table.lsst_format import make_distortion_matrix

    bands = dict(map(_band, filters))
    loaded, (gains, _) = _prepare(table, gains, ptc, output, overwrite)
    shifts = _shifts(loaded, level, lags, tail)
    made = make_distortion_matrix(
        shifts, gains, thickness=loaded.thickness, pitch=loaded.pitch[0],
        filters={n: _shifts(loaded, level, lags, tail, w) for n, w in bands.items()},
        meta=_cards(detector, instrument),
    )  # fmt: skip
    made.write(output, overwrite=overwrite)
    summary = {
        "written": str(output), "version": made.version, "lags": f"{lags} x {lags}",
        "amplifiers": len(gains), "filters": list(bands),
        "a_00 [1/e-]": float(shifts.areas[0, 0]), "a_10 [1/e-]": float(shifts.areas[0, 1]),
        "a_01 [1/e-]": float(shifts.areas[1, 0]),
    }  # fmt: skip
    _finish(summary, as_json)


def _band(text: str) -> tuple[str, tuple[float, ...]]:
    """Name of a filter and its wavelengths [nm]."""
    name, _, waves = text.partition("=")
    try:
        numbers = tuple(float(wave) for wave in waves.split(","))
    except ValueError:
        numbers = ()
    if not name or not numbers:
        raise click.UsageError(
            f"--filter {text}: not of the form NAME=NM, such as y_10=1000"
        )
    return name, numbers


def _prepare(
    table: str, gains: dict[str, float], ptc: Path | None, output: Path, overwrite: bool
) -> tuple[DistortionTable, tuple[dict[str, float], dict[str, float]]]:
    """Read the table, and gains and noise by amplifier."""
    from bfsensor.recording.tables.lsst_datasets import PhotonTransferDataset
    from bfsensor.sensor.options import find_table, load_table

    if bool(gains) == (ptc is not None):
        raise click.UsageError(
            "give the gains of the amplifiers: either --gain or --ptc FILE"
        )
    check_targets([output], overwrite, TableError)
    noises: dict[str, float] = {}
    if ptc is not None:
        found = PhotonTransferDataset.read(ptc).columns
        names = [str(name) for name in found["AMPLIFIER_NAME"]]
        gains = dict(zip(names, found["GAIN"].astype(float).tolist(), strict=True))
        noises = dict(zip(names, found["NOISE"].astype(float).tolist(), strict=True))
    return load_table(*find_table(table)), (gains, noises)


def _shifts(
    table: DistortionTable, level: float, lags: int, tail: bool,
    wavelengths: tuple[float, ...] = (),
) -> Any:  # fmt: skip
    """Shifts of the edges for light of these wavelengths, or that converts at the back."""
    from bfsensor.table.quadrant_shifts import quadrant_shifts

    more: dict[str, Any] = {} if tail else {"tail_slope": None}
    return quadrant_shifts(
        table, background=level, lags=lags, wavelengths=wavelengths or None, **more
    )


def _cards(detector: int, instrument: str | None) -> dict[str, Any]:
    cards: dict[str, Any] = {"DETECTOR": detector}
    return {**cards, "INSTRUME": instrument} if instrument else cards


def _finish(summary: dict[str, Any], as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(summary, indent=1))
        return
    for key, value in summary.items():
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        text = ", ".join(value) if isinstance(value, list) else text
        click.echo(f"{key:14} {text}")
