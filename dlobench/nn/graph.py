"""Predicts one push by message passing: along the chain of segments, and between them, bodies, walls and the pusher.

All is computed in the frame of the push (origin in the pusher, x along the action), and walls come in as geometry, so
that a scene that is turned or moved as a whole, walls too, gives a prediction that is turned and moved with it.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from dlobench.domain import DLO_RADIUS, PUSHER_RADIUS
from dlobench.nn.geometry import Scene, corners, nearest, rotated, sweep, walls

TOUCH = PUSHER_RADIUS + DLO_RADIUS  # m, between the centres of pusher and segment
NEIGHBOURS = (1, 2, 4, 8)  # segments along the chain to which a segment sees the offset
ROUNDS = ((1, 2), (1, 4), (1, 8))  # of message passing: the neighbours that a segment hears in each
SEGMENT, BODY, GLOBAL = 32, 26, 6  # features of a segment, of a body, and of the whole scene
SPAN = 0.08  # m, by which positions are scaled
LEVER = 0.02  # m, by which a turn of a body is scaled into a length


def shifted(rows: Tensor, by: int) -> Tensor:
    """Returns rows (B, N, C) such that the one at i is that of i − by, 0 beyond the ends."""
    if abs(by) >= rows.shape[1]:
        return torch.zeros_like(rows)
    return pad(rows[:, :-by], (0, 0, by, 0)) if by > 0 else pad(rows[:, -by:], (0, 0, 0, -by))


def local_frame(scene: Scene, action: Tensor, origin: Tensor, *, mirror: bool) -> Scene:
    """Returns a scene in the frame of a push: the origin (B, 2), x along the action (B, 2); or that frame's mirror."""
    local = scene.turned(torch.atan2(action[:, 1], action[:, 0]), origin)
    return local.mirrored() if mirror else local


