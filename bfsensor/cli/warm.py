"""``bfsensor warm``: compile the kernels before the first image needs them."""

from __future__ import annotations

import time
from typing import Any

import click

# Measured CPU seconds with an empty cache, on the machine of the notice in bfsensor._kernels.notice:
# images 17 and corrections 3, areas 9, tables 5 of their own and a table of 4.
_IMAGES, _AREAS, _TABLES = 20, 9, 9


@click.command("warm", short_help="Compile the kernels of sensors and corrections.")
@click.option("--areas", is_flag=True,
              help="Also compile the kernels of calculate_pixel_areas, about "
              f"{_AREAS} CPU s.")  # fmt: skip
@click.option("--tables", is_flag=True,
              help=f"Also compile the kernels of 'bfsensor table', about {_TABLES} CPU s.")  # fmt: skip
@click.option("--all", "everything", is_flag=True, help="All of these.")
def warm(areas: bool, tables: bool, everything: bool) -> None:
    """Compile the kernels of sensors and corrections now, so that the first image does not wait.

    Without this command kernels are compiled on first use.  Compiled kernels are kept on disk, for
    this processor and version, in the folder that is printed (the environment variable
    NUMBA_CACHE_DIR changes it), and are not compiled again.  One set of kernels serves both sensors,
    images of 32 and 64 bits, light with and without colour, and tree rings.

    \b
    Examples:
      bfsensor warm
      bfsensor warm --all
    """
    from numba.core import event

    from bfsensor._kernels import shoot
    from bfsensor._kernels.notice import notice

    areas, tables = (part or everything for part in (areas, tables))
    seconds = _IMAGES + _AREAS * areas + _TABLES * tables
    click.echo(f"compiling the kernels that are missing: about {seconds} s, once", err=True)
    notice.given = True  # said just now
    began = time.perf_counter()
    with event.install_recorder("numba:compile") as recorder:
        _use_sensors(areas=areas)
        _use_corrections()
        if tables:
            _use_tables()
    kernels = {
        one.data["dispatcher"].py_func.__qualname__
        for _, one in recorder.buffer
        if one.is_start
    }
    took = time.perf_counter() - began
    done = f"compiled {len(kernels)} kernels" if kernels else "all was compiled before"
    click.echo(f"{done}, {took:.0f} s; kept in {shoot.shoot.stats.cache_path}")


def _use_sensors(*, areas: bool) -> None:
    """Draw a few photons, and what else is asked for."""
    import galsim
    import numpy as np

    from bfsensor.sensor.brighter_fatter import BrighterFatterSensor

    rings = galsim.LookupTable([0.0, 100.0], [0.0, 0.01], interpolant="linear")
    options: list[dict[str, Any]] = [{}]
    options += [{"treering_func": rings}] if areas else []
    for given in options:
        sensor = BrighterFatterSensor(rng=galsim.BaseDeviate(7321), **given)
        # Areas of large images are summed in single precision, by code of its own.
        for side in (9, 512) if areas else (9,):
            image = galsim.Image(side, side, dtype=np.float32)
            middle = np.full(10, 5.0)
            photons = galsim.PhotonArray(len(middle), x=middle, y=middle, flux=1)
            sensor.accumulate(photons, image)
            if areas:
                sensor.calculate_pixel_areas(image)


def _use_corrections() -> None:
    """Correct a small image with a masked pixel."""
    import numpy as np

    from bfsensor.sensor.table_correction import correct_table

    image = np.full((40, 40), 1e3, np.float32)
    correct_table(image, "itl_sta3800c", mask=np.eye(40) == 1.0)


def _use_tables() -> None:
    """Build a coarse table of one charge, background and depth."""
    from bfsensor.device.device import Device
    from bfsensor.table.build import build_table
    from bfsensor.table.table_plan import plan_table

    plan = plan_table(
        Device.load("itl_sta3800c"), charges=(5e4,), backgrounds=(0.0,), depths=(95.0,),
        vertices=8, pixels=5, accuracy=0.05,
    )  # fmt: skip
    build_table(plan)
