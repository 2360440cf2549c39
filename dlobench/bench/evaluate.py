"""Scores a fitted model on unseen domains. One road for every kind of model, and no branch for any."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from dlobench.bench import metrics, scoring
from dlobench.bench.answers import Misdeed, blame, counted, plain
from dlobench.bench.model import Model
from dlobench.bench.questions import Domain
from dlobench.bench.record import CellScore, DomainScore
from dlobench.bench.rolling import roll
from dlobench.bench.task import Fit, Task
from dlobench.domain import WORKSPACE
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Floats, Prediction, Query

Returned = TypeVar("Returned")

FAR = 1000.0  # m, beyond which a prediction is taken for a mistake


@dataclass(frozen=True)
class Scored:
    """Holds the scores of one domain, and what the model predicts there after its first support."""

    score: DomainScore
    first: Prediction


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


def predict(model: Model, query: Query, what: str, samples: int = 1) -> Prediction:
    """Predicts and checks the answer: dlo (S, B, 32, 2) and, if any, bodies (S, B, 3, 3), floats within a kilometre.

    S is 1, or the samples that were asked for. The model gets a copy, so that whatever it does to its query changes no
    score. Raises `RunError`.
    """
    given, B = copy.deepcopy(query), len(query)
    prediction = call(f"{what}.predict", lambda: model.predict(given, samples))
    dlo, bodies = getattr(prediction, "dlo", None), getattr(prediction, "bodies", None)
    S = samples if isinstance(dlo, np.ndarray) and dlo.shape[:1] == (samples,) else 1
    _check_form(dlo, "dlo", (S, B, *query.dlo.shape[1:2], 2), what)
    if bodies is not None:
        _check_form(bodies, "bodies", (S, *query.bodies.shape), what)
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


def score_domain(model: Model, domain: Domain, K: int, *, task: Task, fit: Fit) -> dict[int, Scored]:
    """Adapts to K trajectories of a domain and scores its queries, by the number of pushes ahead.

    Scores are means over supports, each of which has a model of its own.
    """
    what, ahead, question = type(model).__name__, task.ahead(fit), domain.question
    query, found, first = question.query, list[dict[int, dict[str, Any]]](), dict[int, Prediction]()
    adapting = predicting = 0.0
    for chosen in domain.supports(K):
        support = copy.deepcopy(chosen)  # the model's own: the pool stays as it is
        begin = time.perf_counter()
        adapted = call(f"{what}.adapt", lambda s=support: model.adapt(s)) if K else model  # type: ignore[misc]
        if not isinstance(adapted, Model):
            raise RunError(f"{what}.adapt returned {type(adapted).__name__}, a Model was asked for")
        middle = time.perf_counter()
        if task.rolled:
            answers = roll(lambda now, m=adapted: predict(m, now, what), query, ahead)  # type: ignore[misc]
        else:
            answers = {fit.horizon: predict(adapted, query, what, task.samples)}
        adapting, predicting = adapting + middle - begin, predicting + time.perf_counter() - middle
        first = first or answers
        found.append({n: _scores(answer, domain, n, task) for n, answer in answers.items()})
    asked = len(found) * len(query) * (max(ahead) if task.rolled else 1)
    times = {"adapt_seconds": adapting / len(found) if K else 0.0, "predict_seconds": predicting / asked}
    out = {}
    for n in ahead:
        still = scoring.still(question.truths[n], question.start, query.dlo[..., :2], query.dlo_mask)
        scores = {"supports": len(found), **still, **_means([each[n] for each in found]), **times}
        out[n] = Scored(DomainScore(domain=domain.name, cell=domain.cell, **_rounded(scores)), first[n])
    return out


def _scores(answer: Prediction, domain: Domain, n: int, task: Task) -> dict[str, Any]:
    """Returns the scores of one prediction by name; None for what there is nothing of."""
    question = domain.question
    mask, truth = question.query.dlo_mask, question.truths[n]
    scores = scoring.point(answer, truth, question.start, (mask, question.query.body_mask))
    if task.rolled:
        scores |= scoring.valid(answer, mask)
    if task.futures is not None:
        scores |= scoring.spread(answer, truth, question.start, mask, f"{domain.name} {n}")
    return scores


def _means(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns the means over supports; histograms, of which there is one support, as they are."""
    first = found[0]
    return {
        name: value if value is None or isinstance(value, list) else np.mean([one[name] for one in found])
        for name, value in first.items()
    }


def _rounded(scores: dict[str, Any]) -> dict[str, Any]:
    """Returns scores as records hold them, numbers to nine digits: what is averaged is what is recorded."""
    return {name: float(f"{value:.9g}") if isinstance(value, float) else value for name, value in scores.items()}


def summarise(task: Task, fit: Fit, K: int, horizon: int, scores: list[DomainScore]) -> CellScore:
    """Returns the scores of a cell, means over its domains."""
    energies = [s.energy for s in scores if s.energy is not None]
    if energies:
        skill = metrics.skill(energies, [s.persistence_energy or 0.0 for s in scores])
    else:
        skill = metrics.skill([s.mse for s in scores], [s.persistence_mse for s in scores])
    return CellScore(
        id=task.cell_id(fit, K, horizon),
        trajectories=fit.trajectories,
        horizon=horizon,
        K=K,
        without=fit.without,
        mse=float(np.mean([s.mse for s in scores])),
        euclidean=float(np.mean([s.euclidean for s in scores])),
        energy=float(np.mean(energies)) if energies else None,
        skill=skill,
        domains=scores,
    )
