"""Fits a model and scores it: one fit of a run, on all training domains of its task or on some."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from dlobench.bench import kept, questions
from dlobench.bench.answers import Misdeed
from dlobench.bench.evaluate import call, parameters, score_domain
from dlobench.bench.journal import Finished, Scores
from dlobench.bench.kept import Kept
from dlobench.bench.model import Model, Setting
from dlobench.bench.order import Order
from dlobench.bench.record import DomainScore, FitReport
from dlobench.bench.remote import state_of
from dlobench.bench.task import Fit
from dlobench.bench.weights import State
from dlobench.data.domain_set import PARTS, DomainSet, Part, Span
from dlobench.data.ensure import Reporter
from dlobench.data.store import Store
from dlobench.errors import UsageError
from dlobench.nn.budget import Log
from dlobench.trajectories import Trajectories
from dlobench.trajectories import parameters as parameters_of

CURVE_POINTS = 200  # of a learning curve, at most

Parts = dict[Part, dict[str, Trajectories]]  # of each part, the domains by their ids


@dataclass(frozen=True)
class Outcome:
    """Holds what comes of a fit: its scores, some of its predictions, and its weights where they can be kept."""

    finished: Finished
    kept: list[Kept]
    state: State | None
    lacking: str = ""  # why there are no weights


def domain_id(order: Order, domain: int | None) -> str | None:
    """Returns how records name a domain that is fitted apart, such as `single-domain-large/00017`."""
    return None if domain is None else f"{order.of.name}/{domain:05d}"


def fit_name(fit: Fit) -> str:
    """Returns how files of a fit are called, such as `trajectories50-h4-00017`."""
    domain = "" if fit.domain is None else f"-{fit.domain:05d}"
    return f"trajectories{fit.trajectories}-h{fit.horizon}{domain}{'-without-' + fit.without if fit.without else ''}"


def load(order: Order, fit: Fit, store: Store, *, title: str, reporter: Reporter) -> Parts:
    """Loads what a fit is about, as models may see it."""
    spans = order.task.parts(order.spans, fit)
    parts: Parts = {part: {} for part in PARTS}
    total, done = sum(map(len, spans.values())), 0
    with reporter.bar(f"{title}loading", "domains") as listen:
        for part, members in spans.items():
            of = order.task.set_of(part)
            for span in members:
                parts[part][f"{of.name}/{span.domain:05d}"] = seen(store, of, span, order.plugin.model)
                done += 1
                listen(done, total, {})
    return parts


def seen(store: Store, of: DomainSet, span: Span, model: type[Model]) -> Trajectories:
    """Loads trajectories as a model may see them: with the parameters of their domain for one that is privileged.

    Raises `UsageError` for a privileged model and a set that was imported, whose parameters nobody knows.
    """
    there = store.load_span(of, span).observed()
    return replace(there, parameters=parameters_of(of.domain(span.domain))) if model.privileged else there


def fit_and_score(order: Order, fit: Fit, parts: Parts, *, title: str, reporter: Reporter) -> Outcome:
    """Fits the model of an order and scores it for every K; raises `RunError` for whatever goes wrong in it."""
    begin = time.perf_counter()
    model, report = _fit(order, fit, parts, title, reporter)
    task, of = order.task, order.task.set_of("test")
    cells = {f"{of.name}/{span.domain:05d}": str(of.cell(span.domain)) for span in order.spans["test"]}
    asked = [
        questions.domain(name, cells[name], there, task=task, scale=task.scale(order.scale), fit=fit)
        for name, there in parts["test"].items()
    ]
    together = _tested_together(order, fit)
    scores, some = list[Scores](), list[Kept]()
    for K in order.K:
        found = {n: list[DomainScore]() for n in task.ahead(fit)}
        with reporter.bar(f"{title}scoring K = {K}", "domains") as listen:
            for done, domain in enumerate(asked, 1):
                for n, scored in score_domain(model, domain, K, task=task, fit=fit).items():
                    found[n].append(scored.score)
                    if domain.name in (names := kept.domains(task, n, together)):
                        rows = kept.windows(task, n, domain.name, len(domain.question.start), len(names))
                        some.append(kept.keep(task.cell_id(fit, K, n), domain, n, rows, scored.first))
                listen(done, len(asked), {})
        scores += [Scores(horizon=n, K=K, domains=domains) for n, domains in found.items()]
    learned = parameters(model, order.plugin.name)
    finished = Finished(fit=report, parameters=learned, seconds=time.perf_counter() - begin, scores=scores)
    try:
        return Outcome(finished, some, state_of(model))
    except (UsageError, Misdeed) as error:
        return Outcome(finished, some, None, str(error))


def _tested_together(order: Order, fit: Fit) -> list[str]:
    """Returns the ids of all domains whose scores are joined with those of a fit in one cell."""
    of = order.task.set_of("test").name
    if not order.task.apart:
        return [f"{of}/{span.domain:05d}" for span in order.task.parts(order.spans, fit)["test"]]
    same = [f for f in order.fits if replace(f, domain=None) == replace(fit, domain=None)]
    return [f"{of}/{f.domain:05d}" for f in same]


def build(order: Order) -> Model:
    """Returns the model of an order, not yet fitted; raises `UsageError` where it refuses its hyperparameters."""
    return call(
        order.plugin.name,
        lambda: order.plugin.model(seed=order.seed, device=order.device, **order.hyperparameters),
    )


def _fit(order: Order, fit: Fit, parts: Parts, title: str, reporter: Reporter) -> tuple[Model, FitReport]:
    name, task = order.plugin.name, order.task
    model = build(order)
    curve = list[dict[str, float]]()
    about = f"fitting h = {fit.horizon}" + (f", {fit.trajectories} trajectories" if title else "")
    train, valid = (list(parts[part].values()) for part in ("train", "valid"))
    if task.futures is not None:
        train, valid = ([questions.commanded(each) for each in domains] for domains in (train, valid))
    valid = [questions.measured(each, task.noise, domain) for domain, each in zip(parts["valid"], valid, strict=True)]
    with reporter.bar(title + about, "steps") as listen:
        log = Log([listen, lambda step, total, values: curve.append({"step": float(step), **values})])
        setting = Setting(horizon=fit.horizon, K=order.K, budget=order.budget, log=log)
        begin = time.perf_counter()
        call(f"{name}.fit", lambda: model.fit(train, valid, setting))
        seconds = time.perf_counter() - begin
    finite = [point for point in curve if all(np.isfinite(value) for value in point.values())]
    report = FitReport(
        trajectories=fit.trajectories,
        horizon=fit.horizon,
        domain=domain_id(order, fit.domain),
        without=fit.without,
        seconds=seconds,
        curve=finite[:: max(1, -(-len(finite) // CURVE_POINTS))],
    )
    return model, report
