"""Holds a record against domains that did not exist when it was made: its weights, new domains, the same scores.

A model that has seen the test domains, or was chosen by them, is worse on new ones. The seed is drawn after the weights
were handed in, and everything about the new domains follows from it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dlobench.bench import questions, weights
from dlobench.bench.evaluate import score_domain, summarise
from dlobench.bench.fitting import fit_name, seen
from dlobench.bench.model import Model
from dlobench.bench.order import recordable
from dlobench.bench.plugins import ModelPlugin, load_task
from dlobench.bench.record import CellScore, DomainScore, Record
from dlobench.bench.remote import revive
from dlobench.bench.statistics import DRAWS, LEVEL, generator
from dlobench.bench.task import Fit, Task
from dlobench.data.ensure import Reporter, ensure_data
from dlobench.data.executors import Executor
from dlobench.data.store import Store
from dlobench.errors import RunError


@dataclass(frozen=True)
class Fresh:
    """Holds the skill of one cell, as recorded and on new domains, and the interval of their difference."""

    cell: str
    recorded: float
    fresh: float
    low: float  # of fresh − recorded, at 95 % over all cells of the record
    high: float
    domains: int

    @property
    def holds(self) -> bool:
        """Tells whether the model is no worse on new domains, as far as these tell."""
        return self.high >= 0


def fresh(
    record: Record, path: Path, plugin: ModelPlugin, seed: int, store: Store, *, executor: Executor, reporter: Reporter
) -> list[Fresh]:
    """Returns what becomes of every cell of a record on new domains; its weights stand beside it, at `path`.

    Raises `RunError` where weights are missing or of other hyperparameters, and as `score_domain` does.
    """
    task = replace(load_task(record.task), fresh=seed)
    spans = task.spans(record.scale)
    of, tested = task.set_of("test"), spans["test"]
    fits = [fit for fit in task.fits(record.scale) if _recorded(fit, record)]
    files = {fit: _weights(path, fit) for fit in fits}
    ensure_data(store, of, tested, executor=executor, reporter=reporter)
    scores: dict[tuple[Fit, int, int], list[DomainScore]] = {}
    with reporter.bar("scoring on new domains", "fits") as listen:
        for done, fit in enumerate(fits, 1):
            model = _revived(files[fit], record, plugin)
            for span in task.parts(spans, fit)["test"]:
                there = seen(store, of, span, plugin.model)
                name, cell = f"{of.name}/{span.domain:05d}", str(of.cell(span.domain))
                asked = questions.domain(name, cell, there, task=task, scale=task.scale(record.scale), fit=fit)
                for K in record.provenance.K:
                    for n, scored in score_domain(model, asked, K, task=task, fit=fit).items():
                        scores.setdefault((replace(fit, domain=None), n, K), []).append(scored.score)
            listen(done, len(fits), {})
    found = {cell.id: cell for key, domains in scores.items() for cell in [_cell(task, key, domains)]}
    both = [(cell, found[cell.id]) for cell in record.cells if cell.id in found]
    return [_compared(cell, new, len(both)) for cell, new in both]


def _recorded(fit: Fit, record: Record) -> bool:
    domain = None if fit.domain is None else f"{load_task(record.task).of.name}/{fit.domain:05d}"
    keys = {(one.trajectories, one.horizon, one.domain, one.without) for one in record.fits}
    return (fit.trajectories, fit.horizon, domain, fit.without) in keys


def _weights(path: Path, fit: Fit) -> Path:
    """Returns where the weights of a fit stand."""
    file = path.with_suffix("") / f"{fit_name(fit)}.safetensors"
    if not file.is_file():
        raise RunError(f"{path} has no weights at {file}: they come with a submission, and with the folder of a run")
    return file


def _revived(file: Path, record: Record, plugin: ModelPlugin) -> Model:
    """Returns the model of some weights, of the seed and hyperparameters that the record says."""
    model = revive(plugin.model, weights.read(file), device="cpu")
    for name, said in {"seed": record.seed, **record.provenance.hyperparameters}.items():
        held = recordable({name: getattr(model, name, None)})[name]
        if json.dumps(held) != json.dumps(said):  # where a tuple is a list
            raise RunError(f"the record is of {name} = {said!r}, but {file} holds {name} = {held!r}")
    return model


def _cell(task: Task, key: tuple[Fit, int, int], domains: list[DomainScore]) -> CellScore:
    fit, n, K = key
    return summarise(task, replace(fit, domain=0) if task.apart else fit, K, n, domains)


def _compared(recorded: CellScore, new: CellScore, cells: int) -> Fresh:
    """Compares two sets of domains by the two-sample bootstrap; several cells share the chance of a false alarm."""
    tail = (1 - LEVEL) / 2 / cells
    drawn = _resampled(new.domains, "fresh") - _resampled(recorded.domains, "recorded")
    low, high = np.quantile(drawn, [tail, 1 - tail])
    return Fresh(recorded.id, recorded.skill, new.skill, float(low), float(high), len(new.domains))


def _resampled(domains: Sequence[DomainScore], what: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Returns the skill of every resampling of domains, (DRAWS,)."""
    samples = domains[0].energy is not None
    error = np.array([d.energy if samples else d.mse for d in domains], float)
    still = np.array([d.persistence_energy if samples else d.persistence_mse for d in domains], float)
    index = generator(what, *(d.domain for d in domains)).integers(len(domains), size=(DRAWS, len(domains)))
    skill: np.ndarray[tuple[int], np.dtype[np.float64]] = 1 - error[index].sum(axis=1) / still[index].sum(axis=1)
    return skill
