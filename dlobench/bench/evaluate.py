"""Scores a fitted model on unseen domains. One road for every kind of model, and no branch for any."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from dlobench.bench import metrics
from dlobench.bench.answers import Misdeed, blame, counted, plain
from dlobench.bench.model import Model
from dlobench.bench.results import CellScore, DomainScore
from dlobench.bench.task import Fit, Scale, Task, supports
from dlobench.domain import WORKSPACE
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Floats, Prediction, Query, Trajectories

Returned = TypeVar("Returned")

FAR = 1000.0  # m, beyond which a prediction is taken for a mistake


def call(what: str, function: Callable[[], Returned]) -> Returned:
    """Calls into a plugin; what it raises becomes a `RunError` that names the error and the line."""
    try:
        return function()
    except Misdeed as error:
        raise RunError(f"{what} {error}") from error
    except (RunError, UsageError) as error:
        raise type(error)(f"{what}: {error}") from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a plugin may raise anything, SystemExit too
        raise RunError(f"{what} {blame(error)}") from error


def predict(model: Model, query: Query, what: str) -> Prediction:
    """Predicts and checks the answer: dlo (1, B, 32, 2) and, if any, bodies (1, B, 3, 3), floats within a kilometre.

    The model gets a copy, so that whatever it does to its query changes no score. Raises `RunError`.
    """
    given, B = copy.deepcopy(query), len(query)
    prediction = call(f"{what}.predict", lambda: model.predict(given, 1))
    bodies = getattr(prediction, "bodies", None)
    _check_form(getattr(prediction, "dlo", None), "dlo", (1, B, *query.dlo.shape[1:2], 2), what)
    if bodies is not None:
        _check_form(bodies, "bodies", (1, *query.bodies.shape), what)
    call(f"{what}.predict", lambda: plain(prediction, given))
    _check_values(prediction.dlo[:, :, query.dlo_mask], "a segment", what)
    if bodies is not None:
        _check_values(bodies[:, :, query.body_mask], "a body", what)
    return prediction


def _check_form(array: object, name: str, wanted: tuple[int, ...], what: str) -> None:
    if not isinstance(array, np.ndarray) or array.shape != wanted or array.dtype.kind != "f":
        got = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise RunError(f"{what}.predict returned {name} of {got}, a float array of {wanted} was asked for")


def _check_values(values: Floats, thing: str, what: str) -> None:
    if not np.isfinite(values).all():
        raise RunError(f"{what}.predict returned values that are not finite")
    farthest = np.abs(values).max(initial=0)
    if farthest > FAR:
        raise RunError(f"{what}.predict returned {thing} {farthest:.3g} m away, in a box of {WORKSPACE} m")


def parameters(model: Model, what: str) -> int:
    """Returns the model's number of parameters; raises `RunError` when it is not a whole number."""
    return call(f"{what}.parameters", lambda: counted(model.parameters()))


def score_domains(
    model: Model,
    *,
    scale: Scale,
    horizon: int,
    K: int,
    domains: Mapping[str, tuple[str, Trajectories]],
    progress: Callable[[int, int], None],
) -> list[DomainScore]:
    """Adapts to K trajectories of every domain (id → its cell and trajectories) and scores its queries."""
    scores = []
    for done, (name, (cell, trajectories)) in enumerate(domains.items()):
        progress(done, len(domains))
        errors = _errors(model, trajectories, scale=scale, horizon=horizon, K=K)
        scores.append(DomainScore(domain=name, cell=cell, **errors))
    progress(len(domains), len(domains))
    return scores


def _errors(model: Model, trajectories: Trajectories, *, scale: Scale, horizon: int, K: int) -> dict[str, Any]:
    """Returns the scores of one domain by name, averaged over its supports."""
    what = type(model).__name__
    query, truth = trajectories.take(slice(scale.support, scale.support + scale.query)).windows(horizon)
    found, adapting, predicting = [], 0.0, 0.0
    for chosen in supports(scale.support, K):
        support = copy.deepcopy(trajectories.take(chosen))  # the model's own: the pool stays as it is
        begin = time.perf_counter()
        adapted = call(f"{what}.adapt", lambda s=support: model.adapt(s)) if K else model  # type: ignore[misc]
        if not isinstance(adapted, Model):
            raise RunError(f"{what}.adapt returned {type(adapted).__name__}, a Model was asked for")
        middle = time.perf_counter()
        prediction = predict(adapted, query, what)
        adapting, predicting = adapting + middle - begin, predicting + time.perf_counter() - middle
        found.append(_scores(prediction, query, truth))
    still, true, mask = query.dlo[..., :2], truth.dlo[0], query.dlo_mask
    return {
        "supports": len(found),
        "windows": len(query),
        "moving": int(metrics.moving(still, true, mask).sum()),
        **{name: None if found[0][name] is None else np.mean([one[name] for one in found]) for name in found[0]},
        "persistence_mse": metrics.mse(still, true, mask),
        "persistence_euclidean": metrics.euclidean(still, true, mask),
        "adapt_seconds": adapting / len(found) if K else 0.0,
        "predict_seconds": predicting / len(found) / len(query),
    }


def _scores(prediction: Prediction, query: Query, truth: Prediction) -> dict[str, Any]:
    """Returns the scores of one prediction by name; None for what there is nothing of."""
    predicted, true, mask = prediction.dlo[0], truth.dlo[0], query.dlo_mask
    bodies = None
    if prediction.bodies is not None and truth.bodies is not None:
        bodies = metrics.pose_error(prediction.bodies[0], truth.bodies[0], query.body_mask)
    return {
        "mse": metrics.mse(predicted, true, mask),
        "euclidean": metrics.euclidean(predicted, true, mask),
        "shape": metrics.shape_error(predicted, true, mask),
        "euclidean_moving": metrics.where_moving(metrics.euclidean, predicted, true, query.dlo[..., :2], mask),
        "body_position": None if bodies is None else bodies.position,
        "body_yaw": None if bodies is None else bodies.angle,
    }


def summarise(task: Task, fit: Fit, K: int, scores: list[DomainScore]) -> CellScore:
    """Returns the scores of a cell, means over its domains."""
    return CellScore(
        id=task.cell_id(fit, K),
        trajectories=fit.trajectories,
        horizon=fit.horizon,
        K=K,
        mse=float(np.mean([s.mse for s in scores])),
        euclidean=float(np.mean([s.euclidean for s in scores])),
        skill=metrics.skill([s.mse for s in scores], [s.persistence_mse for s in scores]),
        domains=scores,
    )
