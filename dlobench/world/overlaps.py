"""Measures how deep things lie in each other, from planar poses alone: the engine's own contacts are not asked.

N states of one domain at a time. A segment is a capsule, a body a set of boxes, pusher and cylinder are discs, and the
walls bound a square. Neighbours along the DLO, which the world never tests for contact, are no pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import DLO_RADIUS, PUSHER_RADIUS, WORKSPACE, Domain
from dlobench.world.chain import APART, CYLINDER_RADIUS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Poses:
    """Holds N states of one domain: what is there, without padding."""

    dlo: Array  # (N, segments, 3)  segment centres x m, y m, yaw rad
    pusher: Array  # (N, 2)  x m, y m
    bodies: Array  # (N, bodies, 3)  x m, y m, yaw rad
    cylinder: Array | None  # (N, 3)  x m, y m, yaw rad; None without one


@dataclass(frozen=True)
class _Boxes:
    """Holds the boxes of all bodies in N states."""

    centre: Array  # (N, boxes, 2)  m
    yaw: Array  # (N, boxes)  rad
    half: Array  # (boxes, 2)  m
    owner: NDArray[np.intp]  # (boxes,)  which body


def depths(domain: Domain, poses: Poses) -> dict[str, Array]:
    """Returns the deepest penetration of each kind of pair in each state, (N,) m; 0 where nothing overlaps.

    In a state that holds what is no number no depth is a number.
    """
    segment = domain.length / poses.dlo.shape[1]
    a, b = ends(poses.dlo, segment)
    boxes = _place(domain, poses.bodies)
    corners = _corners(boxes)
    half = WORKSPACE / 2
    line = a[:, :, None], b[:, :, None]
    centre, yaw = boxes.centre[:, None], boxes.yaw[:, None]
    found = {
        "dlo-dlo": 2 * DLO_RADIUS - _self_distance(poses.dlo[..., :2], a, b, segment),
        "dlo-wall": np.abs(np.concatenate([a, b], axis=1)) + DLO_RADIUS - half,
        "dlo-pusher": DLO_RADIUS + PUSHER_RADIUS - _to_line(poses.pusher[:, None], a, b),
        "dlo-body": DLO_RADIUS - _line_to_box(*line, centre, yaw, boxes.half),
        "body-body": _box_overlap(corners, boxes),
        "body-wall": np.abs(corners) - half,
        "body-pusher": PUSHER_RADIUS - _point_to_box(poses.pusher[:, None], boxes.centre, boxes.yaw, boxes.half),
    }
    if poses.cylinder is not None:
        cylinder = poses.cylinder[:, :2]
        far = slice(APART + 1, None)  # it holds the first segments
        between = np.linalg.norm(poses.pusher - cylinder, axis=-1)
        found |= {
            "dlo-cylinder": DLO_RADIUS + CYLINDER_RADIUS - _to_line(cylinder[:, None], a[:, far], b[:, far]),
            "body-cylinder": CYLINDER_RADIUS - _point_to_box(cylinder[:, None], boxes.centre, boxes.yaw, boxes.half),
            "pusher-cylinder": PUSHER_RADIUS + CYLINDER_RADIUS - between,
            "cylinder-wall": np.abs(cylinder) + CYLINDER_RADIUS - half,
        }
    lost = ~np.isfinite(_centres(domain, poses)).all(axis=(1, 2))
    deepest = {name: depth.reshape(len(depth), -1).max(axis=1, initial=0) for name, depth in found.items()}
    return {name: np.where(lost, np.nan, depth) for name, depth in deepest.items()}


def outside(domain: Domain, poses: Poses) -> Mask:
    """Tells in which states (N,) the centre of anything is beyond a wall, or is no number."""
    farthest: Array = np.abs(_centres(domain, poses)).max(axis=(1, 2))
    return ~(farthest <= WORKSPACE / 2)


def _centres(domain: Domain, poses: Poses) -> Array:
    """Returns the centres of everything, boxes one by one: (N, things, 2) m."""
    centres = [poses.dlo[..., :2], poses.pusher[:, None], _place(domain, poses.bodies).centre]
    if poses.cylinder is not None:
        centres.append(poses.cylinder[:, None, :2])
    return np.concatenate(centres, axis=1)


def crossings(domain: Domain, poses: Poses) -> Array:
    """Returns how many pairs of segments that are no neighbours cross with their centre lines, (N,)."""
    a, b = ends(poses.dlo, domain.length / poses.dlo.shape[1])
    i, j = np.triu_indices(a.shape[1], k=2)
    crossed: Array = _cross(a[:, i], b[:, i], a[:, j], b[:, j]).sum(axis=1).astype(float)
    return crossed


def outline(domain: Domain, poses: Poses) -> tuple[Array, Array]:
    """Returns the outermost points of the DLO's centre line, and of the bodies and the cylinder: (N, points, 2) m."""
    dlo = np.concatenate(ends(poses.dlo, domain.length / poses.dlo.shape[1]), axis=1)
    others = [_corners(_place(domain, poses.bodies)).reshape(len(dlo), -1, 2)]
    if poses.cylinder is not None:
        yaw = poses.cylinder[:, 2:] + np.pi / 2 * np.arange(4)
        others.append(poses.cylinder[:, None, :2] + CYLINDER_RADIUS * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1))
    return dlo, np.concatenate(others, axis=1)


