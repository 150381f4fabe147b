"""The index of claims: up to date, complete, and honest about what is stale."""

import re
import subprocess
from pathlib import Path

import pytest
from astropy.table import Table

from validation import index
from validation.common import dependencies as needs
from validation.common.dependencies import ROOT, History, code_digest, dependencies
from validation.index import (
    PAGE,
    UNKNOWN,
    Age,
    Result,
    Run,
    format_page,
    read_ages,
    read_claims,
    read_results,
    read_runs,
    script_of,
    with_ages,
)

FOLDER = ROOT / "validation"

# Long enough for git to know it again where it moves and changes in one.
FAR = "def g(x):\n    first = x + 1\n    second = 3 * first\n    return first * second\n"


@pytest.fixture(scope="module")
def claims():
    return read_claims()


@pytest.fixture(scope="module")
def results(claims):
    return read_results(claims)


def cells(page, masked=()):
    """Rows of the page's tables; what only history knows is left out of the results masked."""
    for line in page.splitlines():
        row = [cell.strip() for cell in line.strip("|").split(" | ")]
        if line.startswith("| [") and len(row) == 7:
            row[6] = (
                "stale" if row[6] else ""
            )  # by which commit may change with the history
            if row[0] in masked:  # which of several commits is the oldest, and their dates
                row[3:5] = [row[3].partition(" to ")[2].partition(", ")[2] or row[3]]
                row.pop()
            yield tuple(row)
        elif not re.fullmatch(r"\d+ of \d+ results are stale\.", line) or not masked:
            yield line


def test_the_page_is_what_the_folders_and_the_files_say(claims, results, monkeypatch):
    """Run ``python -m validation.index`` if this fails.  A clone need not have every commit."""
    history = History()
    # Which commit it is takes long to find, and another history may have another one.
    monkeypatch.setattr(History, "last_same", lambda _self, commit, _changed: commit)
    page = format_page(claims, results, history)
    masked = {
        f"[{r.name}](results/{r.name})"
        for r in results
        if not all(history.knows(run.commit) for run in r.runs)
    }
    assert list(cells(PAGE.read_text(), masked)) == list(cells(page, masked))


def test_every_file_has_its_claim(claims, results):
    kept = {path.name for path in (FOLDER / "results").glob("*.ecsv")}
    assert kept == {result.name for result in results}
    notebooks = {FOLDER / c.folder / n for c in claims for n in c.notebooks}
    assert {n.resolve() for n in notebooks} == set(FOLDER.glob("**/*.ipynb"))
    commands = {script_of(command) for c in claims for command, _ in c.commands}
    scripts = {
        str(path.relative_to(ROOT))
        for path in FOLDER.glob("*/*.py")
        if 'if __name__ == "__main__":' in path.read_text() or path.stem == "__main__"
    }
    assert scripts == {c for c in commands if c.startswith("validation/")}
    folders = {path.parent.name for path in FOLDER.glob("*/__init__.py")}
    assert {claim.folder for claim in claims} == folders - {"common", "concealed"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "- Source: a\n- Command: `python -m validation.index`\n",
            "'A claim' lacks Criterion",
        ),
        ("- Source: a\n- Criterion: b\n", "neither notebook nor command"),
        ("- Sauce: a\n", "'- Sauce: a' is none of Source, Criterion"),
    ],
)
def test_claims_of_another_form_are_refused(tmp_path, text, said):
    place = tmp_path / "validation" / "here"
    place.mkdir(parents=True)
    (place / "README.md").write_text(f"# Here\n\n## A claim\n\n{text}")
    with pytest.raises(ValueError, match=re.escape(said)):
        read_claims(tmp_path)


@pytest.mark.parametrize(
    "command", ["python -m validation.nowhere", "python no.py", "make it"]
)
def test_commands_that_run_nothing_are_refused(command):
    with pytest.raises(ValueError, match="runs no file of this checkout"):
        script_of(command)


