"""Runs a model on a task: data, fit, adapt, score, record. Resumable: what exists is reused, and said so."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from dlobench import machine
from dlobench.bench import kept, results, weights
from dlobench.bench.evaluate import summarise
from dlobench.bench.fitting import Outcome, build, domain_id, fit_and_score, fit_name, load
from dlobench.bench.journal import Finished, Journal, Key
from dlobench.bench.kept import Kept
from dlobench.bench.order import Order, recordable
from dlobench.bench.record import CellScore, Failure, Provenance, Record
from dlobench.bench.task import Fit, split_digest
from dlobench.bench.tracking import Tracker
from dlobench.data.ensure import Reporter, ensure_data
from dlobench.data.executors import Executor
from dlobench.data.store import Store, atomic_write
from dlobench.errors import RunError


class Fitting(Protocol):
    """Fits and scores, here or elsewhere."""

    def __call__(
        self, order: Order, fits: Sequence[tuple[str, Fit]], store: Store, reporter: Reporter
    ) -> Iterator[tuple[Fit, Outcome | RunError]]:
        """Yields what comes of each fit (its title comes before it) as it finishes, or why nothing came of it."""


def one_by_one(
    order: Order, fits: Sequence[tuple[str, Fit]], store: Store, reporter: Reporter
) -> Iterator[tuple[Fit, Outcome | RunError]]:
    """Fits and scores in this process, one after the other."""
    for title, fit in fits:
        try:
            parts = load(order, fit, store, title=title, reporter=reporter)
            yield fit, fit_and_score(order, fit, parts, title=title, reporter=reporter)
        except RunError as error:
            yield fit, error


def run(
    order: Order,
    store: Store,
    out: Path,
    *,
    command: str,
    executor: Executor,
    reporter: Reporter,
    fitting: Fitting = one_by_one,
    tracker: Tracker | None = None,
    force: bool = False,
    keep_going: bool = False,
) -> Record:
    """Makes the record of an order and writes it under `out`; returns the one that is there already unless `force`.

    A run that was killed goes on after the last fit that it had finished. The first fit that fails ends it with a
    `RunError`, unless `keep_going`: then the record names what failed, and has the cells that lack nothing.
    """
    task = order.task
    sets = task.sets(order.spans)
    data_sha256, split_sha256 = task.data_digest(order.spans), split_digest(order.spans)
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
    build(order)  # hyperparameters are better refused now than when the data is there
    for of, spans in sets:
        ensure_data(store, of, spans, executor=executor, reporter=reporter)
    if path.exists() and not force and not (record := results.read(path, out)).failures:
        reporter.say(f"run: reused the record {path}; --force runs it again")
        return record
    results.check_writable(out)  # better said now than after the fit
    plugin = order.plugin.path.read_bytes()
    if hashlib.sha256(plugin).hexdigest() != order.plugin.sha256:
        raise RunError(f"{order.plugin.path} was changed while it was loaded; run it again")
    journal = Journal.beside(path)
    if force:
        journal.remove()
    tracker = tracker or Tracker()
    tracker.begin(f"{task.name}-{order.scale}-{path.parent.name}", order.seed, _told(order, data_sha256, split_sha256))
    finished, failures = journal.read(), list[Failure]()
    for fit, one in _fitted(order, finished, store, fitting, reporter):
        if isinstance(one, RunError):
            if not keep_going:
                raise one
            failures.append(_failure(order, fit, str(one)))
            reporter.say(f"failed: {one}")
            continue
        if isinstance(one, Outcome):
            _keep(one, fit_name(fit), path, journal, reporter)
            finished[_key(order, fit)] = one.finished
        tracker.fitted(fit_name(fit), finished[_key(order, fit)].fit)
    some = [one for fit in order.fits if _key(order, fit) in finished for one in journal.kept(fit_name(fit))]
    cells = _cells(order, finished, some)
    if not cells:
        raise RunError(f"no cell of {task.name} was finished; the last failure: {failures[-1].error}")
    atomic_write(path.with_name("plugin.py"), plugin)
    names = [cell.id for cell in cells]
    predictions = path.with_suffix(".safetensors")
    some = sorted((one for one in some if one.cell in names), key=lambda one: names.index(one.cell))
    kept.write(predictions, some)
    commit, dirty = results.checkout()
    record = Record(
        task=task.name,
        task_version=task.version,
        scale=order.scale,
        model=order.plugin.name,
        config=config,
        seed=order.seed,
        parameters=max(one.parameters for one in finished.values()),
        privileged=order.plugin.model.privileged,
        seconds=sum(one.seconds for one in finished.values()),
        fits=[one.fit for one in finished.values()],
        cells=cells,
        failures=failures,
        predictions_sha256=hashlib.sha256(predictions.read_bytes()).hexdigest(),
        provenance=Provenance(
            command=command,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            commit=commit,
            dirty=dirty,
            versions=machine.versions(),
            cpu=machine.cpu(),
            device=order.device,
            set=" ".join(of.key for of, _ in sets),
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
    tracker.recorded(record, some)
    if not failures:
        journal.remove()
    return record


def _fitted(
    order: Order, finished: Mapping[Key, Finished], store: Store, fitting: Fitting, reporter: Reporter
) -> Iterator[tuple[Fit, Finished | Outcome | RunError]]:
    """Yields what is finished already, then what comes of the other fits."""
    missing = list[tuple[str, Fit]]()
    for number, fit in enumerate(order.fits, 1):
        if _key(order, fit) in finished:
            yield fit, finished[_key(order, fit)]
        else:
            missing.append((f"{number}/{len(order.fits)} " if len(order.fits) > 1 else "", fit))
    yield from fitting(order, missing, store, reporter)


def _failure(order: Order, fit: Fit, error: str) -> Failure:
    trajectories, horizon, domain, without = _key(order, fit)
    return Failure(trajectories=trajectories, horizon=horizon, domain=domain, without=without, error=error)


def _keep(outcome: Outcome, name: str, path: Path, journal: Journal, reporter: Reporter) -> None:
    """Writes what came of a fit: weights beside the record to be, the rest into the journal."""
    if outcome.state is None:
        reporter.say(f"weights: none are kept of {name}: {outcome.lacking}")
    else:
        weights.write(path.with_suffix("") / f"{name}.safetensors", outcome.state)
    journal.append(outcome.finished, name, outcome.kept)


def _told(order: Order, data_sha256: str, split_sha256: str) -> dict[str, Any]:
    """Returns the configuration that a tracker is told."""
    return {
        "task": order.task.name,
        "task_version": order.task.version,
        "scale": order.scale,
        "model": order.plugin.name,
        "seed": order.seed,
        "K": list(order.K),
        "hyperparameters": recordable(order.hyperparameters),
        "budget": asdict(order.budget),
        "data_sha256": data_sha256,
        "split_sha256": split_sha256,
        "versions": machine.versions(),
    }


def _key(order: Order, fit: Fit) -> Key:
    return fit.trajectories, fit.horizon, domain_id(order, fit.domain), fit.without


def _cells(order: Order, finished: Mapping[Key, Finished], some: Sequence[Kept]) -> list[CellScore]:
    """Summarises the cells all of whose fits are finished, smallest first, what lacks nothing before what does."""
    cells, task, sweep = [], order.task, dict[tuple[int, int, str], list[Fit]]()
    for fit in order.fits:
        sweep.setdefault((fit.trajectories, fit.horizon, fit.without or ""), []).append(fit)
    for members in (sweep[key] for key in sorted(sweep)):
        parts = [finished[_key(order, fit)] for fit in members if _key(order, fit) in finished]
        if len(parts) < len(members):
            continue
        for n in task.ahead(members[0]):
            for K in order.K:
                scores = [score for part in parts for score in part.of(n, K)]
                cell = summarise(task, members[0], K, n, scores)
                mine = [one for one in some if one.cell == cell.id]
                sample = kept.score(mine, samples=task.futures is not None) if mine else None
                cells.append(cell.model_copy(update={"sample": sample}))
    return cells
