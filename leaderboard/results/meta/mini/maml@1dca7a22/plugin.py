"""Predicts an unseen domain after one gradient step on K of its trajectories (the paper's meta-learner, Table 1)."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor

from dlobench.bench.model import Model, Setting
from dlobench.nn.fit import Network
from dlobench.nn.inner import Adapts, Inner, RatePer, meta_loss
from dlobench.nn.meta import MetaLearning, adapted, learn
from dlobench.nn.windows import Target
from dlobench.trajectories import Prediction, Query, Trajectories


@dataclass
class Maml(Model):
    """Learns weights from which one gradient step on K trajectories of a new domain gives a model of that domain.

    Follows the paper's section 3 and appendix: MAML (Finn et al. 2017) of second order, 6 hidden layers of 32,
    LeakyReLU, no bodies, one inner step, an inner rate a layer that is learned (shared by its weights and bias,
    positive as an exponential). Each meta step draws N domains, with replacement, and from each of them K support
    and `queries` other trajectories. K is drawn from the positive ones of `setting.K`, or 1 if there are none,
    unless `K_train` fixes it. Where the smallest domain has fewer than K + 1 trajectories, K is cut to half of them.
    Ours differs in the rate of Adam (the paper's is 1e-4) and in predicting displacements of standardised states
    unless `target="absolute"`.
    Variants, of which the paper has none: `first_order` (Finn et al. 2017), several `inner_steps` with the same rates,
    `rate_per="weight"` (Meta-SGD, Li et al. 2017, with rates kept positive), `adapts="head"` (ANIL, Raghu et al. 2020).
    Shapes: (B, 66 + 2 n) to (B, 64).
    Cost: 9,799 parameters at n = 4; on one core about 4 ms a meta step at N = 5, K = 10, and 30 ms at N = 50.
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
    rate_per: RatePer = "layer"
    adapts: Adapts = "all"  # or the last layer alone
    steps: int = 20_000
    patience: int = 40  # validations, 100 steps apart, without a new best
    target: Target = "displacement"

    network: Network = field(init=False, repr=False, compare=False)
    rates: Tensor = field(init=False, repr=False, compare=False)  # one an adapting layer, or a weight

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
        """Learns the weights to start from and the inner rates; validates on adapted models of unseen domains."""
        self.network, self.rates = learn(
            self._how(),
            meta_loss,
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
        return Inner(self.inner_steps, self.first_order, self.rate_per, self.adapts)

    def adapt(self, support: Trajectories) -> Maml:
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
        """Returns the number of weights, biases and inner rates."""
        return self.network.parameters() + self.rates.numel()
