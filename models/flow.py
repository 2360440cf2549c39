"""Predicts samples: a flow from Gaussian noise to what a graph network misses of whole shapes, by flow matching."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from dlobench.bench.model import Model, Setting
from dlobench.nn.execution import root
from dlobench.nn.fit import Plan, positive
from dlobench.nn.missed import NUMBERS, Chain, Missed, Residual, Sampler, learn
from dlobench.nn.rollout import Rollout
from dlobench.trajectories import Prediction, Query, Trajectories

TIMES = 4  # features of the time of the flow


class Velocity(Residual):
    """Moves noise to shapes along an ordinary differential equation, over a time from 0 to 1.

    The noise is that of the Gaussian which is spread as what is missed, so that the way is short.
    """

    spread: Tensor
    numbers = NUMBERS

    def __init__(self, of: Missed, width: int, steps: int) -> None:
        super().__init__()
        self.steps = steps
        self.chain, self.out = Chain(of.hidden.shape[-1], 2 + TIMES, width), nn.Linear(width, 2)
        self.register_buffer("spread", root(of.covariance()))

    def forward(self, hidden: Tensor, exists: Tensor, shape: Tensor, time: Tensor) -> Tensor:
        """Returns the velocity (B, N, 2) of a shape (B, N, 2) at a time (B,)."""
        clock = torch.stack([f(k * torch.pi * time) for k in (1, 2) for f in (torch.cos, torch.sin)], -1)
        extra = torch.cat([shape, clock[:, None].expand(-1, shape.shape[1], -1)], -1)
        velocity: Tensor = self.out(self.chain(hidden, extra, exists)) * exists
        return velocity

    def begin(self, noise: Tensor, segments: int) -> Tensor:
        """Returns shapes (B, N, 2) of so many segments from standard normal noise (B, 64)."""
        return (noise @ self.spread.T)[:, : 2 * segments].view(len(noise), segments, 2)

    def loss(self, of: Missed, generator: torch.Generator) -> Tensor:
        """Returns the squared error of the velocity on straight ways (Lipman et al. 2023, equation 23)."""
        device = of.shape.device
        noise = torch.randn(len(of.shape), NUMBERS, generator=generator).to(device)
        time = torch.rand(len(of.shape), generator=generator).to(device)
        start, t = self.begin(noise, of.shape.shape[1]) * of.exists, time[:, None, None]
        found: Tensor = self(of.hidden, of.exists, start + t * (of.shape - start), time)
        return (found - of.shape + start).square().sum() / (2 * of.exists.sum())

    def draw(self, hidden: Tensor, exists: Tensor, noise: Tensor) -> Tensor:
        """Returns shapes (B, N, 2) from noise (B, 64): midpoint steps along the flow."""
        shape = self.begin(noise, hidden.shape[1]) * exists
        half = 0.5 / self.steps
        for k in range(self.steps):
            time = noise.new_full((len(noise),), k / self.steps)
            middle = shape + half * self(hidden, exists, shape, time)
            shape = shape + 2 * half * self(hidden, exists, middle, time + half)
        return shape


@dataclass
class Flow(Model):
    """Learns the network of `gnn` from where the pusher went, then a flow of what that misses of whole shapes.

    Conditional flow matching with straight ways (Lipman et al. 2023; Liu et al. 2023), in the frame of the push, given
    what the graph network makes of each segment. It is learned from a fifth of the trajectories, which the network does
    not see. Each sample draws n pushes, one after the other: where the pusher goes, as `gnn_noise` does, then the
    shape. Bodies follow the network. Asked for one sample it returns what the network says of the command.
    Not in the paper. Shapes: (B, N, 2) to (S, B, N, 2). Cost: the fit of `gnn` and, on one core, 2,000 steps of about
    18 ms; 20,898 parameters more, and a covariance.
    """

    width: int = 32
    learning_rate: float = 3e-3
    batch: int = 64  # windows
    steps: int = 4000
    unrolled: float = 0.3  # share of the fit that learns rollouts, where the horizon is above 1
    body_weight: float = 0.1  # of bodies in the loss
    flow_width: int = 32
    flow_batch: int = 128  # pushes
    flow_steps: int = 2000  # of the fit
    flow_rate: float = 2e-3
    midpoints: int = 6  # steps along the flow, each of which asks for its velocity twice

    sampler: Sampler = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Raises `UsageError` for hyperparameters that nothing can be learned with."""
        positive(self, "flow_width", "flow_batch", "flow_steps", "flow_rate", "midpoints")
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
        """Learns network, execution noise and flow; keeps the weights that are best on the validation domains."""
        self.sampler = learn(
            self._how(),
            lambda of: Velocity(of, self.flow_width, self.midpoints),
            train,
            valid,
            plan=Plan(self.flow_steps, self.flow_rate, patience=self.flow_steps, every=100, cosine=True, clip=1.0),
            batch=self.flow_batch,
            horizon=setting.horizon,
            seed=self.seed,
            device=self.device,
            budget=setting.budget,
            log=setting.log,
        )

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (S, B, 32, 2) and the bodies (S, B, 3, 3)."""
        return self.sampler.predict(query, samples, seed=self.seed, device=self.device)

    def parameters(self) -> int:
        """Returns the number of weights and biases, and of covariances."""
        learned = sum(weight.numel() for weight in self.sampler.parameters())
        return learned + 3 + NUMBERS * (NUMBERS + 1) // 2
