"""Draws pushes: biased towards the closest segment, redrawn while infeasible, executed with noise.

A push moves the pusher by 12–24 mm. What is executed is what was commanded plus Gaussian noise; both are recorded.
Neither is ever clamped: a command is feasible only if every noise that can be drawn keeps it so.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import DLO_RADIUS, PUSHER_RADIUS
from dlobench.errors import RunError
from dlobench.world.chain import CYLINDER_RADIUS
from dlobench.world.scene import REACH

Array = NDArray[np.float64]

DISTANCE = (0.012, 0.024)  # m, the length of a push (read off the paper's figures)
SPREAD = 0.5  # rad, standard deviation of the direction about that of the closest segment
WANDER = 0.2  # share of the pushes whose direction is uniform, so that the pusher also leaves and comes round
NOISE = 0.0005  # m, standard deviation of the execution noise along each axis
NOISE_LIMIT = 3 * NOISE  # m, longer noise is redrawn
ROOM = 4.5 * DLO_RADIUS  # m, kept free between the pusher and what cannot move: two DLOs fit in
ATTEMPTS = 10_000


class Stuck(RunError):
    """Says that a pusher has nowhere to go: none of a great many drawn commands is feasible."""


def feasible(pusher: Array, displacement: Array, fixed: Array | None) -> bool:
    """Tells whether a command keeps the pusher in reach and off a fixed cylinder at `fixed`, whatever the noise."""
    target = pusher + displacement
    if np.abs(target).max() > REACH - NOISE_LIMIT:
        return False
    if fixed is None:
        return True
    towards = (fixed - pusher) @ displacement
    if towards <= -NOISE_LIMIT * np.linalg.norm(fixed - pusher):
        return True  # it leads away, so that no noise brings the pusher closer than it is
    along = np.clip(towards / (displacement @ displacement), 0, 1)
    clearance = np.linalg.norm(pusher + along * displacement - fixed)
    return bool(clearance > PUSHER_RADIUS + CYLINDER_RADIUS + ROOM + NOISE_LIMIT)


def draw(rng: np.random.Generator, pusher: Array, dlo: Array, fixed: Array | None) -> tuple[Array, int]:
    """Draws a feasible command and tells how many infeasible ones were redrawn.

    pusher (2,) m; dlo (segments, 2) m, the centres of the segments that exist; fixed (2,) m or None.
    Raises `Stuck` when none of a great many draws is feasible.
    """
    towards = dlo[np.argmin(np.linalg.norm(dlo - pusher, axis=-1))] - pusher
    bearing = np.arctan2(towards[1], towards[0])
    for redrawn in range(ATTEMPTS):
        wander = rng.random() < WANDER
        angle = rng.uniform(-np.pi, np.pi) if wander else bearing + SPREAD * rng.normal()
        displacement = rng.uniform(*DISTANCE) * np.array([np.cos(angle), np.sin(angle)])
        if feasible(pusher, displacement, fixed):
            return displacement, redrawn
    raise Stuck(f"no feasible push in {ATTEMPTS} draws with the pusher at {pusher}")


def noise(rng: np.random.Generator) -> Array:
    """Draws the execution noise of one push: (2,) m."""
    while True:
        out = NOISE * rng.normal(size=2)
        if np.linalg.norm(out) <= NOISE_LIMIT:
            return out
