"""Takes the inner steps of gradient-based meta-learners, of many tasks at once."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dlobench.errors import UsageError
from dlobench.nn.episodes import Batch
from dlobench.nn.networks import Layers, Passes, flat, mlp, passes, size, stacked, weighted_mse

Adapts = Literal["all", "head"]
RatePer = Literal["network", "layer", "weight"]


@dataclass(frozen=True)
class Inner:
    """Says how a model adapts: how many steps, of which layers, by how many learned rates."""

    inner_steps: int = 1
    first_order: bool = False  # whether the inner gradients count as constants
    rate_per: RatePer = "layer"
    adapts: Adapts = "all"  # or the last layer alone

    def __post_init__(self) -> None:
        if type(self.inner_steps) is not int or self.inner_steps < 1:
            raise UsageError(f"inner_steps = {self.inner_steps!r} is not a whole number of at least 1")
        if type(self.first_order) is not bool:
            raise UsageError(f"first_order = {self.first_order!r} is neither true nor false")
        for name, choices in (("rate_per", get_args(RatePer)), ("adapts", get_args(Adapts))):
            if getattr(self, name) not in choices:
                raise UsageError(f"{name} = {getattr(self, name)!r} is none of {', '.join(choices)}")

    def moving(self, layers: Layers) -> Layers:
        """Returns the layers that the inner steps move."""
        return layers[-1:] if self.adapts == "head" else layers

    def rates(self, layers: Layers) -> int:
        """Returns how many inner rates there are."""
        moving = self.moving(layers)
        return {"network": 1, "layer": len(moving), "weight": size(moving)}[self.rate_per]


ONE = Inner()  # one step of second order, a rate a layer
PART = 4096  # support windows of tasks that a meta step looks at together, so that they stay in a processor's cache


@dataclass(frozen=True)
class Step:
    """Holds an inner step of N tasks: from where, and how steep it was there."""

    passes: Passes
    slopes: Layers  # stacked, of the layers that move


@torch.no_grad()
def walk(layers: Layers, rates: Tensor, support: Batch, *, inner: Inner) -> tuple[list[Step], Layers]:
    """Takes the inner steps; returns them, and the N networks that they lead to, stacked."""
    moving = len(inner.moving(layers))
    scales = by_weight(rates, layers[-moving:])
    now, start, steps = list(layers), stacked(layers, len(support[0])), list[Step]()
    for _ in range(inner.inner_steps):
        there = passes(now, *support, last=moving)
        steps.append(Step(there, there.gradient()))
        pairs = zip(now[-moving:], steps[-1].slopes, scales, strict=True)
        now = start[:-moving] + [(w - r * dw, b - q * db) for (w, b), (dw, db), (r, q) in pairs]
    return steps, now


def inner_step(layers: Layers, rates: Tensor, support: Batch, *, inner: Inner = ONE) -> Layers:
    """Returns N networks, stacked, each some gradient steps from `layers` on its own task.

    `rates` has one number for all layers that adapt, or one for each, or one for each of their weights and biases
    (flat, layer by layer). No gradient goes through it: `meta_loss` has its own.
    """
    return walk(layers, rates, support, inner=inner)[1]


def by_weight(rates: Tensor, layers: Layers) -> Layers:
    """Returns the rate of each weight and bias: a number for the whole layer, or a tensor of the same shape."""
    if len(rates) in (1, len(layers)):
        return [(rate, rate) for rate in rates.expand(len(layers))]
    tensors = flat(layers)
    parts = torch.split(rates, [tensor.numel() for tensor in tensors])
    shaped = [part.view_as(tensor) for part, tensor in zip(parts, tensors, strict=True)]
    return list(zip(shaped[::2], shaped[1::2], strict=True))


def meta_loss(layers: Layers, rates: Tensor, support: Batch, query: Batch, *, inner: Inner = ONE) -> Tensor:
    """Returns the loss on the query windows after the inner steps, the mean over tasks, to be differentiated once.

    In the first order the inner gradients count as constants (Finn et al. 2017).
    """
    if torch.is_grad_enabled():
        loss: Tensor = _MetaLoss.apply(inner, support, query, rates, *flat(layers))  # type: ignore[no-untyped-call]
        return loss
    adapted = inner_step(layers, rates, support, inner=inner)
    return weighted_mse(mlp(adapted, query[0]), query[1], query[2]).mean()


class _MetaLoss(torch.autograd.Function):
    """Differentiates the meta loss along with it, so that nothing of the tasks has to be kept."""

    @staticmethod
    def forward(context: Any, inner: Inner, support: Batch, query: Batch, rates: Tensor, *tensors: Tensor) -> Tensor:
        layers, N = list(zip(tensors[::2], tensors[1::2], strict=True)), len(support[0])
        each = max(1, PART // max(1, support[0].shape[1]))
        parts = [slice(first, first + each) for first in range(0, N, each)]
        found = [_pulled(layers, rates, _tasks(support, some), _tasks(query, some), inner=inner) for some in parts]
        loss, *context.slopes = (functools.reduce(torch.Tensor.add_, each) for each in zip(*found, strict=True))
        context.N = N
        mean: Tensor = loss / N
        return mean

    @staticmethod
    @once_differentiable
    def backward(context: Any, grad: Tensor) -> Any:
        return None, None, None, *(slope * (grad / context.N) for slope in context.slopes)


def _tasks(batch: Batch, some: slice) -> Batch:
    inputs, targets, weights = batch
    return inputs[some], targets[some], weights[some]


def _pulled(layers: Layers, rates: Tensor, support: Batch, query: Batch, *, inner: Inner) -> list[Tensor]:
    """Returns the sum of the losses of tasks after their inner steps, and its gradient by rates, weights and biases.

    The adjoint of gradient descent: what pulls at the networks is drawn back through each step, in which it loses the
    curvature that the step went by.
    """
    steps, now = walk(layers, rates, support, inner=inner)
    asked = passes(now, *query, last=len(layers))
    pull, moving = asked.gradient(), len(inner.moving(layers))
    scales, to_rates = by_weight(rates, layers[-moving:]), torch.zeros_like(rates)
    for step in reversed(steps):
        pairs = list(zip(pull[-moving:], step.slopes, strict=True))
        to_rates -= like_rates([(pw * w, pb * b) for (pw, pb), (w, b) in pairs], rates)
        if not inner.first_order:
            way = [(r * pw, q * pb) for (pw, pb), (r, q) in zip(pull[-moving:], scales, strict=True)]
            bent = step.passes.curvature(way)
            pull = [(pw - w, pb - b) for (pw, pb), (w, b) in zip(pull, bent, strict=True)]
    return [asked.loss.sum(), to_rates, *(each.sum(0) for each in flat(pull))]


def like_rates(of: Layers, rates: Tensor) -> Tensor:
    """Returns what is known of each weight and bias of a stack, added up over tasks and over what shares a rate."""
    if len(rates) in (1, len(of)):
        by_layer = torch.stack([weight.sum() + bias.sum() for weight, bias in of])
        return by_layer if len(rates) == len(of) else by_layer.sum(0, keepdim=True)
    return torch.cat([each.sum(0).flatten() for each in flat(of)])
