"""Scores predictions. Pure functions of arrays; padding never counts.

Shapes: predicted and true (B, 32, 2) m, mask (32,).
"""

from __future__ import annotations

import numpy as np

from dlobench.trajectories import Floats, Mask


def mse(predicted: Floats, true: Floats, mask: Mask) -> float:
    """Returns the mean squared error per coordinate, m², over queries and valid segments (paper, Table 1)."""
    error = predicted[:, mask].astype(np.float64) - true[:, mask]
    return float(np.mean(error**2))


def euclidean(predicted: Floats, true: Floats, mask: Mask) -> float:
    """Returns the mean Euclidean error per valid segment, m, over queries (paper, Fig. 3)."""
    error = predicted[:, mask].astype(np.float64) - true[:, mask]
    return float(np.mean(np.linalg.norm(error, axis=-1)))


def skill(errors: list[float], persistence: list[float]) -> float:
    """Returns 1 − Σ error / Σ error of persistence over the domains of a cell.

    1 is perfect, 0 no better than standing still. A ratio of sums, so that domains where little moves do not blow it
    up. Raises `ValueError` where nothing moves at all.
    """
    still = sum(persistence)
    if still <= 0:
        raise ValueError("nothing moves in these domains, so that there is no skill to have")
    return 1 - sum(errors) / still
