"""Predicts samples: a conditional variational autoencoder of what a graph network misses, whole shapes at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from dlobench.bench.model import Model, Setting
from dlobench.nn.fit import Plan, positive
from dlobench.nn.missed import NUMBERS, Chain, Missed, Residual, Sampler, learn
from dlobench.nn.rollout import Rollout
from dlobench.trajectories import Prediction, Query, Trajectories


class Autoencoder(Residual):
    """Draws a shape from a few latent numbers, which all segments share, and a little white noise.

    The evidence lower bound (Kingma & Welling 2014; Sohn et al. 2015), with a standard normal prior and a width of the
    decoder that is learned as well (Rybkin et al. 2021): nothing is to be weighed by hand.
    """

    def __init__(self, of: Missed, width: int, latent: int) -> None:
        super().__init__()
        hidden = of.hidden.shape[-1]
        self.latent, self.numbers = latent, latent + NUMBERS
        self.encoder, self.code = Chain(hidden, 2, width), nn.Linear(width, 2 * latent)
        self.decoder, self.out = Chain(hidden, latent, width), nn.Linear(width, 2)
        self.log_width = nn.Parameter(torch.zeros(()))

    def decode(self, hidden: Tensor, exists: Tensor, z: Tensor) -> Tensor:
        """Returns the mean shape (B, N, 2) of latent numbers (B, latent)."""
        mean: Tensor = self.out(self.decoder(hidden, z[:, None].expand(*hidden.shape[:2], -1), exists)) * exists
        return mean

    def loss(self, of: Missed, generator: torch.Generator) -> Tensor:
        """Returns the negative evidence lower bound, the mean over pushes, per coordinate."""
        segments = of.exists.sum(1)
        pooled = self.encoder(of.hidden, of.shape, of.exists).sum(1) / segments
        mean, log_std = self.code(pooled).chunk(2, -1)
        noise = torch.randn(mean.shape, generator=generator).to(mean.device)
        apart = self.decode(of.hidden, of.exists, mean + noise * log_std.exp()) - of.shape
        coordinates = 2 * segments.squeeze(-1)
        told = 0.5 * (apart / self.log_width.exp()).square().sum((1, 2)) + coordinates * self.log_width
        divergence = 0.5 * (mean.square() + (2 * log_std).exp() - 1 - 2 * log_std).sum(-1)
        bound: Tensor = ((told + divergence) / coordinates).mean()
        return bound

    def draw(self, hidden: Tensor, exists: Tensor, noise: Tensor) -> Tensor:
        """Returns shapes (B, N, 2) from noise (B, latent + 64)."""
        mean = self.decode(hidden, exists, noise[:, : self.latent])
        white = noise[:, self.latent :][:, : mean[0].numel()].view_as(mean)
        return mean + white * self.log_width.exp() * exists


@dataclass
class Cvae(Model):
    """Learns the network of `gnn` from where the pusher went, then an autoencoder of what that misses of whole shapes.

    A conditional variational autoencoder (Sohn et al. 2015) in the frame of the push, given what the graph network
    makes of each segment. It is learned from a fifth of the trajectories, which the network does not see. Each sample
    draws n pushes, one after the other: where the pusher goes, as `gnn_noise` does, then the shape. Bodies follow the
    network. Asked for one sample it returns what the network says of the command. Not in the paper. Shapes: (B, N, 2)
    to (S, B, N, 2). Cost: the fit of `gnn` and, on one core, 2,000 steps of about 35 ms; 42,195 parameters more.
    """

    width: int = 32
    learning_rate: float = 3e-3
    batch: int = 64  # windows
    steps: int = 4000
    unrolled: float = 0.3  # share of the fit that learns rollouts, where the horizon is above 1
    body_weight: float = 0.1  # of bodies in the loss
    latent: int = 8  # numbers
    code_width: int = 32
    code_batch: int = 128  # pushes
    code_steps: int = 2000
    code_rate: float = 2e-3

    sampler: Sampler = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Raises `UsageError` for hyperparameters that nothing can be learned with."""
        positive(self, "latent", "code_width", "code_batch", "code_steps", "code_rate")
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
        """Learns network, execution noise and autoencoder; keeps the weights that are best on validation domains."""
        self.sampler = learn(
            self._how(),
            lambda of: Autoencoder(of, self.code_width, self.latent),
            train,
            valid,
            plan=Plan(self.code_steps, self.code_rate, patience=self.code_steps, every=100, cosine=True, clip=1.0),
            batch=self.code_batch,
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
        """Returns the number of weights and biases, and of a covariance."""
        return sum(weight.numel() for weight in self.sampler.parameters()) + 3
