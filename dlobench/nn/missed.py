"""Models what a network of one push misses, by a generative network of whole shapes in the frame of the push.

What becomes of a command is drawn in two parts, one after the other: where the pusher really goes, normal about the
command, and what the graph network misses of the shape then. The second part is learned from pushes that the network
did not learn from, since it misses less of those that it did.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from dlobench.nn.budget import Budget, Log
from dlobench.nn.execution import noise_root, travelled
from dlobench.nn.fit import Plan, descend
from dlobench.nn.geometry import Scene, rotated
from dlobench.nn.graph import ROUNDS, GraphNetwork, shifted
from dlobench.nn.rollout import Rollout, fit, predict
from dlobench.nn.scenes import Recorded, record, scene
from dlobench.trajectories import Prediction, Query, Trajectories

HELD = 5  # one of so many trajectories is held back from the network of one push
PUSHES = 10_000  # that what is missed is learned from, at most
SHARE = 0.8  # of the minutes, for the network of one push
CHUNK = 1024  # scenes looked at at once
NUMBERS = 64  # coordinates of the longest DLO


@dataclass(frozen=True)
class Missed:
    """Holds P pushes as the network sees them, and what it missed of each in the frame of the push, or its mirror."""

    hidden: Tensor  # (P, N, W)
    exists: Tensor  # (P, N, 1)
    shape: Tensor  # (P, N, 2)  in units of a scale

    def covariance(self) -> Tensor:
        """Returns that of whole shapes about 0, (64, 64), each pair over the pushes which have both segments."""
        filled = torch.zeros(len(self.shape), NUMBERS, dtype=torch.float64, device=self.shape.device)
        there, flat = filled.clone(), (self.shape * self.exists).flatten(1)
        filled[:, : flat.shape[1]] = flat.double()
        there[:, : flat.shape[1]] = self.exists.expand_as(self.shape).flatten(1).double()
        return filled.T @ filled / (there.T @ there).clamp_min(1)


class Chain(nn.Module):
    """Passes messages along the chain: what the graph network makes of each segment, and `extra` numbers beside it."""

    def __init__(self, hidden: int, extra: int, width: int) -> None:
        super().__init__()
        self.start = nn.Linear(hidden + extra, width)
        self.rounds = nn.ModuleList(nn.Linear(width * (2 + 2 * len(hears)), width) for hears in ROUNDS)
        self.last = nn.Linear(width, width)

    def forward(self, hidden: Tensor, extra: Tensor, exists: Tensor) -> Tensor:
        """Returns features (B, N, width) of features (B, N, hidden) and (B, N, extra); 0 where there is no segment."""
        share = exists / exists.sum(1, keepdim=True)
        h = silu(self.start(torch.cat([hidden, extra], -1))) * exists
        for mix, hears in zip(self.rounds, ROUNDS, strict=True):
            heard = [shifted(h, sign * by) for by in hears for sign in (1, -1)]
            h = h + silu(mix(torch.cat([h, *heard, (h * share).sum(1, keepdim=True).expand_as(h)], -1))) * exists
        out: Tensor = silu(self.last(h)) * exists
        return out


class Residual(nn.Module, ABC):
    """Draws what is missed of a shape, whole, given what the network of one push makes of it."""

    numbers: int  # standard normal ones that a draw takes

    @abstractmethod
    def loss(self, of: Missed, generator: torch.Generator) -> Tensor:
        """Returns what `fit` makes small, the mean over pushes."""

    @abstractmethod
    def draw(self, hidden: Tensor, exists: Tensor, noise: Tensor) -> Tensor:
        """Returns shapes (B, N, 2), in units of the scale, from noise (B, numbers)."""


class Sampler(nn.Module):
    """Joins the network of one push, how commands are executed, and what both miss."""

    execution: Tensor

    def __init__(self, network: GraphNetwork, executed: Tensor, residual: Residual, scale: float) -> None:
        super().__init__()
        self.network, self.residual, self.scale = network, residual, scale  # m, of what is missed
        self.register_buffer("execution", executed)

    @torch.no_grad()
    def predict(self, query: Query, samples: int, *, seed: int, device: str) -> Prediction:
        """Returns segments (S, B, 32, 2) and bodies (S, B, 3, 3); for S = 1 what the network says of the command.

        Sample s has the same noise for every query, so that a prediction depends on no other query. Every other sample
        is drawn in the mirror.
        """
        if samples == 1:
            return predict(self.network, query, device)
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(samples, query.horizon, 2 + self.residual.numbers, generator=generator).to(device)
        dlo = np.zeros((samples, len(query), *query.dlo.shape[1:2], 2), np.float32)
        bodies = np.repeat(query.bodies[None], samples, 0)
        each = max(1, CHUNK // len(query))
        for mirror in (False, True):
            chosen = torch.arange(int(mirror), samples, 2)
            for s in torch.split(chosen, each):
                many = query.take(np.tile(np.arange(len(query)), len(s)))
                now, actions = scene(many, device), torch.from_numpy(np.ascontiguousarray(many.actions)).to(device)
                for k, action in enumerate(actions.unbind(1)):
                    now = self._push(now, action, noise[s, k].repeat_interleave(len(query), 0), mirror=mirror)
                N, M = now.dlo.shape[1], now.bodies.shape[1]
                dlo[s, :, :N] = now.dlo.view(len(s), len(query), N, 2).cpu().numpy()
                bodies[s, :, :M] = now.bodies.view(len(s), len(query), M, 3).cpu().numpy()
        dlo[:, :, ~query.dlo_mask] = 0
        return Prediction(dlo=dlo, bodies=bodies)

    def _push(self, now: Scene, action: Tensor, noise: Tensor, *, mirror: bool) -> Scene:
        """Returns what may come of a command (B, 2), by noise (B, 2 + numbers)."""
        executed = action + noise[:, :2] @ self.execution.T
        mean, hidden = seen(self.network, now, executed, mirror=mirror)
        missed = self.residual.draw(hidden, now.exists[..., None], noise[:, 2:]) * self.scale
        return replace(mean, dlo=mean.dlo + framed(missed, executed, mirror=mirror, back=True) * now.exists[..., None])


def framed(vectors: Tensor, action: Tensor, *, mirror: bool, back: bool = False) -> Tensor:
    """Returns vectors (B, N, 2) of the world in the frame of an action (B, 2), or its mirror; or `back` from there."""
    flip = vectors.new_tensor([1.0, -1.0 if mirror else 1.0])
    angle = torch.atan2(action[:, 1], action[:, 0])[:, None]
    return rotated(vectors * flip, angle) if back else rotated(vectors, -angle) * flip


def seen(network: GraphNetwork, now: Scene, action: Tensor, *, mirror: bool) -> tuple[Scene, Tensor]:
    """Returns the mean of a network's two sights of an action, and the features of segments in one of them."""
    (one, plain), (other, mirrored) = (network.sight(now, action, mirror=m) for m in (False, True))
    mean = replace(one, dlo=(one.dlo + other.dlo) / 2, bodies=(one.bodies + other.bodies) / 2)
    return mean, mirrored if mirror else plain


