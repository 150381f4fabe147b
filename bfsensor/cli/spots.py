"""``bfsensor spots``: simulate spots electron by electron, and measure their B-F slopes."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import click

from bfsensor.cli.common import (
    device_options,
    executor_options,
    load_device,
    progress_bar,
    summary_option,
)
from bfsensor.errors import BFSensorError, SimulationError
from bfsensor.files import held, written_whole


def _spot_path(folder: Path, key: str, number: int) -> Path:
    return folder / f"spot_{key}_{number:04d}.fits"


@click.command(short_help="Simulate spots electron by electron.")
@device_options
@click.option("--spots", "count", default=8, show_default=True, type=click.IntRange(min=1),
              help="Number of spots, each with its own centre and electrons; errors need "
              "2.")  # fmt: skip
@click.option("--peak", default=80_000.0, show_default=True,
              help="Electrons in the brightest pixel of a centred spot, without diffusion "
              "[e-].")  # fmt: skip
@click.option(
    "--sigma", default=10.0, show_default=True, help="Gaussian sigma of the spot [um]."
)
@click.option("--steps", default=80, show_default=True,
              help="Equal steps in which the charge arrives; the field is solved after "
              "each.")  # fmt: skip
@click.option(
    "--pixels",
    default=13,
    show_default=True,
    help="Width of the simulated array [pixel], odd; it is periodic.",
)
@click.option("--cells", default=8, show_default=True, help="Mesh cells per pixel.")
@click.option("--depth", type=float,
              help="Height above the gates at which light converts [um].  [default: 5 um below the "
              "back surface]")  # fmt: skip
@click.option("--wavelength", type=float,
              help="Vacuum wavelength of the light [nm]; heights then follow its absorption. Not "
              "with --depth.")  # fmt: skip
@click.option("--diffusion", type=float,
              help="Width of the diffusion over that by Einstein's relation; 1.92 has the X-ray "
              "clusters of LSST's sensors, 2.12 the published simulations (Lage et al. 2017).  "
              "[default: the device's]")  # fmt: skip
@click.option(
    "--seed",
    default=20170,
    show_default=True,
    help="Seed of all random numbers; the same seed gives the same spots.",
)
@executor_options
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("spots"),
              show_default=True, help="Folder for images (FITS), growth.ecsv and "
              "growth.png.")  # fmt: skip
@summary_option
def spots(
    device: str,
    settings: list[tuple[str, str]],
    count: int,
    peak: float,
    sigma: float,
    steps: int,
    pixels: int,
    cells: int,
    depth: float | None,
    wavelength: float | None,
    diffusion: float | None,
    seed: int,
    workers: int,
    executor: str,
    output: Path,
    as_json: bool,
) -> None:
    """Simulate spots in a DEVICE electron by electron, and print their B-F slopes.

    DEVICE is a .toml file or a name of 'bfsensor devices'.  Electrons drift in the field of the
    charge already collected, which is solved again in steps; for comparison the same electrons
    also drift in the empty sensor.  Every finished spot is kept in the folder: repeat the command
    to continue an interrupted run, or repeat it with more --spots to add some.

    \b
    Examples:
      bfsensor spots itl_sta3800c --set back_bias=-60V --set gate_high=4V -o spots_60
      bfsensor spots e2v_ccd250 --spots 2 --steps 20 --peak 150000
    """
    from bfsensor.direct.spot_exposure import Spot, SpotPlan, simulate_spot
    from bfsensor.direct.transport import Transport
    from bfsensor.sweeps.executors import open_executor, run_points

    plan = SpotPlan(
        load_device(device, settings), peak=peak, sigma=sigma, steps=steps,
        pixels=pixels, cells=cells, depth=depth, wavelength=wavelength,
        transport=Transport(diffusion=diffusion), seed=seed,
    )  # fmt: skip
    plan.check_full_well()  # before any worker starts
    click.get_current_context().with_resource(held(output, SimulationError))

    def write(spot: Spot, path: Path) -> None:
        spot.write(path)

    with (
        progress_bar("spot") as progress,
        open_executor(executor, min(workers, count)) as pool,
    ):
        made = run_points(
            partial(simulate_spot, plan), range(count),
            path=lambda n: _spot_path(output, plan.key, n), read=Spot.read, write=write,
            executor=pool, progress=progress,
        )  # fmt: skip
    _report(plan, made, output, as_json)


def _report(plan: Any, made: list[Any], output: Path, as_json: bool) -> None:
    """Measure how the spots grow with charge; write, print and draw it."""
    import numpy as np
    from astropy.table import Table

    from bfsensor.measure.growth import measure_growth

    on, off = (np.array([getattr(spot, name) for spot in made]) for name in ("on", "off"))
    levels = np.unique(np.round(np.linspace(0, plan.steps, 9)[1:]).astype(int)) - 1
    summary: dict[str, Any] = {
        "folder": str(output),
        "spots": len(made),
        "electrons_a_spot": plan.electrons,
        "cpu_s_a_spot": round(float(np.mean([spot.cpu_seconds for spot in made])), 1),
    }
    if len(made) > 1:
        growth = measure_growth(on[:, levels], off[:, levels], stamp=min(9, plan.pixels))
        table = Table(
            {
                "steps": levels + 1, "peak": growth.peak,
                **{
                    f"{name}_{axis}": getattr(growth, name)[:, n]
                    for name in ("sigma", "growth", "growth_error")
                    for n, axis in enumerate("xy")
                },
            }
        )  # fmt: skip
        summary["slope_percent_per_50000e"] = {
            axis: f"{growth.slope[n]:.4f} +- {growth.slope_error[n]:.4f}"
            for n, axis in enumerate("xy")
        }
        table.meta = {"device": plan.device.name, "key": plan.key, **summary}
        with written_whole(output / "growth.ecsv", SimulationError) as beside:
            table.write(beside, format="ascii.ecsv", overwrite=True)
        _draw(plan, made, growth, output / "growth.png")
    else:
        summary["slope_percent_per_50000e"] = "needs 2 spots for an error"
    if as_json:
        click.echo(json.dumps(summary, indent=1))
        return
    for key, value in summary.items():
        text = (
            ", ".join(f"{k} {v}" for k, v in value.items())
            if isinstance(value, dict)
            else value
        )
        click.echo(f"{key:26} {text}")


def _draw(plan: Any, made: list[Any], growth: Any, path: Path) -> None:
    """Draw the growth of the spots; without matplotlib a message on stderr."""
    from bfsensor.plots.spots import figure_for_spots
    from bfsensor.plots.style import save_figure

    try:
        figure = figure_for_spots(plan, made, growth)
    except BFSensorError as error:
        click.echo(f"bfsensor: no figure: {error}", err=True)
        return
    save_figure(figure, path)