def ends(dlo: Array, segment: float) -> tuple[Array, Array]:
    """Returns both ends of every segment's centre line, (N, segments, 2) m each."""
    along = segment / 2 * np.stack([np.cos(dlo[..., 2]), np.sin(dlo[..., 2])], axis=-1)
    return dlo[..., :2] - along, dlo[..., :2] + along


def _place(domain: Domain, bodies: Array) -> _Boxes:
    """Moves the boxes of every body to its pose."""
    own = [body.boxes() for body in domain.bodies]
    owner = np.repeat(np.arange(len(own)), [len(b) for b in own]).astype(np.intp)
    boxes = np.concatenate([np.zeros((0, 5)), *own])
    pose = bodies[:, owner]
    return _Boxes(pose[..., :2] + _turn(boxes[:, :2], pose[..., 2]), pose[..., 2] + boxes[:, 2], boxes[:, 3:], owner)


def _turn(points: Array, yaw: Array) -> Array:
    """Turns (…, 2) points by yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1]], axis=-1)


def _corners(boxes: _Boxes) -> Array:
    """Returns the corners of every box, (N, boxes, 4, 2) m."""
    local = boxes.half[:, None] * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    return boxes.centre[..., None, :] + _turn(local, boxes.yaw[..., None])


def _to_line(point: Array, a: Array, b: Array) -> Array:
    """Returns the distance of points to the lines from a to b, all (…, 2)."""
    step = b - a
    along = ((point - a) * step).sum(axis=-1) / (step**2).sum(axis=-1)
    distance: Array = np.linalg.norm(point - a - np.clip(along, 0, 1)[..., None] * step, axis=-1)
    return distance


def _side(a: Array, b: Array, point: Array) -> Array:
    """Returns on which side of the line from a to b a point lies, by its sign."""
    (x, y), (along, across) = np.moveaxis(b - a, -1, 0), np.moveaxis(point - a, -1, 0)
    side: Array = x * across - y * along
    return side


def _cross(a: Array, b: Array, c: Array, d: Array) -> Mask:
    """Tells whether the lines from a to b and from c to d cross."""
    crossed: Mask = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
    return crossed


def _self_distance(centre: Array, a: Array, b: Array, segment: float) -> Array:
    """Returns the least distance between centre lines of segments that are no neighbours, (N, 1) m, at most 1 m."""
    least = np.ones(len(centre))
    i, j = np.triu_indices(centre.shape[1], k=APART + 1)
    apart = np.linalg.norm(centre[:, i] - centre[:, j], axis=-1)
    n, pair = np.nonzero(apart <= 2 * DLO_RADIUS + segment)  # the others are too far apart to touch
    a1, b1, a2, b2 = a[n, i[pair]], b[n, i[pair]], a[n, j[pair]], b[n, j[pair]]
    ways = [_to_line(a1, a2, b2), _to_line(b1, a2, b2), _to_line(a2, a1, b1), _to_line(b2, a1, b1)]
    np.minimum.at(least, n, np.where(_cross(a1, b1, a2, b2), 0, np.min(ways, axis=0)))
    return least[:, None]


def _point_to_box(point: Array, centre: Array, yaw: Array, half: Array) -> Array:
    """Returns the signed distance of points to boxes, negative inside."""
    gap = np.abs(_turn(point - centre, -yaw)) - half
    distance: Array = np.linalg.norm(np.maximum(gap, 0), axis=-1) + np.minimum(gap.max(axis=-1), 0)
    return distance


def _line_to_box(a: Array, b: Array, centre: Array, yaw: Array, half: Array) -> Array:
    """Returns the signed distance of lines to boxes: where they overlap, minus the least move that parts them."""
    a, b = _turn(a - centre, -yaw), _turn(b - centre, -yaw)
    middle, along = (a + b) / 2, (b - a) / 2
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.abs((normal * middle).sum(axis=-1)) - (np.abs(normal) * half).sum(axis=-1)
    gap = np.maximum((np.abs(middle) - half - np.abs(along)).max(axis=-1), across)
    corners = half[..., None, :] * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    zero = np.zeros(2)
    nearest = np.minimum(_point_to_box(a, zero, np.zeros(1), half), _point_to_box(b, zero, np.zeros(1), half))
    from_corners = _to_line(corners, a[..., None, :], b[..., None, :]).min(axis=-1)
    distance: Array = np.where(gap <= 0, gap, np.minimum(nearest, from_corners))
    return distance


def _box_overlap(corners: Array, boxes: _Boxes) -> Array:
    """Returns how deep boxes of different bodies overlap, (N, pairs) m, by separating axes; negative when apart."""
    i, j = np.nonzero(np.triu(boxes.owner[:, None] != boxes.owner))
    gaps = []
    for k in (i, j):
        for quarter in (0, np.pi / 2):
            axis = np.stack([np.cos(boxes.yaw[:, k] + quarter), np.sin(boxes.yaw[:, k] + quarter)], axis=-1)
            p, q = (np.einsum("npcd,npd->npc", corners[:, side], axis) for side in (i, j))
            gaps.append(np.maximum(q.min(axis=-1) - p.max(axis=-1), p.min(axis=-1) - q.max(axis=-1)))
    overlap: Array = -np.max(gaps, axis=0)
    return overlap
