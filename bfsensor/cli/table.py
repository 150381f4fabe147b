"""``bfsensor table``: solve a device and write its distortion table."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from bfsensor.cli import camera
from bfsensor.cli.common import (
    MOST_WORKERS,
    check_targets,
    load_device,
    overwrite_option,
    parse_settings,
    progress_bar,
    settings_option,
    summary_option,
)
from bfsensor.errors import BFSensorError, DeviceError, TableError
from bfsensor.files import held, written_whole

if TYPE_CHECKING:
    from bfsensor.table.table import DistortionTable


def _numbers(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    if value is None:
        return None
    try:
        return tuple(float(v) for v in value.split(","))
    except ValueError:
        raise click.BadParameter(
            f"{value!r} is not a list of numbers such as 0,25000,50000"
        ) from None


@click.command(short_help="Write the distortion table of a device.")
@click.argument("device", required=False)
@settings_option
@click.option("--from", "covariances", type=click.Path(path_type=Path), metavar="FILE",
              help="Fit the image-charge engine to a_ij or covariances of flats in FILE (.csv, .ecsv "
              "or LSST's photon transfer dataset). DEVICE then stands in for what they do not "
              "say.  [default: DEVICE is solved]")  # fmt: skip
@click.option("--thickness", metavar="LENGTH",
              help="Thickness of the silicon, such as 200um; needed with --from, and only for "
              "it.")  # fmt: skip
@click.option("--pitch", metavar="LENGTH",
              help="Pixel pitch in x and y. Only for --from.  [default: DEVICE's]")  # fmt: skip
@click.option("--lags", default=4, show_default=True, type=click.IntRange(1, 8),
              help="Largest lag that is fitted, in pixels. Only for --from.")  # fmt: skip
@click.option("--without", multiple=True, callback=camera.parse_lags, metavar="I,J",
              help="Do not fit this lag, such as 0,0; repeatable. Only for --from.  [default: all "
              "are fitted]")  # fmt: skip
@click.option("--offset", is_flag=True,
              help="Also fit an offset common to all lags. Only for --from.")  # fmt: skip
@click.option("--model-error", default=0.05, show_default=True, type=click.FloatRange(0, 1),
              help="Relative accuracy of the image-charge model, added in quadrature to the errors "
              "of a_ij. Only for --from.")  # fmt: skip
@click.option("--exchange-axes", is_flag=True,
              help="Take i as the lag in y and j as that in x. Only for --from.")  # fmt: skip
@click.option(
    "--charges",
    callback=_numbers,
    metavar="Q,Q,...",
    help="Charges of the source pixel [e-].  [default: 0 and 3, 15, 35, 55, 75, 90 % of the full well; "
    "0 and 200000 for a device fitted to covariances]",
)
@click.option("--backgrounds", callback=_numbers, metavar="B,B,...",
              help="Uniform charges of all other pixels [e-].  [default: 0, 25, 50, 80 % of the "
              "full well]")  # fmt: skip
@click.option("--depths", callback=_numbers, metavar="Z,Z,...",
              help="Heights above the gates at which light converts [um].  [default: that of the "
              "stored charge; 2 and 4 um into the silicon; 1, 2, 4 pixel pitches; the "
              "thickness]")  # fmt: skip
@click.option(
    "--vertices",
    default=32,
    show_default=True,
    help="Vertices on each side of a pixel's boundary, between its corners.",
)
@click.option(
    "--pixels",
    default=9,
    show_default=True,
    help="Width of the table, centred on the source pixel [pixel], odd.",
)
@click.option("--engine", type=click.Choice(["poisson", "image_charge"]),
              help="'poisson' solves the non-linear Poisson equation; 'image_charge' takes an "
              "analytic model, linear in charge, of parameters given by --image-charge or in the "
              "device.  [default: image_charge for devices fitted to covariances, else "
              "poisson]")  # fmt: skip
@click.option("--image-charge", "parameters", multiple=True, callback=parse_settings,
              metavar="KEY=VALUE",
              help="Parameter of --engine image_charge with its unit, such as row_height=1.2um; "
              "repeatable.")  # fmt: skip
@click.option("--accuracy", default=0.01, show_default=True,
              help="Relative accuracy of area changes that chooses the mesh: 0.05, 0.02, 0.01 or "
              "0.005. Only for --engine poisson.")  # fmt: skip
@click.option("--workers", type=click.IntRange(1, MOST_WORKERS), default=2, show_default=True,
              help="Processes that work at the same time. Only for --engine poisson.")  # fmt: skip
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="FITS table to write.  [default: DEVICE.fits; with --from FILE.fits]",
)
@click.option("--galsim", type=click.Path(path_type=Path), metavar="STEM",
              help="Write STEM.cfg and STEM.dat for galsim.SiliconSensor instead of FITS: one "
              "charge (default 100000 e-), no background, one depth (default 95 % of the "
              "thickness).")  # fmt: skip
@click.option(
    "--assess/--no-assess",
    default=None,
    help="Measure the errors of mesh, tracing and superposition and write them to the header. Only "
    "for --engine poisson.  [default: --assess; with --galsim --no-assess]",
)
@click.option(
    "--figure/--no-figure",
    default=True,
    help="Draw the table as a .png beside it; needs bfsensor[plots].  [default: --figure]",
)
@overwrite_option
@summary_option
@click.pass_context
def table(
    context: click.Context,
    device: str | None,
    settings: list[tuple[str, str]],
    covariances: Path | None,
    thickness: str | None,
    pitch: str | None,
    lags: int,
    without: tuple[tuple[int, int], ...],
    offset: bool,
    model_error: float,
    exchange_axes: bool,
    charges: tuple[float, ...] | None,
    backgrounds: tuple[float, ...] | None,
    depths: tuple[float, ...] | None,
    vertices: int,
    pixels: int,
    engine: str | None,
    parameters: list[tuple[str, str]],
    accuracy: float,
    workers: int,
    output: Path | None,
    galsim: Path | None,
    assess: bool | None,
    figure: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Solve a DEVICE, or fit covariances, and write a distortion table.

    DEVICE is a .toml file or a name of 'bfsensor devices'.  The table holds the displacement of
    every vertex of the pixel boundaries [um] as a function of the charge of a source pixel,
    the uniform charge of all others, and the conversion depth.  Repeat the command to continue an
    interrupted run.

    With --from no doping is needed: FILE has a row for each lag with the columns i (along a row, x),
    j (along a column, y), a and error [1/e-]; or i, j, mu_e, cov and sigma, the covariances of a flat
    [e-^2] at its level [e-]; or it is the output of 'bfsensor measure flats -o'.  Beside the table are
    written the device (.toml), the fit by lag (_fit.ecsv) and its figure (_fit.png).

    \b
    Examples:
      bfsensor table itl_sta3800c -o itl.fits
      bfsensor table --from covariances.csv --thickness 200um --pitch 15um -o camera.fits
      bfsensor table e2v_ccd250 --set back_bias=-70V --galsim sensors/e2v_70
      bfsensor table itl_sta3800c --engine image_charge -o analytic.fits \\
        --image-charge charge_height=0.32um --image-charge row_height=1.21um \\
        --image-charge column_height=2.57um --image-charge half_width_x=0.2um \\
        --image-charge half_width_y=3.8um \\
        --image-charge drift_field=0um:0.736V/um,100um:0.364V/um
    """
    from bfsensor.device.depletion import check_depleted

    began, cpu_began = time.perf_counter(), _cpu_seconds()
    levels = _Levels(charges, backgrounds, depths)
    _check_source(context, device, covariances)
    if covariances is not None:
        request = camera.CameraRequest(
            covariances, thickness, pitch, lags, without, offset, exchange_axes,
            model_error,
        )  # fmt: skip
        target = output or Path(f"{covariances.stem}.fits")
        camera.check_outputs(target.with_suffix(""), overwrite)
        check_targets([target], overwrite, TableError)
        loaded, found = camera.fit_covariances_of(
            request, device or camera.STAND_IN, settings, target.stem
        )
        written = camera.write_fit(loaded, found, target.with_suffix(""), figure)
        fitted: dict[str, Any] = {"fit": camera.describe(found), "written": written}
        more = camera.provenance_of(found)
        _write_fitted(loaded, levels, vertices, pixels, target, figure, fitted, more)
        _print_fitted(fitted, as_json)
        return
    assert device is not None
    loaded = load_device(device, settings)
    if engine is None:
        engine = "image_charge" if loaded.image_charge is not None else "poisson"
    _check_engine(context, engine, parameters)
    if engine == "image_charge" and loaded.image_charge is not None and not parameters:
        if galsim is not None:
            raise TableError(
                "--galsim: not for devices fitted to covariances; their table is for "
                "bfsensor.BrighterFatterSensor"
            )
        target = output or Path(f"{loaded.name}.fits")
        check_targets([target], overwrite, TableError)
        fitted = {"written": []}
        _write_fitted(loaded, levels, vertices, pixels, target, figure, fitted, {})
        _print_fitted(fitted, as_json)
        return
    model = _image_charge(loaded, parameters) if engine == "image_charge" else None
    if galsim is not None:
        levels = levels.for_galsim(loaded)
        targets = [galsim.with_name(galsim.name + ending) for ending in (".cfg", ".dat")]
    else:
        levels = levels if model is None else levels.for_image_charge(model)
        targets = [output or Path(f"{loaded.name}.fits")]
    check_targets(targets, overwrite, TableError)
    check_depleted(loaded, levels.depths or ())
    # Imported only now: compiled solvers take longer to load than it takes to refuse a device.
    from bfsensor.table.build import peak_memory
    from bfsensor.table.table_plan import plan_table

    plan = plan_table(
        loaded, charges=levels.charges, backgrounds=levels.backgrounds, depths=levels.depths,
        vertices=vertices, pixels=pixels, accuracy=accuracy,
    )  # fmt: skip
    click.echo(_describe(plan, model), err=True)
    checkpoint = targets[0].with_name(targets[0].name + ".levels")
    if model is None:
        click.get_current_context().with_resource(held(checkpoint, TableError))
    assessed = galsim is None if assess is None else assess
    result = _build(plan, model, workers, assessed, checkpoint)
    _write(result, plan, galsim, targets[0], overwrite)
    if model is None:
        shutil.rmtree(checkpoint)
    drawn = _draw(result, targets[0].with_suffix(".png")) if figure else []
    summary = {
        "written": [*map(str, targets), *drawn],
        "full_well_e": plan.full_well,
        **(_effort(plan, result) if model is None else {"engine": engine}),
        "errors": dict(result.errors),
        "cpu_s": round(_cpu_seconds() - cpu_began, 1),
        "wall_s": round(time.perf_counter() - began, 1),
        "memory_GB": round(peak_memory(), 3),
    }
    if as_json:
        click.echo(json.dumps(summary, indent=1, default=str))
        return
    for key, value in summary.items():
        click.echo(f"{key:18} {_plain(value)}")


