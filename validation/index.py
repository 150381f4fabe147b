"""The index of all claims and results: ``python -m validation.index`` writes validation/README.md.

Claims, their sources, criteria, commands and files of results are those of the README.md in each
folder; commits, dates and CPU seconds are those of the files' headers.  A result is stale where a
file that its command depends on (:mod:`validation.common.dependencies`) has other code now than at
the commit that its rows were made at.  The same marks go into the README.md of each folder, and
into the pages that quote numbers (:mod:`validation.quoted_numbers`): those are copies of the index.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from validation.common.dependencies import ROOT, History, dependencies, module_file

PAGE = ROOT / "validation" / "README.md"

HEAD = """\
# Claims and how they were checked

Written by `python -m validation.index`, as are the lines *Rows* in the README.md of each folder; a
test fails where they are not up to date. A folder holds one claim or a few of one kind; its README.md
states source and criterion of each, and its notebook, if it has one, asserts the criterion. Notebooks
marked *quick* run with every change, the others take minutes. `concealed/` makes campaigns whose truth
is sealed, `common/` holds what checks share.
Commands run from the root of a checkout; words in capitals are folders that are not shipped.

## Claims

| folder | claim | notebook | command | results |
|---|---|---|---|---|
"""

RUNS = """
## What made the results

Rows were made at the commit named; *by* is the command in the file, *today* the same where it has
moved since. CPU seconds are known of rows whose file says them. Files to which rows were added run
by run, before headers kept each run, name the commit of the last rows only.

A result is stale where any file that its command imports, directly or through others, or a device
or table that it names, has other code now than when the rows were made. Imports, docstrings and
comments do not count, nor that a file moved. Under *stale since* stand day and commit of the last
version with the rows' code; `python -m validation.index --why RESULT` lists the files. *Not known*
is said in a clone that lacks the commit of the rows. Stale does not mean wrong, for most changes
leave numbers as they are, but nobody has made the rows again.
{stale} of {results} results are stale.

| result | by | today | commit | date | CPU s | stale since |
|---|---|---|---|---|---|---|
"""


UNKNOWN = "not known"
"""Of commits that a clone does not have."""


@dataclass(frozen=True)
class Claim:
    """One claim of a folder's README.md."""

    folder: str
    text: str
    source: str
    criterion: str
    notebooks: tuple[str, ...] = ()
    commands: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Each with the files of results that it writes."""
    also: tuple[str, ...] = ()
    """Modules that the results depend on besides those that the command's script imports."""


@dataclass(frozen=True)
class Run:
    """What a file of results says of one run that made rows."""

    command: str
    commit: str
    date: str = ""
    cpu_s: float = np.nan


@dataclass(frozen=True)
class Age:
    """When a file of results was made, and since when it is stale, as the index says it."""

    commit: str
    date: str
    stale: str
    """Empty where the code is that of the rows; :data:`UNKNOWN` where this cannot be said."""

    def __str__(self) -> str:
        made = f"made {self.date} ({self.commit})"
        if self.stale == UNKNOWN:
            return f"{made}; not known whether stale"
        if self.stale:
            return f"{made}; **stale since {self.stale}**: the code behind it has changed"
        return f"{made}; the code behind it is the same today"


@dataclass
class Result:
    """A file of results: what made it, and what it depends on."""

    name: str
    runs: list[Run]
    scripts: set[str] = field(default_factory=set)
    today: set[str] = field(default_factory=set)
    """Commands of the claims that name it."""


def read_claims(root: Path = ROOT) -> list[Claim]:
    """Read the claims of all folders.

    Raises
    ------
    ValueError
        A README.md has a line that is none of its form, or lacks one.
    """
    places = sorted((root / "validation").glob("*/README.md"))
    return [claim for place in places for claim in _claims_of(place)]


