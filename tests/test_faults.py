"""Breaks things for real: kills, flips bytes, fills disks, generates twice at once. Nothing is ever lost.

A short version runs with all tests; `make faults` runs as many rounds as the project promises.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from test_store import files, mounted

from dlobench.data.domain_set import SCALES, DomainSet, Extent, Unit
from dlobench.data.generate import generate
from dlobench.data.sets import SETS
from dlobench.data.status import census, status
from dlobench.data.store import Store
from dlobench.data.verify import Verified, repair, verify

pytestmark = pytest.mark.faults

ALL = bool(os.environ.get("DLOBENCH_FAULTS"))
KILLS = 25 if ALL else 4
FLIPS = 200 if ALL else 60
DLOBENCH = Path(sys.executable).with_name("dlobench")
# A failed test tells it in its name. Parallel workers of pytest-xdist collect the same one.
SEED = int(os.environ.get("PYTEST_XDIST_TESTRUNUID", f"{time.time_ns():x}"), 16)
NEW_EVERY_TIME = pytest.mark.parametrize("seed", [SEED])
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}


def tiny(domains: int) -> DomainSet:
    """Cuts meta-learning to shards of one trajectory of two pushes, of domains spread over its cells."""
    cells = SETS["meta-learning"].cells
    extent = Extent(train=2, valid=2, test=2, per_cell=8)
    chosen = tuple(cells[:: len(cells) // -(-domains // 8)][: -(-domains // 8)])
    return replace(
        SETS["meta-learning"], cells=chosen, block=1, pushes=2, per_cell=8, extents=dict.fromkeys(SCALES, (extent,))
    )


def units(of: DomainSet) -> list[Unit]:
    return list(of.units(of.spans("mini")))


def inline(function: Callable[[Any], Any], work: Iterable[Any]) -> Iterator[Any]:
    """Runs work here and now, one piece after another."""
    return map(function, work)


def quiet(*_: object) -> None:
    """Listens to no progress."""


def digest(store: Store, of: DomainSet) -> str | None:
    return census(store, of).scales["paper"].digest


def arrays(folder: Path) -> dict[str, bytes]:
    """Returns every array under a folder with its content."""
    return {name: content for name, content in files(folder).items() if name.endswith(".npy")}


def newest(folder: Path) -> float:
    """Returns when the last array under a folder was written, s; 0 where there is none."""
    latest = 0.0
    for path in folder.rglob("*.npy"):
        with contextlib.suppress(FileNotFoundError):  # renamed meanwhile
            latest = max(latest, path.stat().st_mtime)
    return latest


def whole(store: Store, of: DomainSet) -> Verified:
    """Checks every byte, and that all is there and nothing else."""
    found = verify(store, of, inline, quiet)
    assert (found.shards, found.broken, found.halves, found.strays) == (len(units(of)), {}, [], [])
    return found


DOMAINS = 8 * KILLS  # two shards each
OF = tiny(DOMAINS)

PROGRAM = f"""
import sys
from pathlib import Path
from dlobench.data.executors import find_executor
from dlobench.data.generate import generate
from dlobench.data.status import status
from dlobench.data.store import Store
sys.path.append({str(Path(__file__).parent)!r})
from test_faults import tiny, units, quiet
if __name__ == "__main__":
    store, of = Store(Path(sys.argv[1])), tiny(int(sys.argv[2]))
    found = status(store, of, units(of))
    assert not found.broken, found.broken
    generate(store, of, found.pending, find_executor("local", workers=2), quiet)
"""


def start(folder: Path) -> subprocess.Popen[str]:
    """Starts a generator with two workers in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(folder), str(DOMAINS)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        start_new_session=True,
    )


def kill(process: subprocess.Popen[str]) -> str:
    """Kills a generator and its workers by signal 9; returns what it said before."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    return process.communicate()[1]  # comes when the last of them is gone


def finish(process: subprocess.Popen[str]) -> None:
    """Sees a generator end without a word."""
    out, err = process.communicate(timeout=240)
    assert (process.returncode, out, err) == (0, "", "")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Returns a folder that one generator filled in peace."""
    store = Store(tmp_path_factory.mktemp("undisturbed"))
    generate(store, OF, units(OF), inline, quiet)
    whole(store, OF)
    return store


