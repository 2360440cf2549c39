"""Tests the generation: it can be stopped at any moment, in any way, and what comes out is always the same bytes."""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dlobench.data.domain_set import PUSHES, Unit
from dlobench.data.executors import check_workers, find_executor, local
from dlobench.data.generate import generate
from dlobench.data.sets import SETS
from dlobench.data.status import status
from dlobench.data.store import Store
from dlobench.errors import RunError, UsageError

META = SETS["meta-learning"]
DLOBENCH = Path(sys.executable).with_name("dlobench")
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}

# One short trajectory each, of all materials and attachments, with and without bodies.
UNITS = [Unit(META.name, domain, 0, 1) for domain in range(0, len(META.cells) * META.per_cell, 640)]
PROGRAM = """
import sys
from pathlib import Path
from dlobench.data.generate import generate
from dlobench.data.status import status
from dlobench.data.executors import find_executor
from dlobench.data.domain_set import Unit
from dlobench.data.sets import SETS
from dlobench.data.store import Store
if __name__ == "__main__":
    store = Store(Path(sys.argv[1]))
    units = [Unit("meta-learning", domain, 0, 1) for domain in range(0, 6300, 640)]
    found = status(store, SETS["meta-learning"], units)
    assert not found.broken, found.broken
    generate(store, SETS["meta-learning"], found.pending, find_executor("local", workers=2), lambda done, total: None)
"""


def mini_units(domains: int) -> list[Unit]:
    """Returns the shards of the first domains of meta-learning/mini."""
    return list(META.units(META.spans("mini")[:domains]))


def digests(folder: Path) -> dict[str, str]:
    """Returns the SHA-256 of every array under a folder."""
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.rglob("*.npy")}


def quiet(done: int, total: int) -> None:
    """Listens to no progress."""


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Returns the digests of what one worker makes."""
    folder = tmp_path_factory.mktemp("undisturbed")
    generate(Store(folder), META, UNITS, find_executor("local", workers=1), quiet)
    return digests(folder)


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[str]]]:
    """Ends, group by group, the processes that a test has put in the list."""
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def start(*command: str | Path) -> subprocess.Popen[str]:
    """Starts a command in a process group of its own."""
    return subprocess.Popen(
        [str(part) for part in command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        start_new_session=True,
    )


def start_generate(data: Path, domains: int, workers: int) -> subprocess.Popen[str]:
    """Starts the command line on some domains of 20 trajectories."""
    return start(DLOBENCH, "generate", META.name, "--domains", str(domains), "--workers", str(workers), "--data", data)


def wait_for(condition: object, seconds: float = 30) -> None:
    """Waits until a function returns something true."""
    assert callable(condition)
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def family(group: int) -> dict[int, str]:
    """Returns the living processes of a group with their command lines."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state, _, member = (folder / "stat").read_text().rpartition(")")[2].split()[:3]
            if int(member) == group and state != "Z":
                found[int(folder.name)] = (folder / "cmdline").read_text()
    return found


def workers(group: int) -> list[int]:
    """Returns the worker processes of a group."""
    return [pid for pid, command in family(group).items() if "spawn_main" in command]


def test_units_are_counted_and_progress_reaches_the_end(tmp_path: Path) -> None:
    heard: list[tuple[int, int]] = []
    generate(
        Store(tmp_path),
        META,
        UNITS[:2],
        find_executor("local", workers=2),
        lambda done, total: heard.append((done, total)),
    )
    assert heard == [(0, 2 * PUSHES), (PUSHES, 2 * PUSHES), (2 * PUSHES, 2 * PUSHES)]
    found = status(Store(tmp_path), META, UNITS)
    assert (set(found.done), set(found.pending), found.broken) == (set(UNITS[:2]), set(UNITS[2:]), {})


