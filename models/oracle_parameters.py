"""Predicts with the true parameters of each domain, which no other model sees: the ceiling of adaptation, unranked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from dlobench.bench.model import Model, Setting
from dlobench.errors import RunError
from dlobench.nn.graph import GraphNetwork
from dlobench.nn.rollout import Rollout, Source, fit, predict
from dlobench.nn.scenes import Recorded
from dlobench.trajectories import Prediction, Query, Trajectories


class Told(Source):
    """Tells the network the parameters of the domain of each window."""

    size = 11

    def draw(
        self, of: Recorded, count: int, n: int, generator: torch.Generator, *, mirror: bool = False
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Returns trajectories, starts and the parameters of their domains, (B, 11)."""
        rows, starts = of.draw(count, n, generator)
        if of.parameters is None:
            raise RunError("the parameters of domains are not told: only the bench can ask this model")
        return rows, starts, of.parameters[of.domain[rows]]


@dataclass
class OracleParameters(Model):
    """Learns the network of `gnn` with friction, density, stiffness, yield, material and attachment as its context.

    How far above `gnn` it is says what knowing the domain is worth to this network, and how far `gnn_context` comes
    says how much of that the support tells. Never adapts; the board gives it no place. Not in the paper. Shapes and
    steps: those of `gnn`; 46,469 parameters.
    """

    privileged: ClassVar[bool] = True

    width: int = 32
    learning_rate: float = 3e-3
    batch: int = 64  # windows
    steps: int = 4000
    unrolled: float = 0.3  # share of the fit that learns rollouts
    body_weight: float = 0.1  # of bodies in the loss

    network: GraphNetwork = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Raises `UsageError` for hyperparameters that nothing can be learned with."""
        self._how()

    def _how(self) -> Rollout:
        """Returns what to learn."""
        return Rollout(
            width=self.width,
            learning_rate=self.learning_rate,
            batch=self.batch,
            steps=self.steps,
            unrolled=self.unrolled,
            body_weight=self.body_weight,
        )

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Learns from all training domains; keeps the weights that are best on the validation domains."""
        self.network, _ = fit(
            self._how(),
            train,
            valid,
            horizon=setting.horizon,
            seed=self.seed,
            device=self.device,
            budget=setting.budget,
            log=setting.log,
            source=lambda _: Told(),
        )

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2) and the bodies (1, B, 3, 3)."""
        if query.parameters is None:
            raise RunError("the parameters of the domain are not told: only the bench can ask this model")
        return predict(self.network, query, self.device, torch.tensor(query.parameters, device=self.device))

    def parameters(self) -> int:
        """Returns the number of weights and biases."""
        return sum(weight.numel() for weight in self.network.parameters())
