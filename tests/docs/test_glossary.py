"""The glossary has the terms of reports, and the words that the checker finds."""

from __future__ import annotations

import re

import astropy.units as u
import pytest

from bfsensor.diagnose.report.diagnosis_result import NAMES
from tests.docs.pages import DOCS, tables
from tests.words import DIALECT

PAGE = (DOCS / "glossary.md").read_text(encoding="utf-8")
TABLES = tables(PAGE)
AVOIDED = "Words that these pages and the code avoid"
TERMS = {name: rows for name, rows in TABLES.items() if name != AVOIDED}


def test_each_term_stands_once():
    terms = [row[0] for rows in TERMS.values() for row in rows]
    assert len(terms) == len(set(terms)) > 80


@pytest.mark.parametrize("section", TERMS)
def test_terms_have_one_sentence_and_the_order_of_the_alphabet(section):
    rows = TERMS[section]
    for term, _, unit, meaning in rows:
        assert re.fullmatch(r"[A-Z].*\.", meaning), term
        assert not re.search(r"\. [A-Z]", meaning), term
        for one in re.split(", | or ", unit) if "that of" not in unit else ():
            u.Unit(one.replace("ADU", "adu") if one not in ("1", "any") else "")
    assert [row[0].lower() for row in rows] == sorted(row[0].lower() for row in rows)


def test_every_channel_of_reports_is_explained_by_its_name():
    assert {row[1]: row[0] for row in TABLES["Channels"]} == {
        key: "spots" if key == "spot" else name for key, name in NAMES.items()
    }


def test_every_word_that_the_checker_finds_has_its_replacement():
    words = " | ".join(row[0] for row in TABLES[AVOIDED])
    general = ("from memory", r"ive|ives", "counts for", "what nothing")
    for pattern, better in DIALECT.items():
        if not any(part in pattern for part in general):
            assert re.search(pattern, words), better
