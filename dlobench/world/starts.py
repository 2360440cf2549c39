"""Samples where a trajectory begins: pose and shape of the DLO, rigid bodies near the centre, the pusher.

Everything is drawn at once and redrawn at once until nothing overlaps and all lies inside the walls, so that the
starts that are kept follow the drawn distribution conditioned on being possible.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from dlobench import ranges
from dlobench.domain import DLO_RADIUS, PUSHER_RADIUS, SEGMENT_LENGTH, WORKSPACE, Domain, Material, RigidBody
from dlobench.errors import RunError, UsageError
from dlobench.world.chain import APART, CYLINDER_RADIUS
from dlobench.world.scene import REACH

Array = NDArray[np.float64]

GAP = 0.001  # m, the least distance between things that do not belong together
BODY_SPREAD = 0.06  # m, bodies are placed in a square of this half size about the centre
ATTEMPTS = 100_000
# Standard deviation of the DLO's total bend at the start, rad: ropes lie as they fell, flexible rods nearly straight.
BEND: dict[Material, float] = {"soft": 2.0, "flexible": 0.3, "elastoplastic": 1.0}


@dataclass(frozen=True)
class Start:
    """Describes a start. The DLO is at rest in its shape: that is where its springs are relaxed."""

    root: Array  # (3,)  x m, y m, yaw rad of the DLO's first end, or of the cylinder's axis when it has one
    bends: Array  # (segments,)  joint angles, rad; the first belongs to the clamped end and is 0
    bodies: Array  # (bodies, 3)  x m, y m, yaw rad
    pusher: Array  # (2,)  x m, y m


def sample(domain: Domain, rng: np.random.Generator) -> Start:
    """Samples a possible start; raises `RunError` when none is found in a great many draws."""
    for _ in range(ATTEMPTS):
        start = _draw(domain, rng)
        if possible(domain, start):
            return start
    raise RunError(f"no possible start in {ATTEMPTS} draws for {domain}")


def check(domain: Domain, start: Start) -> None:
    """Raises `UsageError` unless a start has the sizes of a domain, and numbers only."""
    bends, bodies = domain.segments, len(domain.bodies)
    for name, shape in {"root": (3,), "bends": (bends,), "bodies": (bodies, 3), "pusher": (2,)}.items():
        value = getattr(start, name)
        if np.shape(value) != shape:
            found, needed = np.shape(value), f"{bends} segments and {bodies} rigid bodies needs {shape}"
            raise UsageError(f"{name} of a start has shape {found}, a domain of {needed}")
        if not np.isfinite(value).all():
            raise UsageError(f"{name} of a start = {ranges.shown(value)} is not finite")


def chain(domain: Domain, start: Start) -> Array:
    """Returns the DLO's (segments + 1, 2) joint positions, m."""
    x, y, yaw = start.root
    if domain.attachment != "none":
        x, y = x + CYLINDER_RADIUS * np.cos(yaw), y + CYLINDER_RADIUS * np.sin(yaw)
    yaws = yaw + np.cumsum(start.bends)
    steps = SEGMENT_LENGTH * np.stack([np.cos(yaws), np.sin(yaws)], axis=-1)
    joints: Array = np.array([x, y]) + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return joints


def possible(domain: Domain, start: Start) -> bool:
    """Tells whether all lies inside the walls and nothing overlaps. What is cheap and often so is asked first."""
    dlo = chain(domain, start)
    inside = WORKSPACE / 2 - GAP
    if np.abs(dlo).max() > inside - DLO_RADIUS or np.abs(start.pusher).max() > inside - PUSHER_RADIUS:
        return False
    discs = [(start.pusher, PUSHER_RADIUS, dlo)]  # place, radius, and the part of the DLO that it must not touch
    if domain.attachment != "none":
        if np.abs(start.root[:2]).max() > inside - CYLINDER_RADIUS:
            return False
        discs.append((start.root[:2], CYLINDER_RADIUS, dlo[APART + 1 :]))  # it holds the first segments
    boxes = _Boxes.of(domain.bodies, start.bodies)
    if len(boxes.owner) and (np.abs(boxes.corners).max() > inside or boxes.overlap()):
        return False
    if any(_distance(centre, line) < radius + DLO_RADIUS + GAP for centre, radius, line in discs):
        return False
    if len(discs) > 1 and np.linalg.norm(discs[0][0] - discs[1][0]) < PUSHER_RADIUS + CYLINDER_RADIUS + GAP:
        return False
    points = np.concatenate([dlo, *(centre[None] for centre, _, _ in discs)])
    radii = np.array([DLO_RADIUS] * len(dlo) + [radius for _, radius, _ in discs])
    return not boxes.meet(points, radii) and not _self_overlap(dlo)


