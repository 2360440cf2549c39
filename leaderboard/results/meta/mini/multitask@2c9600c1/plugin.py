"""Predicts unseen domains with one network for all of them (the paper's multi-task baseline, Table 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from dlobench.bench.model import Model, Setting
from dlobench.nn.fit import Network, Plan
from dlobench.nn.regression import Regression, regress
from dlobench.nn.windows import Target
from dlobench.trajectories import Prediction, Query, Trajectories


@dataclass
class Multitask(Model):
    """Learns one multilayer perceptron from pusher, segments and n actions to the segments after them; never adapts.

    Follows the paper's section 3 and appendix: 6 hidden layers of 32, LeakyReLU, MSE, no bodies, the network that
    `maml` starts from. Ours differs in the rate of Adam (the paper's is 1e-4, for 5e6 steps), and predicts
    displacements of standardised states unless `target="absolute"`. Shapes: (B, 66 + 2 n) to (B, 64).
    Cost: 9,792 parameters at n = 4; on one core about 0.7 ms a step.
    """

    width: int = 32
    depth: int = 6  # hidden layers
    learning_rate: float = 1e-3
    batch: int = 64  # windows
    steps: int = 200_000
    patience: int = 40  # validations, 500 steps apart, without a new best
    target: Target = "displacement"

    network: Network = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Raises `UsageError` for hyperparameters that nothing can be learned with."""
        self._how()

    def _how(self) -> Regression:
        """Returns what to learn."""
        return Regression(
            width=self.width,
            depth=self.depth,
            bodies=False,
            target=self.target,
            batch=self.batch,
            plan=Plan(self.steps, self.learning_rate, self.patience),
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
