"""Predicts an unseen domain after one gradient step on K of its trajectories (the paper's meta-learner, Table 1)."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import torch
from torch import Tensor

from dlobench.bench.model import Model, Setting
from dlobench.errors import UsageError
from dlobench.nn.episodes import Batch, draw
from dlobench.nn.fit import Network, Plan, descend, positive
from dlobench.nn.networks import Layers, detached, flat, initial, mlp, size, stacked, weighted_mse
from dlobench.nn.windows import COORDINATES, Target, standardise
from dlobench.trajectories import Prediction, Query, Trajectories

Adapts = Literal["all", "head"]
RatePer = Literal["network", "layer", "weight"]


def inner_step(
    layers: Layers,
    rates: Tensor,
    support: Batch,
    *,
    steps: int = 1,
    first_order: bool = False,
    adapts: Adapts = "all",
) -> Layers:
    """Returns N networks, stacked, each `steps` gradient steps from `layers` on its own task.

    `rates` has one number for all layers that adapt, or one for each, or one for each of their weights and biases
    (flat, layer by layer). In the first order the gradients are constants to whoever differentiates the result
    (Finn et al. 2017).
    The tasks share no weight in the stack, so the gradient of the sum of their losses holds the gradient of each.
    """
    inputs, targets, weight = support
    start = stacked(layers, len(inputs))
    kept = len(start) - len(adapting(layers, adapts))
    body, moving = start[:kept], start[kept:]
    scales = by_weight(rates, layers[kept:])

    def loss(part: Layers) -> Tensor:
        return weighted_mse(mlp([*constant(body), *part], inputs), targets, weight).sum()

    def constant(part: Layers) -> Layers:
        return [(w.detach(), b.detach()) for w, b in part] if first_order else part

    for _ in range(steps):
        slopes = torch.func.grad(loss)(constant(moving))
        moving = [(w - r * dw, b - q * db) for (w, b), (dw, db), (r, q) in zip(moving, slopes, scales, strict=True)]
    return [*body, *moving]


def adapting(layers: Layers, adapts: Adapts) -> Layers:
    """Returns the layers that the inner steps move."""
    return layers[-1:] if adapts == "head" else layers


def by_weight(rates: Tensor, layers: Layers) -> Layers:
    """Returns the rate of each weight and bias: a number for the whole layer, or a tensor of the same shape."""
    if len(rates) in (1, len(layers)):
        return [(rate, rate) for rate in rates.expand(len(layers))]
    tensors = flat(layers)
    parts = torch.split(rates, [tensor.numel() for tensor in tensors])
    shaped = [part.view_as(tensor) for part, tensor in zip(parts, tensors, strict=True)]
    return list(zip(shaped[::2], shaped[1::2], strict=True))


def meta_loss(
    layers: Layers,
    rates: Tensor,
    support: Batch,
    query: Batch,
    *,
    steps: int = 1,
    first_order: bool = False,
    adapts: Adapts = "all",
) -> Tensor:
    """Returns the loss on the query windows after the inner steps, the mean over tasks."""
    adapted = inner_step(layers, rates, support, steps=steps, first_order=first_order, adapts=adapts)
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
    unless `target="absolute"`.
    Variants, of which the paper has none: `first_order` (Finn et al. 2017), several `inner_steps` with the same rates,
    `rate_per="weight"` (Meta-SGD, Li et al. 2017, with rates kept positive), `adapts="head"` (ANIL, Raghu et al. 2020).
    Shapes: (B, 66 + 2 n) to (B, 64).
    Cost: 9,799 parameters at n = 4; on one core about 9 ms a meta step at N = 5, K = 10, and 55 ms at N = 50.
    """

    N: int = 5  # tasks a meta step
    K_train: int | None = None  # support trajectories of a task while learning
    queries: int = 10  # query trajectories of a task while learning, at most
    width: int = 32
    depth: int = 6  # hidden layers
    learning_rate: float = 1e-3
    inner_rate: float = 0.1  # at first
    inner_steps: int = 1
    first_order: bool = False  # whether the inner gradients count as constants
    rate_per: RatePer = "layer"
    adapts: Adapts = "all"  # or the last layer alone
    steps: int = 6000
    patience: int = 20  # validations, 100 steps apart, without a new best
    target: Target = "displacement"

    network: Network = field(init=False, repr=False, compare=False)
    rates: Tensor = field(init=False, repr=False, compare=False)  # one an adapting layer, or a weight

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Learns the weights to start from and the inner rates; validates on adapted models of unseen domains."""
        positive(
            self, "N", "queries", "width", "depth", "inner_rate", *(["K_train"] if self.K_train is not None else [])
        )
        self._check()
        windows, scaling = standardise(
            train, horizon=setting.horizon, bodies=False, target=self.target, device=self.device
        )
        generator = torch.Generator().manual_seed(self.seed)
        sizes = [windows.inputs.shape[-1], *[self.width] * self.depth, COORDINATES]
        layers = initial(sizes, generator, self.device)
        moving = adapting(layers, self.adapts)
        number = {"network": 1, "layer": len(moving), "weight": size(moving)}[self.rate_per]
        log_rates = torch.full((number,), self.inner_rate, device=self.device).log_().requires_grad_()
        supports = [self.K_train] if self.K_train is not None else [K for K in setting.K if K > 0] or [1]

        def train_loss() -> Tensor:
            K = supports[int(torch.randint(len(supports), (), generator=generator))]
            domains = torch.randint(len(windows.count), (self.N,), generator=generator)
            return self._loss(
                layers, log_rates.exp(), *draw(windows, domains, K, queries=self.queries, generator=generator)
            )

        unseen = scaling.windows(valid, self.device) if valid else None
        # Several draws a domain, the same at every validation: one support of K = 1 says little.
        again = torch.arange(len(valid)).repeat(4)
        fixed = [draw(unseen, again, K, queries=self.queries, generator=generator) for K in supports] if unseen else []

        def valid_loss() -> float:
            losses = [self._loss(layers, log_rates.exp(), *pair) for pair in fixed]
            return torch.stack(losses).mean().item()

        plan = Plan(self.steps, self.learning_rate, self.patience, every=100)
        check = valid_loss if fixed else None
        descend([*flat(layers), log_rates], train_loss, check, plan=plan, budget=setting.budget, log=setting.log)
        self.network, self.rates = Network(detached(layers), scaling), log_rates.detach().exp()

    def _check(self) -> None:
        """Raises `UsageError` for an option that is none of its choices."""
        if type(self.inner_steps) is not int or self.inner_steps < 1:
            raise UsageError(f"inner_steps = {self.inner_steps!r} is not a whole number of at least 1")
        if type(self.first_order) is not bool:
            raise UsageError(f"first_order = {self.first_order!r} is neither true nor false")
        for name, choices in (("rate_per", get_args(RatePer)), ("adapts", get_args(Adapts))):
            if getattr(self, name) not in choices:
                raise UsageError(f"{name} = {getattr(self, name)!r} is none of {', '.join(choices)}")

    def _loss(self, layers: Layers, rates: Tensor, support: Batch, query: Batch) -> Tensor:
        """Returns the meta loss by this model's options."""
        return meta_loss(
            layers,
            rates,
            support,
            query,
            steps=self.inner_steps,
            first_order=self.first_order,
            adapts=self.adapts,
        )

    def adapt(self, support: Trajectories) -> Maml:
        """Returns a copy that took its gradient steps on the support windows; itself when there are none."""
        if not len(support):
            return self
        windows = self.network.scaling.windows([support], self.device)
        rows = torch.arange(len(support), device=self.device)[None]
        with torch.no_grad():
            adapted = inner_step(
                self.network.layers,
                self.rates,
                windows.pick_trajectories(rows),
                steps=self.inner_steps,
                adapts=self.adapts,
            )
        model = copy.copy(self)
        model.network = Network([(weight[0], bias[0]) for weight, bias in adapted], self.network.scaling)
        return model

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2)."""
        return self.network.predict(query)

    def parameters(self) -> int:
        """Returns the number of weights, biases and inner rates."""
        return self.network.parameters() + self.rates.numel()
