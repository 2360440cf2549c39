"""Generates what is missing of a set, and tells what is there. Safe to stop at any moment and to run again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial

from dlobench.data.domain_set import DomainSet, Unit
from dlobench.data.executors import Executor
from dlobench.data.sets import SEQUENCES, find
from dlobench.data.store import Broken, Store
from dlobench.trajectories import Trajectories
from dlobench.world.futures import futures
from dlobench.world.simulate import Account, simulate

Progress = Callable[[int, int], None]  # pushes done, pushes to do in all


@dataclass
class Status:
    """Counts the units of a set that are done, pending or broken."""

    done: list[Unit] = field(default_factory=list)
    pending: list[Unit] = field(default_factory=list)
    broken: dict[Unit, str] = field(default_factory=dict)
    bytes: int = 0
    seconds: float = 0.0  # core-seconds that the done units took


def status(store: Store, of: DomainSet, units: Iterable[Unit], *, every_byte: bool = False) -> Status:
    """Looks at the units on disk; `every_byte` checks each array against its digest."""
    out = Status()
    for unit in units:
        try:
            sidecar = store.sidecar(of, unit)
            if sidecar is not None and every_byte:
                store.load(of, unit)
        except Broken as error:
            out.broken[unit] = error.why
            continue
        if sidecar is None:
            out.pending.append(unit)
        else:
            out.done.append(unit)
            out.bytes += sidecar["bytes"]
            out.seconds += sidecar["seconds"]
    return out


def simulate_unit(of: DomainSet, unit: Unit) -> tuple[Trajectories, Account]:
    """Simulates what a shard holds, from nothing but the set's definition."""
    domain = of.domain(unit.domain)
    if of.executions == 1:
        return simulate(domain, [of.seed(unit.domain, unit.first + k) for k in range(unit.count)], pushes=of.pushes)
    return futures(
        domain,
        of.seed(unit.domain, unit.first),
        sequences=SEQUENCES,
        executions=of.executions,
        pushes=of.pushes,
    )


def make_unit(unit: Unit, store: Store) -> Unit:
    """Simulates one unit and writes its shard."""
    of = find(unit.set_name)
    begin = time.process_time()
    trajectories, account = simulate_unit(of, unit)
    store.write(of, unit, trajectories, asdict(account), time.process_time() - begin)
    return unit


def generate(store: Store, of: DomainSet, units: Sequence[Unit], executor: Executor, progress: Progress) -> None:
    """Makes units of a set wherever the executor runs them. The first that fails ends it; what is done stays."""
    total = sum(unit.count for unit in units) * of.pushes
    done = 0
    progress(done, total)
    for unit in executor(partial(make_unit, store=store), units):
        done += unit.count * of.pushes
        progress(done, total)
