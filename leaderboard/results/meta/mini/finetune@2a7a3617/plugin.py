"""Predicts an unseen domain after gradient steps on K of its trajectories, from weights that were not meta-learned."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import torch

from dlobench.bench.model import Model, Setting
from dlobench.errors import RunError
from dlobench.nn.episodes import Batch, draw
from dlobench.nn.fit import Network, Plan, positive
from dlobench.nn.networks import Layers, mlp, passes, stacked, weighted_mse
from dlobench.nn.regression import Regression, regress
from dlobench.nn.windows import Target, Windows
from dlobench.trajectories import Prediction, Query, Trajectories

RATES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # of the gradient steps that are tried


def steps(layers: Layers, support: Batch, rate: float) -> Iterator[Layers]:
    """Yields N networks, stacked, after each further gradient step from `layers` on their own task."""
    stack = stacked(layers, len(support[0]))
    while True:
        slopes = passes(stack, *support, last=len(stack)).gradient()
        stack = [(w - rate * dw, b - rate * db) for (w, b), (dw, db) in zip(stack, slopes, strict=True)]
        yield stack


def _loss(stack: Layers, windows: Windows) -> float:
    """Returns the loss of one network, stacked, on all windows."""
    inputs, targets, weight = windows.pick(slice(None))
    return float(weighted_mse(mlp(stack, inputs[None]), targets[None], weight[None]))


@dataclass
class Finetune(Model):
    """Learns as `multitask` does, then takes gradient steps on the support: what `maml` has to beat.

    Rate and number of the steps are those that serve best on validation domains, for each K that is asked about; a K
    between goes by the nearest. Without validation domains, or where no step helps, it never adapts. Network, loss and
    fit are those of `multitask`; not in the paper. Shapes: (B, 66 + 2 n) to (B, 64). Cost: the fit of `multitask` and
    some seconds for the choice; an adaptation takes up to `most` steps of about 1 ms at K = 10.
    """

    width: int = 32
    depth: int = 6  # hidden layers
    learning_rate: float = 1e-3
    batch: int = 64  # windows
    steps: int = 200_000
    patience: int = 40  # validations, 500 steps apart, without a new best
    most: int = 32  # gradient steps of an adaptation
    draws: int = 4  # supports of each validation domain that the choice looks at
    target: Target = "displacement"

    network: Network = field(init=False, repr=False, compare=False)
    chosen: dict[int, tuple[float, int]] = field(init=False, repr=False, compare=False)  # rate and steps by K

    def __post_init__(self) -> None:
        """Raises `UsageError` for hyperparameters that nothing can be learned with."""
        positive(self, "most", "draws")
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
        """Pools the windows of all training domains, stops on the validation domains, and chooses rate and steps."""
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
        self.chosen = {K: self._choose(K, valid) for K in setting.K if K > 0 and valid}

    @torch.no_grad()
    def _choose(self, K: int, valid: Sequence[Trajectories]) -> tuple[float, int]:
        """Returns the rate and number of steps after which the other trajectories are predicted best."""
        windows = self.network.scaling.windows(valid, self.device)
        if int(windows.count.min()) < 2:
            raise RunError("a validation domain has fewer than 2 trajectories: one to adapt on, one to be scored on")
        generator = torch.Generator().manual_seed(self.seed)
        again = torch.arange(len(valid)).repeat(self.draws)
        support, query = draw(windows, again, K, queries=int(windows.count.max()), generator=generator)

        def loss(stack: Layers) -> float:
            return float(weighted_mse(mlp(stack, query[0]), query[1], query[2]).mean())

        best = loss(stacked(self.network.layers, len(again))), 0.0, 0
        for rate in RATES:
            for number, stack in enumerate(islice(steps(self.network.layers, support, rate), self.most), 1):
                found = loss(stack)
                if not found < 10 * best[0]:
                    break  # it runs away
                best = min(best, (found, rate, number))
        return best[1], best[2]

    def adapt(self, support: Trajectories) -> Finetune:
        """Returns a copy that took the chosen steps on the support; itself without any, or where they do not help."""
        if not len(support) or not self.chosen:
            return self
        rate, count = self.chosen[min(self.chosen, key=lambda K: (abs(K - len(support)), K))]
        if not count:
            return self
        windows = self.network.scaling.windows([support], self.device)
        rows = torch.arange(len(support), device=self.device)[None]
        with torch.no_grad():
            walk = steps(self.network.layers, windows.pick_trajectories(rows), rate)
            *_, adapted = islice(walk, count)
        before, after = (_loss(layers, windows) for layers in (stacked(self.network.layers, 1), adapted))
        if not after < before:
            return self  # what served on validation domains runs away here
        model = copy.copy(self)
        model.network = Network([(weight[0], bias[0]) for weight, bias in adapted], self.network.scaling)
        return model

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2)."""
        return self.network.predict(query)

    def parameters(self) -> int:
        """Returns the number of weights and biases."""
        return self.network.parameters()
