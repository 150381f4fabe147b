"""``bfsensor diagnose``: recordings against what the simulation predicts."""

from __future__ import annotations

import json
from pathlib import Path

import click

from bfsensor.cli_common import Bar


@click.command("diagnose")
@click.argument("campaign", type=click.Path(path_type=Path))
@click.option("--baseline", metavar="FILE|STEM|DEVICE",
              help="What predicts: edge displacements (.json), a table (.fits), a GalSim stem or a "
              "built-in device; by default the one campaign.yaml names.")  # fmt: skip
@click.option(
    "--float",
    "floating",
    metavar="NAME",
    multiple=True,
    help="Let a quantity of a DEVICE baseline float within its stated uncertainty, such as "
    "silicon.thickness; 'all' for every one. The device is simulated anew, 5 s for each.",
)
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Folder for report.json, report.html and figures [CAMPAIGN_diagnosis].")  # fmt: skip
@click.option(
    "--seed", default=1, show_default=True, help="Of the draws that p-values come from."
)
@click.option(
    "--json", "as_json", is_flag=True, help="Print report.json instead of a summary."
)
def diagnose(
    campaign: Path,
    baseline: str | None,
    floating: tuple[str, ...],
    output: Path | None,
    seed: int,
    as_json: bool,
) -> None:
    """Hold the recordings of CAMPAIGN against a baseline; say what is left, and where.

    Everything that may honestly float is fitted: gains, noise, lamp, pixel response, the
    device's parameters within their card's spread.  What remains is sought in all channels
    at one false-alarm rate.  The status is 0 when the diagnosis was made, whatever it says.

    \b
    Examples:
      bfsensor diagnose recordings/run_12 -o run_12_diagnosis
      bfsensor diagnose recordings/run_12 --baseline itl_sta3800c --float all
    """
    from bfsensor.diagnose import diagnosis
    from bfsensor.diagnose.report import write_report
    from bfsensor.diagnose.sources import CampaignSource, find_baseline, simulate_baseline
    from bfsensor.recording.campaign import read_campaign

    found = read_campaign(campaign, progress=Bar("headers"))
    folder = output or campaign.with_name(campaign.resolve().name + "_diagnosis")
    named = baseline or found.baseline
    if floating:
        biases = sorted({e.back_bias for e in found.exposures if e.back_bias is not None})
        predicted = simulate_baseline(
            named, floating, biases, keep=folder, progress=Bar("simulations")
        )
    else:
        predicted = find_baseline(named, card=found.card)
    result = diagnosis.diagnose(
        CampaignSource(found), predicted, campaign=found.name, seed=seed, progress=Bar("pixels"),
        notes=[f"{c.topic}: {c.message}" for c in found.warnings]
        + [f"set aside: {s.path.name}: {s.reason}" for s in found.set_aside],
    )  # fmt: skip
    written = write_report(result, folder)
    if as_json:
        click.echo(json.dumps(result.to_report(), indent=1))
        return
    click.echo(result.said())
    click.echo(f"{'channel':22s}{'chi2':>10s}{'dof':>8s}{'ratio':>8s}")
    for word, (square, dof) in result.mismatch.chi2.items():
        click.echo(f"{word:22s}{square:10.1f}{dof:8.1f}{square / max(dof, 1e-9):8.2f}")
    click.echo(f"{folder}: {', '.join(p.name for p in written if p.suffix != '.png')}")
