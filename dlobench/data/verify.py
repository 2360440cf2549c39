"""Checks every byte of a set against its digest, in parallel, and mends what is broken."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from dlobench.data.domain_set import DomainSet, ScaleName, Unit
from dlobench.data.executors import Executor
from dlobench.data.generate import Progress, generate
from dlobench.data.inventory import Folder, folders
from dlobench.data.status import status
from dlobench.data.store import Broken, Store

PIECE = 128  # shards that a worker checks at a time

Listen = Callable[[int, int, int], None]  # shards checked, shards in all, bytes checked


@dataclass
class Verified:
    """Holds what a look at every byte of a set found."""

    shards: int = 0
    bytes: int = 0  # of whole arrays
    broken: dict[Unit, str] = field(default_factory=dict)
    halves: list[Unit] = field(default_factory=list)  # arrays without a sidecar
    temporary: list[Path] = field(default_factory=list)
    strays: list[Path] = field(default_factory=list)


def check(units: Sequence[Unit], store: Store, of: DomainSet) -> Verified:
    """Checks some shards."""
    out = Verified(shards=len(units))
    for unit in units:
        try:
            out.bytes += store.rows(of, unit).nbytes
        except Broken as error:
            out.broken[unit] = error.why
    return out


def verify(store: Store, of: DomainSet, executor: Executor, progress: Listen) -> Verified:
    """Checks all that is there of a set, wherever the executor runs; memory does not grow with its size."""
    total = sum(len(folder.sealed) for folder in folders(store, of))
    out = Verified()
    progress(0, total, 0)
    pieces = _pieces(folders(store, of), out)
    for done in executor(partial(check, store=store, of=of), pieces):
        out.shards, out.bytes, out.broken = out.shards + done.shards, out.bytes + done.bytes, out.broken | done.broken
        progress(out.shards, total, out.bytes)
    out.broken = dict(sorted(out.broken.items(), key=lambda item: (item[0].domain, item[0].first)))
    return out


def _pieces(found: Iterator[Folder], out: Verified) -> Iterator[tuple[Unit, ...]]:
    """Yields the shards to check, and adds all that is none to `out` on the way."""
    for folder in found:
        out.halves += folder.halves
        out.temporary += folder.temporary
        out.strays += folder.strays
        yield from (tuple(folder.sealed[i : i + PIECE]) for i in range(0, len(folder.sealed), PIECE))


def repair(
    store: Store,
    of: DomainSet,
    found: Verified,
    executor: Executor,
    progress: Progress,
    *,
    scale: ScaleName | None = None,
) -> list[Unit]:
    """Makes again what is broken and what lost its sidecar, and all that a scale, if given, misses; returns it.

    Whole shards are left alone. Safe to stop: what is broken is replaced when its successor is ready, not before.
    """
    units = [*found.broken, *found.halves]
    if scale is not None:
        known = set(units)
        missing = status(store, of, of.units(of.spans(scale))).pending
        units += [unit for unit in missing if unit not in known]
    if units:
        generate(store, of, units, executor, progress, again=True)
    return units
