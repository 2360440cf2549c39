"""Tests the evaluator on a toy world whose truth is known, with models whose errors are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from dlobench.bench import questions
from dlobench.bench.evaluate import score_domain, summarise
from dlobench.bench.model import Model, Setting
from dlobench.bench.plugins import load_task
from dlobench.bench.record import CellScore
from dlobench.bench.task import Fit, Scale
from dlobench.domain import MAX_BODIES, MAX_BOXES, MAX_SEGMENTS
from dlobench.errors import RunError
from dlobench.trajectories import Prediction, Query, Trajectories

HORIZON, PUSHES, SEGMENTS = 3, 5, 20
SCALE = Scale(trajectories=(20,), support=12, query=4, K=(0, 1, 4, 12))
FIT = Fit(20, HORIZON)
TASK = load_task("meta")
UNIT = 2**-10  # m; sums of it are exact


def world(seed: int, trajectories: int = 20) -> Trajectories:
    """Makes a domain in which the rod follows the pusher exactly; bodies[:, :, 0, 0] holds the trajectory's number."""
    rng = np.random.default_rng(seed)
    K, mask = trajectories, np.arange(MAX_SEGMENTS) < SEGMENTS
    actions = rng.integers(-20, 21, size=(K, PUSHES, 2)) * UNIT
    pusher = np.concatenate([np.zeros((K, 1, 2)), actions.cumsum(1)], axis=1)
    dlo = np.zeros((K, PUSHES + 1, MAX_SEGMENTS, 3))
    dlo[:, :, mask, :2] = pusher[:, :, None] + UNIT * np.arange(SEGMENTS)[:, None]
    bodies = np.zeros((K, PUSHES + 1, MAX_BODIES, 3))
    bodies[:, :, 0, 0] = np.arange(K)[:, None]
    f = np.float32
    return Trajectories(
        dlo=dlo.astype(f), dlo_mask=mask, pusher=pusher.astype(f), bodies=bodies.astype(f),
        body_mask=np.arange(MAX_BODIES) < 1, boxes=np.zeros((MAX_BODIES, MAX_BOXES, 5), f),
        commanded=np.zeros_like(actions, f), executed=actions.astype(f),
    )  # fmt: skip


DOMAINS = {"toy/00001": ("soft", world(1)), "toy/00002": ("flexible", world(2))}


