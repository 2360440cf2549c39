"""Runs a model on a task: data, fit, adapt, score, record. Resumable: what exists is reused, and said so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from dlobench import machine
from dlobench.bench import results
from dlobench.bench.evaluate import summarise
from dlobench.bench.fitting import domain_id, fit_and_score
from dlobench.bench.journal import Finished, Journal
from dlobench.bench.order import Order, recordable
from dlobench.bench.results import CellScore, Failure, Provenance, Record
from dlobench.bench.task import split_digest
from dlobench.data.domain_set import PARTS
from dlobench.data.ensure import Reporter, ensure_data
from dlobench.data.executors import Executor
from dlobench.data.store import Store
from dlobench.errors import RunError


def run(
    order: Order,
    store: Store,
    out: Path,
    *,
    command: str,
    executor: Executor,
    reporter: Reporter,
    force: bool = False,
    keep_going: bool = False,
) -> Record:
    """Makes the record of an order and writes it under `out`; returns the one that is there already unless `force`.

    A run that was killed goes on after the last fit that it had finished. The first fit that fails ends it with a
    `RunError`, unless `keep_going`: then the record names what failed, and has the cells that lack nothing.
    """
    task = order.task
    spans = [span for part in PARTS for span in order.spans[part]]
    data_sha256, split_sha256 = order.of.digest(spans), split_digest(order.spans)
    hyper = recordable(order.hyperparameters)
    config = results.config_digest(
        plugin=order.plugin.sha256,
        hyperparameters=hyper,
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
    if path.exists() and not force and not (record := results.read(path, out)).failures:
        reporter.say(f"run: reused the record {path}; --force runs it again")
        return record
    results.check_writable(out)  # better said now than after the fit
    journal = Journal.beside(path)
    if force:
        journal.remove()
    finished, failures = journal.read(), list[Failure]()
    for number, fit in enumerate(order.fits, 1):
        key = fit.trajectories, fit.horizon, domain_id(order, fit.domain)
        if key in finished:
            continue
        title = f"{number}/{len(order.fits)} " if len(order.fits) > 1 else ""
        try:
            finished[key] = one = fit_and_score(order, fit, store, title=title, reporter=reporter)
        except RunError as error:
            if not keep_going:
                raise
            failures.append(Failure(trajectories=key[0], horizon=key[1], domain=key[2], error=str(error)))
            reporter.say(f"failed: {error}")
            continue
        journal.append(one)
    cells = _cells(order, finished)
    if not cells:
        raise RunError(f"no cell of {task.name} was finished; the last failure: {failures[-1].error}")
    commit, dirty = results.checkout()
    record = Record(
        task=task.name,
        task_version=task.version,
        scale=order.scale,
        model=order.plugin.name,
        config=config,
        seed=order.seed,
        parameters=max(one.parameters for one in finished.values()),
        seconds=sum(one.seconds for one in finished.values()),
        fits=[one.fit for one in finished.values()],
        cells=cells,
        failures=failures,
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
            hyperparameters=hyper,
            K=list(order.K),
            budget=asdict(order.budget),
            protection=list(order.plugin.protection),
        ),
    )
    reporter.say(f"run: recorded {results.write(record, out)}")
    if not failures:
        journal.remove()
    return record


def _cells(order: Order, finished: Mapping[tuple[int, int, str | None], Finished]) -> list[CellScore]:
    """Summarises the cells all of whose fits are finished, smallest first."""
    cells = []
    sweep = {(fit.trajectories, fit.horizon): fit for fit in order.fits}
    for (trajectories, horizon), fit in sorted(sweep.items()):
        members = [f for f in order.fits if (f.trajectories, f.horizon) == (trajectories, horizon)]
        parts = [finished.get((trajectories, horizon, domain_id(order, f.domain))) for f in members]
        whole = [part for part in parts if part is not None]
        if len(whole) == len(parts):
            scores = {K: [score for part in whole for score in part.scores[K]] for K in order.K}
            cells += [summarise(order.task, fit, K, scores[K]) for K in order.K]
    return cells
