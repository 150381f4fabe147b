"""Runs of independent points on any executor: every result is kept in a file, runs resume.

Any ``concurrent.futures.Executor`` serves: Python's process pool, Dask's
``Client.get_executor()``, Parsl's ``ParslPoolExecutor``.  The process that calls writes the
result of each point, whole or not at all: workers need no common disk, and a run that was
killed continues with the points that are missing.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, TypeVar

from bfsensor.errors import SweepError

Point = TypeVar("Point")
Result = TypeVar("Result")

EXECUTORS = ("process", "dask", "parsl")
"""Kinds of executors that :func:`open_executor` opens."""

SILENT = 5
"""Seconds without a message from Parsl's interchange after which its workers end.  Chosen: messages come
every second; with 10, workers whose interchange has ended are orphans for ten seconds."""


def run_points(
    task: Callable[[Point], Result],
    points: Sequence[Point],
    *,
    path: Callable[[Point], Path],
    read: Callable[[Path], Result],
    write: Callable[[Result, Path], None],
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Result]:
    """Compute the results of points, reading those that a file holds and writing the others.

    Parameters
    ----------
    task : callable
        Function that returns the result of a point; importable by name where the executor sends
        it to other processes.
    points : sequence
        The points.
    path : callable
        Function that returns the file of a point's result.
    read : callable
        Function that reads a result from a file.
    write : callable
        Function that writes a result to a file; it must leave a whole file or none.
    executor : Executor, optional
        Executor that runs the tasks; by default this process, one after another.
    progress : callable, optional
        Function that is called with (points done, points in all).

    Returns
    -------
    list
        Results in the order of the points.

    Raises
    ------
    Exception
        The first error of a task, unchanged; results that came before are kept, tasks that have
        not begun are cancelled.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> run_points(
    ...     abs, [-3, 2], path=lambda n: folder / f"{n}.txt",
    ...     read=lambda p: int(p.read_text()), write=lambda r, p: p.write_text(str(r)) and None,
    ... )
    [3, 2]
    """
    done: dict[int, Result] = {}
    for n, point in enumerate(points):
        if path(point).exists():
            done[n] = read(path(point))

    def keep(n: int, result: Result) -> None:
        write(result, path(points[n]))
        done[n] = result
        if progress is not None:
            progress(len(done), len(points))

    if progress is not None:
        progress(len(done), len(points))
    missing = [n for n in range(len(points)) if n not in done]
    if executor is None:
        for n in missing:
            keep(n, task(points[n]))
    else:
        futures = {executor.submit(task, points[n]): n for n in missing}
        try:
            for future in as_completed(futures):
                keep(futures[future], future.result())
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return [done[n] for n in range(len(points))]


def _end_with_parent() -> None:
    """End this process as soon as the one that made it has ended, whatever the task does."""
    # A forked process has the handlers of the one that made it.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch(sentinel: int) -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, args=(parent.sentinel,), daemon=True).start()


@contextlib.contextmanager
def open_executor(kind: str, workers: int) -> Iterator[Executor | None]:
    """Open an executor with local workers, for a ``with`` statement.

    Parameters
    ----------
    kind : {'process', 'dask', 'parsl'}
        Python's process pool, or local workers of Dask or Parsl (extras of the package).
    workers : int
        Number of worker processes, at least 1.

    Yields
    ------
    Executor or None
        None for one worker of kind 'process': :func:`run_points` then works in this process.

    Raises
    ------
    SweepError
        The kind is unknown, or its package is not installed.

    Examples
    --------
    >>> with open_executor("process", 1) as executor:
    ...     executor is None
    True
    """
    if kind == "process":
        if workers == 1:
            yield None
            return
        from concurrent.futures import ProcessPoolExecutor

        others = set(multiprocessing.active_children())
        pool = ProcessPoolExecutor(workers, initializer=_end_with_parent)
        try:
            yield pool
        except KeyboardInterrupt:
            # Points that have begun would be worked out, and then lost.
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)
    elif kind == "dask":
        with _dask(workers) as executor:
            yield executor
    elif kind == "parsl":
        with _parsl(workers) as executor:
            yield executor
    else:
        raise SweepError(f"executor = {kind!r} must be one of {', '.join(EXECUTORS)}")


@contextlib.contextmanager
def _dask(workers: int) -> Iterator[Any]:
    """Executor of a local Dask cluster, one thread a worker."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise SweepError(
            "executor = 'dask' needs the extra: pip install 'bfsensor[dask]'"
        ) from error
    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client.get_executor()


@contextlib.contextmanager
def _parsl(workers: int) -> Iterator[Any]:
    """Executor of local Parsl workers; its run folder is removed at the end."""
    try:
        import parsl
        from parsl.concurrent import ParslPoolExecutor
        from parsl.config import Config
        from parsl.executors import HighThroughputExecutor
        from parsl.providers import LocalProvider
    except ImportError as error:
        raise SweepError(
            "executor = 'parsl' needs the extra: pip install 'bfsensor[parsl]'"
        ) from error
    import shlex
    import sys
    import tempfile

    # Parsl starts its scripts by bare name, which fails where the environment is not activated:
    # name the folder of this Python, which holds them.
    scripts = Path(sys.executable).parent
    with tempfile.TemporaryDirectory(prefix="bfsensor_parsl_") as folder:
        config = Config(
            executors=[
                HighThroughputExecutor(
                    label="local",
                    max_workers_per_node=workers,
                    address="127.0.0.1",
                    interchange_launch_cmd=[
                        sys.executable,
                        "-m",
                        "bfsensor.sweeps.end_with_parent",
                        str(scripts / "interchange.py"),
                    ],
                    # Workers end once they have not heard of the interchange for so long.
                    heartbeat_period=1,
                    heartbeat_threshold=SILENT,
                    provider=LocalProvider(
                        worker_init=f'export PATH={shlex.quote(str(scripts))}:"$PATH"'
                    ),
                )
            ],
            run_dir=folder,
            initialize_logging=False,
        )
        parsl.clear()
        with ParslPoolExecutor(config) as executor:
            yield executor
