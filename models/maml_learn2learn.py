"""Predicts an unseen domain after gradient steps on K of its trajectories, learned by learn2learn's MAML."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from dlobench.bench.model import Model, Setting
from dlobench.errors import RunError
from dlobench.nn.episodes import Batch
from dlobench.nn.fit import Network
from dlobench.nn.inner import Inner
from dlobench.nn.meta import MetaLearning, adapted, learn
from dlobench.nn.networks import Layers, flat, mlp, weighted_mse
from dlobench.nn.windows import Target
from dlobench.trajectories import Prediction, Query, Trajectories


def learn2learn() -> Any:
    """Imports learn2learn, old parts of which warn; raises `RunError` with the way to get it when it is missing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import learn2learn as library  # type: ignore[import-not-found]  # noqa: PLC0415  # an extra
        except ImportError as error:
            raise RunError(
                f"maml_learn2learn needs learn2learn, which cannot be imported ({error}): `make peers` builds an "
                "environment that has it"
            ) from error
        except RuntimeError:
            # It imports torchvision, whose wheels are built for CUDA: beside a CPU build of torch its operators are
            # missing, and to declare those that it describes is all that its import takes.
            for name in ("nms", "qnms"):
                torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float threshold) -> Tensor")
            import learn2learn as library  # noqa: PLC0415
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


def looped_loss(layers: Layers, rates: Tensor, support: Batch, query: Batch, *, inner: Inner) -> Tensor:
    """Returns the loss on the query windows after learn2learn's inner steps, the mean over tasks; one rate for all."""
    learner = learn2learn().algorithms.MAML(Perceptron(layers), lr=rates[0], first_order=inner.first_order)
    losses = []
    with torch.enable_grad():
        for task in range(len(support[0])):
            clone = learner.clone()
            inputs, targets, weight = (tensor[task] for tensor in support)
            for _ in range(inner.inner_steps):
                clone.adapt(weighted_mse(clone(inputs), targets, weight))
            inputs, targets, weight = (tensor[task] for tensor in query)
            losses.append(weighted_mse(clone(inputs), targets, weight))
    return torch.stack(losses).mean()


@dataclass
class MamlLearn2learn(Model):
    """Learns as `maml` does, its meta loss and gradient made by learn2learn's MAML (Arnold et al. 2020), task by task.

    That class has one rate for the whole network, here learned too, and adapts all layers. The steps on a new domain
    are those of `maml`, whose gradients are equal within rounding. Shapes: (B, 66 + 2 n) to (B, 64). Cost: 9,793
    parameters at n = 4; a loop over tasks, hence several times as slow as `maml` (`make peers` measures it).
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
    steps: int = 20_000
    patience: int = 40  # validations, 100 steps apart, without a new best
    target: Target = "displacement"

    network: Network = field(init=False, repr=False, compare=False)
    rates: Tensor = field(init=False, repr=False, compare=False)  # (1,)

    def __post_init__(self) -> None:
        """Raises `UsageError` for hyperparameters that nothing can be learned with."""
        self._how()

    def _how(self) -> MetaLearning:
        """Returns what to learn."""
        return MetaLearning(
            N=self.N,
            K_train=self.K_train,
            queries=self.queries,
            width=self.width,
            depth=self.depth,
            learning_rate=self.learning_rate,
            inner_rate=self.inner_rate,
            inner=self._inner(),
            steps=self.steps,
            patience=self.patience,
            target=self.target,
        )

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Learns the weights to start from and the inner rate; raises `RunError` when learn2learn is missing."""
        learn2learn()
        self.network, self.rates = learn(
            self._how(),
            looped_loss,
            train,
            valid,
            horizon=setting.horizon,
            K=setting.K,
            seed=self.seed,
            device=self.device,
            budget=setting.budget,
            log=setting.log,
        )

    def _inner(self) -> Inner:
        """Returns how this model adapts."""
        return Inner(self.inner_steps, self.first_order, "network")

    def adapt(self, support: Trajectories) -> MamlLearn2learn:
        """Returns a copy that took its gradient steps on the support windows; itself when there are none."""
        if not len(support):
            return self
        model = copy.copy(self)
        model.network = adapted(self.network, self.rates, support, inner=self._inner(), device=self.device)
        return model

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2)."""
        return self.network.predict(query)

    def parameters(self) -> int:
        """Returns the number of weights, biases and the inner rate."""
        return self.network.parameters() + self.rates.numel()
