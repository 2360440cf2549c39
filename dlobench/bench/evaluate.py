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
from dlobench.trajectories import Prediction, Query, Trajectories

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
    """Predicts and checks the answer: (1, B, 32, 2) floats within a kilometre; raises `RunError` otherwise.

    The model gets a copy, so that whatever it does to its query changes no score.
    """
    given = copy.deepcopy(query)
    prediction = call(f"{what}.predict", lambda: model.predict(given, 1))
    call(f"{what}.predict", lambda: plain(prediction, given))
    dlo, wanted = getattr(prediction, "dlo", None), (1, *query.dlo.shape[:2], 2)
    if not isinstance(dlo, np.ndarray) or dlo.shape != wanted or dlo.dtype.kind != "f":
        got = f"{dlo.dtype} {dlo.shape}" if isinstance(dlo, np.ndarray) else type(dlo).__name__
        raise RunError(f"{what}.predict returned dlo of {got}, a float array of {wanted} was asked for")
    valid = dlo[:, :, query.dlo_mask]
    if not np.isfinite(valid).all():
        raise RunError(f"{what}.predict returned values that are not finite")
    if np.abs(valid).max(initial=0) > FAR:
        raise RunError(f"{what}.predict returned a segment {np.abs(valid).max():.3g} m away, in a box of {WORKSPACE} m")
    return prediction


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
    true, mask = truth.dlo[0], query.dlo_mask
    errors, adapting, predicting = [], 0.0, 0.0
    for chosen in supports(scale.support, K):
        support = copy.deepcopy(trajectories.take(chosen))  # the model's own: the pool stays as it is
        begin = time.perf_counter()
        adapted = call(f"{what}.adapt", lambda s=support: model.adapt(s)) if K else model  # type: ignore[misc]
        if not isinstance(adapted, Model):
            raise RunError(f"{what}.adapt returned {type(adapted).__name__}, a Model was asked for")
        middle = time.perf_counter()
        predicted = predict(adapted, query, what).dlo[0]
        adapting, predicting = adapting + middle - begin, predicting + time.perf_counter() - middle
        errors.append((metrics.mse(predicted, true, mask), metrics.euclidean(predicted, true, mask)))
    mse, euclidean = np.mean(errors, axis=0)
    still = query.dlo[..., :2]
    return {
        "supports": len(errors),
        "windows": len(query),
        "mse": mse,
        "euclidean": euclidean,
        "persistence_mse": metrics.mse(still, true, mask),
        "persistence_euclidean": metrics.euclidean(still, true, mask),
        "adapt_seconds": adapting / len(errors) if K else 0.0,
        "predict_seconds": predicting / len(errors) / len(query),
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
