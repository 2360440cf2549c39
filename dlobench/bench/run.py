"""Runs a model on a task: data, fit, adapt, score, record. Resumable: what exists is reused, and said so."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dlobench import machine
from dlobench.bench import results
from dlobench.bench.evaluate import call, parameters, score_cell
from dlobench.bench.model import Model, Setting
from dlobench.bench.order import Order, recordable
from dlobench.bench.plugins import hyperparameters
from dlobench.bench.results import CellScore, FitReport, Provenance, Record
from dlobench.bench.task import Fit, split_digest
from dlobench.data.domain_set import PARTS, DomainSet, Part, Span, Unit
from dlobench.data.executors import Executor
from dlobench.data.generate import generate
from dlobench.data.status import status
from dlobench.data.store import Store, data_bytes
from dlobench.errors import RunError
from dlobench.nn.budget import Listener, Log
from dlobench.trajectories import Trajectories

CURVE_POINTS = 200  # of a learning curve, at most


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
    """Generates what is missing; raises `RunError` for what is broken, which is never overwritten unasked."""
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
    pushes = sum(unit.count for unit in pending) * of.pushes
    reporter.say(
        f"data: {len(pending)} shards generated, {pushes:,} pushes in {seconds:,.1f} s "
        f"({pushes / seconds:,.0f} pushes/s), {data_bytes(of, pending):,} bytes"
    )


def run(
    order: Order, store: Store, out: Path, *, command: str, executor: Executor, reporter: Reporter, force: bool = False
) -> Record:
    """Makes the record of an order and writes it under `out`; returns the one that is there already unless `force`."""
    task = order.task
    spans = [span for part in PARTS for span in order.spans[part]]
    data_sha256, split_sha256 = order.of.digest(spans), split_digest(order.spans)
    hyper = hyperparameters(order.plugin.model) | dict(order.settings)
    config = results.config_digest(
        plugin=order.plugin.sha256,
        hyperparameters=recordable(hyper),
        fits=[asdict(fit) for fit in order.fits],
        K=order.K,
        budget=asdict(order.budget),
        task=[task.name, task.version],
        data=data_sha256,
        split=split_sha256,
        code=results.code_digest(),
    )
    path = out / task.name / order.scale / f"{order.plugin.name}@{config}" / f"seed{order.seed}.json"
    ensure_data(store, order.of, spans, executor=executor, reporter=reporter)
    if path.exists() and not force:
        record = results.read(path, out)
        reporter.say(f"run: reused the record {path}; --force runs it again")
        return record
    results.check_writable(out)  # better said now than after the fit
    begin = time.perf_counter()
    with reporter.bar("loading", "domains") as listen:
        parts = _load(order, store, listen)
    reports, cells, learned = list[FitReport](), list[CellScore](), 0
    for fit in order.fits:
        model, report = _fit(order, hyper, fit, parts, reporter)
        reports.append(report)
        learned = max(learned, parameters(model, order.plugin.name))
        cells += _score(order, model, fit, parts["test"], reporter)
    commit, dirty = results.checkout()
    record = Record(
        task=task.name,
        task_version=task.version,
        scale=order.scale,
        model=order.plugin.name,
        config=config,
        seed=order.seed,
        parameters=learned,
        seconds=time.perf_counter() - begin,
        fits=reports,
        cells=cells,
        provenance=Provenance(
            command=command,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            commit=commit,
            dirty=dirty,
            versions=machine.versions(),
            cpu=machine.cpu(),
            device=order.device,
            set=order.of.key,
            data_sha256=data_sha256,
            split_sha256=split_sha256,
            plugin_sha256=order.plugin.sha256,
            hyperparameters=recordable(hyper),
            K=list(order.K),
            budget=asdict(order.budget),
        ),
    )
    reporter.say(f"run: recorded {results.write(record, out)}")
    return record


_Parts = dict[Part, dict[int, Trajectories]]


def _load(order: Order, store: Store, listen: Listener) -> _Parts:
    total, done = sum(map(len, order.spans.values())), 0
    parts: _Parts = {part: {} for part in PARTS}
    for part, spans in order.spans.items():
        for span in spans:
            parts[part][span.domain] = store.load_span(order.of, span).observed()
            listen(done := done + 1, total, {})
    return parts


def _fit(
    order: Order, hyper: Mapping[str, Any], fit: Fit, parts: _Parts, reporter: Reporter
) -> tuple[Model, FitReport]:
    name = order.plugin.name
    model = call(name, lambda: order.plugin.model(seed=order.seed, device=order.device, **hyper))
    curve = list[dict[str, float]]()
    with reporter.bar(f"fitting h = {fit.horizon}", "steps") as listen:
        log = Log([listen, lambda step, total, values: curve.append({"step": float(step), **values})])
        setting = Setting(horizon=fit.horizon, K=order.K, budget=order.budget, log=log)
        train = [trajectories.take(slice(fit.trajectories)) for trajectories in parts["train"].values()]
        begin = time.perf_counter()
        call(f"{name}.fit", lambda: model.fit(train, list(parts["valid"].values()), setting))
        seconds = time.perf_counter() - begin
    finite = [point for point in curve if all(np.isfinite(value) for value in point.values())]
    thin = finite[:: max(1, -(-len(finite) // CURVE_POINTS))]
    return model, FitReport(trajectories=fit.trajectories, horizon=fit.horizon, seconds=seconds, curve=thin)


def _score(
    order: Order, model: Model, fit: Fit, test: Mapping[int, Trajectories], reporter: Reporter
) -> list[CellScore]:
    domains = {f"{order.of.name}/{i:05d}": (str(order.of.cell(i)), trajectories) for i, trajectories in test.items()}
    cells = []
    for K in order.K:
        with reporter.bar(f"scoring K = {K}", "domains") as listen:

            def progress(done: int, total: int, listen: Callable[..., None] = listen) -> None:
                listen(done, total, {})

            scale = order.task.scale(order.scale)
            cells.append(
                score_cell(model, task=order.task, scale=scale, fit=fit, K=K, domains=domains, progress=progress)
            )
    return cells