@NEW_EVERY_TIME
def test_kills_at_random_moments_lose_nothing(seed: int, undisturbed: Store, tmp_path: Path) -> None:
    rng, store, expected = random.Random(seed), Store(tmp_path), arrays(undisturbed.root)
    caught = midway = 0
    while caught < KILLS or (not midway and caught < 5 * KILLS):  # a loaded machine may be slow to begin
        process, begin = start(tmp_path), time.time()
        # Half of the rounds end at any moment, half within 30 ms after a shard was begun.
        watch = caught % 2 == 1
        end = time.monotonic() + (30 if watch else rng.uniform(0.2, 3))
        while time.monotonic() < end and process.poll() is None:
            if watch and newest(tmp_path) > begin:  # arrays of discarded shards are still there
                time.sleep(rng.uniform(0, 0.03))
                break
            time.sleep(0.005)
        code = process.poll()
        err = kill(process)
        assert code in (None, 0), err
        caught += code is None
        found = status(store, OF, units(OF), every_byte=True)
        assert not found.broken
        for unit in found.done:
            path = store.path(OF, unit)
            assert path.read_bytes() == expected[str(path.relative_to(tmp_path))]
        midway += bool(found.done and found.pending)
        if not found.pending:  # too quick: once more from the beginning
            assert digest(store, OF) == digest(undisturbed, OF)
            for unit in found.done:
                store.discard(OF, unit)
    assert midway, "at least one round was killed in the middle"
    finish(start(tmp_path))
    assert digest(store, OF) == digest(undisturbed, OF)
    assert arrays(tmp_path) == expected
    whole(store, OF)


def test_two_generators_on_one_folder_make_the_same(undisturbed: Store, tmp_path: Path) -> None:
    both = [start(tmp_path), start(tmp_path)]
    try:
        for process in both:
            finish(process)
    finally:
        for process in both:
            kill(process)
    store = Store(tmp_path)
    assert digest(store, OF) == digest(undisturbed, OF)
    assert arrays(tmp_path) == arrays(undisturbed.root)
    assert whole(store, OF).temporary == []
    assert files(tmp_path).keys() == files(undisturbed.root).keys(), "nothing lies twice on the disk"


@NEW_EVERY_TIME
def test_every_flipped_byte_is_found_and_mended(seed: int, tmp_path: Path) -> None:
    rng, store, of = random.Random(seed), Store(tmp_path), tiny(16)
    generate(store, of, units(of), inline, quiet)
    expected, before = arrays(tmp_path), digest(store, of)
    flipped = 0
    while flipped < FLIPS:
        chosen = rng.sample(units(of), 10)
        for unit in chosen:
            path = store.path(of, unit).with_suffix(rng.choice([".npy", ".json"]))
            content = bytearray(path.read_bytes())
            content[rng.randrange(len(content))] ^= rng.randrange(1, 256)
            path.write_bytes(content)
        flipped += len(chosen)
        written = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npy")}
        found = verify(store, of, inline, quiet)
        assert set(found.broken) == set(chosen)
        assert set(repair(store, of, found, inline, quiet)) == set(chosen)
        again = {path for path, then in written.items() if path.stat().st_mtime_ns != then}
        assert again == {store.path(of, unit) for unit in chosen}, "what is whole is left alone"
        whole(store, of)
        assert arrays(tmp_path) == expected
        assert digest(store, of) == before


def generate_by_command(data: Path) -> subprocess.CompletedProcess[str]:
    """Generates the eight shards of 96 kB of a domain by the command line."""
    command = [
        str(DLOBENCH),
        "generate",
        "single-domain-medium",
        "--domains",
        "1",
        "--workers",
        "2",
        "--data",
        str(data),
    ]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, env=ENVIRONMENT)


def check_refused(done: subprocess.CompletedProcess[str], *parts: str) -> None:
    """Sees a command end with code 1 and one sentence."""
    said = [line for line in done.stderr.splitlines() if line.startswith("dlobench: ")]
    assert done.returncode == 1, done.stderr
    assert said == done.stderr.splitlines()[-1:]
    assert "Traceback" not in done.stderr
    assert not [part for part in parts if part not in said[0]], said[0]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    yield from mounted(tmp_path / "small", "size=512k")


def test_a_full_disk_is_one_sentence_and_freed_space_goes_on(small_disk: Path) -> None:
    store, of = Store(small_disk), SETS["single-domain-medium"]
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(200_000))
    wanted = list(of.units(span for span in of.spans("mini") if span.domain == 0))
    check_refused(generate_by_command(small_disk), str(small_disk), "No space left")
    found = status(store, of, wanted, every_byte=True)
    assert found.pending
    assert not found.broken
    assert not list(small_disk.rglob("*.tmp"))
    ballast.write_bytes(b"")
    kept = {path: path.stat().st_mtime_ns for unit in found.done for path in [store.path(of, unit)]}
    subprocess.run(["mount", "-o", "remount,size=2m", str(small_disk)], check=True)
    done = generate_by_command(small_disk)
    assert done.returncode == 0, done.stderr
    assert status(store, of, wanted, every_byte=True).done == wanted
    assert all(path.stat().st_mtime_ns == then for path, then in kept.items())


def test_a_read_only_folder_is_one_sentence_and_nothing_changes(tmp_path: Path) -> None:
    of = SETS["single-domain-medium"]
    for folder in mounted(tmp_path / "readonly", "size=2m"):
        (folder / of.key / "00000").mkdir(parents=True)
        subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        before = files(folder)
        check_refused(generate_by_command(folder), str(folder), "Read-only file system")
        assert files(folder) == before
        for verb in ("status", "verify"):  # looking needs no right to write
            subprocess.run([DLOBENCH, "data", verb, "--data", folder], check=True, capture_output=True, env=ENVIRONMENT)
