"""Tells how what is executed differs from what was commanded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from dlobench.errors import RunError
from dlobench.trajectories import Trajectories


def travelled(trajectories: Trajectories) -> Trajectories:
    """Returns trajectories whose actions are where the pusher really went, be they commands or what was executed."""
    return replace(trajectories, executed=np.diff(trajectories.pusher, axis=1))


def noise_root(domains: Sequence[Trajectories]) -> Tensor:
    """Returns a root (2, 2), m, of the covariance of where the pusher went about the actions that are told.

    Raises `RunError` for an action that is not finite.
    """
    missed = np.concatenate([(travelled(d).executed - d.executed).reshape(-1, 2) for d in domains], dtype=np.float64)
    if not np.isfinite(missed).all():
        raise RunError("a training domain holds an action that is not finite")
    return root(torch.from_numpy(missed.T @ missed / len(missed)))


def root(covariance: Tensor) -> Tensor:
    """Returns a matrix whose product with its transpose is the covariance."""
    values, vectors = torch.linalg.eigh(covariance)
    found: Tensor = vectors * values.clamp_min(0).sqrt()
    return found.float()