@torch.no_grad()
def missed(network: GraphNetwork, of: Recorded, generator: torch.Generator) -> Missed:
    """Returns what a network misses, m, of single pushes drawn without replacement, in both sights of each."""
    count = len(of.dlo) * of.pushes
    chosen = torch.randperm(count, generator=generator)[: PUSHES // 2].to(of.dlo.device)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for index in torch.split(chosen, CHUNK):
        cut = of.cut(index // of.pushes, index % of.pushes, 1)
        action = cut.actions[:, 0]
        for mirror in (False, True):
            mean, hidden = seen(network, cut.start, action, mirror=mirror)
            shape = framed(cut.dlo[:, 0] - mean.dlo, action, mirror=mirror)
            found.append((hidden, cut.start.exists[..., None], shape * cut.start.exists[..., None]))
    return Missed(*(torch.cat(parts) for parts in zip(*found, strict=True)))


def learn(
    how: Rollout,
    make: Callable[[Missed], Residual],
    train: Sequence[Trajectories],
    valid: Sequence[Trajectories],
    *,
    plan: Plan,
    batch: int,
    horizon: int,
    seed: int,
    device: str,
    budget: Budget,
    log: Log,
) -> Sampler:
    """Fits the network of one push to most training trajectories, then a residual to what it misses of the others.

    `make` is given what is missed, in units of its root mean square. Raises `RunError` as `rollout.fit` does.
    """
    known, other = divided(train)
    network, _ = fit(
        how,
        [travelled(domain) for domain in known],
        [travelled(domain) for domain in valid],
        horizon=horizon,
        seed=seed,
        device=device,
        budget=replace(budget, minutes=budget.minutes and budget.minutes * SHARE),
        log=log,
    )
    generator = torch.Generator().manual_seed(seed)

    def gathered(domains: Sequence[Trajectories]) -> Missed:
        return missed(network, record([travelled(domain) for domain in domains], 1, device), generator)

    held = gathered(other)
    scale = float((held.shape.square().sum() / (2 * held.exists.sum())).sqrt()) or 1.0
    held = replace(held, shape=held.shape / scale)
    unseen = gathered(valid) if valid else None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        residual = make(held).to(device)

    def train_loss() -> Tensor:
        index = torch.randint(len(held.shape), (batch,), generator=generator).to(device)
        return residual.loss(Missed(held.hidden[index], held.exists[index], held.shape[index]), generator)

    def valid_loss(of: Missed) -> float:
        return float(residual.loss(replace(of, shape=of.shape / scale), torch.Generator().manual_seed(0)))

    check = None if unseen is None else lambda: valid_loss(unseen)
    rest = replace(budget, minutes=budget.minutes and budget.minutes * (1 - SHARE))
    done = budget.steps_of(how.steps)
    after = Log([lambda step, total, values: log(done + step, done + total, **values)])
    descend(list(residual.parameters()), train_loss, check, plan=plan, budget=rest, log=after)
    return Sampler(network, noise_root(train).to(device), residual, scale).requires_grad_(False)


def divided(domains: Sequence[Trajectories]) -> tuple[list[Trajectories], list[Trajectories]]:
    """Returns most trajectories of every domain, and one of `HELD` of each; all in both where a domain has but one."""
    kept, held = [], []
    for domain in domains:
        index = np.arange(len(domain))
        back = index % HELD == HELD - 1 if len(domain) >= HELD else index == len(domain) - 1
        kept.append(domain.take(index[~back]) if len(domain) > 1 else domain)
        held.append(domain.take(index[back]))
    return kept, held
