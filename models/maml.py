"""Predicts an unseen domain after one gradient step on K of its trajectories (the paper's meta-learner, Table 1)."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dlobench.bench.model import Model, Setting
from dlobench.nn.episodes import Batch, draw
from dlobench.nn.fit import Network, Plan, descend, positive
from dlobench.nn.networks import Layers, detached, flat, initial, mlp, stacked, weighted_mse
from dlobench.nn.windows import COORDINATES, Target, standardise
from dlobench.trajectories import Prediction, Query, Trajectories


def inner_step(layers: Layers, rates: Tensor, support: Batch) -> Layers:
    """Returns N networks, stacked, each one gradient step from `layers` on its own task; `rates` (L,) one a layer.

    The tasks share no weight in the stack, so the gradient of the sum of their losses holds the gradient of each.
    """
    inputs, targets, weight = support

    def loss(stack: Layers) -> Tensor:
        return weighted_mse(mlp(stack, inputs), targets, weight).sum()

    start = stacked(layers, len(inputs))
    slopes = torch.func.grad(loss)(start)
    return [(w - r * dw, b - r * db) for (w, b), (dw, db), r in zip(start, slopes, rates, strict=True)]


def meta_loss(layers: Layers, rates: Tensor, support: Batch, query: Batch) -> Tensor:
    """Returns the loss on the query windows after the inner step, the mean over tasks."""
    adapted = inner_step(layers, rates, support)
    return weighted_mse(mlp(adapted, query[0]), query[1], query[2]).mean()


@dataclass
class Maml(Model):
    """Learns weights from which one gradient step on K trajectories of a new domain gives a model of that domain.

    Follows the paper's section 3 and appendix: MAML (Finn et al. 2017) of second order, 6 hidden layers of 32,
    LeakyReLU, no bodies, one inner step, an inner rate a layer that is learned (shared by its weights and bias,
    positive as an exponential). Each meta step draws N domains, with replacement, and from each of them K support
    and `queries` other trajectories. K is drawn from the positive ones of `setting.K`, or 1 if there are none,
    unless `K_train` fixes it. Where the smallest domain has fewer than K + 1 trajectories, K is cut to half of them.
    Ours differs in the rate of Adam (the paper's is 1e-4) and in predicting displacements of standardised states
    unless `target="absolute"`. Shapes: (B, 66 + 2 n) to (B, 64).
    Cost: 9,799 parameters at n = 4; on one core about 9 ms a meta step at N = 5, K = 10, and 55 ms at N = 50.
    """

    N: int = 5  # tasks a meta step
    K_train: int | None = None  # support trajectories of a task while learning
    queries: int = 10  # query trajectories of a task while learning, at most
    width: int = 32
    depth: int = 6  # hidden layers
    learning_rate: float = 1e-3
    inner_rate: float = 0.1  # at first
    steps: int = 6000
    patience: int = 20  # validations, 100 steps apart, without a new best
    target: Target = "displacement"

    network: Network = field(init=False, repr=False, compare=False)
    rates: Tensor = field(init=False, repr=False, compare=False)  # (depth + 1,)

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Learns the weights to start from and the inner rates; validates on adapted models of unseen domains."""
        positive(
            self, "N", "queries", "width", "depth", "inner_rate", *(["K_train"] if self.K_train is not None else [])
        )
        windows, scaling = standardise(
            train, horizon=setting.horizon, bodies=False, target=self.target, device=self.device
        )
        generator = torch.Generator().manual_seed(self.seed)
        sizes = [windows.inputs.shape[-1], *[self.width] * self.depth, COORDINATES]
        layers = initial(sizes, generator, self.device)
        log_rates = torch.full((len(layers),), self.inner_rate, device=self.device).log_().requires_grad_()
        supports = [self.K_train] if self.K_train is not None else [K for K in setting.K if K > 0] or [1]

        def train_loss() -> Tensor:
            K = supports[int(torch.randint(len(supports), (), generator=generator))]
            domains = torch.randint(len(windows.count), (self.N,), generator=generator)
            return meta_loss(
                layers, log_rates.exp(), *draw(windows, domains, K, queries=self.queries, generator=generator)
            )

        unseen = scaling.windows(valid, self.device) if valid else None
        # Several draws a domain, the same at every validation: one support of K = 1 says little.
        again = torch.arange(len(valid)).repeat(4)
        fixed = [draw(unseen, again, K, queries=self.queries, generator=generator) for K in supports] if unseen else []

        def valid_loss() -> float:
            losses = [meta_loss(layers, log_rates.exp(), *pair) for pair in fixed]
            return torch.stack(losses).mean().item()

        plan = Plan(self.steps, self.learning_rate, self.patience, every=100)
        check = valid_loss if fixed else None
        descend([*flat(layers), log_rates], train_loss, check, plan=plan, budget=setting.budget, log=setting.log)
        self.network, self.rates = Network(detached(layers), scaling), log_rates.detach().exp()

    def adapt(self, support: Trajectories) -> Maml:
        """Returns a copy that took one gradient step on the support windows; itself when there are none."""
        if not len(support):
            return self
        windows = self.network.scaling.windows([support], self.device)
        rows = torch.arange(len(support), device=self.device)[None]
        with torch.no_grad():
            adapted = inner_step(self.network.layers, self.rates, windows.pick_trajectories(rows))
        model = copy.copy(self)
        model.network = Network([(weight[0], bias[0]) for weight, bias in adapted], self.network.scaling)
        return model

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2)."""
        return self.network.predict(query)

    def parameters(self) -> int:
        """Returns the number of weights, biases and inner rates."""
        return self.network.parameters() + self.rates.numel()
