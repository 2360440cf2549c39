"""Predicts one domain with a plain network (the paper's single-domain baseline, Fig. 3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from dlobench.bench.model import Model, Setting
from dlobench.nn.fit import Network, Plan
from dlobench.nn.regression import Regression, regress
from dlobench.nn.windows import Frame, Target
from dlobench.trajectories import Prediction, Query, Trajectories


@dataclass
class Mlp(Model):
    """Learns a multilayer perceptron from pusher, segments, bodies and n actions to the segments after them.

    Follows the paper's section 3 and appendix: 4 hidden layers of 128, LeakyReLU, MSE, Adam at 2e-4, batches of 64.
    The preset `paper` is just that: absolute positions, nothing normalised, a stop once 10 epochs bring no new best,
    but on validation trajectories rather than on test ones. By default it predicts displacements of standardised
    states, at a rate of Adam that was tuned on validation trajectories; `frame="push"` turns and moves the world into
    the frame of the first push, and tells where that is. Shapes: (B, 78 + 2 n), or (B, 80 + 2 n), to (B, 64). Given
    many domains it pools them. Cost: 68,160 parameters at n = 1; on one core about 1 ms a step.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"target": "absolute", "normalise": False, "learning_rate": 2e-4, "epochs": 10, "steps": 10**9}
    }

    width: int = 128
    depth: int = 4  # hidden layers
    learning_rate: float = 1e-3
    batch: int = 64  # windows
    steps: int = 40_000
    patience: int = 20  # validations, 500 steps apart, without a new best
    epochs: int | None = None  # instead: validates once an epoch, and waits for so many
    target: Target = "displacement"
    frame: Frame = "world"  # or "push": of the first action, from the pusher
    normalise: bool = True  # states to mean 0 and spread 1, displacements to spread 1

    network: Network = field(init=False, repr=False, compare=False)

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
            frame=self.frame,
            normalise=self.normalise,
            epochs=self.epochs,
        )

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Pools the windows of all training domains and stops on the validation domains."""
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

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2)."""
        return self.network.predict(query)

    def parameters(self) -> int:
        """Returns the number of weights and biases."""
        return self.network.parameters()
