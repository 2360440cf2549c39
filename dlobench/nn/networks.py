"""Evaluates multilayer perceptrons as pure functions, one network or a stack of N at once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import leaky_relu

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


def gradient(layers: Layers, inputs: Tensor, targets: Tensor, weight: Tensor, *, last: int) -> Layers:
    """Returns the gradient of the `weighted_mse` of N tasks with respect to the last so many layers, stacked.

    Inputs and targets are (N, B, …); the layers are one network that all tasks share, or a stack. Written out rather
    than left to autograd, so that a gradient of this gradient takes one pass backwards instead of two.
    """
    hidden = [inputs]
    for w, b in layers[:-1]:
        hidden.append(leaky_relu(_affine(hidden[-1], w, b), SLOPE))
    delta = (_affine(hidden[-1], *layers[-1]) - targets) * (weight * (2 / inputs.shape[-2]))
    found: Layers = []
    for k in reversed(range(len(layers) - last, len(layers))):
        found.append((hidden[k].mT @ delta, delta.sum(-2)))
        if k > len(layers) - last:
            slope = torch.where(hidden[k].detach() > 0, 1.0, SLOPE)
            delta = (delta @ layers[k][0].mT) * slope
    return found[::-1]


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
