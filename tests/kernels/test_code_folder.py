"""Place of compiled code where nothing can be written to, and garbage collection meanwhile."""

import gc
import logging
import os
from types import SimpleNamespace

import numba
import pytest

from bfsensor._kernels import code_folder
from bfsensor._kernels.paused_collection import PausedCollection


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    """Numba that finds no place for its code, as where nothing can be written to."""

    def refuse(**options):
        raise RuntimeError("cannot cache function")

    monkeypatch.setattr(numba, "njit", refuse)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(code_folder.tempfile, "tempdir", str(tmp_path))


def test_code_that_is_there_is_copied_from_a_folder_that_is_read_only(
    nowhere, monkeypatch, tmp_path, caplog
):
    given = tmp_path / "given"
    (given / "_kernels_1").mkdir(parents=True)
    (given / "_kernels_1" / "shoot.nbi").write_bytes(b"code")
    (given / "_kernels_1").chmod(0o500)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(given))
    code_folder.find_code_folder()
    used = numba.config.CACHE_DIR
    assert used != str(given)
    assert os.environ["NUMBA_CACHE_DIR"] == used
    copied = os.path.join(used, "_kernels_1")
    with open(os.path.join(copied, "shoot.nbi"), "rb") as file:
        assert file.read() == b"code"
    assert os.stat(copied).st_mode & 0o200
    assert not caplog.records


def test_without_any_folder_each_process_compiles_and_says_so(nowhere, caplog):
    with caplog.at_level(logging.WARNING, "bfsensor"):
        code_folder.find_code_folder()
    assert os.listdir(numba.config.CACHE_DIR) == []
    assert "set NUMBA_CACHE_DIR" in caplog.text


def test_a_place_that_numba_finds_is_left_alone():
    before = numba.config.CACHE_DIR, os.environ.get("NUMBA_CACHE_DIR")
    code_folder.find_code_folder()
    assert (numba.config.CACHE_DIR, os.environ.get("NUMBA_CACHE_DIR")) == before


def _kernel(module):
    function = SimpleNamespace(__module__=module)
    return SimpleNamespace(data={"dispatcher": SimpleNamespace(py_func=function)})


def test_garbage_is_collected_again_after_the_outermost_kernel():
    listener = PausedCollection()
    ours, other = _kernel("bfsensor._kernels.shoot"), _kernel("numba.cpython.builtins")
    assert gc.isenabled()
    listener.on_start(other)
    assert gc.isenabled()
    listener.on_end(other)
    listener.on_start(ours)
    listener.on_start(other)
    listener.on_end(other)
    assert not gc.isenabled()
    listener.on_end(ours)
    assert gc.isenabled()
    gc.disable()
    try:
        listener.on_start(ours)
        listener.on_end(ours)
        assert not gc.isenabled()
    finally:
        gc.enable()