def _check_source(
    context: click.Context, device: str | None, covariances: Path | None
) -> None:
    """Refuse a missing device, and options that belong to the other source of the table."""

    def given(*names: str) -> list[str]:
        return [
            "--" + name.replace("_", "-")
            for name in names
            if context.get_parameter_source(name) == ParameterSource.COMMANDLINE
        ]

    if covariances is None:
        if device is None:
            raise click.UsageError("Missing argument 'DEVICE', or --from FILE.")
        only = (
            "thickness",
            "pitch",
            "lags",
            "without",
            "offset",
            "exchange_axes",
            "model_error",
        )
        if wrong := given(*only):
            raise click.UsageError(f"{', '.join(wrong)}: only for --from")
    elif wrong := given("engine", "accuracy", "workers", "assess", "galsim"):
        raise click.UsageError(f"{', '.join(wrong)}: not for --from")
    elif given("parameters"):
        raise click.UsageError(
            "--image-charge: not for --from, which fits these parameters"
        )


def _write_fitted(
    device: Any,
    levels: _Levels,
    vertices: int,
    pixels: int,
    target: Path,
    figure: bool,
    summary: dict[str, Any],
    provenance: dict[str, str],
) -> None:
    """Write the table of a device that was fitted to covariances; adds to the summary in place."""
    from bfsensor.table.build_image_charge import build_fitted_table

    command = {"command": " ".join(["bfsensor", *sys.argv[1:]])}
    result = build_fitted_table(
        device, charges=levels.charges, backgrounds=levels.backgrounds, depths=levels.depths,
        vertices=vertices, pixels=pixels, provenance={**provenance, **command},
    )  # fmt: skip
    result.write(target, overwrite=True)
    drawn = _draw(result, target.with_suffix(".png")) if figure else []
    summary["written"] = [str(target), *drawn, *summary["written"]]
    summary["table"] = {
        "charges_e": result.charges.tolist(), "backgrounds_e": result.backgrounds.tolist(),
        "depths_um": [round(float(d), 3) for d in result.depths],
        "errors": dict(result.errors),
    }  # fmt: skip


