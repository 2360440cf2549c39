"""Tests what every executor promises: each piece is done once, failures are raised, what does not fit is refused."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from dlobench.data import executors
from dlobench.data.executors import Executor, find_executor
from dlobench.data.ray_cluster import check_address
from dlobench.errors import RunError, UsageError

ray_warns = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning:ray")


def square(number: int) -> int:
    return number * number


def late_if_even(number: int) -> int:
    time.sleep(0.3 * (number % 2 == 0))
    return number


def fail_at_three(number: int, folder: Path) -> int:
    (folder / str(number)).touch()
    if number == 3:
        raise RunError("three is too many")
    return number


def broken(number: int) -> int:
    raise ValueError(f"bad {number}")


@pytest.fixture(params=["local", "ray"])
def executor(request: pytest.FixtureRequest) -> Executor:
    if request.param == "ray":
        return find_executor("ray", address=request.getfixturevalue("ray_address"))
    return find_executor("local", workers=2)


@ray_warns
@pytest.mark.parametrize("count", [0, 1, 23])
def test_every_piece_of_work_is_done_once(executor: Executor, count: int) -> None:
    assert sorted(executor(square, range(count))) == [number**2 for number in range(count)]


@ray_warns
def test_results_arrive_as_they_are_ready(executor: Executor) -> None:
    results = list(executor(late_if_even, range(4)))
    assert sorted(results) == [0, 1, 2, 3]
    assert results != [0, 1, 2, 3]


@ray_warns
def test_the_first_failure_is_raised_as_it_was_and_ends_everything(executor: Executor, tmp_path: Path) -> None:
    with pytest.raises(RunError) as failure:
        list(executor(partial(fail_at_three, folder=tmp_path), range(10_000)))
    assert type(failure.value) is RunError
    assert str(failure.value) == "three is too many"
    begun = {path.name for path in tmp_path.iterdir()}
    assert "3" in begun
    assert len(begun) < 1000, "the failure ends everything"


@ray_warns
def test_what_is_no_error_of_ours_is_raised_as_well(executor: Executor) -> None:
    with pytest.raises(ValueError, match="bad 0"):
        list(executor(broken, [0]))


@ray_warns
def test_few_pieces_wait_at_a_time(executor: Executor) -> None:
    taken = 0

    def work() -> Iterator[int]:
        nonlocal taken
        for number in range(200):
            taken += 1
            yield number

    for done, _ in enumerate(executor(square, work()), start=1):
        assert taken - done <= 8, "memory would grow with the amount of work"
    assert taken == 200


@ray_warns
def test_work_that_is_given_up_leaves_nothing_behind(executor: Executor) -> None:
    results = executor(square, range(100))
    next(results)
    del results
    assert sorted(executor(square, range(3))) == [0, 1, 4]


def test_an_unknown_executor_is_refused() -> None:
    with pytest.raises(UsageError, match=r"'moon'; there are: local, ray, slurm"):
        find_executor("moon")


@pytest.mark.parametrize("name", ["ray", "slurm"])
def test_a_missing_package_is_refused_with_what_installs_it(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "find_spec", lambda package: None)
    with pytest.raises(UsageError, match=rf"--executor {name} needs .*pip install 'dlobench\[cluster\]'"):
        find_executor(name)


def test_options_of_another_executor_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--address goes with --executor ray, not with local"):
        find_executor("local", address="127.0.0.1:1")
    with pytest.raises(UsageError, match="--dry-run goes with --executor slurm, not with ray"):
        find_executor("ray", dry_run=True)
    with pytest.raises(UsageError, match="--slurm goes with --executor slurm, not with local"):
        find_executor("local", slurm=["partition=batch"])
    with pytest.raises(UsageError, match="--workers 3 is for a Ray of its own"):
        find_executor("ray", workers=3, address="127.0.0.1:1")
    for name in ("local", "ray", "slurm"):
        with pytest.raises(UsageError, match="--workers 0 leaves nobody"):
            find_executor(name, workers=0)


@pytest.mark.parametrize("address", ["", "here", "here:", ":6379", "here:x", "here:0", "here:70000", "ray://here:1"])
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match="is not HOST:PORT"):
        check_address(address)


def test_an_address_where_nothing_listens_is_refused_at_once() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{listener.getsockname()[1]}"
    begin = time.monotonic()
    with pytest.raises(RunError, match=f"no Ray cluster answers at {address}"):
        find_executor("ray", address=address)
    assert time.monotonic() - begin < 10


@pytest.mark.parametrize("answer", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b""])
def test_an_address_of_something_else_is_refused(answer: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(1000)
                connection.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        with pytest.raises(RunError, match=f"what answers at {address} is no Ray cluster"):
            check_address(address)
        thread.join()


def test_a_dying_local_worker_is_a_run_error() -> None:
    with pytest.raises(RunError, match="worker process died"):
        list(find_executor("local", workers=1)(os._exit, [3]))