def test_runs_are_those_of_the_header_or_of_the_rows(tmp_path):
    path = tmp_path / "rows.ecsv"

    def runs(meta, rows):
        table = Table(rows)
        table.meta = {"command": "python -m a", "commit": "c0", **meta}
        table.write(path, format="ascii.ecsv", overwrite=True)
        return read_runs(path)

    dated = {"date": "2026-11-23T10:00:00+00:00", "cpu_s": 4.0}
    (one,) = runs(dated, [{"n": 1}])
    assert one == Run("python -m a", "c0", "2026-11-23", 4.0)
    earlier = [{"command": "python -m a", "commit": "c1", "cpu_s": 3.0}]
    assert [r.commit for r in runs({"earlier": earlier}, [{"n": 1}])] == ["c1", "c0"]
    by_run = {
        "x 1": {"commit": "c1", "cpu_s": 2.0},
        "x 2": {"commit": "c2", "command": "b"},
    }
    assert [(r.command, r.commit) for r in runs(by_run, [{"n": 1}])] == [
        ("python -m a", "c1"), ("b", "c2"),
    ]  # fmt: skip
    rows = [{"commit": c} for c in ("c2", "c1", "c2")]
    found = runs(dated | {"commit": "c1"}, rows)
    assert [(r.commit, r.date) for r in found] == [("c1", "2026-11-23"), ("c2", "")]


def test_a_script_depends_on_what_it_imports_at_any_distance():
    found = dependencies("validation/transport/transport.py")
    assert {
        "validation/transport/transport.py",
        "bfsensor/direct/transport.py",
        "bfsensor/_kernels/transport.py",  # imported by the one before
        "tables/itl_sta3800c/device.toml",
    } <= found
    assert not any("diagnose" in path or path in needs.HEADERS for path in found)
    # A public name of the package counts as the module that it is of.
    assert "bfsensor/sensor/brighter_fatter.py" in dependencies(
        "validation/sensor/sensor_stars.py"
    )
    assert "bfsensor/sensor/silicon_sensor.py" in dependencies(
        "tests/benchmarks/bench_sensor.py"
    )


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("from b.a import f\n\nx = f(1)", True),
        ('"""Doc."""\nimport f\nx = f( 1 )  # why\n"""What x is."""', True),
        ("x: int = f(1)", False),  # says the same but is another statement
        ("x = f(2)", False),
        ("x = f(1)\ny = 0", False),
    ],
)
def test_imports_docstrings_and_layout_are_no_code(text, same):
    one = b"from a import f\nx = f(1)"
    assert (code_digest(text.encode(), "x.py") == code_digest(one, "y.py")) == same


def test_annotations_and_commands_are_no_code_and_values_of_toml_are():
    one = b'def f(x: int) -> int:\n    return g("python -m validation.a")'
    two = b'def f(x):\n    import g\n    return g("python -m validation.b.a")'
    assert code_digest(one, "x.py") == code_digest(two, "x.py")
    assert code_digest(b"a = 1 # why", "x.toml") == code_digest(b"a=1", "x.toml")
    assert code_digest(b"a = 2", "x.toml") != code_digest(b"a = 1", "x.toml")
    assert code_digest(b"a = 1 # why", "x.txt") != code_digest(b"a = 1", "x.txt")


@pytest.fixture
def checkout(tmp_path):
    """A small checkout: a script, a module that it imports, one behind that, and a device."""

    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def commit():
        subprocess.run(["git", "add", "-A"], cwd=tmp_path, check=True)
        words = [
            "-c",
            "user.name=n",
            "-c",
            "user.email=e@example.org",
            "commit",
            "-qm",
            "m",
        ]
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
        head = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=tmp_path, capture_output=True,
            text=True, check=True,
        )  # fmt: skip
        return head.stdout.strip()

    def changed(commit):
        needs._needed.cache_clear()
        history = History(tmp_path)
        found = list(history.changed(commit, dependencies("validation/run.py", tmp_path)))
        return [c.new for c in found], history.last_same(commit, found) if found else ""

    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    write("validation/run.py", "from bfsensor.near import f\nx = f('device_a')\n")
    write(
        "bfsensor/near.py", "from bfsensor.far import g\n\n\ndef f(x):\n    return g(x)\n"
    )
    write("bfsensor/far.py", FAR)
    write("bfsensor/aside.py", "y = 1\n")
    write("tables/device_a/device.toml", "thickness = 100\n")
    write("tables/device_a/table.fits", "numbers")
    write.root, write.commit, write.changed = tmp_path, commit, changed
    return write


