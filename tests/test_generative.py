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
from dlobench.nn.budget import Budget
from dlobench.trajectories import Trajectories

gaussian, noisy = load("mlp_gaussian"), load("gnn_noise")
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


@pytest.mark.parametrize("of", [gaussian.MlpGaussian, noisy.GnnNoise])
def test_samples_are_the_same_each_time_and_depend_on_no_other_query(of: Any, domains: list[Trajectories]) -> None:
    model = fitted(of, domains[:2], domains[2:])
    query, _ = domains[2].windows(2)
    once, again = model.predict(query, 7).dlo, model.predict(query, 7).dlo
    assert once.shape == (7, len(query), 32, 2)
    assert np.array_equal(once, again)
    order = np.random.default_rng(0).permutation(len(query))
    np.testing.assert_allclose(model.predict(query.take(order), 7).dlo, once[:, order], atol=1e-6)
    assert not once[:, :, ~query.dlo_mask].any()
