"""``bfsensor fit``: fit the quantities of a device to measurements, with priors."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bfsensor.cli.common import Bar, device_options, load_device, parse_conditions
from bfsensor.errors import BFSensorError, FitError, RecordingError

if TYPE_CHECKING:
    from bfsensor.device.quantities import Prior
    from bfsensor.fit.data import DataSet
    from bfsensor.fit.result import FitResult
    from bfsensor.recording.tables.measured import MeasuredTable


@click.command("fit", short_help="Fit a device to measurements.")
@device_options
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--free", multiple=True, metavar="NAME[:[MEAN+-]SPREAD]",
    help="Fit this quantity; repeatable. Its prior is the file's value and uncertainty, unless "
    "given as back_bias:5V or 'thickness:98um+-2um'; 'all' is every quantity with an uncertainty; "
    "light.absorption_length is a factor on that of silicon.  "
    "[default: those of origin 'guessed']",
)  # fmt: skip
@click.option(
    "--at", "conditions", multiple=True, callback=parse_conditions,
    metavar="[FILE:]KEY=VALUE,...",
    help="State the conditions of one recording, or of all: back_bias, gate_high, gate_low, "
    "wavelength, temperature (with units), level (e- in every pixel; 0: the limit at none, as fits to "
    "covariances give it; else 40000), sigma (of spots, in pixels). Stated quantities are not "
    "fitted for that recording.  [default: the device's]",
)  # fmt: skip
@click.option("--hold", multiple=True, type=click.Path(path_type=Path), metavar="FILE",
              help="Recording that is not fitted but compared with the fit; repeatable.")  # fmt: skip
@click.option("--lags", default=4, show_default=True, type=click.IntRange(1, 8),
              help="Largest lag of a_ij that is fitted, in pixels.")  # fmt: skip
@click.option("--errors", default="scaled", show_default=True,
              type=click.Choice(["scaled", "stated"]),
              help="'scaled' multiplies the errors of each recording by a fitted factor; 'stated' "
              "takes them as they are.")  # fmt: skip
@click.option("--profile", "profiles", multiple=True, metavar="NAME",
              help="Also compute the profile likelihood of this fitted quantity; "
              "repeatable.")  # fmt: skip
@click.option("--readout", default=0, show_default=True, type=click.IntRange(min=0),
              help="Let the readout add a free term at so many lags along a row: they are compared "
              "with the device, not fitted, and the term is what the device leaves.")  # fmt: skip
@click.option("--cells", default=16, show_default=True, help="Mesh cells per pixel.")
@click.option(
    "--finer", type=click.IntRange(min=0),
    help="Cells per pixel of a finer mesh for the values of a_ij and slopes (not their derivatives), "
    "about 8 CPU s per condition and round at 48; 0 switches it off.  [default: 48, or 0 if --cells "
    "is 48 or more]",
)  # fmt: skip
@click.option(
    "--curved", is_flag=True,
    help="Predict with a second-order emulator of the device instead of linear predictions that "
    "are renewed in each round. Errors then come from posterior draws and need not be Gaussian.",
)  # fmt: skip
@click.option(
    "--draws", default=12, show_default=True, type=click.IntRange(0, 1_000_000),
    help="Number of devices drawn from the posterior and solved in full; the error of the "
    "predictions there is added to the errors of the fit. 0 skips this.",
)  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Folder for fit.json, device.toml and fit.png.  [default: DEVICE_fit]")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print fit.json instead of a table.")
def fit(
    device: str,
    recordings: tuple[Path, ...],
    settings: list[tuple[str, str]],
    free: tuple[str, ...],
    conditions: list[tuple[str, dict[str, str]]],
    hold: tuple[Path, ...],
    lags: int,
    errors: str,
    profiles: tuple[str, ...],
    readout: int,
    cells: int,
    finer: int | None,
    curved: bool,
    draws: int,
    output: Path | None,
    as_json: bool,
) -> None:
    """Fit quantities of a DEVICE, such as doping or thickness, to RECORDINGS.

    DEVICE is a .toml file or a name of 'bfsensor devices'.  Its values and uncertainties are the
    means and standard deviations of Gaussian priors.

    RECORDINGS are comma-separated or ECSV tables of one of these kinds, with these columns:

    \b
      a_ij [1/e-]              i_serial, j_parallel, cov_per_e, err_per_e
                               (or LSST's photon transfer dataset, FITS)
      B-F slopes [% / 50 ke-]  axis, slope, slope_error
      saturation levels [e-]   saturation, saturation_error
      diffusion widths [um]    diffusion, diffusion_error
      full-depletion voltage   full_depletion, full_depletion_error  [V, signed as the back bias]

    The last four may have columns back_bias, gate_high and gate_low, the voltages of each row;
    the header of an ECSV table may state them for all rows in an entry 'conditions'.

    Prints a table of the fitted quantities; the last line is chi2 per number, with the errors as
    stated.

    \b
    Examples:
      bfsensor fit itl_sta3800c_60 itl.csv --free all --free back_bias:5V -o itl_fit
      bfsensor fit itl_sta3800c itl.csv slopes.csv --free all --at itl.csv:back_bias=-60V,level=0
      bfsensor fit itl_sta3800c slopes.csv --hold itl.csv --free silicon.background_doping
    """
    from bfsensor.device.quantities import with_priors
    from bfsensor.files import held
    from bfsensor.fit.fit import fit_device
    from bfsensor.fit.linear_predictors import make_tangents
    from bfsensor.recording.tables.measured import read_measured

    loaded = load_device(device, settings)
    read = [(path, read_measured(path)) for path in (*recordings, *hold)]
    sets = _data_sets(read, conditions, len(recordings), lags, errors == "scaled")
    if readout:
        sets = _with_readout(sets, readout)
    priors = _choose_priors(loaded, free, sets)
    names = [prior.name for prior in priors]
    chosen = [_resolve(name, names) for name in profiles]
    folder = output or Path(f"{loaded.name}_fit")
    # A folder that cannot be written is refused before minutes of solving.
    click.get_current_context().with_resource(held(folder, FitError))
    known = with_priors(loaded, priors)
    response = _Response.of(
        known, priors, sets, folder, cells=cells, finer=finer, curved=curved, draws=draws
    )
    result = fit_device(
        known, sets, priors, response.emulator, linearise=response.linearise,
        tangents=make_tangents(known, cells=min(cells, 8), progress=Bar("settings")),
        solved=response.solved, draws=draws, progress=Bar("devices drawn"), profiles=chosen,
        source=f"bfsensor fit of {', '.join(data.name for data in sets if data.fitted)}; "
        "errors are correlated: fit.json",
        notes=[
            f"{path.name}: {note}" for path, one in read for note in one.table.warnings if note
        ],
    )  # fmt: skip
    written = _write(result, folder)
    if as_json:
        click.echo(json.dumps(result.to_dict(), indent=1))
        return
    lines = result.said().splitlines()
    click.echo("\n".join(lines[:-1]))
    click.echo(f"{folder}: {', '.join(written)}")
    click.echo(lines[-1])


def _choose_priors(
    device: Any, free: tuple[str, ...], sets: Sequence[DataSet]
) -> tuple[Prior, ...]:
    """Give the priors of the free quantities; saturation adds the spill barrier, widths diffusion."""
    from bfsensor.device.quantities import ABSORPTION, DIFFUSION, choose_priors
    from bfsensor.fit.linear_predictors import SPILL

    fitted = {data.kind for data in sets if data.fitted}
    more = (
        *([SPILL] if "saturation" in fitted else []),
        *([DIFFUSION] if "diffusion" in fitted else []),
    )
    chosen = choose_priors(device, free, more=more)
    coloured = any(c.wavelength is not None for data in sets for c in data.conditions)
    if not coloured and ABSORPTION in [prior.name for prior in chosen]:
        raise click.UsageError(
            f"{ABSORPTION}: no recording states a wavelength; give it by --at, such as "
            "wavelength=950nm"
        )
    return chosen


@dataclass(frozen=True)
class _Response:
    """Functions that predict areas and slopes, as :func:`bfsensor.fit.fit.fit_device` takes them.

    Either ``emulator``, or ``linearise``, which solves the device and its derivatives at the
    values where a round ends; and ``solved``, which solves it without derivatives and gives the
    error of the predictions.
    """

    emulator: Any = None
    linearise: Any = None
    solved: Any = None

    @classmethod
    def of(
        cls,
        device: Any,
        priors: Sequence[Prior],
        sets: Sequence[DataSet],
        folder: Path,
        *,
        cells: int,
        finer: int | None,
        curved: bool,
        draws: int,
    ) -> _Response:
        """Choose the functions by the options; none if no data set holds areas or slopes."""
        from bfsensor.device.quantities import ABSORPTION, DIFFUSION
        from bfsensor.fit.finer_mesh import FINER
        from bfsensor.fit.linear_predictors import SPILL
        from bfsensor.simulate.mesh import check_cells

        if not {"areas", "slopes"} & {data.kind for data in sets}:
            return cls()
        check_cells(cells)
        if finer is None:
            finer = FINER if cells < FINER else 0
        if finer:
            check_cells(finer, "finer")
        moving = tuple(prior for prior in priors if prior.name not in (SPILL, DIFFUSION))
        emulator = linearise = solved = None
        if curved:
            names = [prior.name for prior in moving]
            if ABSORPTION in names:
                raise click.UsageError(f"--curved: {ABSORPTION} is fitted without it only")
            emulator = build_emulator(device, names, sets, cells, folder)
        else:
            linearise = make_linearise(device, moving, priors, sets, cells)
        if finer:
            solve = linearise or (lambda values, fixed=emulator: fixed)
            carried = make_finer(solve, device, priors, sets, finer, cells, folder)
            return cls(None, carried, carried.at_draw if draws else None)
        if draws:
            solved = make_solved(device, priors, sets, cells, folder)
        return cls(emulator, linearise, solved)


def responding(sets: Sequence[DataSet]) -> tuple[Any, ...]:
    """Conditions of all area and slope data, each once; both follow from the edge response."""
    return tuple(
        dict.fromkeys(
            condition
            for data in sets
            if data.kind in ("areas", "slopes")
            for condition in data.conditions
        )
    )


def build_emulator(
    device: Any, parameters: list[str], sets: Sequence[DataSet], cells: int, folder: Path
) -> Any:
    """Build, or read from the folder, the emulator of a device at the conditions of the data."""
    from bfsensor.response.emulator import DeviceEmulator

    return DeviceEmulator.build(
        device, parameters, conditions=responding(sets), cells=cells,
        keep=folder / "emulator", progress=Bar("emulator"),
    )  # fmt: skip


def make_linearise(
    device: Any,
    moving: Sequence[Any],
    priors: Sequence[Any],
    sets: Sequence[DataSet],
    cells: int,
) -> Any:
    """Make the function that solves the device and its derivatives at given parameter values."""
    from bfsensor.fit.linear_response import Linearise

    solve = Linearise(device, tuple(moving), responding(sets), cells, Bar("solutions"))
    at = [k for k, prior in enumerate(priors) if prior in moving]
    return lambda values: solve(values[at])


def make_finer(
    linearise: Any,
    device: Any,
    priors: Sequence[Any],
    sets: Sequence[DataSet],
    finer: int,
    cells: int,
    folder: Path,
) -> Any:
    """Wrap a function that solves the device so that its values are those of a finer mesh."""
    from bfsensor.fit.finer_mesh import Finer

    return Finer(
        linearise, device, tuple(priors), responding(sets), finer, cells,
        keep=folder / "finer", progress=Bar("finer mesh"),
    )  # fmt: skip


def make_solved(
    device: Any,
    priors: Sequence[Any],
    sets: Sequence[DataSet],
    cells: int,
    folder: Path,
) -> Any:
    """Make the function that solves the device without derivatives, on the mesh of the fit."""
    from bfsensor.fit.full_solutions import FullSolutions
    from bfsensor.response.edge_response import REFINE_Z

    return FullSolutions(
        device, tuple(priors), responding(sets), cells, REFINE_Z, keep=folder / "finer"
    )


def _data_sets(
    read: Sequence[tuple[Path, MeasuredTable]],
    conditions: Sequence[tuple[str, dict[str, str]]],
    fitted: int,
    lags: int,
    scaled: bool,
) -> list[DataSet]:
    """Make data sets of the tables, with the conditions that ``--at`` states."""
    from bfsensor.fit.data import data_set

    for file, _ in conditions:
        if file and not any(file in (str(path), path.name, path.stem) for path, _ in read):
            raise FitError(
                f"--at {file}: not one of the given recordings "
                f"{', '.join(path.name for path, _ in read)}"
            )
    out = []
    for n, (path, measured) in enumerate(read):
        for file, given in conditions:
            if not file or file in (str(path), path.name, path.stem):
                try:
                    measured = measured.at(given)
                except RecordingError as error:
                    raise FitError(f"--at {file}: {error}") from None
        out.append(data_set(measured, lags=lags, fitted=n < fitted, scaled=scaled))
    return out


def _with_readout(sets: Sequence[DataSet], lags: int) -> list[DataSet]:
    """Give the data sets with the lags of a readout set aside, in every fitted set of a_ij."""
    from bfsensor.fit.data import apart_from_readout

    out: list[DataSet] = []
    for data in sets:
        areas = data.kind == "areas" and data.fitted
        out.extend(apart_from_readout(data, lags) if areas else [data])
    if len(out) == len(sets):
        raise FitError("--readout: none of the fitted recordings holds a_ij")
    return out


def _resolve(name: str, names: Sequence[str]) -> str:
    """Full name of a free parameter from its full name or its last part; refuses others."""
    ends = [one for one in names if one == name or one.endswith(f".{name}")]
    if len(ends) != 1:
        raise FitError(
            f"--profile {name}: not one fitted quantity; fitted are {', '.join(names)}"
        )
    return ends[0]


def _write(result: FitResult, folder: Path) -> list[str]:
    """Write the result, the fitted device and the figure; without matplotlib no figure."""
    from bfsensor.device.device import Device
    from bfsensor.fit.fit_figures import figure_for_fit
    from bfsensor.plots.style import save_figure

    result.write(folder / "fit.json")
    Device.from_toml(result.fitted_device).write(folder / "device.toml")
    written = ["fit.json", "device.toml"]
    try:
        figure = figure_for_fit(result)
    except BFSensorError as error:
        click.echo(f"bfsensor: no figure: {error}", err=True)
        return written
    save_figure(figure, folder / "fit.png")
    return [*written, "fit.png"]
