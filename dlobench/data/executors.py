"""Runs independent pieces of work: here, on this machine's cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from typing import TypeVar

from dlobench.errors import RunError, UsageError

Work = TypeVar("Work")
Result = TypeVar("Result")

EXECUTORS = ("local",)


def cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_workers(workers: int) -> int:
    """Returns `workers`, 0 meaning one a core; raises `UsageError` for a negative number."""
    if workers < 0:
        raise UsageError(f"--workers {workers} is negative; 0 takes all {cores()} cores")
    return workers or cores()


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
