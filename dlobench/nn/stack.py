"""Descends with a stack of M multilayer perceptrons at once, each on its own batches, by a backward pass in place."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import leaky_relu_
from torch.optim.adam import adam

from dlobench.nn.networks import SLOPE, Layers, flat


class Stack:
    """Holds M networks of one shape with batches, gradients and Adam's moments, all in memory that is used again.

    One step of it is one step of each network: no network sees another, and all have one learning rate.
    """

    def __init__(self, networks: Sequence[Layers], batch: int, learning_rate: float) -> None:
        weights = [torch.stack(each).detach() for each in zip(*map(flat, networks), strict=True)]
        self.batch, self.learning_rate, self.steps = batch, learning_rate, weights[0].new_zeros(())
        self._hold(weights, *([torch.zeros_like(each) for each in weights] for _ in range(2)))

    def _hold(self, weights: Sequence[Tensor], mean: Sequence[Tensor], square: Sequence[Tensor]) -> None:
        """Makes all buffers for these weights (M, in, out) and biases (M, out), and Adam's moments of them: copies."""
        M, sizes = len(weights[0]), [weights[0].shape[1], *(bias.shape[1] for bias in weights[1::2])]
        self.shapes = [each.shape for each in weights]
        # Each is one tensor, so that Adam runs over it once: weights, the mean of their gradients and that of squares.
        self.state = [torch.cat([each.flatten() for each in parts]) for parts in (weights, mean, square)]
        self.gradient = torch.zeros_like(self.state[0])
        self.layers, self.gradients = self._layers(self.state[0]), self._layers(self.gradient)
        self.values = [weights[0].new_zeros(M, self.batch, size) for size in sizes]  # inputs, hidden layers, outputs
        self.slopes = [torch.zeros_like(each) for each in self.values]  # of the loss with respect to the values
        self.inputs, self.targets = self.values[0], torch.zeros_like(self.values[-1])  # to be filled: (M, batch, …)
        self.weight = torch.zeros_like(self.targets)  # of each coordinate in the loss, to be filled: (M, batch, out)
        self.slots = list(zip(self.inputs, self.targets, self.weight, strict=True))  # the same by network

    def _layers(self, joined: Tensor) -> Layers:
        """Returns what is joined in one tensor as weights and biases: views."""
        parts = torch.split(joined, [shape.numel() for shape in self.shapes])
        views = [part.view(shape) for part, shape in zip(parts, self.shapes, strict=True)]
        return list(zip(views[::2], views[1::2], strict=True))

    def network(self, number: int) -> Layers:
        """Returns one of the networks, as views of the stack."""
        return [(weight[number], bias[number]) for weight, bias in self.layers]

    def step(self) -> Tensor:
        """Takes a step of Adam on the batches that were filled in; returns the loss of each network before it, (M,)."""
        loss = self.backward()
        weights, mean, square = ([each] for each in self.state)
        adam(
            weights, [self.gradient], mean, square, [], [self.steps],
            lr=self.learning_rate, beta1=0.9, beta2=0.999, eps=1e-8, weight_decay=0.0,
            amsgrad=False, maximize=False, fused=True,
        )  # fmt: skip
        return loss

    def backward(self) -> Tensor:
        """Puts the gradient of each network's `weighted_mse` into `gradients`; returns the losses (M,)."""
        for (weight, bias), (before, after) in zip(self.layers, pairwise(self.values), strict=True):
            torch.baddbmm(bias.unsqueeze(-2), before, weight, out=after)
            if after is not self.values[-1]:
                leaky_relu_(after, SLOPE)
        error, slope = self.values[-1].sub_(self.targets), self.slopes[-1]
        torch.mul(error, self.weight, out=slope)
        loss: Tensor = torch.linalg.vecdot(error.flatten(1), slope.flatten(1)) / self.batch
        slope.mul_(2 / self.batch)
        for k in reversed(range(len(self.layers))):
            value, slope, (to_weight, to_bias) = self.values[k], self.slopes[k + 1], self.gradients[k]
            torch.bmm(value.mT, slope, out=to_weight)
            torch.sum(slope, 1, out=to_bias)
            if k:
                before = torch.bmm(slope, self.layers[k][0].mT, out=self.slopes[k])
                torch.ops.aten.leaky_relu_backward.grad_input(before, value, SLOPE, True, grad_input=before)
        return loss

    def keep(self, numbers: Sequence[int]) -> None:
        """Drops all networks but these."""
        weight = self.weight[list(numbers)]
        self._hold(*([each[list(numbers)] for each in flat(self._layers(joined))] for joined in self.state))
        self.weight.copy_(weight)
