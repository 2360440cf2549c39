"""Predicts push by push with a graph network of segments, bodies, walls and pusher, which turns with the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from dlobench.bench.model import Model, Setting
from dlobench.nn.graph import GraphNetwork
from dlobench.nn.rollout import Rollout, fit, predict
from dlobench.trajectories import Prediction, Query, Trajectories


@dataclass
class Gnn(Model):
    """Learns one push by message passing along the chain of segments and between them, bodies, walls and the pusher.

    Interaction network (Battaglia et al. 2016) in the manner of Sanchez-Gonzalez et al. (2020), in the frame of each
    push: equivariant to translation and rotation by construction, walls turned along; to mirroring since it learns
    from mirrored pushes and predicts the mean of both sights. It learns single pushes first, then, over the last
    `unrolled` share of the fit, rollouts as long as the horizon, each state of which counts. It predicts any number
    of pushes, of segments and of bodies. Not in the paper. Shapes: segments (B, N, 2) and bodies (B, M, 3) to the same.
    Cost: 45,765 parameters; on one core a step of 64 single pushes takes 14 ms, 25 ms with three bodies, and n times
    that of rollouts.
    """

    width: int = 32
    learning_rate: float = 3e-3
    batch: int = 64  # windows
    steps: int = 4000
    unrolled: float = 0.3  # share of the fit that learns rollouts, where the horizon is above 1
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
        )

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2) and the bodies (1, B, 3, 3)."""
        return predict(self.network, query, self.device)

    def parameters(self) -> int:
        """Returns the number of weights and biases."""
        return sum(weight.numel() for weight in self.network.parameters())
