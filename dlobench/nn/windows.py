"""Turns trajectories and queries into flat, standardised tensors.

D domains hold R trajectories of `starts` windows each. The F features of a window are: pusher 2, heading of the first
action 2 in its frame alone, segments 64, bodies 12 where asked for, actions 2 n. In the frame `push` the origin is the
pusher and the x axis points along the first action, for all but pusher and heading, which tell where the walls are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from dlobench import ranges
from dlobench.domain import MAX_SEGMENTS
from dlobench.errors import RunError
from dlobench.trajectories import Floats, Query, Trajectories

Target = Literal["displacement", "absolute"]
Frame = Literal["world", "push"]

COORDINATES = 2 * MAX_SEGMENTS
CONSTANT = 1e-7  # a feature that spreads less (in m, or in cosines) is constant: float32 tells no less apart
BACK = np.array([1, -1], np.float32)  # a heading times this turns the other way
CHUNK = 1024  # trajectories handled at once, so that temporaries stay small


@dataclass(frozen=True)
class Windows:
    """Holds every window of R trajectories; the trajectories of a domain are neighbours."""

    inputs: Tensor  # (R, starts, F)  padding is 0
    targets: Tensor  # (R, starts, 64)  padding is 0
    exists: Tensor  # (D, F)  which features are not padding
    weight: Tensor  # (D, 64)  of each coordinate in the loss: 0 for padding, each row sums to 1
    domain: Tensor  # (R,)  the domain of each trajectory
    count: Tensor  # (D,)  how many trajectories each domain has

    def __len__(self) -> int:
        return self.inputs.shape[0] * self.inputs.shape[1]

    def pick(self, index: Tensor | slice) -> tuple[Tensor, Tensor, Tensor]:
        """Returns inputs (B, F), targets (B, 64) and weights (B, 64) of B windows, numbered from 0 to len − 1."""
        if isinstance(index, slice):
            index = torch.arange(*index.indices(len(self)), device=self.inputs.device)
        weight = self.weight[self.domain[index // self.inputs.shape[1]]]
        return self.inputs.flatten(0, 1)[index], self.targets.flatten(0, 1)[index], weight

    def pick_trajectories(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns all windows of J trajectories for each of N tasks, where `rows` (N, J) keeps to one domain a task.

        Inputs (N, J starts, F), targets (N, J starts, 64), weights (N, 1, 64).
        """
        weight = self.weight[self.domain[rows[:, 0]]]
        return self.inputs[rows].flatten(1, 2), self.targets[rows].flatten(1, 2), weight[:, None]


@dataclass(frozen=True)
class Scaling:
    """Says what windows hold, and how they spread over the training domains."""

    horizon: int  # n, pushes ahead
    bodies: bool  # whether the features hold the rigid bodies
    target: Target
    frame: Frame
    mean: Tensor  # (F,)  of the features where they exist, SI
    std: Tensor  # (F,)  1 for a constant feature
    target_std: float  # m, one for all coordinates, so that the MSE keeps its meaning

    def windows(self, domains: Sequence[Trajectories], device: str = "cpu") -> Windows:
        """Returns the standardised windows; raises `RunError` on a value that is not finite."""
        return self._standardise(_gather(domains, self.horizon, self.bodies, self.target, self.frame), device)

    def inputs(self, query: Query) -> Tensor:
        """Returns the standardised features (B, F); raises `RunError` when the horizon is not the fitted one."""
        if query.horizon != self.horizon:
            raise RunError(f"the query looks {query.horizon} pushes ahead, the model was fitted for {self.horizon}")
        scaled = _features(query, self.bodies, self.frame).sub_(self.mean).div_(self.std)
        return scaled.masked_fill_(~_exists(query, self.bodies, self.horizon, self.frame), 0)

    def positions(self, outputs: Tensor, query: Query) -> Floats:
        """Returns the segments (B, 32, 2) in m that outputs (B, 64) stand for, 0 where there is no segment."""
        positions: Floats = outputs.cpu().numpy().reshape(-1, MAX_SEGMENTS, 2) * np.float32(self.target_std)
        if self.frame == "push":
            positions = _turned(positions, _heading(query))
        positions += _origin(query, self.target, self.frame)
        positions[:, ~query.dlo_mask] = 0
        return positions

    def _standardise(self, raw: Windows, device: str) -> Windows:
        """Scales the windows in place, which spares a second copy of the data."""
        raw.inputs.sub_(self.mean).div_(self.std).masked_fill_(~raw.exists[raw.domain][:, None], 0)
        raw.targets.div_(self.target_std)
        return Windows(**{name: value.to(device) for name, value in vars(raw).items()})


def check(domains: Sequence[Trajectories], horizon: int) -> None:
    """Raises `RunError` where nothing can be learnt: none, of several lengths, too short, without segments."""
    if not sum(map(len, domains)):
        raise RunError(f"no trajectories to learn from in {len(domains)} domains")
    if len(pushes := {domain.pushes for domain in domains}) > 1:
        raise RunError(f"trajectories differ in pushes: {sorted(pushes)}")
    if not 1 <= horizon <= domains[0].pushes:
        raise RunError(f"horizon = {horizon} does not fit into trajectories of {domains[0].pushes} pushes")
    for number, domain in enumerate(domains):
        if not domain.dlo_mask.any():
            raise RunError(f"domain {number} of {len(domains)} has no segment")


