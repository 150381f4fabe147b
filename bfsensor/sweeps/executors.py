"""Independent points of work on any executor, kept as files, resumable.

Any ``concurrent.futures.Executor`` serves: Python's process pool, Dask's
``Client.get_executor()``, Parsl's ``ParslPoolExecutor``.  What a point gives is written by
the process that asked for it, whole or not at all, so that workers need no common disk
and a run that was killed goes on with the points that are missing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from pathlib import Path
from typing import Any, TypeVar

from bfsensor.errors import SweepError

Point = TypeVar("Point")
Result = TypeVar("Result")

EXECUTORS = ("process", "dask", "parsl")


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
    """Work through points, keeping what is done.

    Parameters
    ----------
    task : callable
        Gives the result of a point; importable by name where the executor needs it.
    points : sequence
        What to work through.
    path, read, write : callable
        Where the result of a point is kept, and how it is read and written.  ``write``
        leaves a whole file or none.
    executor : Executor, optional
        Where to work; by default here, one after another.
    progress : callable, optional
        Called with (points done, points in all).

    Returns
    -------
    list
        Results in the order of the points.

    Raises
    ------
    Exception
        The first error of a task; results that came before are kept.

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


@contextlib.contextmanager
def open_executor(kind: str, workers: int) -> Iterator[Executor | None]:
    """Open an executor on this machine.

    Parameters
    ----------
    kind : {'process', 'dask', 'parsl'}
        Python's process pool, or local workers of Dask or Parsl (extras of the package).
    workers : int
        Processes; with one of kind 'process' the work is done here.

    Yields
    ------
    Executor or None

    Raises
    ------
    SweepError
        The kind is unknown, or not installed.
    """
    if kind == "process":
        if workers == 1:
            yield None
            return
        from concurrent.futures import ProcessPoolExecutor

        pool = ProcessPoolExecutor(workers)
        try:
            yield pool
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

    # Parsl starts its scripts by bare name: they are found where this Python is, whether or
    # not its environment was activated.
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
                        str(scripts / "interchange.py"),
                    ],
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
