r"""The analytic engine beside the tables of the Poisson solver, lag by lag.

``python -m validation.image_charge.image_charge [--device NAME ...] [-o OUT.ecsv]`` fits the
heights and the half sides of :class:`bfsensor.simulate.charge_field.ImageCharge` to the nearest
lags (up to 2) of a table's relative area changes per electron, light converting at 95 um, and
compares all lags up to 4 and other depths, which are not fitted.  Each lag counts by its ratio.

Three models.  ``uniform, free``: a uniform drift field of free strength, which is what alpha does
in Astier & Regnault (2023).  ``device``: nothing free but heights and half sides; the drift field
is the laterally averaged one of the device in its neutral bulk, a straight line in height,
prolonged to the gates.  ``device, plane free``: besides, the height of the effective plane of the
gates, for which 10 um is fitted together with 95 um.  Two states: one full pixel (100,000 e-,
total), and the differential response in a flat.

Parameters of the fits are in the header.  Their errors give every lag the rms of the residuals;
an error as large as the value means that the value is not determined by these lags.  Beside them
stands what the authors' public code holds for Hyper Suprime-Cam.  Those numbers start its fit;
they could not be compared with the values printed in the paper, whose tables were not at hand.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bfsensor.device.device import Device
from bfsensor.device.shipped import tables_dir
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes
from bfsensor.simulate.unit_cell import solve_unit_cell
from bfsensor.table.table import DistortionTable
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "image_charge.ecsv"
COMMAND = "python -m validation.image_charge.image_charge"
FITTED = 2
"""Largest lag fitted."""

DEPTHS = (95.0, 40.0, 20.0, 10.0)
MODELS = {
    "uniform, free": (("drift_field",), (95.0,)),
    "device": ((), (95.0,)),
    "device, plane free": (("plane_height",), (95.0, 10.0)),
}
"""What is free besides heights and half sides, and the depths fitted."""

STEP = 100.0
"""Charge over the background [e-] that stands for the differential response."""

NAMES = ("charge_height", "row_height", "column_height", "half_width_x", "half_width_y")
STARTS = ((0.3, 1.0, 2.0, 1.0, 3.0), (1.0, 0.5, 2.0, 2.0, 3.5), (0.6, 0.8, 2.5, 2.5, 2.5))
LOWEST, HIGHEST = (0.02, 0.02, 0.02, 0.05, 0.05), (20.0, 20.0, 20.0, 4.9, 4.9)
"""Of z_q above the plane, z_sh and z_sv above z_q, a and b [um]; half sides inside a 10 um pixel."""

MORE = {"drift_field": (0.5, 0.05, 20.0), "plane_height": (0.5, -2.0, 3.0)}
"""Start, lowest and highest of what else may be free [V/um, um]."""

PUBLISHED = {
    "sensor": "Hyper Suprime-Cam, 200 um, 15 um pixels",
    "charge_height": 3.98788573,
    "row_height": 4.76154228,
    "column_height": 6.64889138,
    "half_width_x": 2.56314585,
    "half_width_y": 5.23784427,
    "source": "PierreAstier/bfptc, commit 6a18346, elec/fit_cov.py: where its fit starts, the "
    "strength fitted besides. Not compared with the values printed in Astier & Regnault 2023, "
    "A&A 670, A118.",
}


def device_field(device: Device, background: float) -> tuple[tuple[float, float], ...]:
    """Field of the neutral bulk averaged over a pixel, a line in height [um, V/um]."""
    unit = solve_unit_cell(device, background, cells=16)
    x, y, z = unit.mesh.x, unit.mesh.y, unit.mesh.z
    weights = np.outer(np.gradient(y), np.gradient(x))
    mean = np.tensordot(unit.phi, weights / weights.sum(), 2)
    middle, field = 0.5 * (z[1:] + z[:-1]), -np.diff(mean) / np.diff(z)
    bulk = middle > 8.0  # above gates, implants and channel stops
    slope, start = np.polyfit(middle[bulk], field[bulk], 1)
    return ((0.0, float(start)), (float(z[-1]), float(start + slope * z[-1])))


def responses(
    table: DistortionTable, charge: float, background: float, depth: float
) -> NDArray[np.float64]:
    """Relative area changes per electron [1/e-] of the quadrant of positive lags."""
    change = table.area_changes(charge=charge, background=background, depth=depth)
    per_electron = change / (charge - background) / (table.pitch[0] * table.pitch[1])
    return per_electron[table.reach :, table.reach :]


def make_model(
    vector: NDArray[np.float64], base: ImageCharge, free: str | None
) -> ImageCharge:
    """Give the model of a fit's vector: logarithms of :data:`LOWEST`'s, and what is free."""
    height, row, column, half_x, half_y = np.exp(vector[:5])
    more = {free: float(vector[5])} if free else {}
    height += more.get("plane_height", base.plane_height)
    return dataclasses.replace(
        base,
        charge_height=height,
        row_height=height + row,
        column_height=height + column,
        half_width_x=half_x,
        half_width_y=half_y,
        **more,
    )


def fit_lags(
    observed: NDArray[np.float64],
    depths: tuple[float, ...],
    base: ImageCharge,
    free: str | None = None,
) -> tuple[ImageCharge, dict[str, float], float]:
    """Fit the nearest lags; gives the model, errors of its parameters, rms of the ratios.

    ``observed`` (depths, lags, lags) [1/e-], the quadrant of positive lags; ``base`` holds what is
    not fitted; ``free`` names one parameter more, of :data:`MORE`.
    """
    wanted = observed[:, : FITTED + 1, : FITTED + 1]

    def residuals(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        model = make_model(vector, base, free)
        found = area_changes(model, depth=depths, reach=FITTED)[:, FITTED:, FITTED:]
        return (found / wanted - 1).ravel()

    more = [MORE[free]] if free else []
    low = [*np.log(LOWEST), *(m[1] for m in more)]
    high = [*np.log(HIGHEST), *(m[2] for m in more)]
    fits = [
        least_squares(
            residuals,
            [*np.log(start), *(m[0] for m in more)],
            bounds=(low, high),
            x_scale=0.3,
        )
        for start in STARTS
    ]
    best = min(fits, key=lambda fit: fit.cost)
    model = make_model(best.x, base, free)
    names = [*NAMES, free] if free else list(NAMES)
    slopes = np.array(
        [
            _values(make_model(best.x + step, base, free), names)
            - _values(make_model(best.x - step, base, free), names)
            for step in 1e-5 * np.eye(len(names))
        ]
    ) / 2e-5  # fmt: skip
    variance = 2 * best.cost / (wanted.size - len(names))
    covariance = slopes.T @ np.linalg.pinv(best.jac.T @ best.jac) @ slopes * variance
    errors = dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    return model, errors, float(np.sqrt(np.mean(best.fun**2)))


def _values(model: ImageCharge, names: list[str]) -> NDArray[np.float64]:
    return np.array([getattr(model, name) for name in names])


def compare(name: str) -> tuple[list[dict[str, object]], list[dict[str, object]]]:
    """Rows by lag and depth, and the fits, of a device."""
    table = DistortionTable.read(tables_dir() / name / "table.fits")
    device = Device.load(name)
    background, reach = float(table.backgrounds[1]), table.reach
    rows: list[dict[str, object]] = []
    fits: list[dict[str, object]] = []
    for state, charge, level in (
        ("one pixel, 100,000 e-", 1e5, 0.0),
        (f"flat, {background:,.0f} e-", background + STEP, background),
    ):
        seen = {depth: responses(table, charge, level, depth) for depth in DEPTHS}
        line = device_field(device, level)
        for kind, (free, fitted) in MODELS.items():
            base = ImageCharge(
                0.5, 1.4, 3.2, 1.5, 3.0, table.thickness, *table.pitch,
                0.5 if "drift_field" in free else line, device.material.permittivity_silicon,
            )  # fmt: skip
            observed = np.array([seen[depth] for depth in fitted])
            model, errors, rms = fit_lags(observed, fitted, base, *free)
            fits.append(_describe(name, state, kind, model, errors, rms))
            found = area_changes(model, depth=DEPTHS, reach=reach)[:, reach:, reach:]
            for (d, j, i), value in np.ndenumerate(found):
                theirs = float(seen[DEPTHS[d]][j, i])
                rows.append(
                    {
                        "device": name, "state": state, "model": kind, "depth_um": DEPTHS[d],
                        "i": i, "j": j, "fitted": DEPTHS[d] in fitted and max(i, j) <= FITTED,
                        "table_1e-6": round(1e6 * theirs, 6),
                        "image_charge_1e-6": round(1e6 * float(value), 6),
                        "ratio": round(float(value) / theirs, 4),
                    }
                )  # fmt: skip
    return rows, fits


def _describe(
    name: str,
    state: str,
    kind: str,
    model: ImageCharge,
    errors: dict[str, float],
    rms: float,
) -> dict[str, object]:
    values = {
        key: f"{getattr(model, key):.3f} +- {error:.3f}" for key, error in errors.items()
    }
    if isinstance(model.drift_field, tuple):
        (_, start), (_, end) = model.drift_field
        values["drift_field"] = f"{start:.4f} at the gates to {end:.4f} at the back"
    return {
        "device": name,
        "state": state,
        "model": kind,
        **values,
        "rms_ratio": round(rms, 4),
    }


def show(result: Table, fit: dict[str, object]) -> None:
    """Print a fit and the deviations by lag and depth."""
    print("\n" + ", ".join(f"{key} {value}" for key, value in fit.items()))
    same = np.all([result[key] == fit[key] for key in ("device", "state", "model")], axis=0)
    for depth in DEPTHS:
        part = result[same & (result["depth_um"] == depth)]
        side = int(np.sqrt(len(part)))
        grid = 100 * (np.array(part["ratio"]).reshape(side, side) - 1)
        print(f"  at {depth:g} um, image charge over table less 1 [%], rows j, columns i:")
        print("\n".join("    " + " ".join(f"{v:7.1f}" for v in row) for row in grid))


def main() -> None:
    """Fit, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", nargs="*", default=["itl_sta3800c", "e2v_ccd250"])
    parser.add_argument("-o", "--output", default=str(RESULTS))
    options = parser.parse_args()
    rows: list[dict[str, object]] = []
    fits: list[dict[str, object]] = []
    for name in options.device:
        more, found = compare(name)
        rows += more
        fits += found
    result = Table(rows)
    for fit in fits:
        show(result, fit)
    print("\npublished:", PUBLISHED)
    write_results(result, options.output, COMMAND, fits=fits, published=PUBLISHED)


if __name__ == "__main__":
    main()