def standardise(
    train: Sequence[Trajectories],
    *,
    horizon: int,
    bodies: bool,
    target: Target,
    frame: Frame = "world",
    normalise: bool = True,
    device: str = "cpu",
) -> tuple[Windows, Scaling]:
    """Returns the windows of the training domains, and the scaling fitted on them; all stays in SI unless `normalise`.

    Raises `RunError` as `check` does, and on a value that is not finite; `UsageError` for an unknown target or frame.
    """
    ranges.choice("target", target, get_args(Target))
    ranges.choice("frame", frame, get_args(Frame))
    raw = _gather(train, horizon, bodies, target, frame)
    mean, variance, _ = _moments(raw.inputs, raw.exists[raw.domain])
    _, target_variance, number = _moments(raw.targets, raw.weight[raw.domain] > 0)
    std, target_std = variance.sqrt(), float((target_variance * number).sum().div(number.sum()).sqrt())
    std[std < CONSTANT] = 1
    target_std = target_std if target_std >= CONSTANT else 1.0
    if not normalise:
        mean, std, target_std = torch.zeros_like(mean), torch.ones_like(std), 1.0
    scaling = Scaling(horizon, bodies, target, frame, mean.float(), std.float(), target_std)
    return scaling._standardise(raw, device), scaling


def _heading(query: Query) -> Floats:
    """Returns the unit vectors (B, 2) along the first actions, (1, 0) where the pusher keeps still."""
    action = query.actions[:, 0]
    length = np.linalg.norm(action, axis=-1, keepdims=True)
    ahead: Floats = np.where(length > 0, action / np.where(length > 0, length, 1), np.array([1, 0], np.float32))
    return ahead


def _turned(vectors: Floats, heading: Floats) -> Floats:
    """Returns vectors (B, …, 2) of a frame whose x axis points along these headings (B, 2), as the world has them."""
    c, s = (part.reshape(-1, *[1] * (vectors.ndim - 2)) for part in heading.T)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def _origin(query: Query, target: Target, frame: Frame) -> Floats:
    """Returns where targets are counted from, m: (B, 32, 2) or what is broadcast to it."""
    if target == "displacement":
        return query.dlo[..., :2]
    return query.pusher[:, None] if frame == "push" else np.zeros(2, np.float32)


def _features(query: Query, bodies: bool, frame: Frame = "world") -> Tensor:
    """Returns the features (B, F) in SI."""
    segments, places, yaw, actions = query.dlo[..., :2], query.bodies[..., :2], query.bodies[..., 2:], query.actions
    columns = [query.pusher]
    if frame == "push":
        columns.append(heading := _heading(query))
        back, centre = heading * BACK, query.pusher[:, None]
        segments, places, actions = (_turned(part, back) for part in (segments - centre, places - centre, actions))
        yaw = yaw - np.arctan2(heading[:, 1], heading[:, 0])[:, None, None]
    columns.append(segments)
    if bodies:
        columns.append(np.concatenate([places, np.cos(yaw), np.sin(yaw)], axis=-1))
    flat = [column.reshape(len(query), math.prod(column.shape[1:])) for column in [*columns, actions]]
    return torch.from_numpy(np.concatenate(flat, axis=1, dtype=np.float32))


def _exists(source: Query | Trajectories, bodies: bool, horizon: int, frame: Frame = "world") -> Tensor:
    """Returns which of the F features are not padding."""
    poses = np.repeat(source.body_mask, 4 if bodies else 0)
    pusher = np.ones(4 if frame == "push" else 2, bool)
    return torch.from_numpy(np.concatenate([pusher, np.repeat(source.dlo_mask, 2), poses, np.ones(2 * horizon, bool)]))


def _gather(domains: Sequence[Trajectories], horizon: int, bodies: bool, target: Target, frame: Frame) -> Windows:
    """Returns the windows in SI."""
    check(domains, horizon)
    count = torch.tensor([len(domain) for domain in domains], dtype=torch.long)
    exists = torch.stack([_exists(domain, bodies, horizon, frame) for domain in domains])
    shape = int(count.sum()), domains[0].pushes - horizon + 1
    inputs, targets = torch.empty(*shape, exists.shape[1]), torch.empty(*shape, COORDINATES)
    row = 0
    for number, domain in enumerate(domains):
        for start in range(0, len(domain), CHUNK):
            query, after = domain.take(slice(start, start + CHUNK)).windows(horizon)
            moved = after.dlo[0] - _origin(query, target, frame)
            if frame == "push":
                moved = _turned(moved, _heading(query) * BACK)
            moved[:, ~domain.dlo_mask] = 0
            rows = slice(row, row := row + len(query) // shape[1])
            inputs[rows] = _features(query, bodies, frame).view(-1, *inputs.shape[1:])
            targets[rows] = torch.from_numpy(moved).view(-1, *targets.shape[1:])
            if not (inputs[rows].isfinite().all() and targets[rows].isfinite().all()):
                raise RunError(f"domain {number} of {len(domains)} holds a position or action that is not finite")
    mask = torch.from_numpy(np.stack([np.repeat(domain.dlo_mask, 2) for domain in domains])).to(inputs)
    domain_of = torch.arange(len(domains)).repeat_interleave(count)
    return Windows(inputs, targets, exists, mask / mask.sum(1, keepdim=True), domain_of, count)


def _moments(values: Tensor, exists: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns mean, variance and number of the values (R, starts, F) that exist (R, F), in float64; never, then 0."""
    chunks = list(zip(torch.split(values, CHUNK), torch.split(exists[:, None], CHUNK), strict=True))
    number = exists.sum(0).mul(values.shape[1]).double()
    mean = torch.stack([(v.double() * e).sum((0, 1)) for v, e in chunks]).sum(0) / number.clamp_min(1)
    # Two passes, since the difference of two large sums would give a constant feature a spread.
    squares = torch.stack([((v.double() - mean) * e).square().sum((0, 1)) for v, e in chunks]).sum(0)
    return mean, squares / number.clamp_min(1), number
