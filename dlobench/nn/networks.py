"""Evaluates multilayer perceptrons as pure functions, one network or a stack of N at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import leaky_relu, leaky_relu_

# One (weight, bias) a layer: (in, out) and (out,), or a stack of N networks: (N, in, out) and (N, out).
Layers = list[tuple[Tensor, Tensor]]

SLOPE = 0.01  # of LeakyReLU below 0


def initial(sizes: Sequence[int], generator: torch.Generator, device: str = "cpu") -> Layers:
    """Draws layers between these sizes (input first) as `torch.nn.Linear` does: uniform within 1/√in.

    They are drawn on the CPU, so that a seed means the same network on every device.
    """

    def uniform(*shape: int, bound: float) -> Tensor:
        return torch.empty(*shape).uniform_(-bound, bound, generator=generator).to(device).requires_grad_()

    return [(uniform(i, o, bound=i**-0.5), uniform(o, bound=i**-0.5)) for i, o in pairwise(sizes)]


def mlp(layers: Layers, inputs: Tensor) -> Tensor:
    """Returns the outputs (B, out) of inputs (B, in), or (N, B, out) of (N, B, in) for a stack of N networks."""
    affine = torch.baddbmm if layers[0][0].dim() == 3 else torch.addmm
    hidden = inputs
    for weight, bias in layers[:-1]:
        hidden = leaky_relu(affine(bias.unsqueeze(-2), hidden, weight), SLOPE)
    weight, bias = layers[-1]
    return affine(bias.unsqueeze(-2), hidden, weight)


def stacked(layers: Layers, N: int) -> Layers:
    """Returns N views of one network as a stack; a gradient with respect to it is each copy's own."""
    return [(weight.expand(N, *weight.shape), bias.expand(N, *bias.shape)) for weight, bias in layers]


def weighted_mse(outputs: Tensor, targets: Tensor, weight: Tensor) -> Tensor:
    """Returns the mean over windows of the weighted squared error: () for (B, 64), (N,) for (N, B, 64).

    The weights of a window sum to 1, so this is the MSE over the coordinates that exist.
    """
    error = outputs - targets
    return (error * (error * weight)).sum((-2, -1)) / error.shape[-2]


@dataclass(frozen=True)
class Passes:
    """Holds what a pass through a network and back leaves behind, of N tasks: all that derivatives are made of.

    The layers are one network that all tasks share, or a stack of N. Written out rather than left to autograd, whose
    second derivatives of small networks cost more than their products.
    """

    layers: Layers
    values: list[Tensor]  # (N, B, in) of each layer
    slopes: dict[int, Tensor]  # (N, B, out) of the loss by what comes out of a layer, by its number, from some on
    scale: Tensor  # (N, 1, out) of the squared error in the loss, twice: its second derivative
    loss: Tensor  # (N,) `weighted_mse`

    def gradient(self) -> Layers:
        """Returns the gradient of each task's loss with respect to the layers whose slopes are known, stacked."""
        return [(self.values[k].mT @ slope, slope.sum(-2)) for k, slope in sorted(self.slopes.items())]

    def curvature(self, way: Layers) -> Layers:
        """Returns how that gradient, of all layers, changes as the last layers go a `way`: the Hessian times it.

        The way is stacked, and has as many layers as slopes are known (Pearlmutter 1994, the R operator; a LeakyReLU
        adds nothing of its own).
        """
        first, count = len(self.layers) - len(way), len(self.layers)
        goes, out = dict[int, Tensor](), torch.zeros(0)  # how the values change, and what comes out of a layer
        for k, (weight, bias) in enumerate(way, first):
            out = torch.baddbmm(bias.unsqueeze(-2), self.values[k], weight)
            if k > first:
                _add_product(out, goes[k], self.layers[k][0])
            if k < count - 1:
                goes[k + 1] = _leaky_slope(out, self.values[k + 1])
        bends, found = out.mul_(self.scale), Layers()
        for k in reversed(range(count)):
            change = self.values[k].mT @ bends
            found.append((change.baddbmm_(goes[k].mT, self.slopes[k]) if k in goes else change, bends.sum(-2)))
            if k:
                bends = bends @ self.layers[k][0].mT
                if k >= first:
                    bends.baddbmm_(self.slopes[k], way[k - first][0].mT)
                bends = _leaky_slope(bends, self.values[k])
        return found[::-1]


@torch.no_grad()
def passes(layers: Layers, inputs: Tensor, targets: Tensor, weight: Tensor, *, last: int) -> Passes:
    """Passes inputs (N, B, in) through the layers, and back through the last so many."""
    values, first = [inputs], len(layers) - last
    for layer in layers[:-1]:
        values.append(leaky_relu_(_affine(values[-1], *layer), SLOPE))
    error, scale = _affine(values[-1], *layers[-1]).sub_(targets), weight * (2 / inputs.shape[-2])
    slopes = {len(layers) - 1: error * scale}
    for k in reversed(range(first, len(layers) - 1)):
        slopes[k] = _leaky_slope(slopes[k + 1] @ layers[k + 1][0].mT, values[k + 1])
    loss = torch.linalg.vecdot(error.flatten(1), slopes[len(layers) - 1].flatten(1)) / 2
    return Passes(layers, values, slopes, scale, loss)


def _leaky_slope(slope: Tensor, value: Tensor) -> Tensor:
    """Returns slopes before a LeakyReLU of those behind it, which are overwritten; value is what came out of it."""
    out: Tensor = torch.ops.aten.leaky_relu_backward.grad_input(slope, value, SLOPE, True, grad_input=slope)
    return out


def _add_product(to: Tensor, inputs: Tensor, weight: Tensor) -> None:
    """Adds to (N, B, out) the product of inputs (N, B, in) and a weight that all N share, or each its own."""
    if weight.dim() == 3:
        to.baddbmm_(inputs, weight)
    else:
        to.flatten(0, 1).addmm_(inputs.flatten(0, 1), weight)


def _affine(inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Returns inputs (N, B, in) through a layer that all N share, or through each its own."""
    if weight.dim() == 3:
        return torch.baddbmm(bias.unsqueeze(-2), inputs, weight)
    return torch.addmm(bias, inputs.flatten(0, -2), weight).view(*inputs.shape[:-1], -1)


def flat(layers: Layers) -> list[Tensor]:
    """Returns weights and biases as one list, layer by layer."""
    return [tensor for layer in layers for tensor in layer]


def detached(layers: Layers) -> Layers:
    """Returns copies of the layers that take no part in any gradient."""
    return [(weight.detach().clone(), bias.detach().clone()) for weight, bias in layers]


def size(layers: Layers) -> int:
    """Returns the number of parameters."""
    return sum(tensor.numel() for tensor in flat(layers))
