"""Growth of spots by boundaries alone: no electrons, no chance.

``python -m validation.sensor.boundary_growth [--device itl_sta3800c]`` fills pixels as a centred spot
does, solves the potential at four moments of the exposure on meshes of 8 to 32 cells a pixel, as the
direct simulation does on 8, and moves the light that boundaries sweep over, to first order.  The same is
done with the shifts of the sensor's factored table.  Growth is measured as of images; rows in
``validation/results/boundary_growth.ecsv``.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy.stats import norm

from bfsensor import Device, DistortionTable
from bfsensor._kernels.correction import mean_charges
from bfsensor.direct.spot_exposure import SpotPlan
from bfsensor.measure.growth import measure_growth
from bfsensor.response.vertices import vertex_fractions
from bfsensor.sensor.charge_response import factor_table
from bfsensor.sensor.drift_field import solve_drift
from bfsensor.simulate.boundaries import find_boundaries
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "boundary_growth.ecsv"
COMMAND = "python -m validation.sensor.boundary_growth"
Array = NDArray[np.float64]

LEVELS = (20e3, 80e3, 150e3)
CELLS = (8, 16, 24, 32)
REACH, HALF, PERIOD, VERTICES = 4, 6, 14, 32
"""Largest distance of edges that move, half of the stamp, period of the array [pixel], and vertices of
an edge.  Chosen: beyond 4 pixels there is 1e-4 of the light."""
WELL = 2.0
"""Height below which electrons do not diffuse out of the wells [um], as in the sensor."""


class Light:
    """A centred spot with diffusion: charge of pixels, light on edges, and growth by shifts of edges."""

    def __init__(self, electrons: int, sigma: float) -> None:
        at = np.arange(-HALF, HALF + 1)
        inside = norm.cdf(at + 0.5, scale=sigma) - norm.cdf(at - 0.5, scale=sigma)
        self.charge = electrons * np.outer(inside, inside)
        edges = norm.pdf(np.arange(-REACH - 0.5, REACH + 1), scale=sigma)
        near = inside[HALF - REACH : HALF + REACH + 1]
        self._upright = electrons * np.outer(near, edges)

    def growth(self, x: Array, y: Array) -> Array:
        """Slope of both sizes [% per 50,000 e-], for mean shifts of edges [pixel]."""
        across, along = -x * self._upright, -y * self._upright.T
        changed = self.charge.copy()
        inner = slice(HALF - REACH, HALF + REACH + 1)
        changed[inner, inner] += across[:, :-1] - across[:, 1:] + along[:-1] - along[1:]
        # Two equal images, as errors are of no interest here.
        on, off = (np.array([a, a])[:, None] for a in (changed, self.charge))
        return np.asarray(measure_growth(on, off).slope)


def by_boundaries(
    device: Device, light: Light, depth: float, cells: int, moments: Array, parts: Array
) -> tuple[Array, Array]:
    """Mean shifts of edges [pixel] over the exposure, by solved potentials."""
    mesh = make_mesh(device, pixels=(PERIOD, PERIOD), cells=cells)
    solver = Electrostatics(device, mesh)
    charges = np.zeros(solver.pixel_shape)
    quarter = light.charge[HALF:, HALF:]
    at = np.concatenate([[0.0], vertex_fractions(VERTICES), [1.0]])
    pitch = device.pixel.pitch_x, device.pixel.pitch_y
    x: Array = np.zeros((2 * REACH + 1, 2 * REACH + 2))
    y = x.T.copy()
    for moment, part in zip(moments, parts, strict=True):
        charges[: len(quarter), : len(quarter)] = moment * quarter
        lines = find_boundaries(solver.solve(charges), [depth], reach=REACH)
        corners, flat, upright = (
            a[0] for a in lines.vertices(VERTICES, vertex_fractions(VERTICES))
        )
        ends = [corners[:-1, :, None], upright, corners[1:, :, None]]
        x += part * np.trapezoid(np.concatenate(ends, 2)[..., 0], at) / pitch[0]
        ends = [corners[:, :-1, None], flat, corners[:, 1:, None]]
        y += part * np.trapezoid(np.concatenate(ends, 2)[..., 1], at) / pitch[1]
    return x, y


def by_table(
    table: DistortionTable, light: Light, depth: float, moments: Array, parts: Array
) -> tuple[Array, Array]:
    """The same by the factors of a table, as sensors have them."""
    factors = factor_table(table)
    response = factors.response
    image = light.charge.astype(np.float32)
    charges = np.zeros((len(factors.modes), *image.shape), np.float32)
    mean_charges(
        image, image, response.first, response.near, response.charge_step,
        response.background_step, moments, parts, charges,
    )  # fmt: skip
    layer = int(np.argmin(np.abs(np.asarray(factors.heights) - depth)))
    width = np.diff(factors.points)
    lengths = np.zeros(len(factors.points))
    lengths[1:] += 0.5 * width
    lengths[:-1] += 0.5 * width
    size = 2 * (HALF + REACH) + 2
    x: Array = np.zeros((size, size))
    y: Array = np.zeros((size, size))
    for own, (upright, flat) in zip(charges, factors.modes, strict=True):
        reach = flat.shape[2] // 2
        for (j, i), charge in np.ndenumerate(own):
            for out, pattern in (
                (x, upright[layer][..., 0] @ lengths), (y, flat[layer][..., 1] @ lengths)
            ):  # fmt: skip
                rows, columns = (
                    slice(k + REACH - reach, k + REACH - reach + n)
                    for k, n in zip((j, i), pattern.shape, strict=True)
                )
                out[rows, columns] += float(charge) * pattern
    inner = slice(HALF, HALF + 2 * REACH + 1)
    outer = slice(HALF, HALF + 2 * REACH + 2)
    return x[inner, outer], y[outer, inner]


@click.command(help=__doc__)
@click.option("--device", "name", default="itl_sta3800c", show_default=True)
def main(name: str) -> None:
    """Make all rows."""
    device = Device.load(name)
    drift = solve_drift(device.to_toml(), device.operating_point.temperature, WELL)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    moments, parts = 0.5 * (nodes + 1), 0.5 * weights
    rows = []
    for level in LEVELS:
        plan = SpotPlan(device, peak=level)
        depth = plan.conversion_height
        variance = device.diffusion**2 * np.interp(depth, drift.heights, drift.variance)
        sigma = float(np.sqrt(plan.sigma**2 + variance)) / device.pixel.pitch_x
        light = Light(plan.electrons, sigma)
        found = {
            f"{n} cells": by_boundaries(device, light, depth, n, moments, parts)
            for n in CELLS
        }
        table = DistortionTable.load(name)
        found["table"] = by_table(table, light, depth, moments, parts)
        for source, shifts in found.items():
            x, y = light.growth(*shifts)
            rows.append((name, level, source, x, y))
            click.echo(f"{name} {level:.0f} e- {source}: {x:.4f} {y:.4f} % per 50,000 e-")
    names = ("device", "level", "source", "x", "y")
    write_results(Table(rows=rows, names=names), RESULTS, COMMAND)


if __name__ == "__main__":
    main()
