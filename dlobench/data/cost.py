"""Measures what shards cost on this machine, by really simulating the beginnings of a spread of them."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from dlobench.data.domain_set import DomainSet, Unit
from dlobench.data.executors import Executor
from dlobench.data.generate import simulate_unit
from dlobench.data.sets import SEQUENCES, find
from dlobench.data.store import Store
from dlobench.trajectories import Trajectories
from dlobench.world.simulate import Account

Result = TypeVar("Result")

ENOUGH = 8  # samples are taken even where time is up
SAMPLES = 2000  # are never exceeded
GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples modulo 1 are spread evenly, however many are taken


@dataclass(frozen=True)
class Cost:
    """Holds what one shard costs."""

    core_seconds: float
    wall_seconds: float  # of a worker beside others
    sidecar: int  # bytes


def measure(
    units: Sequence[Unit], executor: Executor, seconds: float, progress: Callable[[int, int], None]
) -> list[Cost]:
    """Returns the costs of a spread of the units, measured wherever the executor runs them, until time is up.

    What is simulated is written to a temporary folder and thrown away. Where like units are neighbours, any number of
    samples represents all of them.
    """
    begin, costs = list[float](), list[Cost]()

    def spread() -> Iterator[Unit]:
        for number in range(SAMPLES):
            if number >= ENOUGH and begin and time.perf_counter() - begin[0] > seconds:
                return
            yield units[int((number * GOLDEN + 0.5) % 1 * len(units))]

    with tempfile.TemporaryDirectory() as folder:
        for cost in executor(partial(cost_of, store=Store(Path(folder))), spread()):
            begin = begin or [time.perf_counter()]  # workers have started
            costs.append(cost)
            progress(round(min(time.perf_counter() - begin[0], seconds)), round(seconds))
    return costs


def cost_of(unit: Unit, store: Store) -> Cost:
    """Returns what one shard costs, extrapolated from two beginnings of it, the larger of which is written too.

    The smaller one is a part of the larger, so that their difference is what more trajectories cost.
    """
    of = find(unit.set_name)
    few, many = (1, 4) if of.executions == 1 else (2 * SEQUENCES, 6 * SEQUENCES)
    _, core_few, wall_few = _timed(lambda: beginning(of, unit, few))
    (trajectories, account), core_many, wall_many = _timed(lambda: beginning(of, unit, many))
    written = replace(unit, count=many)
    _, core_written, wall_written = _timed(lambda: store.write(of, written, trajectories, asdict(account), core_many))
    more = (unit.count - few) / (many - few)
    return Cost(
        core_seconds=core_few + more * (core_many - core_few) + core_written,
        wall_seconds=wall_few + more * (wall_many - wall_few) + wall_written,
        sidecar=store.path(of, written).with_suffix(".json").stat().st_size,
    )


def beginning(of: DomainSet, unit: Unit, count: int) -> tuple[Trajectories, Account]:
    """Simulates what a shard of so many trajectories would hold."""
    executions = 1 if of.executions == 1 else count // SEQUENCES
    return simulate_unit(replace(of, executions=executions), replace(unit, count=count))


def _timed(call: Callable[[], Result]) -> tuple[Result, float, float]:
    """Calls, and returns the result with the processor seconds and the seconds that it took."""
    wall, core = time.perf_counter(), time.process_time()
    result = call()
    return result, time.process_time() - core, time.perf_counter() - wall
