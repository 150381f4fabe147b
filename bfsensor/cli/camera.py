"""``bfsensor table --from``: a camera's device and table from the covariances of its flats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from bfsensor.errors import BFSensorError, MeasurementError

if TYPE_CHECKING:
    from bfsensor.device.device import Device
    from bfsensor.fit.camera_fit import CameraFit

STAND_IN = "itl_sta3800c"
"""Device whose gates, implants and temperature stand in where no DEVICE is given."""


@dataclass(frozen=True)
class CameraRequest:
    """Options of ``bfsensor table --from``."""

    source: Path
    thickness: str | None
    pitch: str | None
    lags: int
    without: tuple[tuple[int, int], ...]
    offset: bool
    exchange: bool
    model_error: float

    def settings(self, more: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
        """Quantities of the device that are stated; refuses to guess the thickness."""
        stated = [("thickness", self.thickness)] if self.thickness else []
        if self.pitch:
            stated += [("pitch_x", self.pitch), ("pitch_y", self.pitch)]
        out = [*stated, *more]
        if not any(key.rpartition(".")[2] == "thickness" for key, _ in out):
            raise click.UsageError(
                "--from needs --thickness, that of the silicon, such as --thickness 200um"
            )
        return out


def parse_lags(
    ctx: click.Context, param: click.Parameter, values: Sequence[str]
) -> tuple[tuple[int, int], ...]:
    """Parse lags such as ``0,0``."""
    out = []
    for text in values:
        parts = text.split(",")
        if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
            raise click.BadParameter(f"{text!r} is not a lag I,J such as 0,0")
        out.append((int(parts[0]), int(parts[1])))
    return tuple(out)


def fit_covariances_of(
    request: CameraRequest, template: str, more: Sequence[tuple[str, str]], name: str
) -> tuple[Device, CameraFit]:
    """Read, fit, and make the device; notes go to stderr."""
    from bfsensor.device.depletion import check_depleted
    from bfsensor.device.device import Device
    from bfsensor.fit.camera_areas import read_camera_areas
    from bfsensor.fit.camera_device import (
        drift_model,
        stand_in_device,
        states_back_bias,
        with_fit,
    )
    from bfsensor.fit.camera_fit import FIELD_GUESSED, FIELD_KNOWN, fit_camera

    settings = request.settings(more)
    areas = read_camera_areas(request.source)
    if request.exchange:
        areas = areas.transposed()
    areas = areas.select(lags=request.lags, without=request.without)
    device = stand_in_device(Device.load(template), name, settings)
    check_depleted(device)
    for note in areas.notes:
        click.echo(f"{request.source.name}: {note}", err=True)
    spread = FIELD_KNOWN if states_back_bias(settings, device) else FIELD_GUESSED
    found = fit_camera(
        areas, base=drift_model(device), field_spread=spread, offset=request.offset,
        model_error=request.model_error,
    )  # fmt: skip
    return with_fit(device, found), found


def describe(found: CameraFit) -> dict[str, Any]:
    """Result of the fit for the summary, in the units of its words."""
    fit, errors = found.fit, found.fit.parameter_errors
    model = found.model
    field = float(np.mean(model.drift_at(np.array([0.0, model.thickness]))))
    parameters = {
        f"{name} [um]": (
            float(getattr(model, name)),
            errors[name],
            found.determined_by(name),
        )
        for name in fit.names
        if hasattr(model, name)
    }
    parameters["mean drift_field [V/um]"] = (
        field, field * found.field_error, found.determined_by("strength")
    )  # fmt: skip
    if "offset" in fit.names:
        parameters["offset, in no table [1/e-]"] = (
            fit.offset, errors["offset"], found.determined_by("offset")
        )  # fmt: skip
    return {
        "data": found.areas.source,
        "parameters": {
            key: {"value": value, "error": error, "determined_by": by}
            for key, (value, error, by) in parameters.items()
        },
        "chi2": found.chi2,
        "lags": int(fit.used.sum()),
        "effective_parameters": found.effective,
        "error_scale": found.error_scale,
        "correction": _correction(found),
        "misfits": [
            {"i": i, "j": j, "measured": float(fit.a[j, i]), "fitted": float(fit.predicted[j, i]),
             "pull": pull, "in_fit": bool(fit.used[j, i])}
            for i, j, pull in _misfits(found)
        ],
        "not_determined": not_determined(found),
    }  # fmt: skip


def _correction(found: CameraFit) -> dict[str, Any]:
    """Errors that the calibration leaves to the growth of a star."""
    from bfsensor.fit.correction_error import correction_error

    known = correction_error(found)
    return {
        "sigma_pixel": 1.5,
        "error_x": known.error[0], "error_y": known.error[1],
        "error_x_by_noise": known.noise[0], "error_y_by_noise": known.noise[1],
        # JSON has no infinity.
        "pairs_for_half": known.pairs if np.isfinite(known.pairs) else None,
    }  # fmt: skip


def _misfits(found: CameraFit) -> Sequence[tuple[int, int, float]]:
    from bfsensor.fit.camera_fit import misfits

    return misfits(found.fit)


def not_determined(found: CameraFit) -> list[str]:
    """Say what these data leave open."""
    out = [
        "how shifts depend on the conversion depth: flats of one colour measure them from one "
        "depth, and the model gives the rest",
        "how shifts change with the level: the table is linear in charge",
        "full well and diffusion: the first is not in the table, the second follows the "
        "stand-in's drift field",
    ]
    names = [n for n in found.fit.names if found.determined_by(n) == "prior"]
    words = ["drift_field" if n == "strength" else n for n in names]
    if words:
        out.insert(0, f"{', '.join(words)} alone: where their priors put them")
    return out


def print_fit(summary: dict[str, Any]) -> None:
    """Print parameters, chi2, lags that misfit, and what is left open."""
    click.echo(f"fitted to {summary['data']}")
    click.echo(f"{'parameter':28}{'value':>10}{'error':>10}  determined by")
    for name, row in summary["parameters"].items():
        error = "-" if np.isnan(row["error"]) else f"{row['error']:.2g}"
        click.echo(f"{name:28}{row['value']:10.4g}{error:>10}  {row['determined_by']}")
    chi2, lags, effective = (
        summary[key] for key in ("chi2", "lags", "effective_parameters")
    )
    scaled = (
        f"; errors of a_ij multiplied by {summary['error_scale']:.2f}"
        if summary["error_scale"] != 1
        else ""
    )
    click.echo(
        f"chi2 {chi2:.1f} for {lags} lags less {effective:.1f} parameters, chi2/n "
        f"{chi2 / max(lags - effective, 1e-9):.2f}{scaled}"
    )
    worst = summary["misfits"]
    if worst:
        click.echo(
            "lags off by more than 3 errors: "
            + ", ".join(
                f"({one['i']},{one['j']}) by {one['pull']:+.1f}"
                + ("" if one["in_fit"] else " (not fitted)")
                for one in worst[:8]
            )
            + (f" and {len(worst) - 8} more" if len(worst) > 8 else "")
        )
    star = summary["correction"]
    pairs = star["pairs_for_half"]
    click.echo(
        f"growth of a star with a sigma of {star['sigma_pixel']:g} pixel known to "
        f"{100 * star['error_x']:.2g} % of it in x, {100 * star['error_y']:.2g} % in y "
        f"({100 * star['error_x_by_noise']:.2g}, {100 * star['error_y_by_noise']:.2g} % by noise); "
        + (
            f"{pairs:.2g} times as many flat pairs would halve that"
            if pairs is not None
            else "no number of flat pairs would halve that"
        )
    )
    click.echo("not determined by these data:")
    for line in summary["not_determined"]:
        click.echo(f"  {line}")


def write_fit(device: Device, found: CameraFit, stem: Path, figure: bool) -> list[str]:
    """Write device, fit and figure beside the table; without matplotlib a message on stderr."""
    written = [stem.with_suffix(".toml"), stem.with_name(f"{stem.name}_fit.ecsv")]
    device.write(written[0])
    found.fit.write(written[1], overwrite=True)
    if figure:
        from bfsensor.plots.camera import figure_for_camera
        from bfsensor.plots.style import save_figure

        fit = found.fit
        title = f"{device.name}: {found.areas.source}"
        try:
            drawn = figure_for_camera(fit.a, fit.errors, fit.predicted, fit.used, title)
        except BFSensorError as error:
            click.echo(f"bfsensor: no figure: {error}", err=True)
        else:
            written.append(stem.with_name(f"{stem.name}_fit.png"))
            save_figure(drawn, written[-1])
    return [str(path) for path in written]


def provenance_of(found: CameraFit) -> dict[str, str]:
    """Entries for the header of the table."""
    fit, errors = found.fit, found.fit.parameter_errors
    left_out = [
        f"{i},{j}" for (j, i), kept in np.ndenumerate(fit.used)
        if not kept and np.isfinite(fit.a[j, i])
    ]  # fmt: skip
    return {
        "fitted to": found.areas.source,
        "fit chi2": f"{found.chi2:.2f} of {int(fit.used.sum())} lags, errors x {found.error_scale:.2f}",
        "fit errors [um]": ", ".join(
            f"{name} {errors[name]:.3g} ({found.determined_by(name)})"
            for name in fit.names if hasattr(fit.model, name)
        ),
        "fit drift field": f"+- {100 * found.field_error:.2g} % ({found.determined_by('strength')})",
        "lags not fitted": ", ".join(left_out) or "none",
        "limits": "linear in charge; depth dependence, diffusion and full well not measured",
    }  # fmt: skip


def check_outputs(stem: Path, overwrite: bool) -> None:
    """Refuse files beside the table that exist; before any work."""
    for path in (stem.with_suffix(".toml"), stem.with_name(f"{stem.name}_fit.ecsv")):
        if path.exists() and not overwrite:
            raise MeasurementError(f"{path} exists; give --overwrite to replace it")
