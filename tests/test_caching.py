"""What tests keep outside the checkout is never older than the code that makes it."""

from __future__ import annotations

import pytest

from tests import caching


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Three modules: the first imports the second, inside a function; nobody imports the third."""
    package = tmp_path / "checkout" / "bfsensor"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "one.py").write_text(
        "def f():\n    from bfsensor.two import g\n    return g\n"
    )
    (package / "two.py").write_text("g = 1\n")
    (package / "three.py").write_text("h = 1\n")
    monkeypatch.setattr(caching, "ROOT", tmp_path / "checkout")
    monkeypatch.setenv("BFSENSOR_TEST_CACHE", str(tmp_path / "cache"))
    caching.code_digest.cache_clear()
    yield package
    caching.code_digest.cache_clear()


def made(count, key="key"):
    def make():
        count.append(key)
        return len(count)

    caching.code_digest.cache_clear()
    return caching.keep(key, make, made_by=["bfsensor.one"])


def test_it_is_made_again_where_code_that_it_uses_changed(checkout):
    count = []
    assert made(count) == made(count) == 1
    (checkout / "three.py").write_text("h = 2\n")
    assert made(count) == 1
    (checkout / "two.py").write_text("g = 2\n")
    assert made(count) == 2 and made(count, "another") == 3
    (checkout / "two.py").write_text("g = 1\n")
    assert made(count) == 1


def test_public_names_count_as_the_modules_that_they_are_of(checkout):
    """A package shows all its modules to type checkers, and imports those that are asked for."""
    (checkout / "__init__.py").write_text(
        "if TYPE_CHECKING:\n"
        "    from bfsensor.two import g\n    from bfsensor.three import h\n"
    )
    (checkout / "one.py").write_text("from bfsensor import g\n")
    count = []
    assert made(count) == 1
    (checkout / "three.py").write_text("h = 2\n")
    assert made(count) == 1
    (checkout / "two.py").write_text("g = 2\n")
    assert made(count) == 2


def test_a_damaged_file_is_made_again_and_no_folder_keeps_nothing(checkout, monkeypatch):
    count = []
    made(count)
    (path,) = (caching.cache_folder() / "made").glob("*.pickle")
    path.write_bytes(path.read_bytes()[:3])
    assert made(count) == 2 == made(count)
    monkeypatch.setenv("BFSENSOR_TEST_CACHE", "")
    assert made(count) == 3 and made(count) == 4


def test_files_of_a_solver_are_put_back(checkout, tmp_path):
    seen = []

    def run(folder):
        folder.mkdir()

        def make():
            seen.append(sorted(p.name for p in folder.iterdir()))
            (folder / "level").write_text("solved")

        caching.keep_files(folder, make, key="levels", made_by=["bfsensor.one"])
        (folder / "level").unlink()  # tests may do with them what they like

    run(tmp_path / "first")
    run(tmp_path / "second")
    assert seen == [[], ["level"]]
