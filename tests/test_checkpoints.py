"""Stages of a computation on disk: read if whole and of the same key, else computed."""

import hashlib
import pickle
from fractions import Fraction

import numpy as np
import pytest

from bfsensor.checkpoints import Checkpoints, digest_of


def fail():
    raise AssertionError("computed again")


def test_a_stage_is_computed_once(tmp_path):
    first = Checkpoints(tmp_path / "unfinished", "seed 1", b"files")
    array = np.arange(5.0)
    assert first.get("one", lambda: (array, "text"))[0] is array
    again, text = Checkpoints(tmp_path / "unfinished", "seed 1", b"files").get("one", fail)
    np.testing.assert_array_equal(again, array)
    assert text == "text"
    for parts in (("seed 2", b"files"), ("seed 1", b"other"), ("seed 1files",)):
        with pytest.raises(AssertionError, match="computed again"):
            Checkpoints(tmp_path / "unfinished", *parts).get("one", fail)
    first.clear()
    assert not (tmp_path / "unfinished").exists()


def test_nothing_is_stored_without_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Checkpoints(None).get("one", lambda: 3) == 3
    assert list(tmp_path.iterdir()) == []
    Checkpoints(None).clear()


@pytest.mark.parametrize("keep", [0, 20, 60])
def test_a_file_cut_short_is_not_used(tmp_path, keep):
    Checkpoints(tmp_path, "a").get("one", lambda: list(range(100)))
    (path,) = tmp_path.glob("stage_one_*")
    path.write_bytes(path.read_bytes()[:keep])
    assert Checkpoints(tmp_path, "a").get("one", lambda: 7) == 7
    assert Checkpoints(tmp_path, "a").get("one", fail) == 7


def test_a_file_makes_no_objects_of_other_packages(tmp_path):
    """A pickle can run any function that it names: only those of stages are allowed."""
    Checkpoints(tmp_path, "a").get("one", lambda: 1)
    (path,) = tmp_path.glob("stage_one_*")
    payload = pickle.dumps(Fraction(1, 3))
    path.write_bytes(hashlib.sha256(payload).digest() + payload)
    assert Checkpoints(tmp_path, "a").get("one", lambda: 5) == 5


def test_what_cannot_be_stored_is_returned(tmp_path):
    found = Checkpoints(tmp_path, "a").get("one", lambda: lambda: 4)
    assert found() == 4 and list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_stops_nothing(tmp_path):
    (tmp_path / "file").write_text("no folder")
    assert Checkpoints(tmp_path / "file" / "sub", "a").get("one", lambda: 6) == 6


def test_digests_know_where_parts_end():
    assert digest_of([b"ab", b"c"]) != digest_of([b"a", b"bc"])
    assert len(digest_of([])) == 64
