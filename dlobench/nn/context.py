"""Reads what is unobserved of a domain, friction, stiffness, attachment, out of pushes that were seen there."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from dlobench.nn.graph import GLOBAL, SEGMENT, local_frame, scene_features, segment_features
from dlobench.nn.scenes import Cut, Recorded

CHUNK = 1024  # pushes encoded at once


class PushEncoder(nn.Module):
    """Encodes any number of seen pushes as one context (C + 1,): the mean of what each says, and how many there are.

    A conditional neural process (Garnelo et al. 2018) whose points are pushes: every segment says what it did beside
    what it was asked to, and the mean over segments and pushes depends on no order. No push gives zeros.
    """

    def __init__(self, width: int, size: int, scale: float) -> None:
        super().__init__()
        self.scale, self.size = scale, size + 1
        self.of_segment = nn.Sequential(
            nn.Linear(SEGMENT + GLOBAL + 2, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )
        self.of_push = nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, size))

    def forward(self, cut: Cut, *, mirror: bool = False) -> Tensor:
        """Returns what each of P pushes says, (P, C)."""
        action = cut.actions[:, 0]
        after = replace(cut.start, dlo=cut.dlo[:, 0])
        local, then = (local_frame(each, action, cut.start.pusher, mirror=mirror) for each in (cut.start, after))
        length = action.norm(dim=-1, keepdim=True)
        moved = (then.dlo - local.dlo) / self.scale
        known = scene_features(local, length)[:, None].expand(-1, moved.shape[1], -1)
        exists = local.exists[..., None]
        said = self.of_segment(torch.cat([segment_features(local, length), known, moved], -1)) * exists
        both = torch.cat([said.sum(1) / exists.sum(1), said.amax(1)], -1)
        pooled: Tensor = self.of_push(both)
        return pooled

    def pooled(self, said: Tensor, pushes: int) -> Tensor:
        """Returns contexts (…, C + 1) of what pushes say, (…, P, C), when there were `pushes` of them."""
        count = said.new_full((*said.shape[:-2], 1), math.log1p(pushes) / 7)
        return torch.cat([said.mean(-2), count], -1)

    @torch.no_grad()
    def domain(self, seen: Recorded) -> Tensor:
        """Returns the context (C + 1,) of one domain, of all pushes that were seen there."""
        R, T = seen.actions.shape[:2]
        rows = torch.arange(R, device=seen.dlo.device).repeat_interleave(T)
        starts = torch.arange(T, device=seen.dlo.device).repeat(R)
        windows = zip(torch.split(rows, CHUNK), torch.split(starts, CHUNK), strict=True)
        said = [(self(cut) + self(cut, mirror=True)) / 2 for cut in (seen.cut(r, s, 1) for r, s in windows)]
        return self.pooled(torch.cat(said), R * T)