class GraphNetwork(nn.Module):
    """Predicts how segments and bodies move in one push; for any number of them.

    Interaction network (Battaglia et al. 2016) with the residual rounds of Sanchez-Gonzalez et al. (2020). `scale` (m)
    is the spread of the displacements; `context` the number of features that are known of the domain.
    """

    def __init__(self, width: int, scale: float, context: int = 0) -> None:
        super().__init__()
        self.scale = scale

        def perceptron(inputs: int) -> nn.Sequential:
            return nn.Sequential(nn.Linear(inputs, width), nn.SiLU(), nn.Linear(width, width))

        self.segment, self.body = perceptron(SEGMENT + GLOBAL + context), perceptron(BODY + GLOBAL + context)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in ROUNDS)
        self.rounds = nn.ModuleList(perceptron(width * (3 + 2 * len(hears))) for hears in ROUNDS)
        self.touches = nn.ModuleList(nn.Linear(width + 6, width) for _ in ROUNDS)  # messages to bodies
        self.bodies = nn.ModuleList(perceptron(3 * width) for _ in ROUNDS)
        self.move, self.turn = nn.Linear(width, 2), nn.Linear(width, 3)
        with torch.no_grad():
            for last in (self.move, self.turn):
                last.weight *= 0.1
                last.bias.zero_()

    def forward(self, scene: Scene, action: Tensor, context: Tensor | None = None, *, mirror: bool = False) -> Scene:
        """Returns the scene after an action (B, 2); `mirror` looks at it in a mirror, which is as good a sight."""
        return self.sight(scene, action, context, mirror=mirror)[0]

    def sight(
        self, scene: Scene, action: Tensor, context: Tensor | None = None, *, mirror: bool = False
    ) -> tuple[Scene, Tensor]:
        """Returns the scene after an action, and what the network makes of each segment of it, (B, N, width)."""
        angle = torch.atan2(action[:, 1], action[:, 0])
        local = local_frame(scene, action, scene.pusher, mirror=mirror)
        length = action.norm(dim=-1, keepdim=True)
        known = scene_features(local, length)
        if context is not None:
            known = torch.cat([known, context], -1)
        dlo, bodies, hidden = self._moves(local, length, known)
        if mirror:
            dlo, bodies = dlo * dlo.new_tensor([1.0, -1.0]), bodies * bodies.new_tensor([1.0, -1.0, -1.0])
        turned = torch.cat([rotated(bodies[..., :2], angle[:, None]), bodies[..., 2:]], -1)
        after = replace(
            scene,
            dlo=scene.dlo + rotated(dlo, angle[:, None]) * scene.exists[..., None],
            pusher=scene.pusher + action,
            bodies=scene.bodies + turned * scene.present[..., None],
        )
        return after, hidden

    def _moves(self, local: Scene, length: Tensor, known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns displacements of segments (B, N, 2) and bodies (B, M, 3) in the frame of the push, and features."""
        exists = local.exists[..., None]
        share = exists / exists.sum(1, keepdim=True)
        h = _through(self.segment, segment_features(local, length), known[:, None]) * exists
        bodies = local.bodies.shape[1] > 0
        if bodies:
            b, (edge, close) = _through(self.body, _bodies(local, length), known[:, None]), _edges(local)
        for k, hears in enumerate(ROUNDS):
            g = self.norms[k](h) * exists
            whole = (g * share).sum(1, keepdim=True)
            heard = torch.cat([g, *(shifted(g, sign * by) for by in hears for sign in (1, -1))], -1)
            from_bodies = close.mT @ b if bodies else g.shape[-1]
            if bodies:
                felt = torch.relu(_linear(self.touches[k], g[:, None], edge))
                felt = (close[:, :, None] @ felt).squeeze(2)
                b = b + _through(self.bodies[k], b, felt, whole)
            h = h + _through(self.rounds[k], heard, from_bodies, whole) * exists
        moves = self.move(h) * self.scale
        if not bodies:
            return moves, local.bodies, h
        return moves, self.turn(b) * self.scale * moves.new_tensor([1.0, 1.0, 1.0 / LEVER]), h


def _through(perceptron: nn.Module, *parts: Tensor | int) -> Tensor:
    """Returns what a perceptron makes of parts side by side, as `_linear` takes them."""
    first, *rest = perceptron.children()
    out = _linear(first, *parts)
    for layer in rest:
        out = layer(out)
    return out


def _linear(layer: nn.Module, *parts: Tensor | int) -> Tensor:
    """Returns what a linear layer makes of parts side by side; a number stands for so many zeros.

    What many rows share is one row of its part, which is multiplied once.
    """
    weight, first = layer.get_parameter("weight"), 0
    out: Tensor = layer.get_parameter("bias")
    for part in parts:
        width = part if isinstance(part, int) else part.shape[-1]
        if not isinstance(part, int):
            out = out + part @ weight[:, first : first + width].T
        first += width
    return out


def scene_features(local: Scene, length: Tensor) -> Tensor:
    """Returns what concerns the whole scene: the push, how the table lies, how long the DLO is."""
    yaw = 4 * local.table[:, 2:]
    segments = local.exists.sum(1, keepdim=True) / 32
    return torch.cat([local.table[:, :2] / SPAN, (length - 0.018) / 0.004, yaw.cos(), yaw.sin(), segments], -1)


def segment_features(local: Scene, length: Tensor) -> Tensor:
    """Returns the features of segments (B, N, 32)."""
    dlo, exists = local.dlo, local.exists[..., None]
    out = [dlo / SPAN]
    for by in (sign * by for by in NEIGHBOURS for sign in (1, -1)):
        out += [(shifted(dlo * exists, by) - dlo) * shifted(exists, by) / (0.005 * abs(by))]
    vector, distance = sweep(dlo, length)
    gap = distance - TOUCH
    out += [gap.clamp_max(0.05) / 0.01, torch.exp(-gap.relu() / 0.01)]
    out += [vector / 0.01 * torch.exp(-((distance / 0.03) ** 2))]
    out += [walls(dlo, local.table, reach) for reach in (0.005, 0.02)]
    number = torch.arange(dlo.shape[1], device=dlo.device, dtype=dlo.dtype)
    ends = torch.stack([number.expand_as(local.exists), local.exists.sum(1, keepdim=True) - 1 - number], -1)
    return torch.cat([*out, torch.exp(-ends.relu() / 8), torch.exp(-ends.relu() / 2)], -1) * exists


def _edges(local: Scene) -> tuple[Tensor, Tensor]:
    """Returns features of pairs of a body and a segment (B, M, N, 6), and how close they are (B, M, N), 0 to 1."""
    vector, gap = nearest(local.dlo, local.bodies, local.boxes)
    lever = local.dlo[:, :, None] + vector - local.bodies[:, None, :, :2]
    near = torch.stack([torch.exp(-gap / reach) for reach in (0.003, 0.01)], -1)
    close = torch.exp(-gap / 0.01) * local.exists[..., None] * local.present[:, None]
    edge = torch.cat([vector.clamp(-0.05, 0.05) / 0.01, lever.clamp(-0.1, 0.1) / LEVER, near], -1)
    return edge.transpose(1, 2).contiguous(), close.mT.contiguous()


def _bodies(local: Scene, length: Tensor) -> Tensor:
    """Returns the features of bodies (B, M, 26)."""
    centre, yaw = local.bodies[..., :2], local.bodies[..., 2:]
    half = local.boxes[..., 3:]
    size = (half[..., :1] > 0).to(half) / (half[..., :1] > 0).sum(-2, keepdim=True).clamp_min(1)
    arms = rotated(local.boxes[..., :2], yaw)
    moments = (torch.stack([arms[..., 0] ** 2, arms[..., 1] ** 2, arms[..., 0] * arms[..., 1]], -1) * size).sum(-2)
    out = [centre / SPAN, moments / LEVER**2, (half[..., 0] > 0).sum(-1, keepdim=True).to(half) / 5]
    path = torch.stack([torch.zeros_like(length), length / 2, length], 1) * length.new_tensor([1.0, 0.0])  # (B, 3, 2)
    vector, gap = (each.transpose(1, 2) for each in nearest(path, local.bodies, local.boxes))
    near = torch.exp(-(gap - PUSHER_RADIUS).relu() / 0.005)[..., None]
    lever = path[:, None] + vector - centre[:, :, None]
    out += [near.flatten(2), (vector * near / 0.01).flatten(2), (lever * near / LEVER)[:, :, -1]]
    tips = corners(local.bodies, local.boxes)
    felt = walls(tips.flatten(1, 2), local.table, 0.005).view(*tips.shape[:3], 3)
    felt = felt * size.repeat_interleave(4, -2)
    arm = tips - centre[:, :, None]
    out += [felt.sum(2), (arm[..., 0] * felt[..., 2] - arm[..., 1] * felt[..., 1]).sum(-1, keepdim=True) / LEVER]
    out.append(_others(local, tips))
    return torch.cat(out, -1) * local.present[..., None]


def _others(local: Scene, tips: Tensor) -> Tensor:
    """Returns where the nearest points of other bodies press on the corners of each body: (B, M, 5)."""
    B, M, count = tips.shape[:3]
    vector, gap = nearest(tips.flatten(1, 2), local.bodies, local.boxes)
    apart = 1 - torch.eye(M, device=gap.device, dtype=gap.dtype)
    near = torch.exp(-gap / 0.005).view(B, M, count, M) * apart[:, None] * local.present[:, None, None]
    near = near * (local.boxes[..., 3] > 0).to(gap).repeat_interleave(4, -1)[..., None]
    nearness, which = near.flatten(2).max(-1)
    chosen = vector.view(B, M, count * M, 2).gather(2, which[..., None, None].expand(B, M, 1, 2))[:, :, 0]
    arm = tips.gather(2, (which // M)[..., None, None].expand(B, M, 1, 2))[:, :, 0] - local.bodies[..., :2]
    return torch.cat([nearness[..., None], nearness[..., None] * torch.cat([chosen / 0.005, arm / LEVER], -1)], -1)
