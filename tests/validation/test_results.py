"""Results say what made them, run by run."""

from astropy.table import Table

from validation.common.write_results import commit_here, replace_run


def test_a_run_replaces_its_own_rows_and_says_what_made_them(tmp_path):
    path = tmp_path / "rows.ecsv"
    first = {"device": "a", "seed": 1}
    for run, found in ((first, [1.0, 2.0]), ({"device": "a", "seed": 2}, [3.0])):
        table = Table([run | {"found": value} for value in found])
        replace_run(table, path, "python -m a", run, {"cpu_s": found[0]})
    made = Table.read(path, format="ascii.ecsv")
    assert made.meta["a 1"] == {"commit": commit_here(), "cpu_s": 1.0}
    # As if the second had been made by another commit.
    made.meta["a 2"]["commit"] = "elsewhere"
    made.write(path, format="ascii.ecsv", overwrite=True)

    again = Table([first | {"found": 4.0}])
    replace_run(again, path, "python -m a", first, {"command": "python -m b"})
    rows = Table.read(path, format="ascii.ecsv")
    assert sorted(zip(rows["seed"], rows["found"], strict=True)) == [(1, 4.0), (2, 3.0)]
    assert rows.meta["a 1"] == {"commit": commit_here(), "command": "python -m b"}
    assert rows.meta["a 2"] == {"commit": "elsewhere", "cpu_s": 3.0}
