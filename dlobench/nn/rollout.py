"""Fits networks of one push to rollouts of many, and applies them to their own predictions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dlobench.errors import RunError, UsageError
from dlobench.nn.budget import Budget, Log
from dlobench.nn.fit import Plan, descend, positive
from dlobench.nn.geometry import Scene
from dlobench.nn.graph import LEVER, GraphNetwork
from dlobench.nn.scenes import Cut, Recorded, record, scene
from dlobench.trajectories import Prediction, Query, Trajectories

CHUNK = 256  # windows that a pass without gradient takes at once
DRAWS, DRAWN = 16, 128  # of a validation, and the windows of each: a source may tell more in one than in another


@dataclass(frozen=True)
class Rollout:
    """Says how to fit a network of one push: single pushes first, then rollouts as long as the horizon."""

    width: int
    learning_rate: float
    batch: int  # windows
    steps: int
    unrolled: float  # share of the fit that learns rollouts
    body_weight: float  # of the error of bodies in the loss

    def __post_init__(self) -> None:
        positive(self, "width", "learning_rate", "batch", "steps")
        for name, value in (("unrolled", self.unrolled), ("body_weight", self.body_weight)):
            if not 0 <= value <= 1:
                raise UsageError(f"{name} = {value!r} is not between 0 and 1")

    @property
    def plan(self) -> Plan:
        """Returns the plan: a cosine over all steps, from which nothing but the budget stops it early."""
        return Plan(self.steps, self.learning_rate, patience=self.steps, every=250, cosine=True, clip=1.0)


class Source:
    """Draws the windows that a network learns from, and what it is told of their domains: here nothing."""

    size = 0  # of the context

    def weights(self) -> list[Tensor]:
        """Returns what is learned beside the network."""
        return []

    def draw(
        self, of: Recorded, count: int, n: int, generator: torch.Generator, *, mirror: bool = False
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Returns trajectories (B,), pushes before the windows (B,) and contexts (B, C) of about `count` windows."""
        return *of.draw(count, n, generator), None


def unroll(
    network: GraphNetwork, start: Scene, actions: Tensor, context: Tensor | None = None, *, mirror: bool = False
) -> Iterator[Scene]:
    """Yields the scene after each of the actions (B, n, 2), one following from the other."""
    now = start
    for action in actions.unbind(1):
        now = network(now, action, context, mirror=mirror)
        yield now


def losses(
    network: GraphNetwork, cut: Cut, body_weight: float, context: Tensor | None = None, *, mirror: bool = False
) -> Tensor:
    """Returns the squared error of windows after each of their pushes, (B, n) m²."""
    walk = unroll(network, cut.start, cut.actions, context, mirror=mirror)
    found = [errors(made, cut.dlo[:, k], cut.bodies[:, k], body_weight) for k, made in enumerate(walk)]
    return torch.stack(found, 1)


def errors(made: Scene, dlo: Tensor, bodies: Tensor, body_weight: float) -> Tensor:
    """Returns the squared error of each scene, (B,) m²: the mean over coordinates of segments, and that of bodies."""
    count = made.exists.sum(1).clamp_min(1)
    out = ((made.dlo - dlo).square().sum(-1) * made.exists).sum(1) / (2 * count)
    if body_weight and bodies.shape[1]:
        apart = made.bodies - bodies
        turn = torch.remainder(apart[..., 2] + torch.pi, 2 * torch.pi) - torch.pi
        off = apart[..., :2].square().sum(-1) + (LEVER * turn).square()
        out = out + body_weight * (off * made.present).sum(1) / made.present.sum(1).clamp_min(1)
    return out


def fit(
    how: Rollout,
    train: Sequence[Trajectories],
    valid: Sequence[Trajectories],
    *,
    horizon: int,
    seed: int,
    device: str,
    budget: Budget,
    log: Log,
    source: Callable[[float], Source] = lambda scale: Source(),
) -> tuple[GraphNetwork, Source]:
    """Fits a network to the training domains and keeps the weights that predict the validation domains best.

    `source` is made for the spread of displacements in one push, m. Raises `RunError` as `record` and `descend` do.
    """
    recorded = record(train, horizon, device)
    unseen = record(valid, horizon, device) if valid else None
    generator = torch.Generator().manual_seed(seed)
    scale = recorded.spread()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        told = source(scale)
        network = GraphNetwork(how.width, scale, told.size).to(device)
    done, step = budget.progress(budget.steps_of(how.plan.steps)), 0

    def train_loss() -> Tensor:
        nonlocal step
        step += 1
        n = 1 if done(step) <= 1 - how.unrolled else horizon
        mirror = bool(torch.randint(2, (), generator=generator))
        rows, starts, context = told.draw(recorded, how.batch, n, generator, mirror=mirror)
        found = losses(network, recorded.cut(rows, starts, n), how.body_weight, context, mirror=mirror)
        return found.mean() / scale**2

    def valid_loss(of: Recorded) -> float:
        chosen, found = torch.Generator().manual_seed(0), []  # the same windows at every validation
        for _ in range(DRAWS):
            rows, starts, context = told.draw(of, DRAWN, horizon, chosen)
            found.append(losses(network, of.cut(rows, starts, horizon), how.body_weight, context)[:, -1])
        return float(torch.cat(found).mean()) / scale**2

    check = None if unseen is None else lambda: valid_loss(unseen)
    descend([*network.parameters(), *told.weights()], train_loss, check, plan=how.plan, budget=budget, log=log)
    return network.requires_grad_(False), told


@torch.no_grad()
def predict(network: GraphNetwork, query: Query, device: str, context: Tensor | None = None) -> Prediction:
    """Returns segments (1, B, 32, 2) and bodies (1, B, 3, 3), the mean of the world's sight and that of its mirror.

    `context` (C,) is what is known of the domain. Raises `RunError` for a query without an action.
    """
    if query.horizon < 1:
        raise RunError("the query looks 0 pushes ahead: there is no action to predict by")
    dlo = np.zeros((*query.dlo.shape[:2], 2), np.float32)
    bodies = np.array(query.bodies, np.float32)
    for first in range(0, len(query), CHUNK):
        part = slice(first, first + CHUNK)
        start = scene(query.take(np.arange(len(query))[part]), device)
        actions = torch.from_numpy(np.ascontiguousarray(query.actions[part], np.float32)).to(device)
        known = None if context is None else context.expand(len(start), -1)
        *_, one = unroll(network, start, actions, known)
        *_, other = unroll(network, start, actions, known, mirror=True)
        N, M = start.dlo.shape[1], start.bodies.shape[1]
        dlo[part, :N] = ((one.dlo + other.dlo) / 2).cpu().numpy()
        bodies[part, :M] = ((one.bodies + other.bodies) / 2).cpu().numpy()
    dlo[:, ~query.dlo_mask] = 0
    return Prediction(dlo=dlo[None], bodies=bodies[None])