def test_two_workers_make_the_same_bytes_as_one(undisturbed: dict[str, str], tmp_path: Path) -> None:
    assert len(undisturbed) == len(UNITS)
    assert len(set(undisturbed.values())) == len(UNITS), "no two domains are alike"
    generate(Store(tmp_path), META, UNITS, find_executor("local", workers=2), quiet)
    assert digests(tmp_path) == undisturbed


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
def test_no_worker_outlives_its_killed_parent(tmp_path: Path, processes: list[subprocess.Popen[str]]) -> None:
    process = start(sys.executable, "-P", "-c", PROGRAM, tmp_path)
    processes.append(process)
    wait_for(lambda: len(workers(process.pid)) == 2)
    process.kill()
    process.wait()
    wait_for(lambda: not workers(process.pid), seconds=6)


def check_interrupted(process: subprocess.Popen[str]) -> None:
    """Sees an interrupted command end with one line and the code of an interrupt."""
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert [line for line in said.splitlines() if line.startswith("dlobench:")] == [said.splitlines()[-1]]
    assert "interrupted" in said.splitlines()[-1]


def test_ctrl_c_keeps_what_is_done(tmp_path: Path, processes: list[subprocess.Popen[str]]) -> None:
    store, units = Store(tmp_path), mini_units(3)
    process = start_generate(tmp_path, domains=3, workers=2)
    processes.append(process)
    wait_for(lambda: len(status(store, META, units).done) == 2)  # one worker is idle now, the other busy
    os.killpg(process.pid, signal.SIGINT)  # what a terminal sends
    check_interrupted(process)
    found = status(store, META, units, every_byte=True)
    assert (len(found.done), len(found.pending), found.broken) == (2, 1, {})
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npy")}
    process = start_generate(tmp_path, domains=3, workers=2)
    processes.append(process)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 0, said
    assert "2 shards reused, 1 to generate" in said
    assert len(status(store, META, units, every_byte=True).done) == 3
    assert all(path.stat().st_mtime_ns == then for path, then in before.items()), "what is done is not made again"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
def test_ctrl_c_while_workers_start_says_one_line(tmp_path: Path, processes: list[subprocess.Popen[str]]) -> None:
    process = start_generate(tmp_path, domains=2, workers=1)
    processes.append(process)
    wait_for(lambda: workers(process.pid))
    time.sleep(0.1)  # in the imports of the worker
    os.killpg(process.pid, signal.SIGINT)
    check_interrupted(process)
    wait_for(lambda: not family(process.pid))


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
def test_a_killed_worker_fails_the_command_in_one_line(tmp_path: Path, processes: list[subprocess.Popen[str]]) -> None:
    process = start_generate(tmp_path, domains=2, workers=1)
    processes.append(process)
    wait_for(lambda: workers(process.pid))
    time.sleep(0.5)
    for worker in workers(process.pid):
        os.kill(worker, signal.SIGKILL)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 1, said
    assert "worker process died" in said.splitlines()[-1]
    assert "Traceback" not in said
    assert not status(Store(tmp_path), META, mini_units(2)).broken


def test_a_dying_worker_is_a_run_error() -> None:
    with pytest.raises(RunError, match="worker process died"):
        list(local(os._exit, [3], 1))


def test_what_fails_in_a_worker_is_raised_here() -> None:
    with pytest.raises(ValueError, match="invalid literal"):
        list(local(int, ["1", "2", "x", *map(str, range(50))], 2))


def test_a_refusing_disk_ends_the_generation(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("mine")
    with pytest.raises(RunError, match="cannot write"):
        generate(Store(tmp_path / "data"), META, UNITS[:2], find_executor("local", workers=1), quiet)
    assert (tmp_path / "data").read_text() == "mine"


@pytest.mark.parametrize("count", [0, 1, 7])
def test_every_piece_of_work_is_done_once(count: int) -> None:
    assert sorted(local(str, range(count), 2)) == [str(i) for i in range(count)]


@pytest.mark.parametrize("workers", [-1, 0])
def test_no_workers_are_refused_and_none_takes_the_cores(workers: int) -> None:
    with pytest.raises(UsageError, match=f"--workers {workers} leaves nobody"):
        check_workers(workers)
    assert check_workers(None) >= 1
    assert check_workers(3) == 3


def test_an_unknown_executor_is_refused() -> None:
    with pytest.raises(UsageError, match=r"'moon'; there are: local"):
        find_executor("moon")