def test_a_result_is_stale_once_code_behind_it_changes(checkout):
    begin = checkout.commit()
    checkout("bfsensor/aside.py", "y = 2\n")
    annotated = FAR.replace("(x)", "(x: float) -> float")
    checkout("bfsensor/far.py", f'"""Far."""\n\n\n{annotated}')
    still = checkout.commit()
    assert checkout.changed(begin) == ([], "")
    checkout("bfsensor/far.py", FAR.replace("1", "2"))
    assert checkout.changed(begin) == (["bfsensor/far.py"], still)  # before it is committed
    checkout.commit()
    checkout("bfsensor/aside.py", "y = 3\n")
    checkout.commit()
    assert checkout.changed(begin) == (["bfsensor/far.py"], still)


def test_a_file_that_moves_leaves_results_as_they_are_until_its_code_changes(checkout):
    begin = checkout.commit()
    (checkout.root / "bfsensor/far.py").unlink()
    checkout("bfsensor/deep/__init__.py", '"""Deep."""\n')
    checkout("bfsensor/deep/far.py", FAR)
    checkout(
        "bfsensor/near.py",
        "from bfsensor.deep.far import g\n\n\ndef f(x):\n    return g(x)\n",
    )
    moved = checkout.commit()
    assert checkout.changed(begin) == ([], "")
    checkout("bfsensor/deep/far.py", FAR.replace("+", "-"))
    checkout.commit()
    assert checkout.changed(begin) == (["bfsensor/deep/far.py"], moved)


def test_devices_tables_and_new_modules_count(checkout):
    begin = checkout.commit()
    checkout("tables/device_a/device.toml", "thickness = 200\n")
    assert checkout.changed(begin) == (["tables/device_a/device.toml"], begin)
    checkout("tables/device_a/device.toml", "thickness = 100  # um\n")
    checkout("tables/device_a/table.fits", "others")
    assert checkout.changed(begin) == (["tables/device_a/table.fits"], begin)
    checkout("tables/device_a/table.fits", "numbers")
    # The same names from another module, of which git knows nothing yet.
    checkout(
        "bfsensor/near.py", "from bfsensor.new import g\n\n\ndef f(x):\n    return g(x)\n"
    )
    checkout("bfsensor/new.py", "def g(x):\n    return 7 * x\n")
    assert checkout.changed(begin) == (["bfsensor/new.py"], begin)
    checkout.commit()
    assert checkout.changed(begin) == (["bfsensor/new.py"], begin)


def test_public_names_count_as_the_modules_that_they_are_of(checkout):
    names = "from bfsensor.{0} import {1}"
    shown = "if TYPE_CHECKING:\n    {}\n    {}\nelse:\n    lists = {}\n"
    both = names.format("far", "g"), names.format("aside", "y")
    checkout("bfsensor/room/__init__.py", shown.format(*both, 1))
    checkout("validation/run.py", "from bfsensor.room import g\nx = g('device_a')\n")
    begin = checkout.commit()
    checkout("bfsensor/aside.py", "y = 2\n")
    checkout("bfsensor/room/__init__.py", shown.format(*both, 2))
    assert checkout.changed(begin) == ([], "")
    checkout("bfsensor/far.py", FAR.replace("1", "2"))
    assert checkout.changed(begin) == (["bfsensor/far.py"], begin)