def _print_fitted(summary: dict[str, Any], as_json: bool) -> None:
    """Print what was fitted and written."""
    if as_json:
        click.echo(json.dumps(summary, indent=1))
        return
    if "fit" in summary:
        camera.print_fit(summary["fit"])
    for key, value in (*summary["table"].items(), ("written", summary["written"])):
        click.echo(f"{key:18} {_plain(value)}")


def _describe(plan: Any, model: Any) -> str:
    """Describe the size and the mesh of the table that will be built."""
    how = f"{plan.cells} cells a pixel" if model is None else "image charges"
    return (
        f"{plan.device.name}: full well {plan.full_well:,.0f} e-, {len(plan.charges)} charges x "
        f"{len(plan.backgrounds)} backgrounds x {len(plan.depths)} depths, {how}"
    )


@dataclass(frozen=True)
class _Levels:
    """Charges and backgrounds [e-] and depths [um] of a table; None: the defaults of its plan."""

    charges: tuple[float, ...] | None
    backgrounds: tuple[float, ...] | None
    depths: tuple[float, ...] | None

    def for_galsim(self, device: Any) -> _Levels:
        """One charge, no background and one depth: GalSim's format holds no more."""
        charges = self.charges or (100000.0,)
        depths = self.depths or (95.0 / 100.0 * device.silicon.thickness,)
        if len(charges) != 1 or len(depths) != 1:
            raise TableError(
                f"a GalSim table holds one charge and one depth, not {len(charges)} and "
                f"{len(depths)}"
            )
        return _Levels(charges, (0.0,), depths)

    def for_image_charge(self, model: Any) -> _Levels:
        """Two charges and one background: enough, as this engine is linear in charge."""
        from bfsensor.table.build_image_charge import default_depths

        return _Levels(
            self.charges or (0.0, 100_000.0),
            self.backgrounds or (0.0,),
            self.depths or default_depths(model),
        )