@dataclass
class Oracle(Model):
    """Knows the toy world, and errs by `offset` in x."""

    offset: float = 0.0  # m
    seen: list[list[int]] = field(default_factory=list)  # trajectories of every support
    asked: set[int] = field(default_factory=set)  # trajectories of every query

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Learns nothing."""

    def predict(self, query: Query, samples: int) -> Prediction:
        assert samples == 1
        self.asked |= {int(i) for i in query.bodies[:, 0, 0]}
        dlo = query.dlo[..., :2] + query.actions.sum(1)[:, None]
        dlo[..., 0] += self.offset
        dlo[:, ~query.dlo_mask] = 99  # padding never counts
        return Prediction(dlo=dlo[None])


def score(model: Model, K: int) -> CellScore:
    """Scores a model on the toy domains."""
    scores = [
        score_domain(model, questions.domain(name, cell, there, task=TASK, scale=SCALE, fit=FIT), K, task=TASK, fit=FIT)
        for name, (cell, there) in DOMAINS.items()
    ]
    return summarise(TASK, FIT, K, HORIZON, [each[HORIZON].score for each in scores])


def persistence(trajectories: Trajectories) -> tuple[float, float]:
    """Computes MSE and mean distance of standing still from the actions alone, query by query."""
    squares, distances = [], []
    for actions in trajectories.executed[12:16].astype(float):
        for start in range(PUSHES - HORIZON + 1):
            x, y = actions[start : start + HORIZON].sum(0)
            squares += [x**2, y**2]
            distances.append((x**2 + y**2) ** 0.5)
    return sum(squares) / len(squares), sum(distances) / len(distances)


def test_a_perfect_model_has_no_error_and_skill_1() -> None:
    cell = score(Oracle(), 0)
    assert (cell.mse, cell.euclidean, cell.skill) == (0, 0, 1)
    assert (cell.id, cell.K, cell.horizon, cell.trajectories) == ("meta/trajectories20-h3-k0", 0, HORIZON, 20)


@pytest.mark.parametrize("K", [0, 1, 4, 12])
def test_a_known_offset_gives_known_scores(K: int) -> None:
    offset = 8 * UNIT
    cell = score(Oracle(offset=offset), K)
    assert cell.mse == pytest.approx(offset**2 / 2, rel=1e-8), "one coordinate of two is off; records have nine digits"
    assert cell.euclidean == pytest.approx(offset, rel=1e-8)
    still = [persistence(trajectories) for _, trajectories in DOMAINS.values()]
    assert cell.skill == pytest.approx(1 - 2 * cell.mse / sum(mse for mse, _ in still))
    for found, (name, (where, _)), (mse, euclidean) in zip(cell.domains, DOMAINS.items(), still, strict=True):
        assert (found.domain, found.cell) == (name, where)
        assert found.windows == 4 * (PUSHES - HORIZON + 1)
        assert (found.mse, found.euclidean) == (cell.mse, cell.euclidean)
        assert (found.persistence_mse, found.persistence_euclidean) == pytest.approx((mse, euclidean))


def test_moving_windows_and_bodies_are_scored_apart() -> None:
    class Turned(Oracle):
        def predict(self, query: Query, samples: int) -> Prediction:
            right = super().predict(query, samples)
            bodies = query.bodies.copy()
            bodies[..., :2] += [3 * UNIT, 4 * UNIT]
            bodies[..., 2] += 2 * np.pi - 0.25
            bodies[:, 1:] = np.nan  # of the bodies only one exists
            return Prediction(dlo=right.dlo, bodies=bodies[None])

    (one, other) = score(Turned(offset=UNIT), 0).domains
    assert one.body_position == pytest.approx(5 * UNIT, rel=1e-4)
    assert one.body_yaw == other.body_yaw == pytest.approx(0.25, rel=1e-4)
    assert one.shape == one.euclidean == one.euclidean_moving == pytest.approx(UNIT, rel=1e-8)
    assert 0 < one.moving <= one.windows
    assert score(Oracle(), 0).domains[0].body_position is None


@pytest.mark.parametrize("bodies", [np.zeros((1, 12, 2, 3)), np.zeros((12, 3, 3)), np.zeros((1, 12, 3, 3), int)])
def test_bodies_of_a_wrong_form_are_named(bodies: Any) -> None:
    class Wrong(Oracle):
        def predict(self, query: Query, samples: int) -> Prediction:
            return Prediction(dlo=super().predict(query, samples).dlo, bodies=bodies)

    with pytest.raises(RunError, match=r"Wrong.predict returned bodies of .*a float array of \(1, 12, 3, 3\)"):
        score(Wrong(), 0)


def test_standing_still_has_skill_0() -> None:
    class Still(Oracle):
        def predict(self, query: Query, samples: int) -> Prediction:
            return Prediction(dlo=query.dlo[None, ..., :2].copy())

    cell = score(Still(), 0)
    assert cell.skill == 0
    assert cell.mse == pytest.approx(np.mean([persistence(t)[0] for _, t in DOMAINS.values()]))


class Adapting(Oracle):
    """Errs by as many units as its support's first trajectory says, after adapting."""

    def adapt(self, support: Trajectories) -> Model:
        numbers = [int(i) for i in support.bodies[:, 0, 0, 0]]
        self.seen.append(numbers)
        return Oracle(offset=numbers[0] * UNIT, asked=self.asked)


@pytest.mark.parametrize(("K", "supports"), [(1, 10), (2, 6), (4, 3), (5, 2), (12, 1)])
def test_scores_are_averaged_over_disjoint_supports(K: int, supports: int) -> None:
    model = Adapting()
    cell = score(model, K)
    assert len(model.seen) == supports * len(DOMAINS)
    for seen in (model.seen[:supports], model.seen[supports:]):
        assert [number for support in seen for number in support] == list(range(K * supports)), "disjoint and whole"
    assert [domain.supports for domain in cell.domains] == [supports] * 2
    offsets = [number[0] * UNIT for number in model.seen[:supports]]
    assert cell.mse == pytest.approx(np.mean([offset**2 / 2 for offset in offsets]))
    assert cell.euclidean == pytest.approx(np.mean(offsets))
    assert all(domain.adapt_seconds > 0 and domain.predict_seconds > 0 for domain in cell.domains)


@pytest.mark.parametrize("K", SCALE.K)
def test_queries_are_the_same_for_every_support_and_never_in_a_support(K: int) -> None:
    model = Adapting()
    score(model, K)
    assert model.asked == {12, 13, 14, 15}
    assert not model.asked & {number for support in model.seen for number in support}


def test_without_support_nothing_adapts() -> None:
    class Fixed(Oracle):
        def adapt(self, support: Trajectories) -> Model:
            raise AssertionError

    cell = score(Fixed(), 0)
    assert (cell.domains[0].adapt_seconds, cell.domains[0].supports) == (0, 1)


Answer = Callable[[Prediction, Query], Any]


def fill(value: float) -> Answer:
    """Returns an answer with one wrong number."""

    def answer(right: Prediction, query: Query) -> Prediction:
        dlo = right.dlo.copy()
        dlo[0, -1, 7, 1] = value
        return Prediction(dlo=dlo)

    return answer


