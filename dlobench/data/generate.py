"""Generates what is missing of a set. Safe to stop at any moment and to run again, in several places at once."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial

from dlobench.data.domain_set import DomainSet, Unit
from dlobench.data.executors import Executor
from dlobench.data.sets import SEQUENCES
from dlobench.data.store import Store
from dlobench.trajectories import Trajectories
from dlobench.world.futures import futures
from dlobench.world.simulate import Account, simulate

Progress = Callable[[int, int], None]  # pushes done, pushes to do in all


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


def make_unit(unit: Unit, store: Store, of: DomainSet, *, again: bool = False) -> Unit:
    """Simulates one unit and writes its shard; `again` even where it is there already.

    What is there by now is left alone, so that two who generate into one folder seldom do the same work, and whose
    shard comes first stays. Raises `Broken` for what is broken, unless `again`.
    """
    if not again and store.sidecar(of, unit) is not None:
        return unit
    begin = time.process_time()
    trajectories, account = simulate_unit(of, unit)
    seconds = time.process_time() - begin
    if again or store.sidecar(of, unit) is None:
        store.write(of, unit, trajectories, asdict(account), seconds)
    return unit


def generate(
    store: Store, of: DomainSet, units: Sequence[Unit], executor: Executor, progress: Progress, *, again: bool = False
) -> None:
    """Makes units of a set wherever the executor runs them. The first that fails ends it; what is done stays.

    In any order, so that two who generate into one folder do not keep each other's pace.
    """
    total = sum(unit.count for unit in units) * of.pushes
    done = 0
    progress(done, total)
    for unit in executor(partial(make_unit, store=store, of=of, again=again), random.sample(units, len(units))):
        done += unit.count * of.pushes
        progress(done, total)
