"""Makes sure that data is there: finds what is missing, generates it, and tells how it goes."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import AbstractContextManager
from typing import Protocol

from dlobench.data import table
from dlobench.data.domain_set import DomainSet, Span, Unit
from dlobench.data.executors import Executor
from dlobench.data.generate import generate
from dlobench.data.status import status
from dlobench.data.store import Store, data_bytes
from dlobench.errors import RunError
from dlobench.nn.budget import Listener


class Reporter(Protocol):
    """Tells the user how a run goes."""

    def say(self, text: str) -> None:
        """Says one line."""

    def bar(self, title: str, unit: str) -> AbstractContextManager[Listener]:
        """Shows progress, with rate and ETA, while the context lasts."""


def missing(store: Store, of: DomainSet, spans: Iterable[Span]) -> tuple[list[Unit], int]:
    """Returns the shards to generate, and how many are there; raises `RunError` where one is broken."""
    units = list(of.units(spans))
    found = status(store, of, units)
    if found.broken:
        unit, why = next(iter(found.broken.items()))
        raise RunError(
            f"{len(found.broken)} of {len(units)} shards are broken, the first {store.path(of, unit)} ({why}); "
            f"`dlobench data repair {of.name}` generates them again"
        )
    return found.pending, len(found.done)


def ensure_data(store: Store, of: DomainSet, spans: Iterable[Span], *, executor: Executor, reporter: Reporter) -> None:
    """Generates what is missing, and writes the table of the domains beside it.

    Raises `RunError` for what is broken, which is never overwritten unasked.
    """
    pending, there = missing(store, of, spans)
    folder = store.root / of.key
    if not pending:
        reporter.say(f"data: all {there} shards reused from {folder}, nothing to generate")
        return
    reporter.say(f"data: {there} shards reused, {len(pending)} to generate into {folder}")
    begin = time.perf_counter()
    with reporter.bar("generating", "pushes") as listen:
        generate(store, of, pending, executor, lambda done, total: listen(done, total, {}))
    seconds = time.perf_counter() - begin
    table.write(store, of)
    pushes = sum(unit.count for unit in pending) * of.pushes
    reporter.say(
        f"data: {len(pending)} shards generated, {pushes:,} pushes in {seconds:,.1f} s "
        f"({pushes / seconds:,.0f} pushes/s), {data_bytes(of, pending):,} bytes"
    )
