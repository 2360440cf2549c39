"""Tests models that sample: their samples spread as what they were fitted to does, and are the same each time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from test_nn import load
from toy import toy_domains

from dlobench.bench.model import Setting
from dlobench.bench.questions import commanded
from dlobench.errors import RunError
from dlobench.nn.budget import Budget, Log
from dlobench.nn.execution import noise_root
from dlobench.nn.fit import Plan, descend
from dlobench.nn.missed import NUMBERS, Missed, Residual, divided
from dlobench.trajectories import Trajectories

gaussian, noisy, flow, cvae = load("mlp_gaussian"), load("gnn_noise"), load("flow"), load("cvae")
SETTING = Setting(horizon=2, K=(0,), budget=Budget(steps=30))
S = 400


@pytest.fixture(scope="module")
def domains() -> list[Trajectories]:
    return toy_domains(3, trajectories=30)


def fitted(of: Any, train: list[Trajectories], valid: list[Trajectories]) -> Any:
    model = of(seed=5)
    model.fit(train, valid, SETTING)
    return model


def test_residuals_of_validation_windows_and_samples_have_the_same_covariance(domains: list[Trajectories]) -> None:
    model = fitted(gaussian.MlpGaussian, domains[:2], domains[2:])
    query, truth = domains[2].windows(2)
    missed = (truth.dlo[0] - model.predict(query, 1).dlo[0])[:, query.dlo_mask].reshape(len(query), -1)
    samples = model.predict(query, S).dlo - model.predict(query, 1).dlo
    drawn = samples[:, 0][:, query.dlo_mask].reshape(S, -1)
    expected, found = missed.T @ missed / len(missed), drawn.T @ drawn / S
    assert np.trace(found) == pytest.approx(np.trace(expected), rel=0.2)
    assert np.linalg.norm(found - expected) < 0.3 * np.linalg.norm(expected)
    np.testing.assert_allclose(samples[:, 0], samples[:, -1], atol=1e-6, err_msg="all queries have the same noise")


def test_a_spread_needs_validation(domains: list[Trajectories]) -> None:
    with pytest.raises(RunError, match="needs validation trajectories"):
        fitted(gaussian.MlpGaussian, domains, [])


def test_an_action_that_is_not_finite_is_told(domains: list[Trajectories]) -> None:
    executed = domains[0].executed.copy()
    executed[0, 0, 0] = np.nan
    with pytest.raises(RunError, match="not finite"):
        noise_root([replace(domains[0], executed=executed), *domains[1:]])


def test_noise_is_what_was_executed_beyond_the_command(domains: list[Trajectories]) -> None:
    rng = np.random.default_rng(0)
    root = np.array([[6e-4, 0.0], [3e-4, 4e-4]])
    told = []
    for domain in domains:
        went = np.diff(domain.pusher, axis=1)
        command = (went - rng.standard_normal(went.shape) @ root.T).astype(np.float32)
        told.append(commanded(replace(domain, commanded=command)))
    model = fitted(noisy.GnnNoise, told[:2], told[2:])
    covariance = (model.factor @ model.factor.T).numpy()
    np.testing.assert_allclose(covariance, root @ root.T, atol=0.2 * 3.6e-7)
    query, _ = told[2].windows(2)
    few = query.take(np.arange(3))
    samples = model.predict(few, 5)
    draws = torch.randn(5, 2, 2, generator=torch.Generator().manual_seed(5)) @ model.factor.T
    for s in range(5):
        alone = model.predict(replace(few, actions=few.actions + draws[s].numpy()), 1)
        np.testing.assert_allclose(samples.dlo[s], alone.dlo[0], atol=1e-6)


def test_samples_are_alike_where_what_is_executed_is_known(domains: list[Trajectories]) -> None:
    exact = [replace(domain, executed=np.diff(domain.pusher, axis=1)) for domain in domains]
    model = fitted(noisy.GnnNoise, exact[:2], exact[2:])
    query, _ = exact[2].windows(2)
    samples = model.predict(query, 4).dlo
    np.testing.assert_allclose(samples, samples[:1].repeat(4, 0), atol=1e-7)


@pytest.mark.parametrize("of", [gaussian.MlpGaussian, noisy.GnnNoise, flow.Flow, cvae.Cvae])
def test_samples_are_the_same_each_time_and_depend_on_no_other_query(of: Any, domains: list[Trajectories]) -> None:
    model = fitted(of, domains[:2], domains[2:])
    query, _ = domains[2].windows(2)
    once, again = model.predict(query, 7).dlo, model.predict(query, 7).dlo
    assert once.shape == (7, len(query), 32, 2)
    assert np.array_equal(once, again)
    order = np.random.default_rng(0).permutation(len(query))
    np.testing.assert_allclose(model.predict(query.take(order), 7).dlo, once[:, order], atol=1e-6)
    assert not once[:, :, ~query.dlo_mask].any()


def learned(residual: Residual, of: Missed, *, steps: int) -> Residual:
    generator = torch.Generator().manual_seed(0)

    def loss() -> torch.Tensor:
        index = torch.randint(len(of.shape), (128,), generator=generator)
        return residual.loss(Missed(of.hidden[index], of.exists[index], of.shape[index]), generator)

    plan = Plan(steps, 3e-3, patience=steps, cosine=True, clip=1.0)
    descend(list(residual.parameters()), loss, None, plan=plan, budget=Budget(), log=Log())
    return residual


@pytest.mark.parametrize(
    "make", [lambda of: flow.Velocity(of, 32, 8), lambda of: cvae.Autoencoder(of, 32, 2)], ids=["flow", "cvae"]
)
def test_whole_shapes_of_two_kinds_are_drawn_not_their_mean(make: Any) -> None:
    """A DLO snaps to one side or the other, more often to the one that the state tells."""
    generator = torch.Generator().manual_seed(1)
    P, N = 4000, 8
    hidden = torch.randn(P, 1, 3, generator=generator).sign().expand(P, N, 3)
    chance = torch.where(hidden[:, 0, 0] > 0, 0.8, 0.2)
    side = torch.where(torch.rand(P, generator=generator) < chance, 1.0, -1.0)
    shape = side[:, None, None] * torch.ones(P, N, 2) + 0.1 * torch.randn(P, N, 2, generator=generator)
    torch.manual_seed(0)
    model = learned(
        make(Missed(hidden, torch.ones(P, N, 1), shape)), Missed(hidden, torch.ones(P, N, 1), shape), steps=500
    )
    for told, share in ((1.0, 0.8), (-1.0, 0.2)):
        noise = torch.randn(600, model.numbers, generator=generator)
        with torch.no_grad():
            drawn = model.draw(torch.full((600, N, 3), told), torch.ones(600, N, 1), noise).mean(-1)
        whole = (drawn > 0).all(1) | (drawn < 0).all(1)
        assert whole.float().mean() > 0.9, "all segments go to the same side"
        assert float((drawn.mean(1) > 0).float().mean()) == pytest.approx(share, abs=0.12)
        assert float(drawn.abs().mean()) == pytest.approx(1.0, abs=0.15)


def test_noise_of_the_flow_is_spread_as_what_is_missed_of_shorter_shapes_too() -> None:
    generator = torch.Generator().manual_seed(1)
    exists = torch.ones(3000, 32, 1)
    exists[::2, 20:] = 0  # every other DLO has 20 segments
    along = torch.linspace(0.5, 2, 32)[:, None]
    shape = torch.randn(3000, 1, 1, generator=generator) * along * exists
    model = flow.Velocity(Missed(torch.zeros(3000, 32, 3), exists, shape.expand(-1, -1, 2)), 8, 2)
    begun = model.begin(torch.randn(4000, NUMBERS, generator=generator), 20)
    np.testing.assert_allclose(begun.std(0)[:, 0], along[:20, 0], rtol=0.1)


def test_what_is_held_back_is_not_learned_from(domains: list[Trajectories]) -> None:
    kept, held = divided(domains)
    for domain, part, other in zip(domains, kept, held, strict=True):
        assert len(other) == len(domain) // 5
        both = np.concatenate([part.dlo, other.dlo])
        assert len(np.unique(both.reshape(len(both), -1), axis=0)) == len(domain)
    (one,), (again,) = divided([domains[0].take(np.arange(1))])
    assert len(one) == len(again) == 1


def test_a_flow_draws_from_a_single_feature_too() -> None:
    exists, hidden = torch.ones(4, 20, 1), torch.zeros(4, 20, 1)
    model = flow.Velocity(Missed(hidden, exists, torch.randn(4, 20, 2)), 8, 2)
    assert model.draw(hidden, exists, torch.randn(4, NUMBERS)).shape == (4, 20, 2)


@pytest.mark.parametrize("of", [flow.Flow, cvae.Cvae])
def test_samples_turn_with_the_push(of: Any, domains: list[Trajectories]) -> None:
    """A quarter turn of the world is the same world, where commands are executed exactly (their noise has axes)."""
    model = fitted(of, domains[:2], domains[2:])
    query, _ = domains[2].windows(2)
    few = query.take(np.arange(4))

    def turned(vectors: Any) -> Any:
        return np.stack([-vectors[..., 1], vectors[..., 0]], -1)

    dlo, bodies = few.dlo.copy(), few.bodies.copy()
    dlo[..., :2], bodies[..., :2] = turned(few.dlo[..., :2]), turned(few.bodies[..., :2])
    bodies[..., 2] += np.float32(np.pi / 2)
    other = replace(few, dlo=dlo, bodies=bodies, pusher=turned(few.pusher), actions=turned(few.actions))
    expected = turned(model.predict(few, 4).dlo)
    np.testing.assert_allclose(model.predict(other, 4).dlo, expected, atol=2e-5)
