"""Pages of shipped tables quote the tables beside them."""

import pytest

from validation.table_readme import ERRORS, TABLES, renewed

PAGES = [p for p in sorted(TABLES.glob("*/README.md")) if ERRORS in p.read_text()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_a_page_says_what_its_table_holds(page) -> None:
    assert renewed(page) == page.read_text()
