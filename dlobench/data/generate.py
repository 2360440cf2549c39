"""Generates what is missing of a set, and tells what is there. Safe to stop at any moment and to run again."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial

from dlobench.data.executors import local
from dlobench.data.sets import PUSHES, DomainSet, Unit, find
from dlobench.data.store import Broken, Store
from dlobench.world.simulate import simulate

Progress = Callable[[int, int], None]  # pushes done, pushes to do in all


@dataclass
class Status:
    """Counts the units of a set that are done, pending or broken."""

    done: list[Unit] = field(default_factory=list)
    pending: list[Unit] = field(default_factory=list)
    broken: dict[Unit, str] = field(default_factory=dict)
    bytes: int = 0
    seconds: float = 0.0  # core-seconds that the done units took


def status(store: Store, of: DomainSet, units: Sequence[Unit], *, every_byte: bool = False) -> Status:
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


def make_unit(unit: Unit, store: Store) -> Unit:
    """Simulates one unit and writes its shard."""
    of = find(unit.set_name)
    begin = time.process_time()
    seeds = [of.seed(unit.domain, unit.first + k) for k in range(unit.count)]
    trajectories, account = simulate(of.domain(unit.domain), seeds)
    store.write(of, unit, trajectories, asdict(account), time.process_time() - begin)
    return unit


def generate(store: Store, units: Sequence[Unit], workers: int, progress: Progress) -> None:
    """Makes the units, on `workers` processes. Raises `RunError` on the first that fails; what is done stays."""
    total = sum(unit.count * PUSHES for unit in units)
    done = 0
    progress(done, total)
    for unit in local(partial(make_unit, store=store), units, min(workers, max(1, len(units)))):
        done += unit.count * PUSHES
        progress(done, total)
