"""Draws tasks for meta-learners: support and query trajectories of domains."""

from __future__ import annotations

import torch
from torch import Tensor

from dlobench.errors import RunError
from dlobench.nn.windows import Windows

Batch = tuple[Tensor, Tensor, Tensor]  # inputs (N, B, F), targets (N, B, 64), weights (N, 1, 64)


def rows(count: Tensor, domains: Tensor, K: int, *, queries: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draws, for each of N tasks, K support and up to `queries` other trajectories of its domain: (N, K), (N, Q).

    `count` (D,) are the trajectories of all domains, which are numbered domain by domain. All tasks have the same
    numbers of them. Where the smallest domain has fewer than K + 1 trajectories, K is cut to half of them. Raises
    `RunError` where a domain has fewer than 2.
    """
    fewest, most = int(count.min()), int(count.max())
    if fewest < 2:
        raise RunError(f"a domain has {fewest} trajectories, a task needs 2: one to adapt on, one to be scored on")
    K = K if fewest > K else fewest // 2
    order = torch.rand(len(domains), most, generator=generator)
    order[torch.arange(most) >= count.cpu()[domains, None]] = 1  # no trajectory there, so never drawn
    drawn = order.topk(min(K + queries, fewest), largest=False).indices
    first = count.cumsum(0) - count
    found = drawn.to(first.device) + first[domains.to(first.device), None]
    return found[:, :K], found[:, K:]


def draw(windows: Windows, domains: Tensor, K: int, *, queries: int, generator: torch.Generator) -> tuple[Batch, Batch]:
    """Draws the windows of K support and up to `queries` other trajectories for each of N tasks, as `rows` does."""
    support, query = rows(windows.count, domains, K, queries=queries, generator=generator)
    return windows.pick_trajectories(support), windows.pick_trajectories(query)