def _draw(domain: Domain, rng: np.random.Generator) -> Start:
    half = WORKSPACE / 2
    # Two slow cosines along the arc length: a smooth shape whose total bend has the material's spread.
    s = (np.arange(domain.segments) + 0.5) / domain.segments
    amplitude = rng.normal(size=3) * BEND[domain.material] * np.array([1.0, 0.7, 0.5])
    density = amplitude[0] + amplitude[1] * np.pi * np.cos(np.pi * s) + amplitude[2] * np.pi * np.cos(2 * np.pi * s)
    bends = density / domain.segments
    bends[0] = 0.0
    return Start(
        root=np.array([*rng.uniform(-half, half, size=2), rng.uniform(-np.pi, np.pi)]),
        bends=bends,
        bodies=np.concatenate(
            [
                rng.uniform(-BODY_SPREAD, BODY_SPREAD, size=(len(domain.bodies), 2)),
                rng.uniform(-np.pi, np.pi, size=(len(domain.bodies), 1)),
            ],
            axis=1,
        ),
        pusher=rng.uniform(-REACH, REACH, size=2),
    )


def _distance(point: Array, line: Array) -> float:
    """Returns the least distance of a (2,) point to a (Q, 2) polyline."""
    first, step = line[:-1], line[1:] - line[:-1]
    along = ((point - first) * step).sum(axis=-1) / (step * step).sum(axis=-1)
    away = first + np.clip(along, 0, 1)[:, None] * step - point
    return math.sqrt((away * away).sum(axis=-1).min())


def _self_overlap(dlo: Array) -> bool:
    """Tells whether segments far enough apart along the DLO come closer than their diameter."""
    x, y = (dlo[1:] + dlo[:-1]).T / 2
    one, other = _far(len(x))
    # Centres within a segment's length of each other may hide a crossing; demand room for it.
    room = 2 * DLO_RADIUS + GAP + SEGMENT_LENGTH / 2
    return bool(((x[one] - x[other]) ** 2 + (y[one] - y[other]) ** 2).min() < room**2)


@cache
def _far(segments: int) -> tuple[NDArray[np.intp], ...]:
    """Returns the pairs of segments that may meet: two arrays of indices."""
    return np.triu_indices(segments, APART + 1)


@lru_cache(maxsize=8)
def _local(bodies: tuple[RigidBody, ...]) -> tuple[NDArray[np.intp], Array]:
    """Returns which body each of N boxes belongs to, and (5, N) x m, y m, yaw rad and half sizes m in its frame."""
    boxes = [body.boxes() for body in bodies]
    owner = np.repeat(np.arange(len(boxes)), [len(own) for own in boxes])
    return owner, np.concatenate([np.zeros((0, 5)), *boxes]).T


@dataclass(frozen=True)
class _Boxes:
    """Holds the N boxes of all rigid bodies in their places."""

    owner: NDArray[np.intp]  # (N,)  which body a box belongs to
    centre: Array  # (N, 2)  m
    axes: Array  # (N, 2, 2)  the directions of a box's sides
    half: Array  # (N, 2)  half sizes, m

    @staticmethod
    def of(bodies: tuple[RigidBody, ...], poses: Array) -> _Boxes:
        """Places the boxes of bodies at (bodies, 3) x m, y m, yaw rad."""
        owner, (x, y, yaw, *half) = _local(bodies)
        at, turn = poses[owner], poses[owner, 2]
        c, s = np.cos(turn), np.sin(turn)
        centre = np.stack([c * x - s * y, s * x + c * y], axis=-1) + at[:, :2]
        c, s = np.cos(turn + yaw), np.sin(turn + yaw)
        return _Boxes(owner, centre, np.stack([c, s, -s, c], axis=-1).reshape(-1, 2, 2), np.stack(half, axis=-1))

    @cached_property
    def corners(self) -> Array:
        """Returns the (N, 4, 2) corners, m."""
        along, across = np.moveaxis(self.half[:, :, None] * self.axes, 1, 0)[:, :, None]
        signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
        corners: Array = self.centre[:, None] + signs[:, :1] * along + signs[:, 1:] * across
        return corners

    def overlap(self) -> bool:
        """Tells whether boxes of two bodies come closer than the gap, by separating axes."""
        N = len(self.owner)
        shadow = self.corners.reshape(-1, 2) @ self.axes.reshape(-1, 2).T  # of every corner on every box's axes
        low, high = (edge(shadow.reshape(N, 4, N, 2), axis=1) for edge in (np.min, np.max))
        mine = np.arange(N)
        low_own, high_own = low[mine, mine], high[mine, mine]  # of a box on its own axes
        apart = ((low > high_own + GAP) | (low_own > high + GAP)).any(axis=-1)
        return bool((~(apart | apart.T) & (self.owner[:, None] != self.owner)).any())

    def meet(self, points: Array, radii: Array) -> bool:
        """Tells whether a disc, at (P, 2) m with radius (P,) m, comes closer to a box than the gap."""
        offset = points[:, None] - self.centre
        outside = np.maximum(np.abs((offset[:, :, None] * self.axes).sum(axis=-1)) - self.half, 0)
        return bool(((outside * outside).sum(axis=-1) < (radii[:, None] + GAP) ** 2).any())
