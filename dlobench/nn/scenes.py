"""Holds recorded trajectories as scenes: minibatches of states, the actions after them, and what came of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dlobench.errors import RunError
from dlobench.nn.geometry import Scene
from dlobench.nn.windows import check
from dlobench.trajectories import Query, Trajectories


@dataclass(frozen=True)
class Cut:
    """Holds B windows of n pushes: where they begin, what is done, and what comes of each push."""

    start: Scene
    actions: Tensor  # (B, n, 2)
    dlo: Tensor  # (B, n, N, 2)
    bodies: Tensor  # (B, n, M, 3)


@dataclass(frozen=True)
class Recorded:
    """Holds the R trajectories of D domains, of T pushes each; the trajectories of a domain are neighbours."""

    dlo: Tensor  # (R, T + 1, N, 2)  m
    pusher: Tensor  # (R, T + 1, 2)  m
    bodies: Tensor  # (R, T + 1, M, 3)  m, m, rad; M is that of the domain which has most
    actions: Tensor  # (R, T, 2)  m
    domain: Tensor  # (R,)
    count: Tensor  # (D,)  trajectories
    exists: Tensor  # (D, N)  1 or 0
    present: Tensor  # (D, M)  1 or 0
    boxes: Tensor  # (D, M, 5, 5)
    parameters: Tensor | None  # (D, 11)  where all domains tell them

    @property
    def pushes(self) -> int:
        """Returns T."""
        return self.actions.shape[1]

    def scene(self, rows: Tensor, starts: Tensor) -> Scene:
        """Returns the states in which windows begin: trajectories `rows` (B,), after `starts` (B,) pushes."""
        of = self.domain[rows]
        return Scene(
            dlo=self.dlo[rows, starts],
            exists=self.exists[of],
            pusher=self.pusher[rows, starts],
            bodies=self.bodies[rows, starts],
            present=self.present[of],
            boxes=self.boxes[of],
            table=self.dlo.new_zeros(len(rows), 3),
        )

    def cut(self, rows: Tensor, starts: Tensor, n: int) -> Cut:
        """Returns windows of n pushes."""
        ahead = starts[:, None] + torch.arange(n, device=starts.device)
        many = rows[:, None]
        actions, dlo, bodies = self.actions[many, ahead], self.dlo[many, ahead + 1], self.bodies[many, ahead + 1]
        return Cut(self.scene(rows, starts), actions, dlo, bodies)

    def draw(self, count: int, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draws windows of n pushes, with replacement: their trajectories and the pushes before them, (B,) each."""
        rows = torch.randint(len(self.dlo), (count,), generator=generator)
        starts = torch.randint(self.pushes - n + 1, (count,), generator=generator)
        return rows.to(self.dlo.device), starts.to(self.dlo.device)

    def spread(self) -> float:
        """Returns the root mean square of a coordinate's displacement in one push, m; 1 where nothing moves."""
        weight = self.exists[self.domain][:, None, :, None]
        moved = self.dlo.diff(dim=1) * weight
        mean = moved.double().square().sum() / (2 * moved.shape[1] * weight.double().sum())
        return float(mean.sqrt()) or 1.0


def record(domains: Sequence[Trajectories], horizon: int, device: str = "cpu") -> Recorded:
    """Returns the trajectories of domains as scenes.

    Raises `RunError` where there are none, where they differ in pushes or are shorter than the horizon, for a domain
    that has no segment, and for a value that is not finite.
    """
    check(domains, horizon)
    most = max(int(domain.body_mask.sum()) for domain in domains)
    for number, domain in enumerate(domains):
        masked = domain.dlo[:, :, domain.dlo_mask], domain.bodies[:, :, domain.body_mask]
        if not all(np.isfinite(each).all() for each in (*masked, domain.pusher, domain.executed)):
            raise RunError(f"domain {number} of {len(domains)} holds a position or action that is not finite")

    def joined(arrays: list[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.concatenate(arrays, dtype=np.float32)).to(device)

    told = [d.parameters for d in domains if d.parameters is not None]
    counts = torch.tensor([len(domain) for domain in domains])
    return Recorded(
        dlo=joined([np.where(d.dlo_mask[:, None], d.dlo[..., :2], 0) for d in domains]),
        pusher=joined([d.pusher for d in domains]),
        bodies=joined([np.where(d.body_mask[:most, None], d.bodies[:, :, :most], 0) for d in domains]),
        actions=joined([d.executed for d in domains]),
        domain=torch.arange(len(domains)).repeat_interleave(counts).to(device),
        count=counts.to(device),
        exists=joined([d.dlo_mask[None] for d in domains]),
        present=joined([d.body_mask[None, :most] for d in domains]),
        boxes=joined([d.boxes[None, :most] for d in domains]),
        parameters=joined([known[None] for known in told]) if len(told) == len(domains) else None,
    )


def scene(query: Query, device: str = "cpu") -> Scene:
    """Returns the states that a query asks about, without the bodies and segments that nobody has at the end."""
    N, M = (int(np.flatnonzero(mask).max(initial=-1)) + 1 for mask in (query.dlo_mask, query.body_mask))

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(device)

    def alike(array: np.ndarray) -> Tensor:
        return tensor(array).expand(len(query), *array.shape)

    return Scene(
        dlo=tensor(np.where(query.dlo_mask[:N, None], query.dlo[:, :N, :2], 0)),
        exists=alike(query.dlo_mask[:N]),
        pusher=tensor(query.pusher),
        bodies=tensor(np.where(query.body_mask[:M, None], query.bodies[:, :M], 0)),
        present=alike(query.body_mask[:M]),
        boxes=alike(query.boxes[:M]),
        table=torch.zeros(len(query), 3, device=device),
    )
