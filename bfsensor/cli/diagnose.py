"""``bfsensor diagnose``: recordings against what the simulation predicts."""

from __future__ import annotations

import json
from pathlib import Path

import click

from bfsensor.cli.common import Bar


@click.command("diagnose")
@click.argument("campaign", type=click.Path(path_type=Path))
@click.option("--baseline", metavar="FILE|STEM|DEVICE",
              help="What predicts: edge displacements (.json), a table (.fits), a GalSim stem, a "
              "built-in device, or 'none' for a sensor of which nothing is known (white noise and "
              "near a_ij that float); by default the one campaign.yaml names.")  # fmt: skip
@click.option(
    "--float",
    "floating",
    metavar="NAME",
    multiple=True,
    help="Let a quantity of a DEVICE baseline float within its stated uncertainty, such as "
    "silicon.thickness; 'all' for every one. The device is simulated anew, 5 s for each.",
)
@click.option(
    "--towards", metavar="TABLE|DEVICE",
    help="The same device at another back bias: the operating point of the baseline may be off "
    "its card on the line to that one.",
)  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Folder for report.json, report.html and figures [CAMPAIGN_diagnosis].")  # fmt: skip
@click.option(
    "--seed", default=1, show_default=True, help="Of the draws that p-values come from."
)
@click.option(
    "--explain/--locate-only", default=True,
    help="Look for the effects that explain a mismatch, or only for where it is.",
)  # fmt: skip
@click.option(
    "--predict", "asked", metavar="CONDITIONS", multiple=True,
    help="Write predicted.ecsv: what the accepted model expects of exposures that were not taken. "
    "Flats by level [e-] or seconds, spots by flux [e-]; wavelength [nm], back_bias [V], "
    "temperature [C] and lamp where they differ from the campaign's; several times, or an ECSV "
    "file with these columns.",
)  # fmt: skip
@click.option(
    "--json", "as_json", is_flag=True, help="Print report.json instead of a summary."
)
def diagnose(
    campaign: Path,
    baseline: str | None,
    floating: tuple[str, ...],
    towards: str | None,
    output: Path | None,
    seed: int,
    explain: bool,
    asked: tuple[str, ...],
    as_json: bool,
) -> None:
    """Hold the recordings of CAMPAIGN against a baseline; say what is left, and where.

    CAMPAIGN is a folder of raw exposures, or a reduced recording: a table of measured a_ij or
    of covariances (ECSV, LSST's photon transfer dataset), diagnosed as one channel.

    Everything that may honestly float is fitted: gains, noise, lamp, pixel response, the
    device's parameters within their card's spread.  What remains is sought in all channels
    at one false-alarm rate.  The status is 0 when the diagnosis was made, whatever it says.

    \b
    Examples:
      bfsensor diagnose recordings/run_12 -o run_12_diagnosis
      bfsensor diagnose recordings/run_12 --baseline itl_sta3800c --float all
      bfsensor diagnose other_camera --baseline none
      bfsensor diagnose itl_covariances.csv --baseline itl_sta3800c_60
      bfsensor diagnose e2v_covariances.csv --baseline e2v_ccd250 --towards e2v_ccd250_70
      bfsensor diagnose recordings/run_12 --predict level=40000,back_bias=-40 --predict flux=5e5
    """
    from bfsensor.diagnose import diagnosis
    from bfsensor.diagnose.data.reduced_channels import measure_reduced
    from bfsensor.diagnose.model.open_baseline import (
        CampaignSource,
        find_baseline,
        find_reduced_recording,
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
    from bfsensor.recording.campaign.campaign import read_campaign

    conditions = read_conditions(asked)
    folder = output or campaign.with_name(campaign.resolve().stem + "_diagnosis")
    reduced = find_reduced_recording(campaign)
    found = (
        None if reduced is not None else read_campaign(campaign, progress=Bar("headers"))
    )
    named = baseline or (None if found is None else found.baseline)
    if towards is not None and (floating or named is None):
        raise click.UsageError("--towards needs a --baseline, and none of --float")
    if towards is not None:
        predicted = with_operating_point(str(named), towards)
    elif floating:
        exposures = () if found is None else found.exposures
        biases = sorted({e.back_bias for e in exposures if e.back_bias is not None})
        warm = {round(e.temperature) for e in exposures if e.temperature is not None}
        predicted = simulate_baseline(
            named, floating, biases, keep=folder, warming=len(warm) > 1,
            progress=Bar("simulations"),
        )  # fmt: skip
        if explain and named is not None:
            predicted = with_physics(predicted, named, keep=folder / "walks")
    else:
        predicted = find_baseline(named, card=None if found is None else found.card)
    refuse_unheld(conditions, predicted)
    if found is None:
        assert reduced is not None
        measured = measure_reduced(reduced, reach=predicted.reach)
        result = diagnosis.diagnose_measured(
            measured, predicted, campaign=reduced.path.stem, seed=seed, explain=explain
        )
    else:
        result = diagnosis.diagnose(
            CampaignSource(found), predicted, campaign=found.name, seed=seed, explain=explain,
            progress=Bar("pixels"),
            notes=[f"{c.topic}: {c.message}" for c in found.warnings]
            + [f"set aside: {s.path.name}: {s.reason}" for s in found.set_aside],
        )  # fmt: skip
    written = write_report(result, folder)
    notes: tuple[str, ...] = ()
    predictor, fit = result.accepted
    if conditions and predictor is not None:
        prediction = predict_conditions(predictor, fit, conditions)
        notes = prediction.notes
        written.append(prediction.write(folder / "predicted.ecsv"))
    if as_json:
        click.echo(json.dumps(result.to_report(), indent=1))
        return
    click.echo(result.said())
    click.echo(f"{'channel':22s}{'chi2':>10s}{'dof':>8s}{'ratio':>8s}")
    for word, (square, dof) in result.mismatch.chi2.items():
        click.echo(f"{word:22s}{square:10.1f}{dof:8.1f}{square / max(dof, 1e-9):8.2f}")
    for advice in result.plan.said():
        click.echo(f"advised: {advice}")
    for note in (*result.notes[result.read :], *notes):
        click.echo(f"note: {note}")
    click.echo(f"{folder}: {', '.join(p.name for p in written if p.suffix != '.png')}")
