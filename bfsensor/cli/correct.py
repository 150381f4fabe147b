"""``bfsensor correct``: take the brighter-fatter effect out of FITS images."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bfsensor.cli.common import (
    check_targets,
    executor_options,
    overwrite_option,
    parse_figure,
    progress_bar,
    summary_option,
)
from bfsensor.errors import MeasurementError, RecordingError
from bfsensor.files import held, written_whole

if TYPE_CHECKING:
    from bfsensor.measure.star_sizes import SizeSlope
    from bfsensor.sensor.corrected_files import Correction, FileOptions


@dataclass(frozen=True)
class _Task:
    """One file to correct, for any process."""

    path: str
    work: str
    correction: Correction
    options: FileOptions
    history: str
    stars: tuple[float, float, int] | None
    """Threshold and saturation of stars [e-] and side of their stamps [pixel]; None: not measured."""


@click.command(short_help="Take the effect out of images.")
@click.argument("files", nargs=-1, required=True,
                type=click.Path(path_type=Path, exists=True, dir_okay=False))  # fmt: skip
@click.option("--table", required=True, metavar="TABLE|DEVICE",
              help="Distortion table (.fits), or the name of a built-in device.")  # fmt: skip
@click.option("--band", type=click.Choice(["u", "g", "r", "i", "z", "y"]),
              help="Band of LSST, with as many photons at all its wavelengths.  [default: light "
              "converts at the back surface]")  # fmt: skip
@click.option("--light", type=click.Path(path_type=Path, exists=True, dir_okay=False),
              metavar="FILE",
              help="Light of your filter and source: an ECSV or CSV file with the columns "
              "wavelength [nm] and photons (of each, that enter the silicon), in place of "
              "--band.")  # fmt: skip
@click.option("--sky", type=float, default=0.0, metavar="ELECTRONS",
              help="Sky that was subtracted from the images [e-]: it is there while they are corrected. "
              " [default: 0]")  # fmt: skip
@click.option("--with", "kind", default="table", show_default=True,
              type=click.Choice(["table", "kernel", "edges"]),
              help="Correct by the whole table, or by the scalar kernel or the edge shifts of "
              "LSST's pipelines at one level of charge.")  # fmt: skip
@click.option("--level", type=float, default=0.0, metavar="ELECTRONS",
              help="Charge of all pixels [e-] at which kernel and edges are taken.  [default: "
              "0]")  # fmt: skip
@click.option("--gain", type=float,
              help="Gain of all amplifiers [e-/ADU].  [default: that of the headers or of "
              "campaign.yaml; 1 where BUNIT is electron]")  # fmt: skip
@click.option("--overscan", default="row median", show_default=True,
              type=click.Choice(["row median", "row mean", "median"]),
              help="Level subtracted, where a file has an overscan.")  # fmt: skip
@click.option("--mask", type=click.Path(path_type=Path, exists=True, dir_okay=False),
              metavar="FILE",
              help="FITS image of the sensor, other than 0 where light did not fill a pixel: "
              "saturated and bled ones, bad columns, cosmic rays. Saturated pixels of raw files, "
              "campaign.yaml's masks and LSST's mask planes count without it.")  # fmt: skip
@click.option("--variance", "read_noise", type=float, metavar="ELECTRONS",
              help="Also write the variance of each pixel, for weight maps, as further extensions "
              "VARIANCE, for files without one; the read noise [e-] is given.")  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True,
              help="File to write; with several FILES the folder for files of the same names, made "
              "if it is missing.")  # fmt: skip
@click.option("--measure", type=float, metavar="ELECTRONS",
              help="Also measure the stars whose brightest pixel exceeds this signal [e-], and print "
              "the slopes of size and shape against the peak before and after.")  # fmt: skip
@click.option("--saturation", type=float, default=float("inf"), metavar="ELECTRONS",
              help="With --measure, leave out stars with a pixel at or above this signal [e-].  "
              "[default: no limit]")  # fmt: skip
@click.option("--stamp", default=21, show_default=True,
              help="With --measure, side of the stars' stamps [pixel], odd.")  # fmt: skip
@click.option("--plot", type=click.Path(path_type=Path), callback=parse_figure, metavar="FIG",
              help="With --measure, draw sizes against peaks; needs bfsensor[plots].")  # fmt: skip
@click.option("--threads", default=1, show_default=True, type=click.IntRange(1, 1000),
              help="Threads of each process.")  # fmt: skip
@executor_options
@overwrite_option
@summary_option
@click.pass_context
def correct(
    context: click.Context,
    files: Sequence[Path],
    table: str,
    band: str | None,
    light: Path | None,
    sky: float,
    kind: str,
    level: float,
    gain: float | None,
    overscan: str,
    mask: Path | None,
    read_noise: float | None,
    output: Path,
    measure: float | None,
    saturation: float,
    stamp: int,
    plot: Path | None,
    threads: int,
    workers: int,
    executor: str,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Take the brighter-fatter effect out of FILES: FITS images in electrons, or raw ones.

    Each pixel is corrected at its own charge and that around it, averaged over the exposure, for light
    that converts where its wavelengths do.  Files are raw ones with an extension an amplifier, single
    images, or LSST's exposures with image, mask and variance.  The output has the input's extensions and
    unit; overscan levels are subtracted, and keywords that begin with BF say what was done.

    Corrected files are kept when the command is interrupted: repeat it to go on.

    \b
    Examples:
      bfsensor correct image.fits --table itl_sta3800c --band r -o corrected.fits
      bfsensor correct raw_*.fits --table my_ccd.fits --band y --gain 1.6 -o corrected/
      bfsensor correct star_*.fits --table e2v_ccd250 --band i --with kernel \\
        --measure 10000 --saturation 120000 --plot kernel.png -o by_kernel/
    """
    if band is not None and light is not None:
        raise click.UsageError("--band and --light: give one of them")
    if plot is not None and measure is None:
        raise click.UsageError("--plot: only with --measure")
    from bfsensor.sensor.corrected_files import Correction, FileOptions, band_wavelengths
    from bfsensor.sweeps.executors import open_executor, run_points

    waves: tuple[float, ...] = tuple(band_wavelengths(band).tolist()) if band else ()
    photons: tuple[float, ...] = ()
    if light is not None:
        waves, photons = _read_light(light)
    correction = Correction(
        # Workers may have another folder.
        os.path.abspath(table) if os.path.isfile(table) else table,
        kind, waves, photons, sky, level, threads, read_noise,
    )  # fmt: skip
    correction.check()
    options = FileOptions(gain, overscan, "" if mask is None else os.path.abspath(mask))
    targets = _targets(files, output)
    stars = None if measure is None else (measure, saturation, stamp)
    history = " ".join(["bfsensor", *sys.argv[1:]])
    work = output.with_name(output.name + ".unfinished")
    tasks = [
        _Task(os.path.abspath(path), os.path.abspath(work), correction, options, history, stars)
        for path in files
    ]  # fmt: skip
    made = len(files) > 1 and not output.exists()
    if len(files) > 1 and output.is_file():
        raise RecordingError(f"{output} is a file, and {len(files)} files need a folder")
    new = [*([output] if made else []), *([plot] if plot else [])]
    check_targets(new, overwrite, RecordingError)
    if not made:
        # Whether they exist is asked below, where it is known which of them are finished.
        check_targets(targets, True, RecordingError)
    context.with_resource(held(work, RecordingError))
    place = {_key(task): target for task, target in zip(tasks, targets, strict=True)}

    def keep(result: dict[str, Any], note: Path) -> None:
        """Keep that a file is done, then put it in its place: from either moment a run goes on."""
        _write_note(result, note)
        os.replace(note.with_suffix(".fits"), place[result["key"]])

    if made:
        output.mkdir()
    missing = []
    for task in tasks:
        note, target = _note_of(task), place[_key(task)]
        draft = note.with_suffix(".fits")
        if note.exists() and draft.exists():
            os.replace(draft, target)
        if not (note.exists() and target.exists()):
            note.unlink(missing_ok=True)
            missing.append(target)
    check_targets(missing, overwrite, RecordingError)
    with (
        progress_bar("file") as progress,
        open_executor(executor, min(workers, len(tasks))) as pool,
    ):
        results = run_points(
            _correct, tasks, path=_note_of, read=_read_note, write=keep, executor=pool,
            progress=progress,
        )  # fmt: skip
    slopes = _slopes(results) if stars else {}
    if plot is not None:
        from bfsensor.plots.star_sizes import figure_for_star_sizes
        from bfsensor.plots.style import save_figure

        figure = figure_for_star_sizes(
            *(
                [one["stars"][name] for one in results]
                for name in ("peaks", "before", "after")
            )
        )
        save_figure(figure, plot)
    shutil.rmtree(work)
    _print(targets, results, slopes, as_json)