def _claims_of(place: Path) -> Iterator[Claim]:
    """Claims of one README.md: headings of the second order, each with its items."""
    for part in place.read_text().split("\n## ")[1:]:
        text, *lines = part.splitlines()
        values: dict[str, list[str]] = {}
        for line in lines:
            if line.startswith("- "):
                name, colon, value = line[2:].partition(": ")
                if not colon or name not in (*_ITEMS, "Source", "Criterion", "Rows"):
                    raise ValueError(f"{place}: '{line}' is none of Source, Criterion, "
                                     f"{', '.join(_ITEMS)}")  # fmt: skip
                values.setdefault(name, []).append(value)
        if missing := {"Source", "Criterion"} - set(values):
            raise ValueError(f"{place}: '{text}' lacks {' and '.join(sorted(missing))}")
        if not values.keys() & {"Notebook", "Command"}:
            raise ValueError(f"{place}: '{text}' has neither notebook nor command")
        quoted = {
            n: [re.findall("`([^`]+)`", v) for v in values.get(n, ())] for n in _ITEMS
        }
        yield Claim(
            folder=place.parent.name, text=text,
            source=values["Source"][0], criterion=values["Criterion"][0],
            notebooks=tuple(found for (found,) in quoted["Notebook"]),
            commands=tuple(
                (words[0], tuple(w for w in words if w.endswith(".ecsv")))
                for words in quoted["Command"]
            ),
            also=tuple(name for names in quoted["Depends also on"] for name in names),
        )  # fmt: skip


_ITEMS = ("Notebook", "Command", "Depends also on")


def script_of(command: str, root: Path = ROOT) -> str:
    """File that a command runs, relative to the checkout.

    Raises
    ------
    ValueError
        The command is not ``python -m MODULE`` or ``python FILE`` of this checkout.
    """
    words = command.split()
    if words[:2] == ["python", "-m"]:
        module = words[2]
        found = module_file(f"{module}.__main__", root) or module_file(module, root)
        if found:
            return found
    elif words[0] == "python" and (root / words[1]).is_file():
        return words[1]
    raise ValueError(f"'{command}' runs no file of this checkout")


def read_runs(path: Path) -> list[Run]:
    """Runs that made the rows of a file, as far as its header or its rows tell them apart."""
    table = Table.read(path, format="ascii.ecsv")
    meta = table.meta
    named = [
        value for value in meta.values() if isinstance(value, Mapping) and "commit" in value
    ]
    if named:  # every run has an entry of its own
        return [_run({"command": meta["command"], **run}) for run in named]
    runs = [*meta.get("earlier", ()), meta]
    if "commit" in table.colnames:  # every row has
        commits = dict.fromkeys(str(commit) for commit in table["commit"])
        runs = [run for run in runs if run["commit"] in commits]
        silent = set(commits) - {run["commit"] for run in runs}
        runs += [{"command": meta["command"], "commit": c} for c in commits if c in silent]
    return [_run(run) for run in runs]


def _run(told: Mapping[str, Any]) -> Run:
    return Run(
        str(told["command"]), str(told["commit"]), str(told.get("date", ""))[:10],
        float(told.get("cpu_s", np.nan)),
    )  # fmt: skip


def read_results(claims: list[Claim], root: Path = ROOT) -> list[Result]:
    """Read what made each file of results, by name."""
    found: dict[str, Result] = {}
    for claim in claims:
        for command, names in claim.commands:
            for name in names:
                runs = read_runs(root / "validation" / "results" / name)
                result = found.setdefault(name, Result(name, runs))
                result.today.add(command)
                files = [module_file(module, root) for module in claim.also]
                result.scripts |= {script_of(command, root), *(f for f in files if f)}
    return [found[name] for name in sorted(found)]


def format_page(claims: list[Claim], results: list[Result], history: History) -> str:
    """Text of the index."""
    lines = [_claim_line(claim) for claim in claims]
    made = [_result_line(result, history) for result in results]
    stale = sum(not line.endswith(("|  |", f"| {UNKNOWN} |")) for line in made)
    runs = RUNS.format(stale=stale, results=len(results))
    return HEAD + "\n".join(lines) + "\n" + runs + "\n".join(made) + "\n"


def _claim_line(claim: Claim) -> str:
    notebooks = []
    for name in claim.notebooks:
        place = (ROOT / "validation" / claim.folder / name).resolve()
        kind = "quick" if is_quick(place) else "minutes"
        link = place.relative_to(PAGE.parent)
        notebooks.append(f"[{place.name}]({link}) ({kind})")
    files = [name for _, names in claim.commands for name in names]
    return _row(
        f"[{claim.folder}]({claim.folder}/README.md)",
        claim.text,
        "<br>".join(notebooks),
        "<br>".join(f"`{command}`" for command, _ in claim.commands),
        "<br>".join(f"[{name}](results/{name})" for name in files),
    )


