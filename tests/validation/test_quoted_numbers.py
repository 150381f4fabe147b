"""README.md and docs/ say what the results say, link to what exists, and README's start runs."""

import re

import numpy as np
import pytest

from validation.index import Age, read_ages
from validation.quoted_numbers import (
    INDEX,
    PLACE,
    ROOT,
    SOURCES,
    list_sources,
    names_in,
    pages,
    quoted,
    read_rows,
    render,
)

README = ROOT / "README.md"
ACCURACY = ROOT / "docs" / "reference" / "accuracy.md"
MADE = {"validation", "gallery", "generated"}
"""Folders of docs/ that building the site writes."""


@pytest.fixture(scope="module")
def numbers():
    return quoted()


def test_pages_are_what_the_results_say(numbers):
    """Run ``python -m validation.quoted_numbers`` if this fails."""
    ages = read_ages(INDEX.read_text())
    used = set()
    for page in pages():
        text = page.read_text()
        used |= names_in(text)
        assert render(text, numbers, list_sources(page, numbers, ages)) == text, page
        # README.md has no room: its links lead to the pages that bear the marks.
        assert (f"<!--={SOURCES}-->" in text) == (page != README), page
    assert used == set(numbers)


def test_readme_links_to_the_marks_of_all_its_numbers(numbers):
    text, marked = README.read_text(), set()
    for folder in set(re.findall(r"\]\(validation/(\w+)/README\.md\)", text)):
        page = (ROOT / "validation" / folder / "README.md").read_text()
        marked |= set(re.findall(r"^- Rows: \[([^]]+)\]", page, re.M))
    assert set().union(*(numbers[name].results for name in names_in(text))) <= marked


def test_one_changed_value_of_a_row_fails_readme_and_docs(numbers):
    def rows(file):
        table = read_rows(file)
        if file == "convergence":
            (at,) = np.flatnonzero(
                (table["device"] == "itl_sta3800c") & (table["period"] == 6)
                & (table["cells"] == 32) & (table["refine_z"] == 0) & (table["depth_um"] == 95)
            )  # fmt: skip
            table["dA_00_um2"][at] *= 1.01
        return table

    changed = numbers | quoted(rows, [n for n in numbers if n.startswith("mesh")])
    assert changed["mesh itl 00"] != numbers["mesh itl 00"]
    for page in (README, ACCURACY):
        assert render(page.read_text(), changed) != render(page.read_text(), numbers)


def test_every_number_follows_its_rows(numbers):
    """Each file of results in turn, each value by a factor of its own: ratios are quoted too."""
    texts = [page.read_text() for page in pages()]
    for file in sorted(set().union(*(quote.results for quote in numbers.values()))):

        def rows(name, file=file):
            table, rng = read_rows(name), np.random.default_rng(52701)
            if f"{name}.ecsv" == file:
                for column in table.columns.values():
                    if (
                        column.dtype.kind == "f"
                        and column.ndim == 1
                        and column.name not in KEYS
                    ):
                        column *= 10 ** rng.uniform(-2.5, -0.05, len(table))
                for run in table.meta.values():
                    if isinstance(run, dict) and "cpu_s" in run:
                        run["cpu_s"] *= 0.7
            return table

        own = [n for n in numbers if file in numbers[n].results and n not in BY_TEXT]
        changed = numbers | quoted(rows, own)
        for text in texts:
            if set(own) & names_in(text):
                assert render(text, changed) != render(text, numbers), file


KEYS = {
    "depth_um", "height_um", "at", "sigma_pixel", "sigma", "level", "peak", "sky", "misstated",
    "gate_low_V", "gate_high_V",
}  # fmt: skip
"""Columns that say which row it is."""