def _check_engine(
    context: click.Context, engine: str, parameters: Sequence[tuple[str, str]]
) -> None:
    """Refuse options that only the other engine takes."""
    if engine == "poisson":
        wrong = ["--image-charge"] if parameters else []
    else:
        wrong = [
            f"--{name}"
            for name in ("accuracy", "workers", "assess")
            if context.get_parameter_source(name) == ParameterSource.COMMANDLINE
        ]
    if wrong:
        raise click.UsageError(f"{', '.join(wrong)}: not for --engine {engine}")


_LENGTHS = (
    "charge_height", "row_height", "column_height", "half_width_x", "half_width_y",
    "plane_height",
)  # fmt: skip


def _image_charge(device: Any, parameters: Sequence[tuple[str, str]]) -> Any:
    """Read the parameters of the image-charge model; geometry and permittivity are the device's."""
    from bfsensor.device.written_units import to_internal
    from bfsensor.simulate.charge_field import ImageCharge

    values: dict[str, Any] = {}
    for name, text in parameters:
        if name not in (*_LENGTHS, "drift_field"):
            raise DeviceError(
                f"image charge: no parameter {name!r}; there are {', '.join(_LENGTHS)} and "
                "drift_field; thickness, pitch and permittivity are the device's"
            )
        try:
            if name in _LENGTHS:
                values[name] = to_internal(text, "length")
            elif ":" in text:
                pairs = [part.partition(":")[::2] for part in text.split(",")]
                values[name] = tuple(
                    (to_internal(height, "length"), to_internal(field, "field"))
                    for height, field in pairs
                )
            else:
                values[name] = to_internal(text, "field")
        except DeviceError as error:
            raise DeviceError(f"image charge: {name}: {error}") from None
    lacking = [n for n in (*_LENGTHS[:-1], "drift_field") if n not in values]
    if lacking:
        raise DeviceError(
            f"image charge: {', '.join(lacking)} missing; give each by --image-charge KEY=VALUE"
        )
    return ImageCharge(
        **values, thickness=device.silicon.thickness, pitch_x=device.pixel.pitch_x,
        pitch_y=device.pixel.pitch_y, permittivity=device.material.permittivity_silicon,
    )  # fmt: skip


