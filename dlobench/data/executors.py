"""Runs independent pieces of work: on this machine's cores, or wherever an executor of another name runs them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Protocol, TypeVar

from dlobench.errors import RunError, UsageError

Work = TypeVar("Work")
Result = TypeVar("Result")

EXECUTORS = ("local", "ray", "slurm")


def cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_workers(workers: int | None) -> int:
    """Returns the number of workers, None meaning one a core; raises `UsageError` when there would be none."""
    if workers is not None and workers < 1:
        raise UsageError(f"--workers {workers} leaves nobody to work; this machine has {cores()} cores")
    return workers or cores()


class Executor(Protocol):
    """Applies a function to pieces of work, anywhere and in any order, and yields the results as they arrive."""

    def __call__(self, function: Callable[[Work], Result], work: Iterable[Work]) -> Iterator[Result]:
        """Yields the results; the first failure ends everything. Pieces are atomic and may run more than once."""


def find_executor(
    name: str,
    *,
    workers: int | None = None,
    address: str | None = None,
    slurm: Sequence[str] = (),
    dry_run: bool = False,
    folder: Path | None = None,
) -> Executor:
    """Returns an executor by name, checked as far as it can be before there is work.

    `address` is for ray, `slurm` (sbatch's options), `dry_run` and the `folder` that all nodes see for slurm. Raises
    `UsageError` for an unknown name, naming the choices, and for what does not go with the executor.
    """
    if name not in EXECUTORS:
        raise UsageError(f"unknown executor {name!r}; there are: {', '.join(EXECUTORS)}")
    count = check_workers(workers)
    given = {"--address": ("ray", address), "--slurm": ("slurm", slurm), "--dry-run": ("slurm", dry_run)}
    for option, (executor, value) in given.items():
        if value and executor != name:
            raise UsageError(f"{option} goes with --executor {executor}, not with {name}")
    if name == "local":
        return partial(local, workers=count)
    _need("ray" if name == "ray" else "submitit", name)
    if name == "ray":
        from dlobench.data import ray_cluster

        if address is not None and workers is not None:
            raise UsageError(f"--workers {workers} is for a Ray of its own; the one at {address} has its own CPUs")
        if address is not None:
            ray_cluster.check_address(address)
        return partial(ray_cluster.run, workers=count, address=address)
    from dlobench.data.slurm import WORKERS, Slurm, check_sbatch, parse_options

    if not dry_run:
        check_sbatch()
    if folder is None:
        raise UsageError("--executor slurm needs a folder that all nodes see")
    return Slurm(folder, parse_options(slurm), workers=workers or WORKERS)


def _need(package: str, name: str) -> None:
    """Refuses an executor whose package is not installed."""
    if find_spec(package) is None:
        raise UsageError(f"--executor {name} needs {package}: pip install 'dlobench[cluster]'")


def local(function: Callable[[Work], Result], work: Iterable[Work], workers: int) -> Iterator[Result]:
    """Yields the results of `function` in the order of their arrival, from a pool of processes.

    The first failure, and Ctrl-C, end the pool at once: pieces are atomic, so that what is done stays done.
    """
    context = multiprocessing.get_context("spawn")  # MuJoCo and forked threads do not mix
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_end_with_parent)
    queue = iter(work)
    try:
        # Few pieces wait in the pool at a time, so that memory does not grow with the amount of work.
        with _workers_ignore_interrupts():
            running: set[Future[Result]] = {pool.submit(function, piece) for piece in islice(queue, 2 * workers)}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            running |= {pool.submit(function, piece) for piece in islice(queue, len(done))}
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        raise RunError("a worker process died (killed, or out of memory); what is done is kept") from error
    finally:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _workers_ignore_interrupts() -> Iterator[None]:
    """Leaves Ctrl-C to the parent: workers that are started meanwhile inherit that they ignore it."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers, and only it gets interrupts
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _end_with_parent() -> None:
    """Ends the worker when its parent is killed, which gives it no time to end its workers."""

    def follow() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
