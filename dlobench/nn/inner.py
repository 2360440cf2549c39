"""Takes the inner steps of gradient-based meta-learners, of many tasks at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from dlobench.errors import UsageError
from dlobench.nn.episodes import Batch
from dlobench.nn.networks import Layers, flat, gradient, mlp, size, stacked, weighted_mse

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


def inner_step(layers: Layers, rates: Tensor, support: Batch, *, inner: Inner = ONE) -> Layers:
    """Returns N networks, stacked, each some gradient steps from `layers` on its own task.

    `rates` has one number for all layers that adapt, or one for each, or one for each of their weights and biases
    (flat, layer by layer). In the first order the gradients are constants to whoever differentiates the result
    (Finn et al. 2017).
    """
    kept = len(layers) - len(inner.moving(layers))
    scales = by_weight(rates, layers[kept:])
    now, start = list(layers), stacked(layers, len(support[0]))
    for _ in range(inner.inner_steps):
        with torch.set_grad_enabled(torch.is_grad_enabled() and not inner.first_order):
            slopes = gradient(now, *support, last=len(layers) - kept)
        pairs = zip(now[kept:], slopes, scales, strict=True)
        now = start[:kept] + [(w - r * dw, b - q * db) for (w, b), (dw, db), (r, q) in pairs]
    return now


def by_weight(rates: Tensor, layers: Layers) -> Layers:
    """Returns the rate of each weight and bias: a number for the whole layer, or a tensor of the same shape."""
    if len(rates) in (1, len(layers)):
        return [(rate, rate) for rate in rates.expand(len(layers))]
    tensors = flat(layers)
    parts = torch.split(rates, [tensor.numel() for tensor in tensors])
    shaped = [part.view_as(tensor) for part, tensor in zip(parts, tensors, strict=True)]
    return list(zip(shaped[::2], shaped[1::2], strict=True))


def meta_loss(layers: Layers, rates: Tensor, support: Batch, query: Batch, *, inner: Inner = ONE) -> Tensor:
    """Returns the loss on the query windows after the inner steps, the mean over tasks."""
    adapted = inner_step(layers, rates, support, inner=inner)
    return weighted_mse(mlp(adapted, query[0]), query[1], query[2]).mean()
