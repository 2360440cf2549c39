"""Finds goals: where pushes can bring the DLO from the start of an episode."""

from __future__ import annotations

import contextlib

import numpy as np
from dm_control.rl import control

from dlobench.domain import MAX_SEGMENTS
from dlobench.world import actions
from dlobench.world.physics import Physics
from dlobench.world.simulate import PUSHES, impossible
from dlobench.world.starts import Start
from dlobench.world.state import Array

DISTANCE = 0.02  # m, how far a goal should be from the start, as `distance` has it
TRIALS = 5  # of an episode's pushes each, to bring the DLO so far


def settle(physics: Physics, start: Start) -> None:
    """Places everything at a start, at rest, and lets it settle for the time of a push."""
    physics.reset()
    physics.start(start)
    physics.step(physics.plan(np.zeros(2)))


def check(physics: Physics) -> None:
    """Raises `control.PhysicsError` when things have been pressed into each other."""
    if impossible(physics.domain, physics.state()).any():
        raise control.PhysicsError("things have been pressed into each other")


def centres(physics: Physics) -> Array:
    """Returns the (segments, 2) centres of the DLO's segments, m."""
    return physics.state().dlo[0, : physics.domain.segments, :2]


def distance(dlo: Array, goal: Array) -> float:
    """Returns the mean distance, m, of segment centres (segments, 2) to those of a goal, end by end.

    Segment i belongs to segment i: a free DLO that lies on its goal the other way round has not reached it.
    """
    return float(np.linalg.norm(dlo - goal, axis=-1).mean())


def reach(physics: Physics, start: Start, rng: np.random.Generator) -> Array:
    """Pushes the DLO about until it is far enough from its start, and returns (32, 2) m where it lies; padding is 0.

    The pushes are biased towards the DLO as the recorded ones are, without noise, and no more than an episode has. So
    the goal can be reached from the start, past the bodies that are in the way, and with a fixed end where it is fixed.
    Where no trial brings it so far (a rod that lies along a wall), the goal is the farthest pose of all trials. Leaves
    the physics anywhere.
    """
    settle(physics, start)
    first = farthest = centres(physics)
    for _ in range(TRIALS):
        now = first
        # What cannot be simulated is no goal, nor is where no push leads away from; what came before may be.
        with contextlib.suppress(control.PhysicsError, actions.Stuck):
            for _ in range(PUSHES):
                command, _ = actions.draw(rng, physics.state().pusher[0], now, physics.fixed_cylinder())
                physics.step(physics.plan(command))
                check(physics)
                now = centres(physics)
                farthest = max(farthest, now, key=lambda dlo: distance(dlo, first))
                if distance(now, first) >= DISTANCE:
                    return _padded(now)
        settle(physics, start)
    return _padded(farthest)


def _padded(dlo: Array) -> Array:
    return np.concatenate([dlo, np.zeros((MAX_SEGMENTS - len(dlo), 2))])
