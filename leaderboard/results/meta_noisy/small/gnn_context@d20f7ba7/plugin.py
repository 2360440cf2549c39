"""Predicts an unseen domain by a graph network that is told what K of its trajectories say of it: no gradient steps."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

import torch
from torch import Tensor

from dlobench.bench.model import Model, Setting
from dlobench.nn import episodes
from dlobench.nn.context import PushEncoder
from dlobench.nn.fit import positive
from dlobench.nn.graph import GraphNetwork
from dlobench.nn.rollout import Rollout, Source, fit, predict
from dlobench.nn.scenes import Recorded, record
from dlobench.trajectories import Prediction, Query, Trajectories


class Seen(Source):
    """Draws tasks: pushes of a few domains, each beside what other trajectories of its domain say of it."""

    def __init__(self, encoder: PushEncoder, supports: Sequence[int], *, tasks: int, points: int) -> None:
        self.encoder, self.supports, self.tasks, self.points = encoder, (0, *supports), tasks, points
        self.size = encoder.size

    def weights(self) -> list[Tensor]:
        """Returns the weights of the encoder."""
        return list(self.encoder.parameters())

    def draw(
        self, of: Recorded, count: int, n: int, generator: torch.Generator, *, mirror: bool = False
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Returns trajectories, starts and contexts: `count` windows of `tasks` domains, K the same for all of them.

        Of the pushes of a support, `points` are looked at, drawn with replacement.
        """
        device, each = of.dlo.device, max(1, count // self.tasks)
        K = self.supports[int(torch.randint(len(self.supports), (), generator=generator))]
        domains = torch.randint(len(of.count), (self.tasks,), generator=generator)
        support, query = episodes.rows(of.count, domains, max(1, K), queries=each, generator=generator)
        which = torch.randint(query.shape[1], (self.tasks, each), generator=generator).to(device)
        rows = query.gather(1, which).flatten()
        starts = torch.randint(of.pushes - n + 1, rows.shape, generator=generator).to(device)
        if not K:
            return rows, starts, torch.zeros(len(rows), self.size, device=device)
        K = support.shape[1]
        points = min(self.points, K * of.pushes)
        chosen = torch.randint(K, (self.tasks, points), generator=generator).to(device)
        pushes = torch.randint(of.pushes, (self.tasks * points,), generator=generator).to(device)
        said = self.encoder(of.cut(support.gather(1, chosen).flatten(), pushes, 1), mirror=mirror)
        context = self.encoder.pooled(said.view(self.tasks, points, -1), K * of.pushes)
        return rows, starts, context.repeat_interleave(each, 0)


@dataclass
class GnnContext(Model):
    """Learns the network of `gnn` and, with it, to read a domain out of the pushes of its support.

    A conditional neural process (Garnelo et al. 2018) around an interaction network: every push of the support is
    encoded with what it did, the mean of the codes is a context that all nodes see. It learns from tasks, K of which
    is drawn from those it will be asked about and 0. Without support the context is 0. Not in the paper. Shapes:
    support of K trajectories to (C + 1,), then as `gnn`. Cost: 51,829 parameters; on one core a step of 64 single
    pushes takes 16 ms, and a support of K = 10 is read in 10 ms.
    """

    width: int = 32
    context: int = 16  # features that a support says
    tasks: int = 8  # a step
    points: int = 24  # pushes of each support that a step looks at, at most
    learning_rate: float = 3e-3
    batch: int = 64  # windows
    steps: int = 4000
    unrolled: float = 0.3  # share of the fit that learns rollouts
    body_weight: float = 0.1  # of bodies in the loss

    network: GraphNetwork = field(init=False, repr=False, compare=False)
    encoder: PushEncoder = field(init=False, repr=False, compare=False)
    known: Tensor = field(init=False, repr=False, compare=False)  # (C + 1,) of the domain

    def __post_init__(self) -> None:
        """Raises `UsageError` for hyperparameters that nothing can be learned with."""
        positive(self, "context", "tasks", "points")
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
        """Learns from tasks of all training domains; keeps the weights that are best on those of validation domains."""
        supports = [K for K in setting.K if K > 0] or [1]

        def source(scale: float) -> Seen:
            encoder = PushEncoder(self.width, self.context, scale).to(self.device)
            return Seen(encoder, supports, tasks=self.tasks, points=self.points)

        self.network, found = fit(
            self._how(),
            train,
            valid,
            horizon=setting.horizon,
            seed=self.seed,
            device=self.device,
            budget=setting.budget,
            log=setting.log,
            source=source,
        )
        self.encoder = cast("Seen", found).encoder.requires_grad_(False)
        self.known = torch.zeros(self.encoder.size, device=self.device)

    def adapt(self, support: Trajectories) -> GnnContext:
        """Returns a copy that knows what the support says of its domain; itself when there is none."""
        if not len(support):
            return self
        model = copy.copy(self)
        model.known = self.encoder.domain(record([support], 1, self.device))
        return model

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2) and the bodies (1, B, 3, 3)."""
        return predict(self.network, query, self.device, self.known)

    def parameters(self) -> int:
        """Returns the number of weights and biases of network and encoder."""
        return sum(weight.numel() for part in (self.network, self.encoder) for weight in part.parameters())
