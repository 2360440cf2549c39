"""Predicts samples: the `mlp` plus normal noise as its residuals are spread, the probabilistic floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dlobench.bench.model import Model, Setting
from dlobench.errors import RunError
from dlobench.nn.execution import root
from dlobench.nn.fit import CHUNK, Network, Plan
from dlobench.nn.networks import mlp
from dlobench.nn.regression import Regression, regress
from dlobench.nn.windows import Target, Windows
from dlobench.trajectories import Prediction, Query, Trajectories


@dataclass
class MlpGaussian(Model):
    """Learns the network of `mlp`, then the covariance of what it misses on validation windows, whole shapes at once.

    The spread is the same wherever a push leads, so that what rests is spread as well: what a generative model has to
    beat. Asked for one sample it returns the mean. Sample s has the same noise for every query, so a prediction depends
    on no other. Not in the paper. Shapes: (B, 78 + 2 n) to (S, B, 64). Cost: that of `mlp`; 2,080 numbers more.
    """

    width: int = 128
    depth: int = 4  # hidden layers
    learning_rate: float = 1e-3
    batch: int = 64  # windows
    steps: int = 40_000
    patience: int = 20  # validations, 500 steps apart, without a new best
    target: Target = "displacement"

    network: Network = field(init=False, repr=False, compare=False)
    factor: Tensor = field(init=False, repr=False, compare=False)  # (64, 64): its square is the covariance, scaled

    def __post_init__(self) -> None:
        """Raises `UsageError` for hyperparameters that nothing can be learned with."""
        self._how()

    def _how(self) -> Regression:
        """Returns what to learn."""
        return Regression(
            width=self.width,
            depth=self.depth,
            bodies=True,
            target=self.target,
            batch=self.batch,
            plan=Plan(self.steps, self.learning_rate, self.patience),
        )

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Fits the mean to the training domains, the covariance to the validation domains; raises without these."""
        if not sum(map(len, valid)):
            raise RunError("the spread of residuals needs validation trajectories, and there are none")
        self.network = regress(
            self._how(),
            train,
            valid,
            horizon=setting.horizon,
            seed=self.seed,
            device=self.device,
            budget=setting.budget,
            log=setting.log,
        )
        self.factor = self._spread(self.network.scaling.windows(valid, self.device))

    @torch.no_grad()
    def _spread(self, windows: Windows) -> Tensor:
        """Returns a root of the covariance of the residuals, about 0; a pair of coordinates counts where both exist."""
        square, count = (torch.zeros(64, 64, dtype=torch.float64, device=self.device) for _ in range(2))
        for first in range(0, len(windows), CHUNK):
            inputs, targets, weight = windows.pick(slice(first, first + CHUNK))
            there = (weight > 0).double()
            missed = (targets - mlp(self.network.layers, inputs)).double() * there
            square, count = square + missed.T @ missed, count + there.T @ there
        return root(square / count.clamp_min(1))

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (S, B, 32, 2)."""
        mean = self.network.predict(query).dlo
        if samples == 1:
            return Prediction(dlo=mean)
        drawn = torch.randn(samples, 64, generator=torch.Generator().manual_seed(self.seed))
        noise = (drawn @ self.factor.T.cpu()).view(samples, 1, 32, 2) * self.network.scaling.target_std
        dlo = mean + noise.numpy()
        dlo[:, :, ~query.dlo_mask] = 0
        return Prediction(dlo=dlo)

    def parameters(self) -> int:
        """Returns the number of weights and biases, and of a covariance."""
        return self.network.parameters() + 64 * 65 // 2
