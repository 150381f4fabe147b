"""Files are written whole or not at all, whatever fails and wherever."""

import pytest

from bfsensor.errors import BFSensorError, SweepError, TableError
from bfsensor.files import refuse_existing, written_whole


def test_the_old_file_stays_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with written_whole(path, TableError) as beside:
        beside.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(
    ("fault", "raised", "message"),
    [
        (OSError("disk full"), SweepError, r"a\.txt: cannot be written: disk full"),
        (ValueError("no number"), ValueError, "^no number$"),
        (TableError("odd"), TableError, "^odd$"),
        (KeyboardInterrupt("Ctrl-C"), KeyboardInterrupt, "Ctrl-C"),
    ],
)
def test_a_failure_leaves_nothing_behind(tmp_path, fault, raised, message):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail():
        with written_whole(path, SweepError) as beside:
            beside.write_text("half")
            raise fault

    with pytest.raises(raised, match=message):
        fail()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_folder_that_is_missing_is_named(tmp_path):
    with (
        pytest.raises(TableError, match=r"absent/a\.txt: cannot be written"),
        written_whole(tmp_path / "absent" / "a.txt", TableError) as beside,
    ):
        beside.write_text("")


def test_existing_files_are_replaced_only_when_told(tmp_path):
    path = tmp_path / "a.txt"
    refuse_existing(path, False, TableError)
    path.touch()
    refuse_existing(path, True, TableError)
    with pytest.raises(BFSensorError, match=r"a\.txt exists; say overwrite to replace it"):
        refuse_existing(path, False, TableError)
