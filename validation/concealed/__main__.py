"""``python -m validation.concealed make|run|open|table``: campaigns sealed until scored."""

from __future__ import annotations

import secrets
from pathlib import Path

import click
import numpy as np
from tqdm import tqdm

from validation.concealed.calibration import coverage_by_class, reliability
from validation.concealed.campaign import write_campaign
from validation.concealed.effect import Effect
from validation.concealed.goals import causes, described, goals, splits
from validation.concealed.library import EFFECTS, draw_effect, draw_effects, make_effect
from validation.concealed.misses import print_misses
from validation.concealed.opening import (
    COMMAND,
    add_results,
    open_truths,
    to_row,
    trial_from_row,
    write_goals,
    write_summary,
)
from validation.concealed.plan import SIZES
from validation.concealed.rows import read_rows
from validation.concealed.submit import read_json, run_campaigns
from validation.concealed.tally import print_lines, tally

RESULTS = Path(__file__).parents[1] / "results" / "challenge.ecsv"


@click.group()
def main() -> None:
    """Concealed campaigns of a virtual sensor: made, diagnosed, opened and scored.

    \b
    Example:
      python -m validation.concealed make campaigns --count 40 --truth-folder sealed
      python -m validation.concealed run campaigns -o reports
      python -m validation.concealed open campaigns reports sealed
    """


def _asked(words, variant, strength, amplitudes, rng) -> tuple[Effect, ...]:
    """Draw the effects asked for by class, then set the parameters that were given."""
    effects = [draw_effect(w, rng, strength=strength, variant=variant) for w in words]
    for entry in amplitudes:
        name, _, value = entry.partition("=")
        at = [k for k, e in enumerate(effects) if name in e.parameters]
        try:
            number = float(value)
        except ValueError:
            at = []
        if not at:
            raise click.UsageError(
                f"--amplitude {entry}: NAME=NUMBER, a parameter of --class"
            )
        effect = effects[at[0]]
        effects[at[0]] = make_effect(
            effect.word, {**effect.parameters, name: number}, effect.variant
        )
    return tuple(effects)


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--size", type=click.Choice(list(SIZES)), default="S", show_default=True)
@click.option("--count", default=1, show_default=True, help="Number of campaigns.")
@click.option("--seed", type=int, help="Fixes everything; secret and fresh if not given.")
@click.option(
    "--name", default="concealed", show_default=True, help="NAME_0000, NAME_0001, ..."
)
@click.option("--class", "words", multiple=True, type=click.Choice(sorted(EFFECTS)))
@click.option("--variant", help="Variant of the class, where it has some.")
@click.option("--strength", type=float, help="0 to 1: place in the range of amplitudes.")
@click.option(
    "--amplitude", "amplitudes", multiple=True, help="NAME=NUMBER of a class's parameter."
)
@click.option("--null-fraction", default=0.25, show_default=True)
@click.option("--outside-fraction", default=0.12, show_default=True)
@click.option("--several-fraction", default=0.16, show_default=True)
@click.option("--amplifiers", default=2, show_default=True)
@click.option(
    "--truth-folder", type=click.Path(path_type=Path), help="Away from the campaigns."
)
@click.option(
    "--withheld-folder", type=click.Path(path_type=Path), help="Exposures kept back."
)
def make(
    folder: Path,
    size: str,
    count: int,
    seed: int | None,
    name: str,
    words: tuple[str, ...],
    variant: str | None,
    strength: float | None,
    amplitudes: tuple[str, ...],
    null_fraction: float,
    outside_fraction: float,
    several_fraction: float,
    amplifiers: int,
    truth_folder: Path | None,
    withheld_folder: Path | None,
) -> None:
    """Make campaigns under FOLDER: of given classes, or drawn with nulls and foreign ones.

    \b
    Example:
      python -m validation.concealed make campaign --class cti_serial --amplitude cti=1e-6
      python -m validation.concealed make campaigns --count 40 --truth-folder sealed
    """
    seed = secrets.randbits(63) if seed is None else seed
    try:
        for number in range(count):
            rng = np.random.default_rng([seed, number])
            if words or null_fraction == 1:
                effects = _asked(words, variant, strength, amplitudes, rng)
            else:
                effects = draw_effects(
                    rng,
                    null_fraction=null_fraction,
                    outside_fraction=outside_fraction,
                    several_fraction=several_fraction,
                    strength=strength,
                )
            write_campaign(
                folder / f"{name}_{number:04d}",
                seed=int(rng.integers(2**62)),
                size=size,
                effects=effects,
                amplifiers=amplifiers,
                truth_folder=truth_folder,
                withheld_folder=withheld_folder,
                progress=lambda e, n=number: tqdm(e, desc=f"{name}_{n:04d}", disable=None),
            )
    except ValueError as error:
        raise click.ClickException(str(error)) from None


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Folder of results [FOLDER_results].")  # fmt: skip
@click.option(
    "--command",
    default="bfsensor diagnose",
    show_default=True,
    help="Called with a campaign, -o and a folder.",
)
def run(folder: Path, output: Path | None, command: str) -> None:
    """Diagnose each campaign of FOLDER, once; truths are neither needed nor read.

    The hash of each report is written to submissions.json: what is opened later is what was
    said before.  Interrupted at any moment, the same command goes on where it was; campaigns with
    a report are not run again.  Time and peak memory of each are in its cost.json.

    \b
    Example:
      python -m validation.concealed run campaigns -o reports
      python -m validation.concealed run campaigns --command "bfsensor diagnose --seed 5"
    """
    output = output or folder.with_name(folder.resolve().name + "_results")
    try:
        done = run_campaigns(
            folder, output, command=command, progress=lambda c: tqdm(c, desc="campaigns")
        )
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    except KeyboardInterrupt:
        click.echo(f"{output}: interrupted; the same command goes on", err=True)
        raise click.exceptions.Exit(130) from None
    click.echo(
        f"{output}: {len(done.made)} diagnosed, {len(done.there)} were there already"
    )
    if done.failed:
        raise click.ClickException(
            f"no report of {', '.join(done.failed)}; what the command said is in "
            f"{output}/NAME.failed.txt"
        )


