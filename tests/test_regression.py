"""Tests regressions: a stack of networks against each of them alone, by autograd."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from toy import toy_domain, toy_domains

from dlobench.errors import RunError, UsageError
from dlobench.nn.budget import Budget, Log
from dlobench.nn.fit import Network, Plan, descend
from dlobench.nn.networks import Layers, detached, flat, initial, mlp, weighted_mse
from dlobench.nn.regression import Job, Regression, mean_loss, regress_many
from dlobench.nn.stack import Stack
from dlobench.nn.windows import standardise
from dlobench.trajectories import Trajectories

HOW = Regression(
    width=24, depth=2, bodies=False, target="displacement", batch=16, plan=Plan(400, 3e-3, patience=3, every=20)
)


@pytest.fixture
def double() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def alone(how: Regression, job: Job, horizon: int = 2) -> Layers:
    """Fits one network as `descend` does any loss: by autograd, drawing batch after batch."""
    windows, scaling = standardise(
        job.train, horizon=horizon, bodies=how.bodies, target=how.target, normalise=how.normalise
    )
    generator = torch.Generator().manual_seed(job.seed)
    layers = initial([windows.inputs.shape[-1], *[how.width] * how.depth, 64], generator)

    def train_loss() -> Tensor:
        inputs, targets, weight = windows.pick(torch.randint(len(windows), (how.batch,), generator=generator))
        return weighted_mse(mlp(layers, inputs), targets, weight)

    unseen = scaling.windows(job.valid) if job.valid else None
    check = None if unseen is None else lambda: mean_loss(layers, unseen)
    descend(flat(layers), train_loss, check, plan=how.plan_of(len(windows)), budget=Budget(), log=job.log)
    return detached(layers)


def job(seed: int, trajectories: int = 12, domains: int = 1, valid: int = 2) -> tuple[Job, list[int]]:
    """Makes a job, and the list of steps that it will report."""
    known = toy_domains(domains, seed=seed, trajectories=trajectories + valid, segments=20 + seed)
    train = [each.take(slice(0, trajectories)) for each in known]
    unseen = [each.take(slice(trajectories, trajectories + valid)) for each in known]
    steps: list[int] = []
    return Job(train, unseen if valid else [], seed, Log([lambda step, *_: steps.append(step)])), steps


def many(jobs: list[Job], how: Regression = HOW, budget: Budget | None = None) -> list[Network | RunError]:
    return regress_many(how, jobs, horizon=2, device="cpu", budget=budget or Budget())


def network(made: Network | RunError) -> Network:
    assert isinstance(made, Network), made
    return made


def test_gradients_of_a_stack_are_those_of_autograd(double: None) -> None:
    rng = torch.Generator().manual_seed(0)
    nets = [initial([7, 16, 12, 5], rng) for _ in range(3)]
    stack = Stack(nets, batch=9, learning_rate=1e-3)
    for filled in (stack.inputs, stack.targets, stack.weight):
        filled.copy_(torch.rand(filled.shape, generator=rng) - 0.3)
    losses = stack.backward()
    for m, net in enumerate(nets):
        loss = weighted_mse(mlp(net, stack.inputs[m]), stack.targets[m], stack.weight[m])
        torch.testing.assert_close(losses[m], loss, rtol=1e-12, atol=1e-14)
        for ours, theirs in zip(flat(stack.gradients), torch.autograd.grad(loss, flat(net)), strict=True):
            torch.testing.assert_close(ours[m], theirs, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("epochs", [None, 2])
def test_a_stack_equals_each_network_alone(double: None, epochs: int | None) -> None:
    how = replace(HOW, epochs=epochs)
    shapes: list[dict[str, int]] = [{}, {"trajectories": 30}, {"domains": 3}, {"valid": 0}, {"trajectories": 6}]
    pairs = [(job(seed, **shape), job(seed, **shape)) for seed, shape in enumerate(shapes)]
    made = many([one for (one, _), _ in pairs], how)
    stopped = set()
    for found, ((_, steps), (reference, expected)) in zip(made, pairs, strict=True):
        layers = alone(how, reference)
        for ours, theirs in zip(flat(network(found).layers), flat(layers), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-10)
        assert steps == expected
        stopped.add(steps[-1])
    assert len(stopped) > 2 and 400 in stopped  # some stopped early and left the stack, each at its own time


def test_one_that_fails_is_named_and_the_others_go_on() -> None:
    good = [job(seed)[0] for seed in range(2)]
    [domain] = toy_domains(1, seed=5, trajectories=4)
    huge = Job([replace(domain, dlo=domain.dlo * np.float32(1e30))], [], seed=5)
    broken = Job([replace(domain, executed=domain.executed * np.float32("nan"))], [], seed=6)
    nothing = Job([domain.take(slice(0, 0))], [], seed=7)
    how = replace(HOW, normalise=False)
    made = many([huge, good[0], broken, nothing, good[1]], how)
    for found, why in zip(
        (made[0], made[2], made[3]),
        ("diverged at step 1 of 400: loss inf", "domain 0 of 1 holds a position or action", "no trajectories"),
        strict=True,
    ):
        assert isinstance(found, RunError) and why in str(found)
    for ours, theirs in zip((made[1], made[4]), many(good, how), strict=True):
        for one, other in zip(flat(network(ours).layers), flat(network(theirs).layers), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    assert all(isinstance(each, RunError) for each in many([broken, nothing])) and many([]) == []


def test_a_group_has_the_minutes_of_its_members(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter(range(10**6))
    monkeypatch.setattr(time, "monotonic", lambda: next(ticks))  # a second a look at the clock
    taken = []
    for M in (1, 3):
        jobs = [job(seed, valid=0) for seed in range(M)]
        many([one for one, _ in jobs], budget=Budget(minutes=1))
        taken.append({steps[-1] for _, steps in jobs})
    assert taken == [{60}, {180}]


def test_what_a_stack_cannot_do_is_refused() -> None:
    for plan in (replace(HOW.plan, cosine=True), replace(HOW.plan, clip=1.0)):
        with pytest.raises(UsageError, match="one learning rate and does not clip"):
            replace(HOW, plan=plan)


def test_a_network_predicts_the_same_whoever_shared_its_stack() -> None:
    jobs = [job(seed)[0] for seed in range(3)]
    domain: Trajectories = toy_domain(np.random.default_rng(9), trajectories=2)
    query, _ = domain.windows(2)
    together = network(many(jobs)[1]).predict(query).dlo
    np.testing.assert_allclose(network(many(jobs[1:2])[0]).predict(query).dlo, together, atol=1e-5)
