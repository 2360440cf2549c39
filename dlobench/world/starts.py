"""Samples where a trajectory begins: pose and shape of the DLO, rigid bodies near the centre, the pusher.

Everything is drawn at once and redrawn at once until nothing overlaps and all lies inside the walls, so that the
starts that are kept follow the drawn distribution conditioned on being possible.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import DLO_RADIUS, SEGMENT_LENGTH, WORKSPACE, Domain, Material
from dlobench.errors import RunError
from dlobench.world.chain import APART, CYLINDER_RADIUS
from dlobench.world.scene import PUSHER_RADIUS, REACH

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
    """Tells whether all lies inside the walls and nothing overlaps."""
    dlo = chain(domain, start)
    discs = [(start.pusher[None], PUSHER_RADIUS)]
    if domain.attachment != "none":
        discs.append((start.root[None, :2], CYLINDER_RADIUS))
    boxes = [_place(body.boxes(), pose) for body, pose in zip(domain.bodies, start.bodies, strict=True)]
    round_things = [(dlo, DLO_RADIUS), *discs]
    reaches = [float(np.abs(points).max()) + radius for points, radius in round_things]
    reaches += [float(np.abs(_corners(own)).max()) for own in boxes]
    if max(reaches) > WORKSPACE / 2 - GAP or _dlo_overlaps(dlo, discs):
        return False
    return not any(
        any(_box_distance(points, box) < radius + GAP for points, radius in round_things for box in own)
        or any(_boxes_overlap(a, b) for other in boxes[:i] for a in own for b in other)
        for i, own in enumerate(boxes)
    )


def _dlo_overlaps(dlo: Array, discs: list[tuple[Array, float]]) -> bool:
    """Tells whether the DLO meets itself or a disc, or the discs (pusher, then the cylinder if any) each other."""
    for i, (centre, radius) in enumerate(discs):
        own = dlo if i == 0 else dlo[APART + 1 :]  # the cylinder holds the first segments
        if _distance(centre, own) < radius + DLO_RADIUS + GAP:
            return True
        if any(np.linalg.norm(centre - other) < radius + more + GAP for other, more in discs[:i]):
            return True
    return _self_overlap(dlo)


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


def _distance(points: Array, line: Array) -> float:
    """Returns the least distance of (P, 2) points to a (Q, 2) polyline."""
    a, step = line[:-1], np.diff(line, axis=0)
    along = np.einsum("pqd,qd->pq", points[:, None] - a, step) / np.einsum("qd,qd->q", step, step)
    nearest = a + np.clip(along, 0, 1)[..., None] * step
    return float(np.linalg.norm(points[:, None] - nearest, axis=-1).min())


def _self_overlap(dlo: Array) -> bool:
    """Tells whether segments far enough apart along the DLO come closer than their diameter."""
    middle = (dlo[1:] + dlo[:-1]) / 2
    apart = np.linalg.norm(middle[:, None] - middle, axis=-1)
    order = np.arange(len(middle))
    far = np.abs(order[:, None] - order) > APART
    # Centres within a segment's length of each other may hide a crossing; demand room for it.
    return bool((apart[far] < 2 * DLO_RADIUS + GAP + SEGMENT_LENGTH / 2).any())


def _place(boxes: Array, pose: Array) -> Array:
    """Returns (boxes, 5) moved from a body's frame to its pose (x, y, yaw)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    out = boxes.copy()
    out[:, :2] = boxes[:, :2] @ np.array([[c, s], [-s, c]]) + pose[:2]
    out[:, 2] += pose[2]
    return out


def _corners(boxes: Array) -> Array:
    """Returns the (boxes, 4, 2) corners of (boxes, 5) boxes."""
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    local = boxes[:, None, 3:] * signs
    c, s = np.cos(boxes[:, 2])[:, None], np.sin(boxes[:, 2])[:, None]
    turned = np.stack([c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1]], axis=-1)
    return turned + boxes[:, None, :2]


def _box_distance(points: Array, box: Array) -> float:
    """Returns the least distance of (P, 2) points to one box, 0 inside."""
    c, s = np.cos(box[2]), np.sin(box[2])
    local = (points - box[:2]) @ np.array([[c, -s], [s, c]])
    return float(np.linalg.norm(np.maximum(np.abs(local) - box[3:], 0), axis=-1).min())


def _boxes_overlap(a: Array, b: Array) -> bool:
    """Tells whether two boxes come closer than the gap, by separating axes."""
    first, second = _corners(np.stack([a, b]))
    for yaw in (a[2], a[2] + np.pi / 2, b[2], b[2] + np.pi / 2):
        axis = np.array([np.cos(yaw), np.sin(yaw)])
        p, q = first @ axis, second @ axis
        if p.min() > q.max() + GAP or q.min() > p.max() + GAP:
            return False
    return True