BY_TEXT = {
    "trial sets", "derivatives itl", "derivatives e2v", "iteration",
    *(f"flats left e2v {lag}" for lag in ("00", "10", "01")),
    *(f"{word} {name}" for word in ("fresh", "frozen") for name in ("alarms", "named", "values")),
}  # fmt: skip
"""Numbers of rows, of a column of text or of arrays in rows, which factors on floats do not reach."""


def test_no_line_begins_with_a_number():
    """A line that begins with a comment is HTML as a whole: Markdown in it is not read."""
    for name, text in hand_written():
        assert not re.findall(rf"^[ \t>*-]*<!--=(?!{SOURCES}-->).*", text, re.M), name


def test_a_place_without_number_is_refused(numbers):
    with pytest.raises(KeyError, match="no such number"):
        render("<!--=no such number-->1<!--/-->", numbers)


def test_the_list_of_results_says_since_when_they_are_stale(numbers):
    page = ROOT / "docs" / "concepts" / "limits.md"
    (name,) = set().union(*(numbers[n].results for n in names_in(page.read_text())))
    for stale, said in (
        ("2026-11-22 (`c1`)", "**stale since 2026-11-22 (`c1`)**"),
        ("", "the code behind it is the same today"),
        ("not known", "not known whether stale"),
    ):
        text = list_sources(page, numbers, {name: Age("`c0`", "2026-11-21", stale)})
        link = "[correction](../../validation/correction/README.md)"
        assert f"- `{name}` ({link}), made 2026-11-21 (`c0`); {said}" in text


TYPED = {
    "README.md": ["1 %"],  # stated rate of false alarms
    # the same, and levels of intervals
    "docs/concepts/diagnosis.md": ["1 %", "95 %", "1 %", "68 %", "95 %", "95 %"],
    "docs/glossary.md": ["68 or 95 %"],  # levels of intervals
    "docs/howto/diagnosis.md": ["5 %", "5 %"],  # setting: light that makes a pair
    "docs/reference/accuracy.md": [
        "95.4 %",
        "95.0 %",
        "68 and 95 %",
    ],  # of a normal distribution
}
"""Settings and definitions that a page may hold as they are, in the order of the page."""

MEASURED = re.compile(
    r"(?<![\w.])\d[\d.,]*(?: (?:and|to|or) \d[\d.,]*)? ?(?:%|GB|MB|CPU|seconds|minutes|times\b|s\b|ms\b)"
)


def typed_numbers(text: str) -> list[str]:
    """Percentages, times and sizes in prose that stand in no place."""
    text = PLACE.sub("", text)
    text = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", text, flags=re.S)
    return [found[0] for found in MEASURED.finditer(text)]


def hand_written():
    """README.md and the pages of docs/ that building the site does not write."""
    ignored = (ROOT / ".gitignore").read_text().split()
    for page in (README, *sorted((ROOT / "docs").rglob("*.md"))):
        name = str(page.relative_to(ROOT))
        if not any(name.startswith(path) for path in ignored if path.startswith("docs/")):
            yield name, page.read_text()


def test_no_measured_number_is_typed():
    """Quote it by a place and a function in validation/quoted_numbers.py, or say here why not."""
    found = {name: typed_numbers(text) for name, text in hand_written()}
    assert {name: typed for name, typed in found.items() if typed} == TYPED
    text = "It takes <!--=level 16-->1.5<!--/--> CPU s, or 12 CPU s, or 0.3 to 0.7 %."
    assert typed_numbers(text) == ["12 CPU", "0.3 to 0.7 %"]


def test_readme_is_short_and_its_links_lead_somewhere():
    text = README.read_text()
    assert len(text.splitlines()) <= 120
    assert len(text.split()) <= 1300
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        assert link.startswith("http") or (ROOT / link).exists(), link


def test_the_star_of_the_readme_grows(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.S)
    exec(compile(code, str(README), "exec"), {})
    faint, bright = (
        float(line.split()[-2]) for line in capsys.readouterr().out.splitlines()
    )
    assert 1.005 * faint < bright < 1.05 * faint
