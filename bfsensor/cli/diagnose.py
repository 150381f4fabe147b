"""``bfsensor diagnose``: compare recordings with a simulated baseline and explain the difference."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import click

from bfsensor.cli.common import Bar, parse_conditions
from bfsensor.errors import ConvergenceError, DeviceError, DiagnosisError
from bfsensor.files import held


@click.command("diagnose", short_help="Compare recordings with a baseline.")
@click.argument("campaign", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--baseline", metavar="FILE|STEM|DEVICE",
              help="Model that predicts the recordings: edge displacements (.json), a table "
              "(.fits), a GalSim stem, a built-in device, or 'none' for an unknown sensor, whose "
              "nearest a_ij are then fitted.  [default: that of campaign.yaml]")  # fmt: skip
@click.option(
    "--float",
    "floating",
    metavar="NAME",
    multiple=True,
    help="Fit this quantity of a baseline device, such as silicon.thickness, within its stated "
    "uncertainty; repeatable; 'all' for every one. The device is simulated again, about 5 s each.",
)
@click.option(
    "--device/--no-device", "device", default=True,
    help="Fit every quantity of a baseline device within its stated uncertainty, as --float all does, "
    "and seek physics that the device lacks; solves the device, about a minute the first time. With "
    "--no-device its shipped table answers, and no quantity is fitted.  [default: --device]",
)  # fmt: skip
@click.option(
    "--at", "conditions", multiple=True, callback=parse_conditions,
    metavar="[FILE:]KEY=VALUE,...",
    help="State the conditions of one table of a_ij, or of all: back_bias, wavelength and temperature "
    "(with units), and level [e-], such as itl.csv:back_bias=-60V,level=40000.  [default: the "
    "device's; the level is fitted]",
)  # fmt: skip
@click.option("--errors", default="scaled", show_default=True,
              type=click.Choice(["scaled", "stated"]),
              help="'scaled' multiplies the errors of tables of a_ij by a factor where far lags, at "
              "which no sensor has a signal, contradict them; 'stated' takes them as they are."
              )  # fmt: skip
@click.option(
    "--towards", metavar="TABLE|DEVICE",
    help="The baseline's device at another operating point. The fit may then move the operating "
    "point of the baseline on the straight line between the two; not with --float.",
)  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Folder for report.json, report.html and figures.  [default: "
              "CAMPAIGN_diagnosis]")  # fmt: skip
@click.option(
    "--seed",
    default=1,
    show_default=True,
    type=click.IntRange(0, 2**63 - 1),
    help="Seed of the simulated noise from which p-values are computed.",
)
@click.option(
    "--explain/--locate-only", default=True,
    help="Search for effects that explain a mismatch, or only find the channels and places where "
    "it is.  [default: --explain]",
)  # fmt: skip
@click.option(
    "--predict", "asked", metavar="CONDITIONS", multiple=True,
    help="Predict exposures that were not taken, to predicted.ecsv; repeatable. CONDITIONS are "
    "level [e-] or seconds [s] of flats, flux [e-] of spots, and wavelength [nm], back_bias [V], "
    "temperature [C] or lamp where they differ from the campaign; or an ECSV file of them.",
)  # fmt: skip
@click.option(
    "--json", "as_json", is_flag=True, help="Print report.json instead of a summary."
)
def diagnose(
    campaign: tuple[Path, ...],
    baseline: str | None,
    floating: tuple[str, ...],
    device: bool,
    conditions: list[tuple[str, dict[str, str]]],
    errors: str,
    towards: str | None,
    output: Path | None,
    seed: int,
    explain: bool,
    asked: tuple[str, ...],
    as_json: bool,
) -> None:
    """Compare the recordings of CAMPAIGN with a baseline, and explain the difference.

    CAMPAIGN is a folder of raw exposures, one table of covariances (ECSV, or LSST's photon transfer
    dataset), or one or more tables of a_ij of one sensor, each at its own voltage and level.

    First the quantities that no baseline knows are fitted: gains, noise, lamp, pixel response, and
    quantities of the device within their stated uncertainty.  The residuals of all channels are
    then tested at one false-alarm rate, and effects are sought that explain them.  The exit
    status is 0 if a diagnosis was made, whatever its result.

    \b
    Examples:
      bfsensor diagnose recordings/run_12 -o run_12_diagnosis
      bfsensor diagnose recordings/run_12 --baseline itl_sta3800c --float all
      bfsensor diagnose other_camera --baseline none
      bfsensor diagnose itl_covariances.csv --baseline itl_sta3800c_60
      bfsensor diagnose a60.csv a40.csv --baseline mine.toml --at a60:back_bias=-60V --at a40:level=40000
      bfsensor diagnose e2v_covariances.csv --baseline e2v_ccd250 --towards e2v_ccd250_70
      bfsensor diagnose recordings/run_12 --predict level=40000,back_bias=-40 --predict flux=5e5
    """
    from bfsensor.checkpoints import Checkpoints
    from bfsensor.diagnose import diagnosis
    from bfsensor.diagnose.data.reduced_channels import measure_reduced
    from bfsensor.diagnose.model.open_baseline import (
        CampaignSource,
        asked_of,
        find_baseline,
        find_reduced_recordings,
        is_device,
        reduced_states,
        simulate_baseline,
        with_physics,
    )
    from bfsensor.diagnose.model.table_baseline import with_operating_point
    from bfsensor.diagnose.plan.predict_conditions import (
        predict_conditions,
        read_conditions,
        refuse_unheld,
    )
    from bfsensor.diagnose.report.html_report import write_report
    from bfsensor.diagnose.report.provenance import files_of, provenance_of
    from bfsensor.recording.campaign.campaign import read_campaign

    began = time.monotonic()
    wanted = read_conditions(asked)
    first = campaign[0]
    folder = output or first.with_name(first.resolve().stem + "_diagnosis")
    click.get_current_context().with_resource(held(folder, DiagnosisError))
    reduced = find_reduced_recordings(campaign, conditions)
    found = None if reduced is not None else read_campaign(first, progress=Bar("headers"))
    named = baseline or (None if found is None else found.baseline)
    if towards is not None and (floating or named is None):
        raise click.UsageError("--towards needs a --baseline, and none of --float")
    asked_device = floating or (
        ("all",) if device and towards is None and is_device(named) else ()
    )
    predicted, notes = None, []
    if towards is not None:
        predicted = with_operating_point(str(named), towards)
    elif asked_device:
        exposures = () if found is None else found.exposures
        states = [(e.back_bias, e.temperature) for e in exposures]
        if reduced is not None:
            states = reduced_states(reduced)
        warm = {round(t) for _, t in states if t is not None}
        try:
            predicted = simulate_baseline(
                named, asked_device, [b for b, _ in states], keep=folder, warming=len(warm) > 1,
                progress=Bar("simulations"),
            )  # fmt: skip
            if explain and named is not None:
                predicted = with_physics(predicted, named, keep=folder / "solutions")
            notes.append(asked_of(predicted))
        except (DeviceError, ConvergenceError) as error:
            if floating:
                raise
            notes.append(
                f"no quantity of the device was fitted, nor physics sought that it lacks: {error}"
            )
    if predicted is None:
        predicted = find_baseline(named, card=None if found is None else found.card)
    refuse_unheld(wanted, predicted)
    read = list(campaign) if found is None else found.files
    files = files_of(first if found is not None else first.parent, read)
    options = f"{seed} {explain} {errors} {conditions}"
    keep = Checkpoints(folder / "unfinished", json.dumps(files), predicted.digest, options)
    if found is None:
        assert reduced is not None
        measured = measure_reduced(reduced, reach=predicted.reach)
        result = diagnosis.diagnose_measured(
            measured,
            predicted,
            campaign=first.resolve().stem,
            seed=seed,
            notes=notes,
            explain=explain,
            scaled=errors == "scaled",
            keep=keep,
        )
    else:
        result = diagnosis.diagnose(
            CampaignSource(found), predicted, campaign=found.name, seed=seed, explain=explain,
            progress=Bar("pixels"), keep=keep,
            notes=notes + [f"{c.topic}: {c.message}" for c in found.warnings]
            + [f"set aside: {s.path.name}: {s.reason}" for s in found.set_aside],
        )  # fmt: skip
    command = " ".join(["bfsensor", *sys.argv[1:]])
    told = provenance_of(command, seed=seed, files=files, began=began)
    written = write_report(result, folder, provenance=told)
    further = [*notes, *result.notes[result.read :]]
    predictor, fit = result.accepted
    if wanted and predictor is not None:
        prediction = predict_conditions(predictor, fit, wanted)
        further += prediction.notes
        written.append(prediction.write(folder / "predicted.ecsv"))
    keep.clear()
    if as_json:
        click.echo((folder / "report.json").read_text(), nl=False)
        return
    click.echo(result.said())
    click.echo(f"{'channel':22s}{'chi2':>10s}{'dof':>8s}{'ratio':>8s}")
    for word, (square, dof) in result.mismatch.chi2.items():
        click.echo(f"{word:22s}{square:10.1f}{dof:8.1f}{square / max(dof, 1e-9):8.2f}")
    for advice in result.plan.said():
        click.echo(f"advised: {advice}")
    for note in further:
        click.echo(f"note: {note}")
    click.echo(f"{folder}: {', '.join(p.name for p in written if p.suffix != '.png')}")
