"""Spreads the fits of a run over an executor: each is made in a process of its own, wherever that runs.

What a fit needs travels with it: the plugin's file, its order and its data. So nodes need no data folder, and no file
system that they share.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dlobench.bench.fitting import Outcome, Parts, fit_and_score, load
from dlobench.bench.limits import Limits
from dlobench.bench.order import Order
from dlobench.bench.run import Fitting
from dlobench.bench.sandbox import Sandbox
from dlobench.bench.task import Fit
from dlobench.data.ensure import Reporter
from dlobench.data.executors import Executor
from dlobench.data.store import Store
from dlobench.errors import RunError
from dlobench.nn.budget import Listener


@dataclass(frozen=True)
class Piece:
    """Holds one fit and all that it needs; nothing in it belongs to this machine."""

    fit: Fit
    order: dict[str, Any]  # fields of the order but for its plugin
    plugin: tuple[str, bytes]  # name and content of its file
    parts: Parts
    limits: Limits
    threads: int


@dataclass
class _Quiet:
    """Tells nobody: what happens on a node is told when it has happened."""

    def say(self, text: str) -> None:
        """Says nothing."""

    @contextmanager
    def bar(self, title: str, unit: str) -> Iterator[Listener]:
        """Shows nothing."""
        yield lambda done, total, values: None


def spread(executor: Executor, limits: Limits, *, threads: int) -> Fitting:
    """Returns what makes the fits of a run by an executor, in any order; a fit that fails is yielded as its error."""

    def fitting(
        order: Order, fits: Sequence[tuple[str, Fit]], store: Store, reporter: Reporter
    ) -> Iterator[tuple[Fit, Outcome | RunError]]:
        plugin = order.plugin.path.name, order.plugin.path.read_bytes()
        told = {name: value for name, value in vars(order).items() if name not in ("plugin", "spans")}

        def pieces() -> Iterator[Piece]:
            for _, fit in fits:
                parts = load(order, fit, store, title="", reporter=_Quiet())
                yield Piece(fit, told, plugin, parts, limits, threads)

        with reporter.bar("fitting and scoring", "fits") as listen:
            listen(0, len(fits), {})
            for done, (fit, outcome) in enumerate(executor(make, pieces()), 1):
                listen(done, len(fits), {})
                yield fit, outcome

    return fitting


def make(piece: Piece) -> tuple[Fit, Outcome | RunError]:
    """Makes one fit here, in a sandbox of its own; what goes wrong in it is returned."""
    with tempfile.TemporaryDirectory(prefix="dlobench-") as folder, Sandbox(piece.limits, threads=piece.threads) as box:
        name, content = piece.plugin
        path = Path(folder) / name
        path.write_bytes(content)
        try:
            order = Order(plugin=box.load(str(path)), **piece.order)
            return piece.fit, fit_and_score(order, piece.fit, piece.parts, title="", reporter=_Quiet())
        except RunError as error:
            return piece.fit, error
