"""``bfsensor export``: write distortion tables as correction files of LSST's pipelines."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bfsensor.cli.common import check_targets, overwrite_option, summary_option
from bfsensor.errors import TableError

if TYPE_CHECKING:
    from bfsensor.recording.tables.lsst_datasets import (
        BrighterFatterKernel,
        DistortionMatrix,
    )
    from bfsensor.table.quadrant_shifts import QuadrantShifts
    from bfsensor.table.table import DistortionTable

SEGMENTS = tuple(f"C{row}{column}" for row in (1, 0) for column in range(8))
"""Names of the 16 amplifiers of LSST's science sensors, C10 to C17 and C00 to C07, as defined
by LSST."""


@click.group(short_help="Write corrections for LSST's pipelines.")
def export() -> None:
    """Write a distortion table in a format with which LSST's pipelines correct images.

    \b
    Example:
      bfsensor export bfk itl_sta3800c --detector 94 --gain 1.65 -o bfk.fits
    """


@dataclass(frozen=True)
class _Request:
    """Values of the options that both formats take."""

    table: str
    detector: int
    instrument: str | None
    gains: dict[str, float]
    ptc: Path | None
    level: float
    lags: int
    tail: bool
    output: Path
    overwrite: bool
    as_json: bool

    def read(self) -> tuple[DistortionTable, dict[str, float], dict[str, float]]:
        """Read the table, and gains [e-/ADU] and noises [e-] by amplifier; refuse the output."""
        from bfsensor.recording.tables.lsst_datasets import PhotonTransferDataset
        from bfsensor.sensor.options import find_table, load_table

        if bool(self.gains) == (self.ptc is not None):
            raise click.UsageError(
                "give the gains of the amplifiers: either --gain or --ptc FILE"
            )
        check_targets([self.output], self.overwrite, TableError)
        gains, noises = self.gains, {}
        if self.ptc is not None:
            found = PhotonTransferDataset.read(self.ptc).columns
            names = [str(name) for name in found["AMPLIFIER_NAME"]]
            gains = dict(zip(names, found["GAIN"].astype(float).tolist(), strict=True))
            noises = dict(zip(names, found["NOISE"].astype(float).tolist(), strict=True))
        return load_table(*find_table(self.table)), gains, noises

    def shifts(
        self, table: DistortionTable, wavelengths: tuple[float, ...] = ()
    ) -> QuadrantShifts:
        """Shifts of the edges for light of these wavelengths [nm]; none: it converts at the back."""
        from bfsensor.table.quadrant_shifts import quadrant_shifts

        more: dict[str, Any] = {} if self.tail else {"tail_slope": None}
        return quadrant_shifts(
            table,
            background=self.level,
            lags=self.lags,
            wavelengths=wavelengths or None,
            **more,
        )

    @property
    def keywords(self) -> dict[str, Any]:
        """FITS keywords that name the detector and the camera."""
        named = {"INSTRUME": self.instrument} if self.instrument else {}
        return {"DETECTOR": self.detector, **named}

    def finish(
        self,
        made: BrighterFatterKernel | DistortionMatrix,
        shifts: QuadrantShifts,
        **summary: Any,
    ) -> None:
        """Write the file; print the nearest a_ij and what a format adds to the summary."""
        made.write(self.output, overwrite=self.overwrite)
        nearest = {"a_00": (0, 0), "a_10": (0, 1), "a_01": (1, 0)}
        summary = {
            "written": str(self.output), **summary,
            **{f"{name} [1/e-]": float(shifts.areas[at]) for name, at in nearest.items()},
        }  # fmt: skip
        if self.as_json:
            click.echo(json.dumps(summary, indent=1))
            return
        for key, value in summary.items():
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            text = ", ".join(value) if isinstance(value, list) else text
            click.echo(f"{key:14} {text}")


def _common(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of both formats to a command, which gets them as one :class:`_Request`."""
    names = [field.name for field in fields(_Request)]

    @functools.wraps(command)
    def gathered(**given: Any) -> None:
        command(_Request(**{name: given.pop(name) for name in names}), **given)

    out: Callable[..., None] = gathered
    for option in reversed(
        [
            click.argument("table"),
            click.option("--detector", type=click.IntRange(min=0), metavar="N", required=True,
                         help="Number of the detector in the camera, for the FITS keyword "
                         "DETECTOR."),
            click.option("--instrument", metavar="NAME",
                         help="Name of the camera, such as LSSTCam, for the FITS keyword "
                         "INSTRUME.  [default: not written]"),
            click.option("--gain", "gains", multiple=True, metavar="[AMP=]GAIN", callback=_gains,
                         help="Gain of one amplifier [e-/ADU], such as C10=1.65, or without a name "
                         "that of all 16 of an LSST sensor; repeatable. It is recorded in the file "
                         "and changes no other number."),
            click.option("--ptc", type=click.Path(path_type=Path), metavar="FILE",
                         help="LSST photon transfer dataset with names, gains and noise of the "
                         "amplifiers, in place of --gain."),
            click.option("--level", default=0.0, show_default=True, metavar="ELECTRONS",
                         help="Charge of all pixels at which the shifts by one more electron are "
                         "taken [e-], within the backgrounds of the table."),
            click.option("--lags", default=8, show_default=True, type=click.IntRange(2, 64),
                         help="Number of lags from 0 on [pixel]; cp_pipe has 8."),
            click.option("--tail/--no-tail", default=True,
                         help="Beyond the table, let shifts fall off as in cp_pipe (areas as the "
                         "power -1.35 of the squared distance), or set them to 0.  "
                         "[default: --tail]"),
            click.option("-o", "--output", type=click.Path(path_type=Path), required=True,
                         help="File to write, FITS or ECSV by its ending."),
            overwrite_option,
            summary_option,
        ]
    ):  # fmt: skip
        out = option(out)
    return out


