"""HSC's a_ij from its published scalar kernel, and the device and table that are fitted to them.

``python -m validation.own_camera.hsc_kernel RECORDINGS [--areas hsc.csv] [-o OUT.ecsv]`` reads
``hsc_bfk/hsc_bf_kernel.txt`` (``lsst/testdata_ci_hsc`` @ a025837, the kernel K of Coulton et al. 2018
for Hyper Suprime-Cam, 17 x 17 pixels) and takes

a_ij = -(K_{i+1,j} + K_{i-1,j} + K_{i,j+1} + K_{i,j-1} - 4 K_ij)

at lags up to 7.  K was made by solving this equation with the same five-point Laplacian, zero at its
border, so that the step back is exact to the round-off of the file; the header has what a nine-point
Laplacian would give instead (a_10 fell below a_20, which no covariances do).  The file states no errors.
That of a_ij is taken from the scatter of the lags beyond 5 pixels off the row j = 0, times root two on
the axes and two at (0, 0), where fewer mirrored lags are averaged.

The file does not say which axis is which.  Taken: its first index is y (parallel), its second x.
Then a_01 is 2.2 times a_10, as in all thick CCDs whose columns are separated by channel stops; and the
excess over all other directions that does not fall with distance lies along x, where pixels are read
one after the other, as a memory of the readout would have it.

Lags (2, 0), (3, 0) and (4, 0) hold that excess and are not fitted.  One row for each lag: a_ij of the
kernel, of the fit, and of the shipped table, light converting at the back.  ``--areas`` writes the a_ij
from which `bfsensor table` made ``tables/hsc_hamamatsu``.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.device.device import Device
from bfsensor.fit.camera_areas import CameraAreas
from bfsensor.fit.camera_device import drift_model
from bfsensor.fit.camera_fit import CameraFit, fit_camera
from bfsensor.table.table import DistortionTable
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "hsc_kernel.ecsv"
COMMAND = "python -m validation.own_camera.hsc_kernel RECORDINGS"
NAME, LAGS = "hsc_hamamatsu", 4
LEFT_OUT = ((2, 0), (3, 0), (4, 0))
ALTERNATIVES = {
    "as shipped": LEFT_OUT,
    "all lags": (),
    "without (0,0)": ((0, 0), *LEFT_OUT),
    "without (0,0) and all of the row": ((0, 0), (1, 0), *LEFT_OUT),
}
"""Lags left out of fits that are compared."""


def read_kernel(recordings: Path) -> NDArray[np.float64]:
    """Read HSC's kernel [1/e-], ``[j, i]``, lag (0, 0) in the middle."""
    return np.loadtxt(recordings / "hsc_bfk" / "hsc_bf_kernel.txt")


def laplacian(kernel: NDArray[np.float64], corners: bool = False) -> NDArray[np.float64]:
    """Five-point Laplacian inside the kernel's border, or the nine-point one with corners."""
    k = kernel
    sides = k[2:, 1:-1] + k[:-2, 1:-1] + k[1:-1, 2:] + k[1:-1, :-2]
    if not corners:
        return sides - 4 * k[1:-1, 1:-1]
    diagonal = k[2:, 2:] + k[2:, :-2] + k[:-2, 2:] + k[:-2, :-2]
    return (4 * sides + diagonal - 20 * k[1:-1, 1:-1]) / 6


def areas_of(kernel: NDArray[np.float64]) -> CameraAreas:
    """a_ij and errors by lag from (0, 0) [1/e-]."""
    whole = -laplacian(kernel)
    middle = len(whole) // 2
    a = whole[middle:, middle:]
    j, i = np.indices(a.shape)
    averaged = np.where(i > 0, 2.0, 1.0) * np.where(j > 0, 2.0, 1.0)
    far = (np.maximum(i, j) > 5) & (j > 0)
    noise = float(np.sqrt(np.mean((a * np.sqrt(averaged / 4))[far] ** 2)))
    source = "hsc_a.csv, a_ij by the Laplacian of HSC's scalar kernel"
    return CameraAreas(a, noise * np.sqrt(4 / averaged), a == a, source)


