"""Predicts an unseen domain after gradient steps on K of its trajectories, learned by learn2learn's MAML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from dlobench.models.maml import Batch, Maml, RatePer  # type: ignore[import-not-found]
from torch import Tensor

from dlobench.bench.model import Setting
from dlobench.errors import RunError, UsageError
from dlobench.nn.networks import Layers, flat, mlp, weighted_mse
from dlobench.trajectories import Trajectories

MISSING = (
    "maml_learn2learn needs learn2learn, which is not installed: "
    "by pip 26 (23 ignores the option), pip install learn2learn==0.2.0 "
    '--config-settings="--build-option=build_ext"'
)


def learn2learn() -> Any:
    """Imports learn2learn; raises `RunError` with the way to get it when it is missing."""
    try:
        import learn2learn as library  # type: ignore[import-not-found]  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise RunError(MISSING) from error
    return library


class Perceptron(torch.nn.Module):
    """Holds the layers as parameters, the very tensors that the optimizer moves, as learn2learn wants them."""

    def __init__(self, layers: Layers) -> None:
        super().__init__()
        # Not register_parameter, which would want a Parameter, another leaf than the optimizer's.
        self._parameters.update({f"tensor{i}": tensor for i, tensor in enumerate(flat(layers))})  # type: ignore[misc]

    def forward(self, inputs: Tensor) -> Tensor:
        """Returns the outputs (B, 64) of inputs (B, F)."""
        tensors = list(self._parameters.values())
        return mlp(list(zip(tensors[::2], tensors[1::2], strict=True)), inputs)  # type: ignore[arg-type]


def looped_loss(
    layers: Layers, rate: Tensor, support: Batch, query: Batch, *, steps: int = 1, first_order: bool = False
) -> Tensor:
    """Returns the loss on the query windows after learn2learn's inner steps, the mean over tasks."""
    learner = learn2learn().algorithms.MAML(Perceptron(layers), lr=rate, first_order=first_order)
    losses = []
    with torch.enable_grad():
        for task in range(len(support[0])):
            clone = learner.clone()
            inputs, targets, weight = (tensor[task] for tensor in support)
            for _ in range(steps):
                clone.adapt(weighted_mse(clone(inputs), targets, weight))
            inputs, targets, weight = (tensor[task] for tensor in query)
            losses.append(weighted_mse(clone(inputs), targets, weight))
    return torch.stack(losses).mean()


@dataclass
class MamlLearn2learn(Maml):  # type: ignore[misc]
    """Learns as `maml` does, its meta loss and gradient made by learn2learn's MAML (Arnold et al. 2020), task by task.

    That class has one rate for the whole network (here learned too) and adapts all layers, so `rate_per` is "network"
    and `adapts` "all". The steps on a new domain are those of `maml`, whose results are equal. Shapes: as `maml`.
    Cost: the parameters of `maml` with one rate; a loop over tasks, hence several times as slow.
    """

    rate_per: RatePer = "network"

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Learns as `maml`; raises `RunError` when learn2learn is missing."""
        if self.rate_per != "network" or self.adapts != "all":
            raise UsageError(
                f"rate_per = {self.rate_per!r}, adapts = {self.adapts!r}: learn2learn's MAML has network and all alone"
            )
        learn2learn()
        super().fit(train, valid, setting)

    def _loss(self, layers: Layers, rates: Tensor, support: Batch, query: Batch) -> Tensor:
        """Returns the meta loss by learn2learn."""
        return looped_loss(layers, rates[0], support, query, steps=self.inner_steps, first_order=self.first_order)
