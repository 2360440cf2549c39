"""Checks that a plugin keeps the contract of `Model`, on a tiny set that is simulated on the spot."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from dlobench import domain
from dlobench.bench.calibration import SAMPLES
from dlobench.bench.evaluate import call, parameters, predict
from dlobench.bench.model import Model, Setting
from dlobench.bench.plugins import ModelPlugin
from dlobench.errors import RunError
from dlobench.nn.budget import Budget
from dlobench.trajectories import Query, Trajectories
from dlobench.trajectories import parameters as parameters_of
from dlobench.world.simulate import simulate

HORIZON = 2
STEPS = 20  # of a fit


@dataclass(frozen=True)
class Check:
    """Holds the outcome of one check."""

    name: str
    passed: bool
    why: str = ""


def tiny(*, privileged: bool = False) -> list[Trajectories]:
    """Simulates five domains, 3 trajectories of 6 pushes each: every material, two attachments, 16 and 12 cm.

    Those who are privileged see the parameters of each, as in a run.
    """
    out = []
    for i, material in enumerate((*domain.MATERIALS, *domain.MATERIALS[:2])):
        attachment = domain.ATTACHMENTS[2 * (i % 2)]
        length = 0.12 if i == 4 else 0.16
        of = domain.sample(
            np.random.default_rng([1, i]), material=material, attachment=attachment, length=length, rigid_objects=0
        )
        made = simulate(of, [[1, i, k] for k in range(3)], pushes=6)[0]
        out.append(dataclasses.replace(made, parameters=parameters_of(of)) if privileged else made)
    return out


def check(plugin: ModelPlugin, again: Callable[[], ModelPlugin] | None = None) -> Iterator[Check]:
    """Yields the outcome of every check, one after the other; later ones are skipped once a fit has failed.

    `again` loads the plugin in another process, where the same seed must give the same model.
    """
    data = tiny(privileged=plugin.model.privileged)
    query, _ = data[-1].windows(HORIZON)
    fitted: list[Model] = []

    def fit() -> None:
        fitted.append(_fit(plugin, data))

    def refitted() -> Model:
        return _fit(plugin if again is None else again(), data)

    yield _outcome("fits on three domains, validating on one", fit)
    if not fitted:
        return
    model = fitted[0]
    yield _outcome("predicts finite float arrays of (1, B, 32, 2)", lambda: predict(model, query, plugin.name))
    name = f"asked for {SAMPLES} samples, predicts as many, or one"
    yield _outcome(name, lambda: predict(model, query, plugin.name, SAMPLES))
    yield _outcome("predicts the same twice", lambda: _same(model, model, query, plugin.name))
    yield _outcome("leaves the query as it was", lambda: _untouched(model, query, plugin.name))
    yield _outcome("permuted queries give permuted predictions", lambda: _permuted(model, query, plugin.name))
    yield _outcome("adapts to 1 trajectory and predicts", lambda: predict(_adapt(model, data), query, plugin.name))
    yield _outcome("adapting leaves the model as it was", lambda: _unchanged(model, data, query, plugin.name))
    yield _outcome("adapting depends on nothing before", lambda: _forgetful(model, data, query, plugin.name))
    yield _outcome("the same seed gives the same model", lambda: _same(model, refitted(), query, plugin.name))
    yield _outcome("counts its parameters", lambda: parameters(model, plugin.name))


def _outcome(name: str, function: Callable[[], object]) -> Check:
    try:
        function()
    except RunError as error:
        return Check(name, False, str(error))
    return Check(name, True)


def _fit(plugin: ModelPlugin, data: list[Trajectories]) -> Model:
    model = call(plugin.name, lambda: plugin.model(seed=3, device="cpu"))
    setting = Setting(horizon=HORIZON, K=(1,), budget=Budget(steps=STEPS))
    call(f"{plugin.name}.fit", lambda: model.fit(data[:3], data[3:4], setting))
    return model


def _adapt(model: Model, data: list[Trajectories], which: int = -1) -> Model:
    adapted = call("adapt", lambda: model.adapt(copy.deepcopy(data[which].take(slice(1)))))
    if not isinstance(adapted, Model):
        raise RunError(f"adapt returned {type(adapted).__name__}, a Model was asked for")
    return adapted


def _same(one: Model, other: Model, query: Query, name: str) -> None:
    if not np.array_equal(predict(one, query, name).dlo, predict(other, query, name).dlo):
        raise RunError("the predictions differ")


def _untouched(model: Model, query: Query, name: str) -> None:
    given = copy.deepcopy(query)
    call(name, lambda: model.predict(given, 1))
    for field in dataclasses.fields(Query):
        if not np.array_equal(getattr(given, field.name), getattr(query, field.name)):
            raise RunError(f"predict changed query.{field.name}")


def _permuted(model: Model, query: Query, name: str) -> None:
    order = np.random.default_rng(0).permutation(len(query))
    whole, shuffled = predict(model, query, name).dlo[:, order], predict(model, query.take(order), name).dlo
    if not np.allclose(whole, shuffled, atol=1e-5):  # m; kernels round by position in the batch
        raise RunError(f"they differ by up to {np.abs(whole - shuffled).max():.2g} m")


def _unchanged(model: Model, data: list[Trajectories], query: Query, name: str) -> None:
    before = predict(model, query, name).dlo.copy()
    _adapt(model, data)
    if not np.array_equal(before, predict(model, query, name).dlo):
        raise RunError("its predictions changed")


def _forgetful(model: Model, data: list[Trajectories], query: Query, name: str) -> None:
    first = _adapt(model, data)
    before = predict(first, query, name).dlo.copy()
    other = _adapt(model, data, 0)
    predict(other, query, name)
    if not np.array_equal(before, predict(first, query, name).dlo):
        raise RunError("an adapted model predicts otherwise once another was adapted")
    if not np.array_equal(before, predict(_adapt(model, data), query, name).dlo):
        raise RunError("adapting to the same trajectories gives another model once one was adapted to others")