def _targets(files: Sequence[Path], output: Path) -> list[Path]:
    """Outputs in the order of the files; refuse two of one name, and inputs as outputs."""
    if len(files) == 1 and not output.is_dir():
        targets = [output]
    else:
        targets = [output / path.name for path in files]
    names = [path.name for path in files]
    for path, target in zip(files, targets, strict=True):
        if len(targets) > 1 and names.count(path.name) > 1:
            raise RecordingError(
                f"{path}: {names.count(path.name)} of the files have this name, and {output} has room "
                "for one: correct them into different folders"
            )
        if target.exists() and target.samefile(path):
            raise RecordingError(f"{path}: the output is the file itself: name another one")
    return targets


def _read_light(path: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Wavelengths [nm] and photons of a file."""
    from astropy.table import Table

    form = "ascii.ecsv" if path.suffix == ".ecsv" else "ascii.csv"
    try:
        found = Table.read(path, format=form)
        columns = [tuple(map(float, found[name])) for name in ("wavelength", "photons")]
    except (OSError, ValueError, KeyError, TypeError) as fault:
        raise RecordingError(
            f"{path}: must have the columns wavelength [nm] and photons, with numbers: {fault}"
        ) from None
    return columns[0], columns[1]


def _correct(task: _Task) -> dict[str, Any]:
    """Correct one file, and measure its stars before and after."""
    from bfsensor.sensor.corrected_files import correct_file

    found = correct_file(
        task.path, _note_of(task).with_suffix(".fits"), task.correction, task.options,
        history=task.history, overwrite=True,
    )  # fmt: skip
    if task.stars is not None:
        found["stars"] = _measure(task, *task.stars)
    return {"key": _key(task), "name": Path(task.path).name, **found}


def _measure(
    task: _Task, threshold: float, saturation: float, stamp: int
) -> dict[str, Any]:
    """Peaks [e-] and moments [pixel^2] of a file's stars before and after."""
    import numpy as np

    from bfsensor.measure.spots import find_spots
    from bfsensor.measure.star_sizes import star_sizes
    from bfsensor.sensor.corrected_files import read_parts

    out: dict[str, list[Any]] = {"peaks": [], "before": [], "after": []}
    for part in read_parts(task.path, task.options):
        after, _ = task.correction.apply(part.image, part.mask)
        sky = float(np.nanmedian(np.where(part.mask, np.nan, part.image)))
        stars = find_spots(
            part.image, threshold=threshold + sky, saturation=saturation, separation=stamp,
            mask=part.mask, stamp=stamp,
        )  # fmt: skip
        if not len(stars):
            continue
        out["peaks"] += (part.image[stars.y, stars.x] - sky).tolist()
        for name, image in (("before", part.image), ("after", after)):
            out[name] += star_sizes(
                image, stars, stamp=stamp, background=sky, mask=part.mask
            ).tolist()
    return out


def _slopes(results: Sequence[dict[str, Any]]) -> dict[str, SizeSlope]:
    """Slopes of the stars of all files before and after."""
    from bfsensor.measure.star_sizes import size_slopes

    some = [one["stars"] for one in results if one["stars"]["peaks"]]
    peaks = [one["peaks"] for one in some]
    if not peaks:
        raise MeasurementError(
            "--measure: no star in any file is above the threshold; what was corrected is kept"
        )
    names = ("before", "after")
    found = size_slopes(peaks, *([one[name] for one in some] for name in names))
    return dict(zip(names, found, strict=True))


def _key(task: _Task) -> str:
    """Digest of all that a result depends on: options, and the input's size and time."""
    place = os.stat(task.path)
    text = repr((task.path, place.st_size, place.st_mtime_ns, task.correction, task.options,
                 task.stars))  # fmt: skip
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _note_of(task: _Task) -> Path:
    """File that says that a task is done; until it is put in place the image lies beside it."""
    return Path(task.work, f"{_key(task)}.json")


def _read_note(path: Path) -> dict[str, Any]:
    """Result of a task that was done."""
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def _write_note(result: dict[str, Any], path: Path) -> None:
    """Keep the result of a task."""
    with written_whole(path, RecordingError) as beside:
        beside.write_text(json.dumps(result))


def _print(
    targets: Sequence[Path],
    results: Sequence[dict[str, Any]],
    slopes: dict[str, SizeSlope],
    as_json: bool,
) -> None:
    """Print what was done and the slopes."""
    keys = ("pixels", "masked", "beyond", "moved")
    if as_json:
        rows = [
            {"written": str(target), **{key: one[key] for key in keys}}
            for target, one in zip(targets, results, strict=True)
        ]
        told = {name: slope._asdict() for name, slope in slopes.items()}
        click.echo(json.dumps({"files": rows, **told}, indent=1))
        return
    for target, one in zip(targets, results, strict=True):
        masked = f", {one['masked']} masked" if one["masked"] else ""
        beyond = f", {one['beyond']} beyond the table" if one["beyond"] else ""
        click.echo(f"{target}: {one['moved']:.4g} e- moved{masked}{beyond}")
    for name, slope in slopes.items():
        click.echo(
            f"{name}: {slope.stars} stars grow by {slope.x:+.3f} +- {slope.x_error:.3f} % in x and "
            f"{slope.y:+.3f} +- {slope.y_error:.3f} % in y (second moments, for 50,000 e- in the peak); "
            f"(xx - yy) / (xx + yy) by {slope.ellipticity:+.1e} +- {slope.ellipticity_error:.0e}"
        )
