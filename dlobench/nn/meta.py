"""Learns weights that a few gradient steps on a new domain turn into a model of it, by any meta loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from dlobench.nn.budget import Budget, Log
from dlobench.nn.episodes import Batch, draw
from dlobench.nn.fit import Network, Plan, descend, positive
from dlobench.nn.inner import Inner, inner_step
from dlobench.nn.networks import Layers, detached, flat, initial
from dlobench.nn.windows import COORDINATES, Target, standardise
from dlobench.trajectories import Trajectories

EVERY = 100  # steps between two validations
AGAIN = 4  # draws of a domain at a validation, since one support of K = 1 says little


class MetaLoss(Protocol):
    """Computes the loss on query windows after inner steps on support windows, the mean over tasks."""

    def __call__(self, layers: Layers, rates: Tensor, support: Batch, query: Batch, *, inner: Inner) -> Tensor:
        """Returns a number that gradients of weights and rates can be taken of."""


@dataclass(frozen=True)
class MetaLearning:
    """Says what to learn, from which tasks and for how long."""

    N: int  # tasks a meta step
    K_train: int | None  # support trajectories of a task while learning; None: those that it will be scored at
    queries: int  # query trajectories of a task while learning, at most
    width: int
    depth: int  # hidden layers
    learning_rate: float
    inner_rate: float  # at first
    inner: Inner
    steps: int
    patience: int  # validations, `EVERY` steps apart, without a new best
    target: Target

    def __post_init__(self) -> None:
        chosen = ["K_train"] if self.K_train is not None else []
        positive(self, "N", "queries", "width", "depth", "inner_rate", *chosen)


def learn(
    how: MetaLearning,
    loss: MetaLoss,
    train: Sequence[Trajectories],
    valid: Sequence[Trajectories],
    *,
    horizon: int,
    K: Sequence[int],
    seed: int,
    device: str,
    budget: Budget,
    log: Log,
) -> tuple[Network, Tensor]:
    """Returns the weights to start from and the inner rates, which are learned too, positive as exponentials.

    Each meta step draws N domains, with replacement, and from each of them support and other trajectories; their
    number is drawn from the positive ones of `K`, or is 1 if there are none, unless `how.K_train` fixes it. Validates
    on adapted models of unseen domains. Raises `RunError` when there is nothing to learn from or the fit diverges.
    """
    windows, scaling = standardise(train, horizon=horizon, bodies=False, target=how.target, device=device)
    generator = torch.Generator().manual_seed(seed)
    layers = initial([windows.inputs.shape[-1], *[how.width] * how.depth, COORDINATES], generator, device)
    number = how.inner.rates(layers)
    log_rates = torch.full((number,), how.inner_rate, device=device).log_().requires_grad_()
    supports = [how.K_train] if how.K_train is not None else [each for each in K if each > 0] or [1]

    def train_loss() -> Tensor:
        chosen = supports[int(torch.randint(len(supports), (), generator=generator))]
        domains = torch.randint(len(windows.count), (how.N,), generator=generator)
        support, query = draw(windows, domains, chosen, queries=how.queries, generator=generator)
        return loss(layers, log_rates.exp(), support, query, inner=how.inner)

    unseen = scaling.windows(valid, device) if valid else None
    again = torch.arange(len(valid)).repeat(AGAIN)  # the same draws at every validation
    fixed = [draw(unseen, again, each, queries=how.queries, generator=generator) for each in supports] if unseen else []

    def valid_loss() -> float:
        losses = [loss(layers, log_rates.exp(), *pair, inner=how.inner) for pair in fixed]
        return torch.stack(losses).mean().item()

    plan = Plan(how.steps, how.learning_rate, how.patience, every=EVERY)
    descend([*flat(layers), log_rates], train_loss, valid_loss if fixed else None, plan=plan, budget=budget, log=log)
    return Network(detached(layers), scaling), log_rates.detach().exp()


@torch.no_grad()
def adapted(network: Network, rates: Tensor, support: Trajectories, *, inner: Inner, device: str) -> Network:
    """Returns the network after its inner steps on all windows of a support of at least one trajectory."""
    rows = torch.arange(len(support), device=device)[None]
    windows = network.scaling.windows([support], device).pick_trajectories(rows)
    layers = inner_step(network.layers, rates, windows, inner=inner)
    return Network([(weight[0], bias[0]) for weight, bias in layers], network.scaling)
