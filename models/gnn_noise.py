"""Predicts samples: draws what may really be executed of a command, and the graph network tells what comes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from dlobench.bench.model import Model, Setting
from dlobench.nn.execution import noise_root, travelled
from dlobench.nn.graph import GraphNetwork
from dlobench.nn.rollout import Rollout, fit, predict
from dlobench.trajectories import Prediction, Query, Trajectories


@dataclass
class GnnNoise(Model):
    """Learns the network of `gnn` from where the pusher went, and how that differs from what it was told.

    A latent variable model whose latent has a meaning: the displacements that are executed, normal about the command
    with the covariance that training shows, n of them one after the other. Where training knows what was executed there
    is no difference, and all samples are alike. What stays unknown of the domain is not sampled. Asked for one sample
    it returns that of the command. Sample s has the same noise for every query. Not in the paper. Shapes: (B, N, 2)
    to (S, B, N, 2). Cost: the fit of `gnn`; S times its predictions.
    """

    width: int = 32
    learning_rate: float = 3e-3
    batch: int = 64  # windows
    steps: int = 4000
    unrolled: float = 0.3  # share of the fit that learns rollouts, where the horizon is above 1
    body_weight: float = 0.1  # of bodies in the loss

    network: GraphNetwork = field(init=False, repr=False, compare=False)
    factor: Tensor = field(init=False, repr=False, compare=False)  # (2, 2), m: a root of the noise's covariance

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
        """Learns network and noise from all training domains; keeps the weights that are best on validation domains."""
        self.network, _ = fit(
            self._how(),
            [travelled(domain) for domain in train],
            [travelled(domain) for domain in valid],
            horizon=setting.horizon,
            seed=self.seed,
            device=self.device,
            budget=setting.budget,
            log=setting.log,
        )
        self.factor = noise_root(train)

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (S, B, 32, 2) and the bodies (S, B, 3, 3)."""
        if samples == 1:
            return predict(self.network, query, self.device)
        generator = torch.Generator().manual_seed(self.seed)
        noise = (torch.randn(samples, query.horizon, 2, generator=generator) @ self.factor.T).numpy()
        every = query.take(np.tile(np.arange(len(query)), samples))
        found = predict(self.network, replace(every, actions=every.actions + noise.repeat(len(query), 0)), self.device)
        shape = samples, len(query)
        bodies = None if found.bodies is None else found.bodies.reshape(*shape, *query.bodies.shape[1:])
        return Prediction(dlo=found.dlo.reshape(*shape, *query.dlo.shape[1:2], 2), bodies=bodies)

    def parameters(self) -> int:
        """Returns the number of weights and biases, and of a covariance."""
        return sum(weight.numel() for weight in self.network.parameters()) + 3