def _build(plan: Any, model: Any, workers: int, assessed: bool, checkpoint: Path) -> Any:
    """Build the table of a plan; Poisson's engine shows a bar and keeps finished levels."""
    from bfsensor.sweeps.executors import open_executor
    from bfsensor.table.build import build_table

    provenance = {"command": " ".join(["bfsensor", *sys.argv[1:]])}
    if model is not None:
        return build_table(
            plan, engine="image_charge", image_charge=model, provenance=provenance
        )
    with progress_bar("level") as progress, open_executor("process", workers) as executor:
        errors = _start_assessment(plan, executor, checkpoint) if assessed else None
        return build_table(
            plan, executor=executor, checkpoint=checkpoint, progress=progress,
            errors=errors, provenance=provenance,
        )  # fmt: skip


def _write(
    result: Any, plan: Any, galsim: Path | None, target: Path, overwrite: bool
) -> None:
    """Write the table as FITS, or its single level in GalSim's format."""
    from bfsensor.table.galsim_format import write_galsim

    if galsim is None:
        result.write(target, overwrite=overwrite)
        return
    charge, depth = plan.charges[0], plan.depths[0]
    write_galsim(result, galsim, charge=charge, depth=depth, overwrite=overwrite)


def _effort(plan: Any, result: Any) -> dict[str, Any]:
    """Mesh and iterations of the solver, for the summary."""
    return {
        "cells_a_pixel": plan.cells,
        "nodes": result.provenance.get("nodes"),
        "newton_steps": int(result.provenance["newton steps"]),
        "linear_iterations": int(result.provenance["linear iterations"]),
    }


def _start_assessment(
    plan: Any, executor: Executor | None, checkpoint: Path
) -> Callable[[DistortionTable], dict[str, float]]:
    """Start to measure the errors of a table; they are kept beside its finished levels."""
    from bfsensor.table.assess import assess_sums, mesh_errors

    kept = checkpoint / plan.key / "errors.json"
    if kept.exists():
        return lambda table: dict(json.loads(kept.read_text()))
    pending = executor.submit(assess_sums, plan) if executor is not None else None

    def finish(table: DistortionTable) -> dict[str, float]:
        sums = pending.result() if pending is not None else assess_sums(plan)
        errors = {**mesh_errors(plan, table), **sums}
        with written_whole(kept, TableError) as beside:
            beside.write_text(json.dumps(errors))
        return errors

    return finish


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value))
    if isinstance(value, dict):
        return "; ".join(
            f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in value.items()
        )
    return f"{value:,.0f}" if isinstance(value, float) and value > 1000 else str(value)


def _draw(result: Any, path: Path) -> list[str]:
    """Draw a figure beside the table; without matplotlib a message on stderr."""
    from bfsensor.plots import table as show
    from bfsensor.plots.style import save_figure

    try:
        figure = show.figure_for_table(result)
    except BFSensorError as error:
        click.echo(f"bfsensor: no figure: {error}", err=True)
        return []
    save_figure(figure, path)
    return [str(path)]


def _cpu_seconds() -> float:
    return sum(os.times()[:4])  # own and of finished children, user and system
