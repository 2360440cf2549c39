"""Says how a body presses on the table: where its supports stand and how much each carries."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import BOX_SIZE, GRAVITY, RigidBody

Array = NDArray[np.float64]

_OFFSET = BOX_SIZE / 2 / math.sqrt(3)  # m, Gauss points: they integrate an affine pressure and its moments exactly


def spread(body: RigidBody) -> tuple[Array, Array]:
    """Returns the supports of a rigid body in its frame, (P, 2) x m, y m, and what each carries, (P,) N.

    Four Gauss points a box; the pressure is affine over the body where it is positive, 0 elsewhere, and balances the
    weight and its two moments (a body that rests on a springy table, seen in the limit of a stiff one).
    """
    weights = np.array(body.densities) * BOX_SIZE**3 * GRAVITY
    boxes = body.boxes()[:, :2]
    corners = np.array([(x, y) for x in (-_OFFSET, _OFFSET) for y in (-_OFFSET, _OFFSET)])
    points = (boxes[:, None] + corners).reshape(-1, 2)
    basis = np.column_stack([np.ones(len(points)), points / BOX_SIZE])
    wanted = np.array([weights.sum(), *(weights @ boxes / BOX_SIZE)])
    carried = np.ones(len(points), dtype=bool)
    for _ in range(len(points)):  # each turn lifts points off or sets them down; a handful of turns settles it
        affine = np.linalg.solve(basis[carried].T @ basis[carried], wanted)
        positive = basis @ affine > 0
        if (positive == carried).all():
            return points[carried], (basis @ affine)[carried]
        carried = positive
    raise ValueError(f"no pressure carries {body}")
