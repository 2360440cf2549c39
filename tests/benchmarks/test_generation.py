"""Measures what the store costs: generation beside the bare simulator, verification beside bare hashing, memory.

Run with `make bench-data`. Both sides of a ratio do the same work, turn by turn in one run. Nothing is asserted about
time: machines differ. Where benchmarks are disabled, all sides run once on little. What is flat in memory is asserted.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from rates import Tables
from test_faults import tiny, units
from test_store import write

from dlobench.data.domain_set import Unit
from dlobench.data.executors import cores, find_executor
from dlobench.data.generate import make_unit, simulate_unit
from dlobench.data.sets import SETS
from dlobench.data.store import Store, pack
from dlobench.data.verify import check, verify

LARGE = SETS["single-domain-large"]
TESTS = Path(__file__).parents[1]
BOUND = 16_000_000  # bytes; the arrays of 10^6 pushes take 480 MB, their units alone in a list about 1 MB

Tell = Callable[[str], None]


@pytest.fixture(scope="module")
def small(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("benchmark_disable")) and not request.config.getoption("benchmark_enable")


@pytest.fixture
def tell(small: bool, tables: Tables) -> Tell:
    """Returns what adds a line to the table at the end, where benchmarks are enabled."""
    return lambda text: None if small else tables.setdefault("generation and verification", []).append(text)


@dataclass
class Spent:
    """Adds up the seconds of one side, by the clock and of the processor."""

    clock: float = 0.0
    processor: float = 0.0

    def add(self, work: Callable[[], Any]) -> None:
        clock, processor = time.perf_counter(), time.process_time()
        work()
        self.clock += time.perf_counter() - clock
        self.processor += time.process_time() - processor


def seconds(work: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def test_generation_beside_the_bare_simulator(benchmark: Any, small: bool, tell: Tell, tmp_path: Path) -> None:
    """The shards of every second domain of single-domain-large, 200 pushes each, in one process."""
    store, of = Store(tmp_path), tiny(8) if small else LARGE
    made = units(of)[:2] if small else [Unit(LARGE.name, domain, 0, LARGE.block) for domain in range(0, len(LARGE), 2)]
    bare, stored = Spent(), Spent()

    def turn() -> None:
        for number, unit in enumerate(made):  # unit by unit, so that both meet the same moods of the machine
            for side in (bare, stored) if number % 2 else (stored, bare):
                simulated = partial(simulate_unit, of, unit)
                side.add(simulated if side is bare else partial(make_unit, unit, store, of, again=True))

    rounds = 1 if small else 2
    benchmark.pedantic(turn, rounds=rounds)
    pushes = rounds * sum(unit.count for unit in made) * of.pushes
    for name in ("clock", "processor"):
        alone, through = getattr(bare, name), getattr(stored, name)
        benchmark.extra_info |= {"pushes": pushes, f"store_over_bare_{name}": through / alone}
        tell(
            f"generation, by the {name}: {pushes / alone:.0f} pushes/s bare, {pushes / through:.0f} through the store: "
            f"{100 * (through / alone - 1):+.1f} %"
        )
    again = simulate_unit(of, made[0])[0]
    assert store.rows(of, made[0]).tobytes() == pack(again).tobytes()


def test_verification_beside_bare_hashing(benchmark: Any, small: bool, tell: Tell, tmp_path: Path) -> None:
    """Shards of 96 kB, in the cache of the system: random walks, for verification knows no physics."""
    store = Store(tmp_path)
    made = [Unit(LARGE.name, number % 18, number // 18 * 10, 10) for number in range(9 if small else 1800)]
    for unit in made:
        write(store, LARGE, unit)
    paths = [store.path(LARGE, unit) for unit in made]
    size = sum(path.stat().st_size for path in paths)
    hashed: list[str] = []
    sides = {
        "bare hashlib over the same files": lambda: hashed.extend(
            hashlib.sha256(path.read_bytes()).hexdigest() for path in paths
        ),
        "verify, one process": lambda: check(made, store, LARGE),
        f"verify, pool of {cores()}, its start included": lambda: verify(
            store, LARGE, find_executor("local"), lambda *_: None
        ),
    }
    times = benchmark.pedantic(
        lambda: [{name: seconds(side) for name, side in sides.items()} for _ in range(1 if small else 5)], rounds=1
    )
    best = {name: min(each[name] for each in times) for name in sides}
    benchmark.extra_info |= {name: size / value / 1e9 for name, value in best.items()}
    bare = next(iter(best.values()))
    for name, value in best.items():
        tell(f"{name:44}{size / value / 1e9:8.2f} GB/s{100 * bare / value:8.0f} % of bare hashing")
    assert verify(store, LARGE, find_executor("local", workers=1), lambda *_: None).shards == len(made)
    assert len(set(hashed)) == len({path.read_bytes() for path in paths})


MEMORY = f"""
import resource, sys
from pathlib import Path
sys.path.append({str(TESTS)!r})
from rates import Tables
from test_faults import inline, quiet
from test_store import fake
from dlobench.data import generate as module
from dlobench.data.domain_set import Unit
from dlobench.data.sets import SETS
from dlobench.data.status import census
from dlobench.data.store import Store
from dlobench.data.verify import verify
from dlobench.world.simulate import Account

of, verb, folders, sizes = SETS["single-domain-large"], sys.argv[1], sys.argv[2:4], sys.argv[4:6]
walk = fake(of.domain(0), of.block), Account(0, 0, 0)
module.simulate_unit = lambda of, unit: walk  # the volume is what counts here

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)

def work(folder, pushes):
    store = Store(Path(folder))
    if verb == "generate":
        made = [Unit(of.name, 0, first, of.block) for first in range(0, int(pushes) // of.pushes, of.block)]
        module.generate(store, of, made, inline, quiet)
    elif verb == "verify":
        assert verify(store, of, inline, quiet).shards == int(pushes) // of.pushes // of.block
    else:
        assert census(store, of).scales["paper"].pushes == int(pushes)

work(folders[0], sizes[0])
before = peak()
work(folders[1], sizes[1])
print(peak() - before)
"""


def test_memory_is_flat_in_the_number_of_pushes(small: bool, tell: Tell, tmp_path: Path) -> None:
    """From 10^4 to 10^6 pushes (half of 10^5 where benchmarks are disabled), each verb in a process of its own.

    The pushes are made up, all the same, so that the volume is there in a minute; files, seals and digests are real.
    """
    sizes = (10**4, 5 * 10**4 if small else 10**6)
    folders = [str(tmp_path / str(size)) for size in sizes]
    for verb in ("generate", "verify", "status"):
        command = [sys.executable, "-c", MEMORY, verb, *folders, *map(str, sizes)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        grown = int(done.stdout)
        tell(f"{verb}: the peak of memory grew by {grown / 1e6:.1f} MB from {sizes[0]:,} to {sizes[1]:,} pushes")
        assert grown < BOUND, verb
    assert sum(1 for _ in tmp_path.rglob("*.npy")) == sum(sizes) // 200