def _result_line(result: Result, history: History) -> str:
    runs = result.runs
    known = all(history.knows(run.commit) for run in runs)
    if known:
        runs = sorted(runs, key=lambda run: history.seconds(run.commit))
    commits = list(dict.fromkeys(run.commit for run in runs))
    days = sorted(
        {run.date or (history.date(run.commit) if known else UNKNOWN) for run in runs}
    )
    seconds = np.array([run.cpu_s for run in runs])
    by = {run.command for run in runs}
    return _row(
        f"[{result.name}](results/{result.name})",
        "<br>".join(f"`{command}`" for command in sorted(by)),
        "<br>".join(
            f"`{command}`" for command in sorted(result.today) if command not in by
        ),
        f"`{commits[0]}`"
        + (f" to `{commits[-1]}`, {len(commits)} commits" if commits[1:] else ""),
        " to ".join(dict.fromkeys((days[0], days[-1]))),
        "" if np.isnan(seconds).any() else f"{seconds.sum():.0f}",
        _stale(commits[0], result, history) if known else UNKNOWN,
    )


def _stale(commit: str, result: Result, history: History) -> str:
    """Since when the code is another one than at the oldest of the runs, empty if it is not."""
    changed = history.changed(commit, _files(result))
    try:
        first = next(changed, None)
        if first is None:
            return ""
        last = history.last_same(commit, chain([first], changed))
        return f"{history.date(last)} (`{last}`)"
    except LookupError:  # a clone that lacks old files
        return UNKNOWN


def _files(result: Result) -> frozenset[str]:
    return frozenset().union(*(dependencies(script) for script in result.scripts))


def _row(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def read_ages(page: str) -> dict[str, Age]:
    """Read from the text of the index how old each file of results is, by its name."""
    rows = re.findall(r"^\| \[([^]]+\.ecsv)\]\([^)]+\) \|(.*)\|$", page, re.M)
    ages = {}
    for name, rest in rows:
        _, _, commit, date, _, stale = (
            cell.strip() for cell in re.split(r"(?<!\\)\|", rest)
        )
        ages[name] = Age(commit, date, stale)
    return ages


def with_ages(text: str, ages: Mapping[str, Age]) -> str:
    """README.md of a folder with a line for each file of results under the command that writes it."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("- Rows: "):
            lines.append(line)
        if line.startswith("- Command: "):
            lines += [
                f"- Rows: [{name}](../results/{name}), {ages[name]}"
                for name in re.findall(r"`([^`]+\.ecsv)`", line)
            ]
    return "\n".join(lines) + "\n"


def write_pages(claims: list[Claim], results: list[Result], history: History) -> None:
    """Write the index, and the marks of its results wherever else they stand."""
    from validation.quoted_numbers import write_quotes

    page = format_page(claims, results, history)
    PAGE.write_text(page)
    ages = read_ages(page)
    for place in PAGE.parent.glob("*/README.md"):
        place.write_text(with_ages(place.read_text(), ages))
    write_quotes()


def is_quick(notebook: Path) -> bool:
    """Whether a notebook is one of those that run with every change."""
    told = json.loads(notebook.read_text())["metadata"].get("bfsensor", {})
    return bool(told.get("quick"))


def main() -> None:
    """Write the index, or list what changed under results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--why", nargs="+", metavar="RESULT", help="Files that changed under it."
    )
    asked = parser.parse_args().why
    claims, history = read_claims(), History()
    results = read_results(claims)
    if asked is None:
        write_pages(claims, results, history)
        print(f"{PAGE}: {len(claims)} claims, {len(results)} results")
        return
    if unknown := set(asked) - {result.name for result in results}:
        parser.error(
            f"{', '.join(sorted(unknown))}: no file of validation/results with a claim"
        )
    for result in (result for result in results if result.name in asked):
        for commit in dict.fromkeys(run.commit for run in result.runs):
            if not history.knows(commit):
                print(f"{result.name}: this clone does not have {commit}")
                continue
            changed = [change.new for change in history.changed(commit, _files(result))]
            count = f"{len(changed)} of {len(_files(result))} files"
            print(f"{result.name}: {count} changed since {commit}", *changed, sep="\n  ")


if __name__ == "__main__":
    main()