def fit_without(areas: CameraAreas, lags: tuple[tuple[int, int], ...]) -> CameraFit:
    """Fit as `bfsensor table --from` does, without some lags."""
    return fit_camera(
        areas.select(lags=LAGS, without=lags), base=drift_model(Device.load(NAME))
    )


@click.command(help=__doc__)
@click.argument("recordings", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--areas", "target", type=click.Path(path_type=Path),
              help="Write the a_ij as a table for bfsensor table --from.")  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path), default=RESULTS)
def main(recordings: Path, target: Path | None, output: Path) -> None:
    """Take the Laplacian, fit, print, write."""
    kernel = read_kernel(recordings)
    areas = areas_of(kernel)
    if target is not None:
        lines = [
            f"{i},{j},{a:.6e},{areas.errors[j, i]:.3e}"
            for (j, i), a in np.ndenumerate(areas.a)
        ]
        target.write_text("\n".join(["i,j,a,error", *lines]) + "\n")
        return
    table = DistortionTable.load(NAME)
    charge = 1e4
    shipped = table.area_changes(charge=charge, depth=table.thickness)
    shipped = shipped[table.reach :, table.reach :] / (charge * np.prod(table.pitch))
    nine = -laplacian(kernel, corners=True)
    nine = nine[len(nine) // 2 :, len(nine) // 2 :]
    fits = {name: fit_without(areas, lags) for name, lags in ALTERNATIVES.items()}
    fit = fits["as shipped"].fit
    rows = []
    for (j, i), a in np.ndenumerate(fit.a):
        rows.append({
            "i": i, "j": j, "fitted": bool(fit.used[j, i]),
            "kernel_1e-9": round(1e9 * float(a), 3),
            "error_1e-9": round(1e9 * float(areas.errors[j, i]), 3),
            "nine_point_1e-9": round(1e9 * float(nine[j, i]), 3),
            "fit_1e-9": round(1e9 * float(fit.predicted[j, i]), 3),
            "table_1e-9": round(1e9 * float(shipped[j, i]), 3),
            "table_over_kernel": round(float(shipped[j, i] / a), 4),
            "pull": round(float((a - shipped[j, i]) / fit.errors[j, i]), 2),
        })  # fmt: skip
        click.echo("  ".join(f"{k} {v}" for k, v in rows[-1].items()))
    heads = [_describe(name, one) for name, one in fits.items()]
    for head in heads:
        click.echo(", ".join(f"{k} {v}" for k, v in head.items()))
    whole = -laplacian(kernel)
    write_results(
        Table(rows), output, COMMAND, fits=heads,
        sum_of_a=float(whole.sum()), noise=float(areas.errors[1, 1]),
    )  # fmt: skip


def _describe(name: str, found: CameraFit) -> dict[str, object]:
    """Header entry of a fit: parameters, chi2, and the nearest a_ij."""
    fit, errors, model = found.fit, found.fit.parameter_errors, found.model
    field = float(np.mean(model.drift_at(np.array([0.0, model.thickness]))))
    return {
        "fit": name,
        **{
            n: f"{getattr(model, n):.3g} +- {errors[n]:.2g} um ({found.determined_by(n)})"
            for n in fit.names if hasattr(model, n)
        },
        "drift_field": f"{field:.3g} +- {field * found.field_error:.2g} V/um "
                       f"({found.determined_by('strength')})",
        "chi2": round(found.chi2, 2), "lags": int(fit.used.sum()),
        "effective_parameters": round(found.effective, 2),
        "error_scale": round(found.error_scale, 3),
        "a_00_1e-9": round(1e9 * float(fit.predicted[0, 0]), 2),
        "a_10_1e-9": round(1e9 * float(fit.predicted[0, 1]), 2),
    }  # fmt: skip


if __name__ == "__main__":
    main()
