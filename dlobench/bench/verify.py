"""Holds records against what they came from: their numbers must follow from the predictions that stand beside them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dlobench.bench import kept, metrics, results
from dlobench.bench.evaluate import summarise
from dlobench.bench.kept import Kept
from dlobench.bench.plugins import load_task
from dlobench.bench.record import CellScore, Record
from dlobench.bench.task import Fit, Task, split_digest, supports
from dlobench.data.domain_set import Span
from dlobench.data.reproduce import TOLERANCE
from dlobench.errors import RunError, UsageError

PLUGIN = "plugin.py"  # what a record's plugin is called beside it
FAR = 8.0  # standard errors that the error of kept windows may be away from that of all
LITTLE = 0.01  # of the error of all: less than that kept windows do not err by having missed the tail
FEW = 16  # windows, below which their mean says too little of all


@dataclass
class Verified:
    """Holds what is wrong with a record, and what should be known of it."""

    path: Path
    wrong: list[str] = field(default_factory=list)


def verify(paths: Sequence[Path], folder: Path) -> Iterator[Verified]:
    """Yields what was found of each record, one after the other; what they share is compared between them.

    Raises nothing: a record that cannot be read is wrong.
    """
    shared = _Shared()
    for path in paths:
        found = Verified(path)
        try:
            record = results.read(path, folder)
            found.wrong += _wrong(record, path, shared)
        except (RunError, UsageError) as error:
            found.wrong.append(str(error))
        yield found


@dataclass
class _Shared:
    """Remembers what records must agree on, and by which it was first said."""

    predictions: dict[str, tuple[str, Path]] = field(default_factory=dict)  # SHA-256 → model
    truths: dict[tuple[str, ...], tuple[Kept, Path]] = field(default_factory=dict)
    still: dict[tuple[str, ...], tuple[float, Path]] = field(default_factory=dict)  # errors of persistence, m²


def _wrong(record: Record, path: Path, shared: _Shared) -> list[str]:
    try:
        task = load_task(record.task)
    except UsageError:
        return [f"no task is called {record.task!r} here, so that nobody else can run it"]
    wrong = list(_definition(record, task))
    if wrong:
        return wrong
    wrong += _plugin(record, path)
    spans, fits = task.spans(record.scale), task.fits(record.scale)
    for cell in record.cells:
        tested = [span for fit in fits if _makes(fit, cell, task) for span in task.parts(spans, fit)["test"]]
        wrong += _tested(record, cell, task, tested)
        wrong += _numbers(cell, task)
        wrong += _same_still(record, cell, path, shared)
    beside = path.with_suffix(".safetensors")
    if record.predictions_sha256 is None or not beside.is_file():
        return [*wrong, f"no predictions stand beside it at {beside.name}"]
    if hashlib.sha256(beside.read_bytes()).hexdigest() != record.predictions_sha256:
        return [*wrong, f"the predictions at {beside.name} are not those that it was recorded with"]
    known, first = shared.predictions.setdefault(record.predictions_sha256, (record.model, path))
    if known != record.model:
        wrong.append(f"its predictions are those of {known} in {first}, to the last bit")
    predictions = kept.read(beside)
    for cell in record.cells:
        mine = [one for one in predictions if one.cell == cell.id]
        wrong += _rescored(cell, mine, task)
        wrong += _same_truth(record, cell, mine, path, shared)
    return wrong


def _definition(record: Record, task: Task) -> Iterator[str]:
    """Says where a record is about another version of its task or about other data."""
    if record.task_version != task.version:
        yield f"it is about version {record.task_version} of {task.name}, which has version {task.version}"
        return
    spans = task.spans(record.scale)
    if record.provenance.split_sha256 != split_digest(spans):
        yield f"its split is not that of {task.name} at scale {record.scale}"
    if record.provenance.data_sha256 != task.data_digest(spans):
        yield f"its data are not those of {task.name} at scale {record.scale}: another version of the world or engine"
    known = set(task.cells(record.scale, record.provenance.K))
    for cell in record.cells:
        if cell.id not in known:
            yield f"{task.name} has no cell {cell.id} at scale {record.scale}, or it has it once"
        known.discard(cell.id)


def _plugin(record: Record, path: Path) -> Iterator[str]:
    """Says where the plugin beside a record is not the one that it was made with."""
    plugin = path.with_name(PLUGIN)
    if not plugin.is_file():
        yield f"no plugin stands beside it at {PLUGIN}"
    elif hashlib.sha256(plugin.read_bytes()).hexdigest() != record.provenance.plugin_sha256:
        yield f"the plugin at {PLUGIN} is not the one that it was recorded with"


def _makes(fit: Fit, cell: CellScore, task: Task) -> bool:
    """Tells whether the scores of a fit belong to a cell."""
    same = (fit.trajectories, fit.without) == (cell.trajectories, cell.without)
    return same and cell.horizon in task.ahead(fit)


def _tested(record: Record, cell: CellScore, task: Task, spans: Sequence[Span]) -> Iterator[str]:
    """Says where a cell was not scored on all that its task says, and on nothing else."""
    of, scale = task.set_of("test"), task.scale(record.scale)
    cells = {f"{of.name}/{span.domain:05d}": str(of.cell(span.domain)) for span in spans}
    if sorted(score.domain for score in cell.domains) != sorted(cells):
        yield f"{cell.id}: it is scored on {len(cell.domains)} domains that are not the {len(cells)} of the task"
        return
    longest = max(task.horizon) if task.rolled else cell.horizon
    windows = scale.query * (1 if task.futures is not None else of.pushes - longest + 1)
    counts = len(supports(scale.support, cell.K)), windows
    for score in cell.domains:
        if (score.supports, score.windows) != counts or score.cell != cells[score.domain]:
            found = f"{score.supports} supports and {score.windows} windows as {score.cell}"
            yield f"{cell.id}: {score.domain} is scored by {found}, the task has {counts[0]} and {counts[1]}"


def _numbers(cell: CellScore, task: Task) -> Iterator[str]:
    """Says where the scores of a cell do not follow from those of its domains."""
    fit = Fit(cell.trajectories, 1 if task.rolled else cell.horizon, 0 if task.apart else None, cell.without)
    again = summarise(task, fit, cell.K, cell.horizon, cell.domains)
    for name in ("id", "mse", "euclidean", "energy", "skill"):
        if getattr(again, name) != getattr(cell, name):
            yield f"{cell.id}: {name} is {getattr(cell, name)}, its domains give {getattr(again, name)}"


def _same_still(record: Record, cell: CellScore, path: Path, shared: _Shared) -> Iterator[str]:
    """Says where the error of persistence, which is the data's and no model's, differs between records."""
    for score in cell.domains:
        key = (record.task, str(record.task_version), record.provenance.data_sha256, str(cell.horizon), score.domain)
        value, first = shared.still.setdefault(key, (score.persistence_mse, path))
        if not np.isclose(value, score.persistence_mse, rtol=1e-3, atol=0):
            yield f"{cell.id}: persistence errs by {score.persistence_mse} m² in {score.domain}, by {value} in {first}"


def _same_truth(record: Record, cell: CellScore, mine: Sequence[Kept], path: Path, shared: _Shared) -> Iterator[str]:
    """Says where the truth of a window differs between records by more than kinds of CPU do."""
    for one in mine:
        key = (record.task, record.provenance.data_sha256, str(cell.horizon), one.domain, *map(str, one.windows))
        other, first = shared.truths.setdefault(key, (one, path))
        if other.true.shape != one.true.shape or np.median(np.abs(other.true - one.true)[..., one.mask, :]) > TOLERANCE:
            yield f"{cell.id}: the truth of {one.domain} is not that of {first}"


def _rescored(cell: CellScore, mine: Sequence[Kept], task: Task) -> Iterator[str]:
    """Says where a cell is not the score of its predictions."""
    names = kept.domains(task, cell.horizon, [score.domain for score in cell.domains])
    scores = {score.domain: score for score in cell.domains}
    if [one.domain for one in mine] != names:
        yield f"{cell.id}: predictions of other domains are kept than the task says"
        return
    for one in mine:
        wanted = kept.windows(task, cell.horizon, one.domain, scores[one.domain].windows, len(names))
        if not np.array_equal(one.windows, wanted):
            yield f"{cell.id}: predictions of other windows of {one.domain} are kept than the task says"
            return
    again = kept.score(mine, samples=task.futures is not None)
    if cell.sample != again:
        yield f"{cell.id}: the kept predictions score {again}, the record says {cell.sample}"
    if again.windows < FEW:
        return
    errors = [_errors(one) for one in mine]
    said = np.concatenate([np.full(len(e), scores[one.domain].mse) for e, one in zip(errors, mine, strict=True)])
    found = np.concatenate(errors)
    ratio = found.sum() / said.sum() if said.sum() else np.inf
    spread = np.sqrt(np.square(found - ratio * said).sum()) / said.sum() if said.sum() else 0.0
    # Where the few windows that err most are not among the kept, these err far less than all, and alike: no spread of
    # theirs tells how far.
    if found.any() and (ratio - 1 > FAR * spread or ratio < LITTLE):
        yield f"{cell.id}: the kept predictions err {ratio:.3g} times as much as the record says of all"


def _errors(one: Kept) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Returns the mean squared error of every kept window, m²."""
    dlo = one.dlo.mean(axis=0, dtype=np.float64)
    return np.array(
        [
            np.mean([metrics.mse(dlo[w : w + 1], true[w : w + 1], one.mask) for true in one.true])
            for w in range(len(one.windows))
        ]
    )