def _gains(
    ctx: click.Context, param: click.Parameter, values: Sequence[str]
) -> dict[str, float]:
    """Parse ``--gain`` into gains [e-/ADU] by amplifier."""
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


@export.command("bfk", short_help="Write a brighter-fatter kernel.")
@_common
@click.option("--wavelength", "wavelengths", type=float, multiple=True, metavar="NM",
              help="Vacuum wavelength of the light [nm]; repeatable, with equal weights.  "
              "[default: all light converts at the back surface, as in blue flats]")  # fmt: skip
@click.option("--zero-sum", is_flag=True,
              help="Subtract the sum over all lags from a_00 first, as cp_pipe's "
              "forceZeroSum.")  # fmt: skip
def bfk(request: _Request, wavelengths: tuple[float, ...], zero_sum: bool) -> None:
    """Write LSST's BrighterFatterKernel (version 1.1) of a distortion TABLE.

    TABLE is a .fits file or a name of 'bfsensor devices'.  The kernel is the scalar one of Coulton
    et al. 2018, in electrons and the same for every amplifier.

    \b
    Examples:
      bfsensor export bfk itl.fits --detector 94 --gain 1.65 -o bfk.fits
      bfsensor export bfk e2v_ccd250 --detector 23 --ptc ptc.fits --wavelength 620 -o bfk.fits
    """
    from bfsensor.table.lsst_format import make_kernel

    table, gains, noises = request.read()
    shifts = request.shifts(table, wavelengths)
    made = make_kernel(
        shifts, gains, noises=noises, zero_sum=zero_sum, meta=request.keywords
    )
    side = made.columns["KERNEL"].shape[-1]
    request.finish(
        made, shifts, kernel=f"{side} x {side}", amplifiers=len(gains),
        valid=bool(made.columns["VALID"].all()),
    )  # fmt: skip


@export.command("edm", short_help="Write a distortion matrix.")
@_common
@click.option("--filter", "filters", multiple=True, metavar="NAME=NM[,NM...]",
              help="A physical filter of the pipeline and the vacuum wavelengths of its light [nm], "
              "of equal weight, such as y_10=950,1000,1050; repeatable.  [default: none: a file of "
              "version 1.0, for light that converts at the back surface]")  # fmt: skip
def edm(request: _Request, filters: tuple[str, ...]) -> None:
    """Write LSST's electrostatic distortion matrix of a distortion TABLE.

    TABLE is a .fits file or a name of 'bfsensor devices'.  The matrix holds the shifts of the four
    edges of a pixel by one electron (Astier & Regnault 2023), taken from the table instead of from
    a fit to covariances.

    \b
    Examples:
      bfsensor export edm itl.fits --detector 94 --gain 1.65 -o edm.fits
      bfsensor export edm e2v_ccd250 --detector 23 --ptc ptc.fits \\
        --filter g_6=480 --filter y_10=950,1000,1050 -o edm.fits
    """
    from bfsensor.table.lsst_format import make_distortion_matrix

    bands = dict(map(_band, filters))
    table, gains, _ = request.read()
    shifts = request.shifts(table)
    made = make_distortion_matrix(
        shifts, gains, thickness=table.thickness, pitch=table.pitch[0],
        filters={name: request.shifts(table, waves) for name, waves in bands.items()},
        meta=request.keywords,
    )  # fmt: skip
    request.finish(
        made, shifts, version=made.version, lags=f"{request.lags} x {request.lags}",
        amplifiers=len(gains), filters=list(bands),
    )  # fmt: skip


def _band(text: str) -> tuple[str, tuple[float, ...]]:
    """Parse ``--filter`` into a name and wavelengths [nm]."""
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