WRONG: dict[str, tuple[Answer, str]] = {
    "nan": (fill(np.nan), "not finite"),
    "inf": (fill(np.inf), "not finite"),
    "no samples": (lambda right, query: Prediction(dlo=right.dlo[0]), r"\(12, 32, 2\).*\(1, 12, 32, 2\)"),
    "two samples": (lambda right, query: Prediction(dlo=right.dlo.repeat(2, 0)), r"\(2, 12, 32, 2\)"),
    "yaw": (lambda right, query: Prediction(dlo=query.dlo[None].copy()), r"\(1, 12, 32, 3\)"),
    "one short": (lambda right, query: Prediction(dlo=right.dlo[:, 1:]), r"\(1, 11, 32, 2\)"),
    "integers": (lambda right, query: Prediction(dlo=right.dlo.astype(int)), "int64"),
    "objects": (lambda right, query: Prediction(dlo=right.dlo.astype(object)), "object"),
    "list": (lambda right, query: Prediction(dlo=right.dlo.tolist()), "list"),
    "array": (lambda right, query: right.dlo, "NoneType"),
    "none": (lambda right, query: None, "NoneType"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_answer_is_named(what: str) -> None:
    answer, message = WRONG[what]

    class Wrong(Oracle):
        def predict(self, query: Query, samples: int) -> Prediction:
            right = super().predict(query, samples)
            wrong: Prediction = answer(right, query)
            return wrong

    with pytest.raises(RunError, match=message) as error:
        score(Wrong(), 0)
    assert "Wrong.predict" in str(error.value)


def test_values_in_padding_may_be_anything() -> None:
    class Padded(Oracle):
        def predict(self, query: Query, samples: int) -> Prediction:
            dlo = super().predict(query, samples).dlo
            dlo[:, :, SEGMENTS:] = np.nan
            return Prediction(dlo=dlo)

    assert score(Padded(), 0).mse == 0


def test_what_a_model_raises_is_named_with_its_line() -> None:
    class Raises(Oracle):
        def predict(self, query: Query, samples: int) -> Prediction:
            raise IndexError("the moon")

    with pytest.raises(RunError, match="the moon") as error:
        score(Raises(), 0)
    line = Raises.predict.__code__.co_firstlineno + 1
    assert all(part in str(error.value) for part in ("Raises.predict", "IndexError", f"test_evaluate.py:{line}"))


def test_the_line_is_the_plugins_even_where_a_library_raises() -> None:
    class Raises(Oracle):
        def predict(self, query: Query, samples: int) -> Prediction:
            np.stack([np.zeros(2), np.zeros(3)])
            raise AssertionError

    with pytest.raises(RunError, match="ValueError") as error:
        score(Raises(), 0)
    assert f"test_evaluate.py:{Raises.predict.__code__.co_firstlineno + 1}" in str(error.value)


def test_what_adapt_raises_is_named() -> None:
    class Raises(Oracle):
        def adapt(self, support: Trajectories) -> Model:
            raise RuntimeError("diverged")

    with pytest.raises(RunError, match=r"Raises\.adapt raised RuntimeError at test_evaluate\.py:\d+: diverged"):
        score(Raises(), 1)


@pytest.mark.parametrize("returned", [None, 3, Oracle], ids=str)
def test_an_adapt_that_returns_no_model_is_named(returned: Any) -> None:
    class Forgets(Oracle):
        def adapt(self, support: Trajectories) -> Model:
            model: Model = returned
            return model

    with pytest.raises(RunError, match=r"Forgets\.adapt returned"):
        score(Forgets(), 1)


def test_a_plugin_cannot_leave_the_program() -> None:
    class Leaves(Oracle):
        def predict(self, query: Query, samples: int) -> Prediction:
            raise SystemExit(0)

    with pytest.raises(RunError, match="SystemExit"):
        score(Leaves(), 0)


def test_enormous_predictions_are_a_failed_run() -> None:
    with pytest.raises(RunError, match="Wild"):

        class Wild(Oracle):
            def predict(self, query: Query, samples: int) -> Prediction:
                return Prediction(dlo=np.full((1, *query.dlo.shape[:2], 2), 1e200))

        score(Wild(), 0)


def test_writing_into_the_query_gains_nothing() -> None:
    class Cheats(Oracle):
        def predict(self, query: Query, samples: int) -> Prediction:
            right = super().predict(query, samples)
            if query.dlo.flags.writeable:
                query.dlo[:] = 1e3
            return replace(right)

    honest, cheating = score(Oracle(offset=UNIT), 4), score(Cheats(offset=UNIT), 4)
    assert (cheating.skill, cheating.mse) == (honest.skill, honest.mse)


def test_writing_into_the_support_reaches_no_other_model() -> None:
    class Scribbles(Oracle):
        def adapt(self, support: Trajectories) -> Model:
            if support.dlo.flags.writeable:
                support.dlo[:] = 1e3
            return self

    before = {name: trajectories.dlo.copy() for name, (_, trajectories) in DOMAINS.items()}
    try:
        score(Scribbles(), 1)
        assert all(np.array_equal(before[name], DOMAINS[name][1].dlo) for name in before)
    finally:
        for name, (_, trajectories) in DOMAINS.items():
            trajectories.dlo[:] = before[name]
