"""Tells whether predicted shapes could be a DLO at all: how its segments are spaced, and whether it lies in itself.

Shapes: dlo (B, 32, 2) m, segment centres alone as models predict them; mask (32,). The truth is not asked; its own
values are what a model should come to, since a bent chain is spaced a little closer and contacts are a little soft. All
raise `UsageError` for other shapes, no query or fewer than two valid segments.
"""

from __future__ import annotations

import numpy as np

from dlobench.bench.metrics import Array, valid_segments
from dlobench.domain import DLO_RADIUS, MAX_SEGMENTS, SEGMENT_LENGTH
from dlobench.errors import UsageError
from dlobench.trajectories import Floats, Mask

APART = 3  # segments closer than this along the DLO are neighbours, as in `dlobench.world.chain`
PIECE = 256  # queries whose pairs of segments are held at a time


def spacing_error(dlo: Floats, mask: Mask) -> float:
    """Returns the mean over queries and neighbours of |distance of their centres / segment length − 1|; no unit."""
    steps = np.diff(_shapes(dlo, mask), axis=1)
    return float(np.abs(np.sqrt((steps**2).sum(axis=-1)) / SEGMENT_LENGTH - 1).mean())


def self_overlap(dlo: Floats, mask: Mask, depth: float = 0.0) -> float:
    """Returns the share of windows in which the DLO overlaps itself by more than `depth` m (`overlapping`), 0 to 1."""
    return float(overlapping(dlo, mask, depth).mean())


def overlapping(dlo: Floats, mask: Mask, depth: float = 0.0) -> Mask:
    """Tells in which windows (B,) two segments that are no neighbours are nearer than a DLO's diameter.

    As "dlo-dlo" of `dlobench.world.overlaps` defines it: a segment is a line of 5 mm with a radius, and its neighbours
    are up to three segments away. Its direction is not predicted, and is that from the segment before to the one after,
    by which depths are wrong by some tenths of a millimetre: a true DLO that touches itself may already count. What the
    world allows no state to do is to overlap by more than `depth` = 0.001 m.
    """
    shapes = _shapes(dlo, mask)
    pieces = [_nearest(shapes[first : first + PIECE]) for first in range(0, len(shapes), PIECE)]
    return np.concatenate(pieces) < 2 * DLO_RADIUS - depth


def _nearest(shapes: Array) -> Array:
    """Returns the least distance of ends of segments to centre lines of others, no neighbours, (B,) m; ∞ for far ones.

    Lines that do not cross are nearest at an end; those that do have one within half their length, which is less than
    a diameter.
    """
    along = np.gradient(shapes, axis=1)
    length = np.sqrt((along**2).sum(axis=-1, keepdims=True))
    half = SEGMENT_LENGTH / 2 * np.divide(along, length, out=np.zeros_like(along), where=length > 0)
    i, j = np.triu_indices(shapes.shape[1], k=APART + 1)
    centres = np.ascontiguousarray(shapes.transpose(2, 1, 0))
    x, y = centres[:, i] - centres[:, j]
    pair, b = np.nonzero(x**2 + y**2 <= (2 * DLO_RADIUS + SEGMENT_LENGTH) ** 2)  # the others cannot touch
    p, q = (np.stack([shapes[b, k[pair]] - half[b, k[pair]], shapes[b, k[pair]] + half[b, k[pair]]]) for k in (i, j))
    ways = [_to_line(p[0], *q), _to_line(p[1], *q), _to_line(q[0], *p), _to_line(q[1], *p)]
    nearest = np.full(len(shapes), np.inf)
    np.minimum.at(nearest, b, np.min(ways, axis=0))
    return nearest


def _to_line(point: Array, a: Array, b: Array) -> Array:
    """Returns the distance of points to the lines from a to b, all (…, 2) m; a line may have no length."""
    step = b - a
    square = (step**2).sum(axis=-1)
    along = np.divide(((point - a) * step).sum(axis=-1), square, out=np.zeros_like(square), where=square > 0)
    away = point - a - np.clip(along, 0, 1)[..., None] * step
    distance: Array = np.sqrt((away**2).sum(axis=-1))
    return distance


def _shapes(dlo: Floats, mask: Mask) -> Array:
    """Returns the valid segments in their order, (B, n, 2) m."""
    valid = valid_segments(mask)
    if dlo.ndim != 3 or dlo.shape[1:] != (MAX_SEGMENTS, 2) or not len(dlo) or mask.sum() < 2:
        raise UsageError(
            f"shapes of {dlo.shape} with {int(mask.sum())} segments are no DLOs: "
            f"(B, {MAX_SEGMENTS}, 2) with B ≥ 1 and at least two segments are"
        )
    return dlo[:, valid].astype(np.float64)