def test_of_a_clone_without_the_commit_nothing_is_said(checkout, tmp_path):
    result = Result("a.ecsv", [Run("python -m validation.run", "0123abc")])
    for history in (History(checkout.root), History(tmp_path / "..")):
        assert not history.knows("0123abc") and not history.knows("")
        row = index._result_line(result, history)
        assert row.endswith("| `0123abc` | not known |  | not known |")
        (age,) = read_ages(row).values()
        assert str(age) == "made not known (`0123abc`); not known whether stale"


def test_of_a_shallow_clone_and_without_git_nothing_is_said(checkout, monkeypatch):
    begin = checkout.commit()
    checkout("bfsensor/far.py", FAR.replace("1", "2"))
    checkout.commit()
    shallow = checkout.root / "shallow"
    words = ["clone", "-q", "--depth", "1", checkout.root.as_uri(), str(shallow)]
    subprocess.run(["git", *words], check=True)
    assert History(checkout.root).knows(begin)
    assert not History(shallow).knows(begin)
    monkeypatch.setenv("PATH", str(shallow))
    assert not History(checkout.root).knows(begin)


def test_of_a_clone_without_old_files_nothing_is_said(checkout, monkeypatch):
    begin = checkout.commit()
    result = Result("a.ecsv", [Run("python -m validation.run", begin)])
    monkeypatch.setattr(
        index, "_files", lambda _: dependencies("validation/run.py", checkout.root)
    )
    needs._needed.cache_clear()
    assert index._result_line(result, History(checkout.root)).endswith("|  |")
    checkout("bfsensor/far.py", FAR.replace("1", "2"))
    row = index._result_line(result, History(checkout.root))
    assert re.search(rf"\| \d{{4}}-\d\d-\d\d \(`{begin}`\) \|$", row)
    git = History._run
    lost = subprocess.CompletedProcess([], 128, b"", b"missing blob")
    monkeypatch.setattr(
        History, "_run", lambda self, *w: lost if "blob" in w else git(self, *w)
    )
    assert index._result_line(result, History(checkout.root)).endswith(f"| {UNKNOWN} |")


def test_pages_of_the_folders_bear_the_marks_of_the_index():
    """Run ``python -m validation.index`` if this fails."""
    ages = read_ages(PAGE.read_text())
    assert set(ages) == {path.name for path in (FOLDER / "results").glob("*.ecsv")}
    for place in FOLDER.glob("*/README.md"):
        assert place.read_text() == with_ages(place.read_text(), ages), place


@pytest.mark.parametrize(
    ("stale", "said"),
    [
        ("", "; the code behind it is the same today"),
        ("2026-11-23 (`c1`)", "; **stale since 2026-11-23 (`c1`)**: the code behind it"),
    ],
)
def test_a_mark_says_since_when_and_goes_when_rows_are_made_again(stale, said):
    page = "- Command: `python -m a`, rows in `a.ecsv`\n- Rows: of before\n\nEnd.\n"
    made = with_ages(page, {"a.ecsv": Age("`c0`", "2026-11-22", stale)})
    first, second, *rest = made.splitlines()
    assert [first, *rest] == [page.splitlines()[0], "", "End."]
    begin = "- Rows: [a.ecsv](../results/a.ecsv), made 2026-11-22 (`c0`)"
    assert second.startswith(begin + said)


def test_files_behind_a_result_are_listed_and_unknown_results_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["index", "--why", "toy_array.ecsv"])
    index.main()
    assert re.search(
        r"toy_array.ecsv: (\d+ of|this clone does not)", capsys.readouterr().out
    )
    monkeypatch.setattr("sys.argv", ["index", "--why", "none.ecsv"])
    with pytest.raises(SystemExit):
        index.main()
    assert "none.ecsv: no file of validation/results" in capsys.readouterr().err


def test_quick_notebooks_are_found_in_their_folders():
    text = (ROOT / ".ci" / "run").read_text() if (ROOT / ".ci").exists() else None
    if text is None:
        pytest.skip("a copy without .ci")
    pattern = re.search(r'Path\("validation"\)\.glob\("([^"]+)"\)', text)[1]
    found = [p for p in Path(FOLDER).glob(pattern) if index.is_quick(p)]
    assert len(found) > 10
