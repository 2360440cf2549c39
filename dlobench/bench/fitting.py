"""Fits a model and scores it: one fit of a run, on all training domains of its task or on one."""

from __future__ import annotations

import time

import numpy as np

from dlobench.bench.evaluate import call, parameters, score_domains
from dlobench.bench.journal import Finished
from dlobench.bench.model import Model, Setting
from dlobench.bench.order import Order
from dlobench.bench.results import FitReport
from dlobench.bench.task import Fit
from dlobench.data.domain_set import PARTS, Part
from dlobench.data.ensure import Reporter
from dlobench.data.store import Store
from dlobench.nn.budget import Log
from dlobench.trajectories import Trajectories

CURVE_POINTS = 200  # of a learning curve, at most


Parts = dict[Part, dict[str, Trajectories]]  # of each part, the domains by their ids


def domain_id(order: Order, domain: int | None) -> str | None:
    """Returns how records name a domain, such as `meta-learning/00017`."""
    return None if domain is None else f"{order.of.name}/{domain:05d}"


def fit_and_score(order: Order, fit: Fit, store: Store, *, title: str, reporter: Reporter) -> Finished:
    """Fits the model of an order and scores it for every K; raises `RunError` for whatever goes wrong in it."""
    begin = time.perf_counter()
    parts = _load(order, fit, store, title, reporter)
    model, report = _fit(order, fit, parts, title, reporter)
    scale = order.task.scale(order.scale)
    cells = {f"{order.of.name}/{span.domain:05d}": str(order.of.cell(span.domain)) for span in order.spans["test"]}
    domains = {name: (cells[name], trajectories) for name, trajectories in parts["test"].items()}
    scores = {}
    for K in order.K:
        with reporter.bar(f"{title}scoring K = {K}", "domains") as listen:
            scores[K] = score_domains(
                model,
                scale=scale,
                horizon=fit.horizon,
                K=K,
                domains=domains,
                progress=lambda done, total, listen=listen: listen(done, total, {}),  # type: ignore[misc]
            )
    learned = parameters(model, order.plugin.name)
    return Finished(fit=report, parameters=learned, seconds=time.perf_counter() - begin, scores=scores)


def _load(order: Order, fit: Fit, store: Store, title: str, reporter: Reporter) -> Parts:
    """Loads what a fit is about: everything, or its domain."""
    spans = [(part, s) for part in PARTS for s in order.spans[part] if fit.domain in (None, s.domain)]
    parts: Parts = {part: {} for part in PARTS}
    with reporter.bar(f"{title}loading", "domains") as listen:
        for done, (part, span) in enumerate(spans, 1):
            head = span.head(fit.trajectories) if part == "train" else span
            parts[part][f"{order.of.name}/{span.domain:05d}"] = store.load_span(order.of, head).observed()
            listen(done, len(spans), {})
    return parts


def _fit(order: Order, fit: Fit, parts: Parts, title: str, reporter: Reporter) -> tuple[Model, FitReport]:
    name = order.plugin.name
    model = call(name, lambda: order.plugin.model(seed=order.seed, device=order.device, **order.hyperparameters))
    curve = list[dict[str, float]]()
    about = f"fitting h = {fit.horizon}" + (f", {fit.trajectories} trajectories" if title else "")
    with reporter.bar(title + about, "steps") as listen:
        log = Log([listen, lambda step, total, values: curve.append({"step": float(step), **values})])
        setting = Setting(horizon=fit.horizon, K=order.K, budget=order.budget, log=log)
        train, valid = list(parts["train"].values()), list(parts["valid"].values())
        begin = time.perf_counter()
        call(f"{name}.fit", lambda: model.fit(train, valid, setting))
        seconds = time.perf_counter() - begin
    finite = [point for point in curve if all(np.isfinite(value) for value in point.values())]
    thin = finite[:: max(1, -(-len(finite) // CURVE_POINTS))]
    report = FitReport(
        trajectories=fit.trajectories,
        horizon=fit.horizon,
        domain=domain_id(order, fit.domain),
        seconds=seconds,
        curve=thin,
    )
    return model, report
