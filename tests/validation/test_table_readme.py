"""Pages of shipped tables quote the tables beside them."""

import pytest

from bfsensor.table.table import DistortionTable
from validation.boundaries.table_readme import ERRORS, TABLES, written

PAGES = [p for p in sorted(TABLES.glob("*/README.md")) if ERRORS in p.read_text()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_a_page_says_what_its_table_holds(page) -> None:
    text = page.read_text()
    assert written(text, DistortionTable.read(page.parent / "table.fits")) == text
