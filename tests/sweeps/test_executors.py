"""Points of work on every executor: the same results, kept, resumed."""

import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from bfsensor.errors import SweepError
from bfsensor.sweeps.executors import EXECUTORS, open_executor, run_points


def square(n):
    return n * n


def fail_at(bad, n):
    if n == bad:
        raise ArithmeticError(f"point {n}")
    return n * n


def run(folder, task, points, **options):
    def write(result, path):
        part = path.with_suffix(".part")
        part.write_text(str(result))
        part.replace(path)

    return run_points(
        task, points, path=lambda n: folder / f"{n}.txt", read=lambda p: int(p.read_text()),
        write=write, **options,
    )  # fmt: skip


def test_results_come_in_the_order_of_the_points(tmp_path):
    assert run(tmp_path, square, [3, 1, 2]) == [9, 1, 4]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["1.txt", "2.txt", "3.txt"]


def test_what_is_done_is_not_done_again(tmp_path):
    seen = []

    def task(n):
        seen.append(n)
        return n * n

    run(tmp_path, task, [1, 2])
    progress = []
    again = run(tmp_path, task, [1, 2, 3], progress=lambda a, b: progress.append((a, b)))
    assert again == [1, 4, 9]
    assert seen == [1, 2, 3]
    assert progress == [(2, 3), (3, 3)]


@pytest.mark.parametrize("threads", [0, 2])
def test_an_error_keeps_what_came_before(tmp_path, threads):
    pool = ThreadPoolExecutor(1) if threads else None
    with pytest.raises(ArithmeticError, match="point 3"):
        run(tmp_path, partial(fail_at, 3), [1, 2, 3, 4], executor=pool)
    if pool is not None:
        pool.shutdown()
    assert (tmp_path / "1.txt").exists() and not (tmp_path / "3.txt").exists()
    assert run(tmp_path, square, [1, 2, 3, 4]) == [1, 4, 9, 16]


def test_points_run_side_by_side(tmp_path):
    with ThreadPoolExecutor(4) as pool:
        begin = time.perf_counter()
        run(tmp_path, lambda n: time.sleep(0.2) or n, range(4), executor=pool)
        assert time.perf_counter() - begin < 0.7


@pytest.mark.slow
@pytest.mark.parametrize("kind", EXECUTORS)
def test_every_executor_gives_the_same(tmp_path, kind):
    """On real local workers."""
    if kind != "process":
        pytest.importorskip({"dask": "distributed", "parsl": "parsl"}[kind])
    with open_executor(kind, 2) as pool:
        assert pool is not None
        assert run(Path(tmp_path), square, range(5), executor=pool) == [0, 1, 4, 9, 16]


def test_one_worker_works_here():
    with open_executor("process", 1) as pool:
        assert pool is None


def test_refuses_unknown_executors():
    with (
        pytest.raises(SweepError, match="'mpi' must be one of process, dask, parsl"),
        open_executor("mpi", 2),
    ):
        pass


PROGRAM = """
import os, signal, sys
from bfsensor.sweeps.executors import open_executor

def task(folder, seconds):
    import os, pathlib, time
    pathlib.Path(folder, str(os.getpid())).touch()
    time.sleep(seconds)

if __name__ == "__main__":
    # Processes in the background of a shell ignore it, and so do theirs.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with open_executor(sys.argv[1], 2) as executor:
        tasks = [executor.submit(task, os.getcwd(), seconds) for seconds in (60, 61)]
        for one in tasks:
            one.result()
"""


def is_alive(pid):
    # An ended process whose parent has not asked for its status is no longer running.
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are listed in /proc")
@pytest.mark.parametrize(
    ("kind", "end"),
    [
        ("process", signal.SIGKILL),
        ("process", signal.SIGINT),
        pytest.param("dask", signal.SIGKILL, marks=pytest.mark.slow),
        pytest.param("parsl", signal.SIGKILL, marks=pytest.mark.slow),
    ],
)
def test_workers_end_with_the_process_that_made_them(tmp_path, kind, end):
    (tmp_path / "program.py").write_text(PROGRAM)
    process = subprocess.Popen(
        [sys.executable, "program.py", kind], cwd=tmp_path, stderr=subprocess.DEVNULL
    )
    workers = []
    for _ in range(600):
        workers = [int(p.name) for p in tmp_path.iterdir() if p.name.isdigit()]
        if len(workers) == 2:
            break
        time.sleep(0.1)
    assert all(map(is_alive, workers)) and len(workers) == 2, workers
    process.send_signal(end)
    try:
        process.wait(20)
    finally:
        process.kill()
        process.wait()
    for _ in range(100):
        if not any(map(is_alive, workers)):
            break
        time.sleep(0.1)
    assert not any(map(is_alive, workers))
