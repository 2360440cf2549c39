"""Scores point predictions. Pure functions of arrays; padding never counts.

Shapes: predicted, true and start (B, 32, 2) m, mask (32,). Arrays are read in pieces and summed in double precision,
without a copy of the whole. All raise `UsageError` for other shapes, no query or no valid segment.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import MAX_BODIES, MAX_SEGMENTS
from dlobench.errors import UsageError
from dlobench.trajectories import Floats, Mask

MOVES = 0.001  # m, mean displacement of the valid segments beyond which a window counts as moving
PIECE = 1024  # queries that are read at a time: their errors stay in the cache

Array = NDArray[np.float64]
Score = Callable[[Floats, Floats, Mask], float]


class PoseError(NamedTuple):
    """Holds how far rigid bodies are from where they should be."""

    position: float  # m
    angle: float  # rad, 0 to π


def mse(predicted: Floats, true: Floats, mask: Mask) -> float:
    """Returns the mean squared error per coordinate, m², over queries and valid segments (paper, Table 1).

    Examples:
        >>> mask = np.arange(32) < 20  # a DLO of 10 cm
        >>> true = np.zeros((1, 32, 2), np.float32)
        >>> print(f"{mse(true + [0.003, 0.004], true, mask):.2e}")  # 5 mm off, in two coordinates
        1.25e-05

    """
    total = math.fsum(square.sum() for square in _squares(predicted, true, mask))
    return total / (2 * len(true) * int(mask.sum()))


def euclidean(predicted: Floats, true: Floats, mask: Mask) -> float:
    """Returns the mean Euclidean error per valid segment, m, over queries (paper, Fig. 3).

    Examples:
        >>> mask = np.arange(32) < 20
        >>> true = np.zeros((1, 32, 2), np.float32)
        >>> print(f"{euclidean(true + [0.003, 0.004], true, mask):.3f}")
        0.005

    """
    total = math.fsum(np.sqrt(square).sum() for square in _squares(predicted, true, mask))
    return total / (len(true) * int(mask.sum()))


def shape_error(predicted: Floats, true: Floats, mask: Mask) -> float:
    """Returns the mean over queries of the Euclidean error of whole shapes, m: a root mean square over valid segments.

    The energy score of whole shapes (`sampled.energy`) is this for one sample. Never below `euclidean`, and equal to
    it where all segments of a query err by the same distance.

    Examples:
        >>> mask, true = np.arange(32) < 20, np.zeros((1, 32, 2), np.float32)
        >>> bent = true.copy()
        >>> bent[:, :10, 0] = 0.004  # half of the segments are 4 mm off
        >>> print(f"{euclidean(bent, true, mask):.4f} {shape_error(bent, true, mask):.4f}")
        0.0020 0.0028

    """
    total = math.fsum(np.sqrt(square.mean(axis=1)).sum() for square in _squares(predicted, true, mask))
    return total / len(true)


def displacement(start: Floats, true: Floats, mask: Mask) -> Array:
    """Returns how far the valid segments of each query are displaced from start to truth, (B,) m: the mean distance."""
    return np.concatenate([np.sqrt(square).mean(axis=1) for square in _squares(start, true, mask)])


def moving(start: Floats, true: Floats, mask: Mask) -> Mask:
    """Tells which windows (B,) move: whose mean displacement from start to truth is more than 1 mm.

    Of true samples, (M, B, 32, 2), the mean over them decides. What a model predicts has no say.

    Examples:
        >>> start, mask = np.zeros((2, 32, 2), np.float32), np.arange(32) < 20
        >>> true = start + np.float32([[[0.0005, 0]], [[0.002, 0]]])  # one query moves by ½ mm, one by 2 mm
        >>> moving(start, true, mask).tolist()
        [False, True]

    """
    samples = true if true.ndim == 4 else true[None]
    moved: Mask = np.mean([displacement(start, each, mask) for each in samples], axis=0) > MOVES
    return moved


def where_moving(score: Score, predicted: Floats, true: Floats, start: Floats, mask: Mask) -> float | None:
    """Returns a score over the windows that move (`moving`), None where none does.

    Takes the scores of this module, and those of samples with predicted (S, B, 32, 2) and true (M, B, 32, 2).
    """
    rows = moving(start, true, mask)
    return score(predicted[..., rows, :, :], true[..., rows, :, :], mask) if rows.any() else None


def pose_error(predicted: Floats, true: Floats, body_mask: Mask) -> PoseError | None:
    """Returns the mean errors of the poses (B, 3, 3) of the rigid bodies that exist, None where there is none.

    Of position the Euclidean distance, m; of yaw the shorter way round, rad.

    Examples:
        >>> true = np.zeros((1, 3, 3))
        >>> error = pose_error(true + [0.003, 0.004, 6.0], true, np.array([True, False, False]))
        >>> print(f"{error.position:.3f} m, {error.angle:.3f} rad")  # 6 rad to the left are 0.28 to the right
        0.005 m, 0.283 rad

    """
    poses = (MAX_BODIES, 3)
    if predicted.shape != true.shape or predicted.shape[1:] != poses or body_mask.shape != poses[:1] or not len(true):
        raise UsageError(
            f"poses of {predicted.shape}, true ones of {true.shape} and a mask of {body_mask.shape} cannot be scored: "
            f"(B, 3, 3), (B, 3, 3) with B ≥ 1 and (3,) can"
        )
    if not body_mask.any():
        return None
    error = np.subtract(predicted[:, body_mask], true[:, body_mask], dtype=np.float64)
    turn = np.abs((error[..., 2] + np.pi) % (2 * np.pi) - np.pi)
    return PoseError(float(np.sqrt((error[..., :2] ** 2).sum(axis=-1)).mean()), float(turn.mean()))


def skill(errors: list[float], persistence: list[float]) -> float:
    """Returns 1 − Σ error / Σ error of persistence over the domains of a cell.

    1 is perfect, 0 no better than standing still. A ratio of sums, so that domains where little moves do not blow it
    up. Raises `ValueError` where nothing moves at all.

    Examples:
        >>> skill([1e-4, 2e-4], persistence=[4e-4, 2e-4])  # halved, though one domain is no better
        0.5

    """
    still = sum(persistence)
    if still <= 0:
        raise ValueError("nothing moves in these domains, so that there is no skill to have")
    return 1 - sum(errors) / still


def valid_segments(mask: Mask) -> slice | Mask:
    """Returns what picks the valid segments: a slice where they come first, as they do, since it needs no copy.

    Raises `UsageError` for what is no mask of 32 segments, or has none.
    """
    if mask.shape != (MAX_SEGMENTS,) or mask.dtype != np.bool_ or not mask.any():
        raise UsageError(
            f"a {mask.dtype} mask of {mask.shape} with {int(np.count_nonzero(mask))} segments picks nothing to score: "
            f"a bool mask of ({MAX_SEGMENTS},) with at least one does"
        )
    count = int(mask.sum())
    return slice(count) if mask[:count].all() else mask


def _squares(predicted: Floats, true: Floats, mask: Mask) -> Iterator[Array]:
    """Yields the squared Euclidean errors of the valid segments of up to `PIECE` queries at a time, m²."""
    valid = valid_segments(mask)
    if predicted.shape != true.shape or true.ndim != 3 or true.shape[1:] != (MAX_SEGMENTS, 2) or not len(true):
        raise UsageError(
            f"predictions of {predicted.shape} cannot be scored against a truth of {true.shape}: "
            f"both have to be (B, {MAX_SEGMENTS}, 2) with B ≥ 1"
        )
    for first in range(0, len(true), PIECE):
        rows = slice(first, first + PIECE)
        error = np.subtract(predicted[rows, valid], true[rows, valid], dtype=np.float64)
        np.square(error, out=error)
        yield error[..., 0] + error[..., 1]
