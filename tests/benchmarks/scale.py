"""Measures what grows with the number of shards: writing, listing, scanning and hashing 10³, 10⁴ and 10⁵ of them.

    python tests/benchmarks/scale.py [--folder DIR] [--most 100000] [--cold]

Prints the table of docs/scale.md. Arrays are tiny, but for those that are hashed; all else is the shipped code. Every
step runs in a process of its own, so that its peak of memory is its own.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from dlobench.data.domain_set import Unit
from dlobench.data.ensure import missing
from dlobench.data.executors import find_executor
from dlobench.data.sets import SETS
from dlobench.data.status import census, status
from dlobench.data.store import Store
from dlobench.data.verify import verify
from dlobench.trajectories import Trajectories

SIZES = (1_000, 10_000, 100_000)
SYNCED = 1_000  # shards are written as in a generation; more would take an hour, so the rest is not waited for
HASHED = 4_000  # shards of the size of the meta-learning set, 192 kB each
OF = SETS["meta-learning"]


def units(count: int) -> Iterator[Unit]:
    """Yields the first shards of the set at scale paper, in the order in which they are generated."""
    return islice(OF.units(OF.spans("paper")), count)


def zeros(domain: int, trajectories: int, pushes: int) -> Trajectories:
    """Makes trajectories in which nothing is anywhere but at the origin."""
    K, T = trajectories, pushes
    dlo_mask, body_mask, boxes = OF.geometry(domain)

    def array(*shape: int) -> np.ndarray:
        return np.zeros((K, *shape), np.float32)

    dlo, bodies, cylinder = array(T + 1, 32, 3), array(T + 1, 3, 3), array(T + 1, 3)
    return Trajectories(dlo, dlo_mask, array(T + 1, 2), bodies, body_mask, boxes, array(T, 2), array(T, 2), cylinder)


def write(store: Store, begin: int, end: int, *, sync: bool, whole: bool = False) -> int:
    """Writes shards, of their real size if `whole`; without `sync` nobody waits until they are on the disk."""
    if not sync:
        os.fsync = lambda _: None  # type: ignore[assignment]
    for unit in islice(units(end), begin, end):
        content = zeros(unit.domain, OF.block if whole else 1, OF.pushes if whole else 1)
        store.write(OF, unit, content, {"commands": 1}, 3.0)
    return end - begin


def walk(store: Store) -> int:
    """Lists every file and returns the number of shards."""
    return sum(len(files) for _, _, files in os.walk(store.root)) // 2


def scan(store: Store) -> int:
    """Counts what is there, as `dlobench data status` does."""
    return census(store, OF).scales["paper"].done


def hashing(store: Store, workers: int) -> int:
    """Checks every byte, as `dlobench data verify` does, and returns how many."""
    return verify(store, OF, find_executor("local", workers=workers), lambda *_: None).bytes


def resume(store: Store, count: int) -> int:
    """Looks for what is missing of so many shards, as a generation does before it begins."""
    found = status(store, OF, units(count))
    return len(found.done) + len(found.pending)


def resume_all(store: Store) -> int:
    """Looks for what is missing of the whole set."""
    pending, there = missing(store, OF, OF.spans("paper"))
    return len(pending) + there


STEPS: dict[str, Callable[[Store, int], int]] = {
    "write": lambda store, count: write(store, 0, count, sync=True),
    "fill": lambda store, count: write(store, SYNCED, count, sync=False),
    "whole": lambda store, count: write(store, 0, count, sync=False, whole=True),
    "list": lambda store, _: walk(store),
    "status": lambda store, _: scan(store),
    "resume": resume,
    "resume all": lambda store, _: resume_all(store),
    "verify 1": lambda store, _: hashing(store, 1),
    "verify 2": lambda store, _: hashing(store, 2),
}


def step(name: str, store: Store, count: int) -> dict[str, float]:
    """Takes a step in a process of its own; returns how much it did, how long it took, s, and the memory, MB."""
    command = [sys.executable, __file__, "--step", name, "--folder", str(store.root), "--most", str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def take(name: str, store: Store, count: int) -> None:
    """Takes a step here and prints what it took."""
    peak, core, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, sum(os.times()[:4]), time.perf_counter()
    amount = STEPS[name](store, count)
    found = {"amount": amount, "seconds": time.perf_counter() - begin, "core": sum(os.times()[:4]) - core}
    found["memory"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) / 1024
    sys.stdout.write(json.dumps(found))


def forget() -> None:
    """Makes the kernel forget what it has read of any disk; needs root."""
    os.sync()
    Path("/proc/sys/vm/drop_caches").write_text("3")


def say(*cells: object) -> None:
    """Prints a row of the table."""
    sys.stdout.write(f"| {' | '.join(map(str, cells))} |\n")
    sys.stdout.flush()


def row(what: str, count: int, found: dict[str, float], unit: str = "shards", scale: float = 1) -> None:
    """Prints what a step took."""
    seconds, amount = found["seconds"], found["amount"] / scale
    say(
        what,
        f"{count:,}",
        f"{seconds:.2f}",
        f"{found['core']:.2f}",
        f"{amount / seconds:,.3g} {unit}/s",
        f"{found['memory']:.0f}",
    )


def measure(root: Path, most: int, cold: bool) -> None:
    """Measures every step at every size."""
    say("step", "shards", "s", "core s", "rate", "more MB")
    say("---", "---", "---", "---", "---", "---")
    for count in [size for size in SIZES if size <= most]:
        store = Store(root / str(count))
        row("write, synced", SYNCED, step("write", store, SYNCED))
        if count > SYNCED:
            step("fill", store, count)
        for name, what in (("list", "list the files"), ("status", "status"), ("resume", "find what is missing")):
            row(what, count, step(name, store, count))
        if cold:
            for name, what in (("list", "list, nothing cached"), ("status", "status, nothing cached")):
                forget()
                row(what, count, step(name, store, count))
        used = sum(path.stat().st_blocks * 512 for path in store.root.rglob("*"))
        say("disk per shard with a tiny array", f"{count:,}", "", "", f"{used / count:,.0f} B", "")
        shutil.rmtree(store.root)
    store = Store(root / "whole")
    step("whole", store, HASHED)
    for name in ("verify 1", "verify 2"):
        row(f"{name} worker(s)", HASHED, step(name, store, 0), "GB", 1e9)
    row("find what is missing, most of it", 157_500, step("resume all", store, 0))
    shutil.rmtree(store.root)


def main() -> None:
    """Measures in a temporary folder, or takes one step of that."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--folder", type=Path, help="where to write; default: a temporary folder")
    options.add_argument("--most", type=int, default=SIZES[-1], help="shards")
    options.add_argument("--cold", action="store_true", help="also with nothing cached; needs root")
    options.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.step:
        take(given.step, Store(given.folder), given.most)
        return
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        measure(Path(folder), given.most, given.cold)


if __name__ == "__main__":
    main()
