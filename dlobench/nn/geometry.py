"""Measures scenes in the frame of a push: how far walls, bodies and the pusher's path are from what they may touch.

Everything is a pure function of tensors, in SI, and turns with the world: B scenes, N segments, M bodies, P points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dlobench.domain import WORKSPACE

FAR = 1.0  # m, the gap to a box that is not there


@dataclass(frozen=True)
class Scene:
    """Holds B states of the world, as a network sees them."""

    dlo: Tensor  # (B, N, 2)  segment centres x m, y m
    exists: Tensor  # (B, N)  1 or 0: which segments are not padding
    pusher: Tensor  # (B, 2)
    bodies: Tensor  # (B, M, 3)  x m, y m, yaw rad
    present: Tensor  # (B, M)  1 or 0: which bodies are not padding
    boxes: Tensor  # (B, M, 5, 5)  in the frame of their body: x m, y m, yaw rad, half sizes m; 0 for none
    table: Tensor  # (B, 3)  centre and yaw of the square between the walls

    def __len__(self) -> int:
        return len(self.dlo)

    def turned(self, angle: Tensor, about: Tensor) -> Scene:
        """Returns it in a frame whose origin is `about` (B, 2) and whose x axis has the direction `angle` (B,)."""

        def seen(points: Tensor) -> Tensor:
            return rotated(points - about[:, None], -angle[:, None])

        def posed(poses: Tensor) -> Tensor:
            return torch.cat([seen(poses[..., :2]), poses[..., 2:] - angle[:, None, None]], -1)

        pusher, table = seen(self.pusher[:, None])[:, 0], posed(self.table[:, None])[:, 0]
        return replace(self, dlo=seen(self.dlo), pusher=pusher, bodies=posed(self.bodies), table=table)

    def mirrored(self) -> Scene:
        """Returns it with y and all yaws turned round, bodies and their boxes too: the same physics."""
        flip = self.dlo.new_tensor([1.0, -1.0])
        pose, box = self.dlo.new_tensor([1.0, -1.0, -1.0]), self.dlo.new_tensor([1.0, -1.0, -1.0, 1.0, 1.0])
        return replace(
            self,
            dlo=self.dlo * flip,
            pusher=self.pusher * flip,
            bodies=self.bodies * pose,
            boxes=self.boxes * box,
            table=self.table * pose,
        )


def rotated(vectors: Tensor, angle: Tensor) -> Tensor:
    """Returns vectors (…, 2) turned by an angle (…) in rad, counterclockwise."""
    c, s = angle.cos(), angle.sin()
    x, y = vectors.unbind(-1)
    return torch.stack([x * c - y * s, x * s + y * c], -1)


def walls(points: Tensor, table: Tensor, reach: float) -> Tensor:
    """Returns how near the walls are to points (B, P, 2): (B, P, 3), a sum of e^(−gap/reach) and of that along normals.

    A sum over the four walls has no order, so that a quarter turn of the world changes nothing. Beyond a wall it grows
    no more than by e.
    """
    local = rotated(points - table[:, None, :2], -table[:, None, 2])
    low, high = (torch.exp(-(WORKSPACE / 2 + sign * local).clamp_min(-reach) / reach) for sign in (1, -1))
    push = rotated(low - high, table[:, None, 2])
    return torch.cat([(low + high).sum(-1, keepdim=True), push], -1)


def placed(bodies: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Returns centres (B, M, 5, 2) and yaws (B, M, 5) of the boxes of bodies (B, M, 3)."""
    yaw = bodies[..., None, 2]
    return bodies[..., None, :2] + rotated(boxes[..., :2], yaw), yaw + boxes[..., 2]


def corners(bodies: Tensor, boxes: Tensor) -> Tensor:
    """Returns the corners of the boxes of bodies (B, M, 3): (B, M, 20, 2)."""
    centre, yaw = placed(bodies, boxes)
    signs = boxes.new_tensor([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    out = centre[..., None, :] + rotated(boxes[..., None, 3:] * signs, yaw[..., None])
    return out.flatten(2, 3)


def nearest(points: Tensor, bodies: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Returns vectors from points (B, P, 2) to the nearest point of each body, (B, P, M, 2), and their lengths.

    It is 0 within a body, and of length `FAR` to one that has no box.
    """
    centre, yaw = (each[:, None] for each in placed(bodies, boxes))  # (B, 1, M, 5, …)
    (x, y), (right, up) = points[:, :, None, None].unbind(-1), boxes[:, None, ..., 3:].unbind(-1)
    c, s, dx, dy = yaw.cos(), yaw.sin(), x - centre[..., 0], y - centre[..., 1]  # (B, P, M, 5)
    along, across = dx * c + dy * s, dy * c - dx * s
    along, across = along.clamp(-right, right) - along, across.clamp(-up, up) - across
    square = (along.square() + across.square()).masked_fill(right <= 0, FAR**2)
    gap, which = square.min(-1, keepdim=True)
    chosen = torch.stack([along.gather(-1, which), across.gather(-1, which)], -1)[..., 0, :]
    turn = yaw.expand_as(square).gather(-1, which)[..., 0]
    return rotated(chosen, turn), gap[..., 0].clamp_min(1e-12).sqrt()


def sweep(points: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the vector from the path of a push to points (B, P, 2), and its length (B, P, 1).

    The path runs along x from the origin, as far as `length` (B, 1).
    """
    x, y = points.unbind(-1)
    along = x - torch.minimum(x.clamp_min(0), length)
    vector = torch.stack([along, y], -1)
    return vector, vector.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