@main.command(name="open")
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("results", type=click.Path(path_type=Path))
@click.argument("truths", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), default=RESULTS, show_default=True,
              help="ECSV that a row for each campaign is added to.")  # fmt: skip
@click.option(
    "--more",
    type=click.Path(path_type=Path),
    help="JSON, by campaign: snr, where, tie_broken "
    "(as `validation.challenge.concealed_trials snr` writes).",
)
def open_(
    folder: Path, results: Path, truths: Path, output: Path, more: Path | None
) -> None:
    """Open TRUTHS, hold them against their commitments, and score RESULTS.

    Refused, by name: truths that do not have the hash committed to, reports that were changed
    after their submission.  Each goal is printed with its trials and 95 % bounds, then all
    misses.  A row for each campaign and the table (NAME_summary.ecsv) are kept.

    \b
    Example:
      python -m validation.concealed open campaigns reports sealed
    """
    try:
        added = read_json(more, "file of SNRs") if more else None
        opened = open_truths(folder, results, truths, more=added)
        group = folder.resolve().name
        kept = add_results(output, [to_row(o, "pixel", group) for o in opened], COMMAND)
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    scores = [o.score() for o in opened]
    lines = tally(scores)
    summary = output.with_name(f"{output.stem}_summary.ecsv")
    write_summary(summary, lines, group, "pixel", COMMAND)
    print_lines(lines, click.echo)
    click.echo("\nMisses:")
    print_misses(scores, click.echo)
    click.echo(f"\n{output}: {kept} rows added of {len(scores)}; {summary}")


@main.command()
@click.argument("rows", type=click.Path(path_type=Path, exists=True))
@click.option("--set", "group", help="Rows of this set alone.")
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="ECSV of the table, by part of the trials.")  # fmt: skip
def table(rows: Path, group: str | None, output: Path | None) -> None:
    """Print the goals of ROWS, whole and by strength, law and layout, and misses by cause.

    Then how often classes are true that were given a probability, by tenths of it, and how often
    intervals hold, by class and parameter.

    \b
    Example:
      python -m validation.concealed table validation/results/independent_campaigns.ecsv
    """
    kept = [r for r in read_rows(rows) if group is None or r["set"] == group]
    if not kept:
        names = ", ".join(sorted({r["set"] for r in read_rows(rows)}))
        raise click.UsageError(f"--set {group}: {rows} holds {names or 'no rows'}")
    trials = [trial_from_row(r) for r in kept]
    parts = {"all": trials, **splits(trials)}
    lines = {name: goals(own) for name, own in parts.items()}
    print_lines(lines["all"], click.echo)
    for name, own in list(parts.items())[1:]:
        click.echo(f"\n{name}: {len(own)} campaigns")
        print_lines([n for n in lines[name] if n.trials], click.echo)
    lines["probabilities"] = reliability([s for t in trials for s in t.stated])
    lines["intervals"] = coverage_by_class([h for t in trials for h in t.held])
    for name in ("probabilities", "intervals"):
        click.echo(f"\n{name}")
        print_lines(lines[name], click.echo)
    by_cause: dict[str, list[str]] = {}
    for trial in trials:
        if word := causes(trial.score):
            by_cause.setdefault(word, []).append(described(trial))
    for word, own in sorted(by_cause.items(), key=lambda c: -len(c[1])):
        click.echo(f"\n{word}: {len(own)}")
        for text in own:
            click.echo(f"  {text}")
    if output:
        write_goals(output, lines, "python -m validation.concealed table")
        click.echo(f"\n{output}")


if __name__ == "__main__":
    main()
