"""Makes a toy world for the tests of models: a rod that follows the pusher by a gain and a turn of its domain."""

from __future__ import annotations

import numpy as np
import torch

from dlobench.domain import MAX_BODIES, MAX_BOXES, MAX_SEGMENTS, SEGMENT_LENGTH
from dlobench.nn.geometry import Scene
from dlobench.trajectories import Floats, Trajectories


def toy_domain(rng: np.random.Generator, *, trajectories: int, pushes: int = 6, segments: int = 20) -> Trajectories:
    """Simulates one domain: the rod moves by gain × action and turns with the action's lever; both gains are hidden."""
    K, T = trajectories, pushes
    gain, turn = rng.uniform(-1.0, 1.0), rng.uniform(-2.0, 2.0)
    mask = np.arange(MAX_SEGMENTS) < segments
    along = np.where(mask, (np.arange(MAX_SEGMENTS) - (segments - 1) / 2) * SEGMENT_LENGTH, 0)
    actions = rng.normal(scale=0.01, size=(K, T, 2))
    centre, yaw = rng.normal(scale=0.02, size=(K, 2)), rng.uniform(-1, 1, size=K)
    pusher = rng.normal(scale=0.03, size=(K, 2))
    dlo, pushers = np.zeros((K, T + 1, MAX_SEGMENTS, 3)), np.zeros((K, T + 1, 2))
    for t in range(T + 1):
        direction = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
        dlo[:, t, :, :2] = centre[:, None] + along[:, None] * direction[:, None]
        dlo[:, t, :, 2] = yaw[:, None]
        pushers[:, t] = pusher
        if t < T:
            lever = direction[:, 0] * actions[:, t, 1] - direction[:, 1] * actions[:, t, 0]
            centre, yaw, pusher = centre + gain * actions[:, t], yaw + turn * 10 * lever, pusher + actions[:, t]
    dlo[:, :, ~mask] = 0
    return Trajectories(
        dlo=dlo.astype(np.float32),
        dlo_mask=mask,
        pusher=pushers.astype(np.float32),
        bodies=np.zeros((K, T + 1, MAX_BODIES, 3), np.float32),
        body_mask=np.zeros(MAX_BODIES, bool),
        boxes=np.zeros((MAX_BODIES, MAX_BOXES, 5), np.float32),
        commanded=actions.astype(np.float32),
        executed=actions.astype(np.float32),
    )


def toy_domains(count: int, *, seed: int = 0, **shape: int) -> list[Trajectories]:
    """Simulates `count` domains with their own gains; `shape` holds trajectories, pushes and segments."""
    rng = np.random.default_rng(seed)
    return [toy_domain(rng, **shape) for _ in range(count)]


def error(positions: Floats, truth: Floats, mask: np.ndarray) -> float:
    """Returns the mean squared error in m² over the segments that exist."""
    return float(((positions - truth)[..., mask, :] ** 2).mean())


def toy_scene(B: int, bodies: int) -> Scene:
    """Makes scenes of 32 segments and so many bodies of four boxes, all of which are there."""
    boxes = torch.zeros(B, bodies, 5, 5)
    boxes[:, :, :4, 3:] = 0.0075
    dlo, present = 0.05 * torch.randn(B, 32, 2), torch.ones(B, bodies)
    poses = 0.05 * torch.randn(B, bodies, 3)
    return Scene(dlo, torch.ones(B, 32), torch.zeros(B, 2), poses, present, boxes, torch.zeros(B, 3))
