"""Runs work on a Ray cluster: one that is there already, or one of our own on this machine for the time of the call."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

from dlobench.errors import RunError, UsageError

Work = TypeVar("Work")
Result = TypeVar("Result")

RETRIES = 20  # how often a piece may lose its node or its process before it is to blame itself
REACH = 5.0  # s, to wait for an address
RECOUNT = 10.0  # s between two looks at how large the cluster is: nodes come and go
HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0\x04\0\0\0\0\0"  # gRPC answers with a frame of type 4
MEMORY = 100_000_000  # bytes for objects of a cluster of our own; shards go to the disk, not through Ray


def check_address(address: str) -> None:
    """Refuses an address that is not HOST:PORT (`UsageError`), or where no Ray listens (`RunError`)."""
    host, _, port = address.rpartition(":")
    if not (host and port.isascii() and port.isdigit() and 0 < int(port) < 65536) or "/" in host:
        raise UsageError(f"--address {address!r} is not HOST:PORT, as in 10.0.0.1:6379")
    try:
        with socket.create_connection((host, int(port)), timeout=REACH) as connection:
            connection.settimeout(REACH)
            connection.sendall(HELLO)
            answer = connection.recv(9)
    except OSError as error:
        raise RunError(f"no Ray cluster answers at {address}: {error.strerror or error}") from error
    if answer[3:4] != b"\x04":
        raise RunError(f"what answers at {address} is no Ray cluster")


def run(
    function: Callable[[Work], Result], work: Iterable[Work], *, workers: int, address: str | None
) -> Iterator[Result]:
    """Yields the results of `function` in the order of their arrival, from the cluster at an address or one of our own.

    What is lost with a node is done again elsewhere; what the function itself raises ends everything at once.
    """
    with _connected(workers, address):
        import ray

        def call(piece: Work) -> Result:
            return function(piece)

        task: Any = ray.remote(num_cpus=1, max_retries=RETRIES, retry_exceptions=False)(call)
        queue, running, limit, counted = iter(work), list[Any](), 0, -RECOUNT
        while True:
            # Few pieces wait in the cluster at a time, so that memory does not grow with the amount of work.
            if time.monotonic() - counted > RECOUNT:
                limit, counted = 2 * max(1, int(ray.cluster_resources().get("CPU", 1))), time.monotonic()
            room = max(0, limit - len(running))  # none where a node was lost
            running += [task.remote(piece) for piece in islice(queue, room)]
            if not running:
                return
            done, running = ray.wait(running, timeout=RECOUNT)
            for reference in done:
                yield _result(reference)


def _result(reference: Any) -> Any:
    """Returns what a task returned; raises what it raised, as it raised it."""
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        cause = error.cause
        if "failed to import on the worker" in str(cause):
            raise RunError(f"a node lacks what is installed here ({str(cause).splitlines()[-1]})") from error
        raise cause from error
    except ray.exceptions.RayError as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise RunError(f"Ray gave up on a piece of work ({reason}); what is done is kept") from error


@contextmanager
def _connected(workers: int, address: str | None) -> Iterator[None]:
    """Connects to a cluster, or starts one, as long as the context lasts."""
    import ray

    own = {"num_cpus": workers, "object_store_memory": MEMORY, "include_dashboard": False}
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # ours says nothing about its user
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        ray.init(
            address=address or "local",
            log_to_driver=False,
            logging_level=logging.ERROR,
            **({} if address else own),
        )
    except Exception as error:  # RuntimeError for another version, ConnectionError, ValueError and more
        reason = " ".join(str(error).split())
        token = "; one that was started with a token needs RAY_AUTH_MODE=token here, too" if address else ""
        raise RunError(f"cannot use the Ray cluster at {address or 'this machine'}: {reason}{token}") from error
    try:
        yield
    finally:
        ray.shutdown()
