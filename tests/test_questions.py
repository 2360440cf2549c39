"""Tests what models are asked: futures, rollouts, noisy measurements, and what training leaves out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toy import toy_domains

from dlobench.bench import questions
from dlobench.bench.evaluate import score_domain
from dlobench.bench.model import Model, Setting
from dlobench.bench.plugins import load_task
from dlobench.bench.questions import asked, measured
from dlobench.bench.regions import Region
from dlobench.bench.rolling import poses, roll
from dlobench.bench.task import Fit, Noise, Scale
from dlobench.data.domain_set import SCALES, ScaleName
from dlobench.errors import UsageError
from dlobench.trajectories import Prediction, Query, Trajectories

(TOY,) = toy_domains(1, trajectories=12, pushes=9)
NOISE = Noise(position=0.002, yaw=0.1)


class Still(Model):
    """Stands still."""

    def fit(self, train: object, valid: object, setting: Setting) -> None:
        """Learns nothing."""

    def predict(self, query: Query, samples: int) -> Prediction:
        return Prediction(dlo=query.dlo[None, ..., :2].copy())


@given(ahead=st.sets(st.integers(1, 9), min_size=1).map(lambda found: tuple(sorted(found))))
@settings(max_examples=20, deadline=None)
def test_every_horizon_is_asked_from_the_same_moments(ahead: tuple[int, ...]) -> None:
    question = asked(TOY, TOY, ahead)
    starts = 9 - max(ahead) + 1
    assert question.query.horizon == max(ahead)
    assert set(question.truths) == set(ahead)
    for n in ahead:
        for k in (0, 11):
            for t in range(starts):
                row = k * starts + t
                assert np.array_equal(question.truths[n].dlo[0, row], TOY.dlo[k, t + n, :, :2])
                assert np.array_equal(question.start[row], TOY.dlo[k, t, :, :2])
                assert np.array_equal(question.query.actions[row], TOY.executed[k, t : t + max(ahead)])


def test_measurements_are_noisy_and_the_truth_is_not() -> None:
    task = replace(load_task("meta"), noise=NOISE)
    scale, fit = Scale(trajectories=(1,), support=6, query=6, K=(0,)), Fit(1, 4)
    domain = questions.domain("toy/00001", "soft", TOY, task=task, scale=scale, fit=fit)
    clean, truth = TOY.take(slice(6, 12)).windows(4)
    assert np.array_equal(domain.question.truths[4].dlo, truth.dlo)
    assert np.array_equal(domain.question.start, clean.dlo[..., :2])
    assert not np.array_equal(domain.question.query.dlo, clean.dlo)
    assert np.array_equal(domain.question.query.pusher, clean.pusher)
    assert np.array_equal(domain.question.query.actions, clean.actions)
    (support,) = domain.supports(6)
    assert not np.array_equal(support.dlo, TOY.dlo[:6])
    scored = score_domain(Still(), domain, 0, task=task, fit=fit)[4].score
    assert scored.mse == scored.persistence_mse, "persistence predicts what was measured"
    assert scored.mse > np.mean((clean.dlo[:, clean.dlo_mask, :2] - truth.dlo[0][:, clean.dlo_mask]) ** 2)


def test_noise_has_the_spread_that_it_says_and_leaves_padding() -> None:
    (many,) = toy_domains(1, trajectories=100, pushes=9)
    noise = measured(many, NOISE, "toy/00001").dlo - many.dlo
    assert not noise[:, :, ~many.dlo_mask].any()
    valid = noise[:, :, many.dlo_mask]
    assert valid.std(axis=(0, 1, 2)) == pytest.approx([0.002, 0.002, 0.1], rel=0.05)
    assert valid.mean(axis=(0, 1, 2)) == pytest.approx([0, 0, 0], abs=2e-3)
    one, other = valid[:, :-1].ravel(), valid[:, 1:].ravel()
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.02, "moments err independently"


def test_noise_belongs_to_the_trajectory_not_to_how_many_are_read() -> None:
    few = measured(TOY.take(slice(4)), NOISE, "toy/00001")
    assert np.array_equal(few.dlo, measured(TOY, NOISE, "toy/00001").dlo[:4])
    assert not np.array_equal(few.dlo, measured(TOY.take(slice(4)), NOISE, "toy/00002").dlo)


def test_futures_are_asked_by_command_and_scored_against_every_execution() -> None:
    task = load_task("distribution")
    R = task.set_of("test").executions
    (many,) = toy_domains(1, trajectories=2 * R, pushes=8)
    first = np.repeat(np.array([0, R]), R)
    many = replace(
        many,
        dlo=np.concatenate([many.dlo[first, :1], many.dlo[:, 1:]], axis=1),
        commanded=many.commanded[first] + np.float32(0.5),
    )
    fit = Fit(50, 4, 0)
    domain = questions.domain("distribution/00000", "soft", many, task=task, scale=task.mini, fit=fit)
    question = domain.question
    assert question.query.actions.shape == (2, 4, 2)
    assert np.array_equal(question.query.actions, many.commanded[[0, R], :4])
    assert question.truths[4].dlo.shape == (R, 2, 32, 2)
    assert np.array_equal(question.truths[4].dlo[:, 1], many.dlo[R:, 4, :, :2])
    scored = score_domain(Still(), domain, 0, task=task, fit=fit)[4].score
    assert scored.energy == scored.persistence_energy
    assert scored.coverage90 is None, "one sample has no spread"


def test_samples_of_the_truth_score_as_the_floor_says() -> None:
    task = load_task("distribution")
    R = task.set_of("test").executions
    rng = np.random.default_rng(0)
    (many,) = toy_domains(1, trajectories=R, pushes=8)
    dlo = np.repeat(many.dlo[:1], R, axis=0)
    dlo[:, 1:, many.dlo_mask, :2] += rng.normal(scale=0.003, size=(R, 8, 1, 2)).astype(np.float32)
    many = replace(many, dlo=dlo)
    domain = questions.domain("distribution/00000", "soft", many, task=task, scale=task.mini, fit=Fit(50, 1, 0))

    class Knows(Still):
        def predict(self, query: Query, samples: int) -> Prediction:
            assert samples == 99
            noise = rng.normal(scale=0.003, size=(samples, len(query), 1, 2))
            shapes = np.repeat(domain.question.start[None], samples, axis=0) + noise
            return Prediction(dlo=shapes + moved)

    moved = domain.question.truths[1].dlo.mean(axis=0) - domain.question.start
    scored = score_domain(Knows(), domain, 0, task=task, fit=Fit(50, 1, 0))[1].score
    assert scored.energy is not None
    assert scored.energy_floor is not None
    assert scored.persistence_energy is not None
    assert scored.energy == pytest.approx(scored.energy_floor, rel=0.15)
    assert scored.coverage90 == pytest.approx(0.9, abs=0.1)
    assert sum(scored.ranks or []) == R * 20 * 2
    assert sum(scored.shape_ranks or []) == R


def test_a_rollout_feeds_a_model_what_it_said() -> None:
    query = TOY.windows(5)[0]

    def follow(now: Query) -> Prediction:
        assert now.horizon == 1
        return Prediction(dlo=(now.dlo[..., :2] + now.actions[:, :1])[None])

    found = roll(follow, query, (1, 3, 5))
    assert list(found) == [1, 3, 5]
    for n, prediction in found.items():
        wanted = query.dlo[..., :2] + query.actions[:, :n].sum(axis=1, keepdims=True)
        assert prediction.dlo[0][:, query.dlo_mask] == pytest.approx(wanted[:, query.dlo_mask], abs=1e-6)


def test_a_rollout_moves_the_pusher_and_leaves_bodies_alone() -> None:
    query, seen = TOY.windows(3)[0], list[Query]()

    def watch(now: Query) -> Prediction:
        seen.append(now)
        return Prediction(dlo=now.dlo[None, ..., :2].copy())

    roll(watch, query, (3,))
    assert seen[2].pusher == pytest.approx(query.pusher + query.actions[:, :2].sum(axis=1), abs=1e-6)
    assert np.array_equal(seen[2].bodies, query.bodies)
    assert np.array_equal(seen[2].actions[:, 0], query.actions[:, 2])


@given(yaw=st.floats(-3.1, 3.1))
def test_poses_of_a_straight_rod_have_its_yaw(yaw: float) -> None:
    mask = np.arange(32) < 20
    along = np.where(mask, np.arange(32) * 0.005, 0)
    dlo = (along[:, None] * [np.cos(yaw), np.sin(yaw)])[None].astype(np.float32)
    out = poses(dlo, mask)
    assert out[0, mask, 2] == pytest.approx(yaw, abs=1e-3)
    assert not out[0, ~mask].any()


@pytest.mark.parametrize("scale", SCALES)
def test_what_is_left_out_is_tested_and_nothing_else_is_trained_on(scale: ScaleName) -> None:
    task = load_task("ood")
    spans, of = task.spans(scale), task.of
    everything = {s.domain for s in spans["test"]}
    for fit in task.fits(scale)[:: 1 if scale != "paper" else 4]:
        parts = task.parts(spans, fit)
        train, valid, test = ({s.domain for s in parts[part]} for part in ("train", "valid", "test"))
        assert train
        assert valid
        assert test
        assert not train & test
        assert not valid & test
        if fit.without is None:
            assert test == everything
            continue
        region = next(each for each in task.left_out if each.name == fit.without)
        assert all(region.holds(of, index) for index in test)
        assert not any(region.holds(of, index) for index in train | valid)
        assert all(not region.holds(of, index) for index in everything - test)


def test_regions_are_values_or_ends_of_a_range() -> None:
    of = load_task("ood").of
    middle = Region("friction", "surface_friction", outside=(0.0, 1.0))
    assert not any(middle.holds(of, index) for index in range(20))
    assert all(Region("all", "material", ("soft", "flexible", "elastoplastic")).holds(of, i) for i in range(20))


def test_what_needs_a_simulator_is_refused_of_imported_sets() -> None:
    for name, missing in (("distribution", "executed again"), ("ood", "parameters of domains")):
        with pytest.raises(UsageError, match=missing):
            load_task(name).on(None)  # type: ignore[arg-type]


def test_a_rollout_takes_no_horizon() -> None:
    from dlobench.bench.order import order
    from dlobench.bench.plugins import load_model

    with pytest.raises(UsageError, match="rollout scores every horizon of one fit"):
        order(load_task("rollout"), "mini", load_model("persistence"), None, 4)


def test_valid_windows_of_trajectories_of_a_noisy_task_are_noisy() -> None:
    one: Trajectories = measured(TOY, NOISE, "a")
    assert one.dlo.dtype == np.float32
    assert one.bodies.dtype == np.float32
