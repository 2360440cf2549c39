"""Measures executors beside each other: two local workers against one, and Ray against local, by the clock.

Run with `make bench-data`, on a machine that does nothing else; it takes some four minutes on two cores. A unit is one
trajectory through the store. All sides make the same units; a side's whole time has the start of its workers in it, its
steady rate counts from the first result on. Nothing is asserted about time: machines differ. Where benchmarks are
disabled, all sides run once on little.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from rates import Tables

from dlobench.data.domain_set import Unit
from dlobench.data.executors import Executor, find_executor
from dlobench.data.generate import generate
from dlobench.data.sets import SETS
from dlobench.data.store import Store

META = SETS["meta-learning"]
TITLE = "executors: units of one trajectory (20 pushes), by the clock"
PAIR, MANY, FEW = 300, 1000, 4  # units: to compare numbers of workers, to compare executors, where nothing is measured

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning:ray")


@dataclass(frozen=True)
class Side:
    """Holds how long one side took."""

    whole: float  # s
    steady: float  # units a second, from the first result on


@pytest.fixture(scope="module")
def small(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("benchmark_disable")) and not request.config.getoption("benchmark_enable")


def units(count: int) -> list[Unit]:
    """Returns units of so many domains, spread over all cells."""
    return [Unit(META.name, domain * len(META) // count, 0, 1) for domain in range(count)]


def measure(folder: Path, executor: Executor, count: int) -> tuple[Side, dict[str, bytes]]:
    """Makes units with an executor; returns how long it took, and what came of it."""
    times: list[float] = []
    begin = time.perf_counter()
    generate(Store(folder), META, units(count), executor, lambda done, total: times.append(time.perf_counter()))
    first, last = times[1], times[-1]  # the call before any is done comes first
    made = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.npy")}
    return Side(last - begin, (count - 1) / (last - first)), made


def compare(benchmark: Any, tables: Tables, sides: dict[str, Executor], count: int, folder: Path, small: bool) -> None:
    """Measures two sides after each other, and tells how the second stands to the first."""
    found: dict[str, tuple[Side, dict[str, bytes]]] = {}

    def play() -> None:
        for name, executor in sides.items():
            found[name] = measure(folder / name, executor, count)

    benchmark.pedantic(play, rounds=1)
    (a, (before, made)), (b, (after, again)) = found.items()
    assert len(made) == count
    assert again == made, "all executors make the same bytes"
    if not small:
        whole, steady = before.whole / after.whole, after.steady / before.steady
        tables.setdefault(TITLE, []).append(
            f"{b} against {a}, {count} units: {steady:.3f} × its steady rate ({after.steady:.2f} against "
            f"{before.steady:.2f} units/s), {whole:.3f} × in all ({after.whole:.1f} s against {before.whole:.1f} s)"
        )
        benchmark.extra_info |= {"units": count, "steady": steady, "whole": whole}


def test_two_workers_against_one(benchmark: Any, tables: Tables, small: bool, tmp_path: Path) -> None:
    sides = {f"{n} local worker{'s' * (n > 1)}": find_executor("local", workers=n) for n in (1, 2)}
    compare(benchmark, tables, sides, FEW if small else PAIR, tmp_path, small)


def test_ray_against_local(benchmark: Any, tables: Tables, small: bool, tmp_path: Path, ray_address: str) -> None:
    """Two CPUs each; the Ray is there already."""
    sides = {"2 local workers": find_executor("local", workers=2), "ray": find_executor("ray", address=ray_address)}
    compare(benchmark, tables, sides, FEW if small else MANY, tmp_path, small)
