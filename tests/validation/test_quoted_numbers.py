"""README.md is what its template and the results say, links to what exists, and its starts run."""

import re
from pathlib import Path

import numpy as np
import pytest

from validation.quoted_numbers import ROOT, TEMPLATE, quoted, read_rows, render

README = ROOT / "README.md"


@pytest.fixture(scope="module")
def numbers():
    return quoted()


def test_readme_is_rendered_from_template_and_results(numbers):
    expected = render(TEMPLATE.read_text(), numbers)
    assert README.read_text() == expected, "run python -m validation.quoted_numbers"


@pytest.mark.parametrize(
    ("results", "column", "name"),
    [
        ("convergence", "dA_00_um2", "mesh itl 00"),
        ("sensor_ladder", "sx", "growth ours x"),
        ("sensor_vs_direct", "ratio", "direct x"),
        ("covariances", "middle", "deficit itl"),
        ("bench_sensor", "ratio", "faster silicon"),
        ("benchmark", "solve_cpu_s", "level 32"),
        ("diagnose_nulls", "p", "alarms"),
    ],
)
def test_a_changed_row_changes_the_readme(numbers, results, column, name):
    def rows(file):
        table = read_rows(file)
        if file == results:
            # Each row by another factor: quoted are ratios and growths.
            table[column] = table[column] * np.linspace(0.3, 1.0, len(table))
        return table

    changed = quoted(rows)
    assert changed[name] != numbers[name]
    assert render(TEMPLATE.read_text(), changed) != README.read_text()


def test_a_number_without_place_or_a_place_without_number_is_refused(numbers):
    with pytest.raises(KeyError, match="no such number"):
        render(TEMPLATE.read_text() + "{{ no such number }}", numbers)
    with pytest.raises(KeyError, match="left over"):
        render(TEMPLATE.read_text(), {**numbers, "left over": "1"})


def test_it_is_short_and_its_links_lead_somewhere():
    text = README.read_text()
    assert len(text.splitlines()) <= 120
    assert len(text.split()) <= 1300
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        assert link.startswith("http") or (ROOT / link).exists(), link


def test_links_of_the_pages_lead_somewhere():
    made = {"effects.md", "index.rst"}
    for page in (ROOT / "docs").rglob("*.md"):
        if {"validation", "gallery", "generated"} & set(
            page.relative_to(ROOT / "docs").parts
        ):
            continue
        for link in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            there = page.parent / link
            assert link.startswith("http") or there.exists() or Path(link).name in made, (
                page,
                link,
            )


def test_the_star_of_the_readme_grows(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.S)
    exec(compile(code, str(README), "exec"), {})
    faint, bright = (
        float(line.split()[-2]) for line in capsys.readouterr().out.splitlines()
    )
    assert 1.005 * faint < bright < 1.05 * faint
