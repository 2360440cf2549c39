"""Holds pushed elastic rods against MuJoCo's own rod, an independent model of bending, weight and friction.

Both worlds begin at the same start and execute the same five pushes, those of the shipped simulator. The reference
(`validation.rods`) takes steps of 0.5 ms, never sleeps and has rolling friction; at 1 ms its medians differ by 0.1 mm.
An error is the mean distance of the segments after a push, in % of the length, or in % of how far the reference has
come from the start; a rod that does not move at all has 100 % of the latter. Only pushes that move the reference by
more than 1 mm count, and only runs whose pusher comes as far as the rod are simulated. Nothing else is left out: rods
that buckle to the other side stay in, and medians are what they are. (With damped twist instead of rolling friction,
soft rods had 0.5 % and 10 % where they had 0.3 % and 7 %; flexible ones had the same.)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np

from dlobench.domain import ATTACHMENTS, DLO_RADIUS, LENGTHS, PUSHER_RADIUS, Attachment, Domain, Material, sample
from dlobench.errors import RunError
from dlobench.validation import rods
from dlobench.validation.check import Effort, Row, at_most
from dlobench.validation.peers import Array
from dlobench.world import starts
from dlobench.world.simulate import Simulator, Streams, simulate

PUSHES = 5
FINE = 0.0005  # s, the reference's step
FINER = 0.001  # s, of our own scene, to tell the step from the model
MOVED = 0.001  # m, a push that moves the reference by less is not counted
OBJECTS: dict[Effort, tuple[int, ...]] = {"quick": (0,), "normal": (0, 2), "full": (0, 2)}
RUNS: dict[Effort, int] = {"quick": 1, "normal": 4, "full": 20}  # a material, attachment and number of objects
CANDIDATES = 1000
ELASTIC: tuple[Material, ...] = ("soft", "flexible")


@dataclass(frozen=True)
class Run:
    """Holds one run of both worlds, at the start and after each push."""

    length: float  # m
    shipped: Array  # (T+1, segments, 2)  m
    finer: Array  # (T+1, segments, 2)  m, our own scene at steps of 1 ms
    reference: Array  # (T+1, segments, 2)  m


def check_flex_rod(effort: Effort) -> Iterator[Row]:
    """Yields the median errors of soft and of flexible rods, at the shipped step and at a finer one."""
    for material in ELASTIC:
        runs = [
            simulate_run(material, attachment, objects, number)
            for attachment in ATTACHMENTS
            for objects in OBJECTS[effort]
            for number in range(RUNS[effort])
        ]
        for step, bounded in (("shipped", True), ("finer", False)):
            of_length, of_motion, pushes = errors([(r.length, getattr(r, step), r.reference) for r in runs])
            name = f"elastic rods pushed, {material}" + ("" if bounded else f", at {1e3 * FINER:g} ms")
            note = f"{pushes} of {PUSHES * len(runs)} pushes in {len(runs)} domains move the reference by > 1 mm"
            yield at_most(f"{name}: of the length", of_length, 2.0 if bounded else None, "%", note)
            yield at_most(f"{name}: of the reference's motion", of_motion, 15.0 if bounded else None, "%", note)


def errors(runs: list[tuple[float, Array, Array]]) -> tuple[float, float, int]:
    """Returns the median errors in % of the length and of the reference's motion, and how many pushes count.

    runs: length m, (T+1, segments, 2) m of the world and the same of the reference. Without a push that counts, both
    medians are no number.
    """
    of_length, of_motion = [], []
    for length, world, reference in runs:
        for push in range(1, len(reference)):
            if _apart(reference[push], reference[push - 1]) > MOVED:
                error = _apart(world[push], reference[push])
                of_length.append(100 * error / length)
                of_motion.append(100 * error / _apart(reference[push], reference[0]))
    if not of_length:
        return np.nan, np.nan, 0
    return float(np.median(of_length)), float(np.median(of_motion)), len(of_length)


def simulate_run(material: Material, attachment: Attachment, objects: int, number: int) -> Run:
    """Simulates the run of that number in a cell: the first random domain whose pusher reaches the rod."""
    cell = [ELASTIC.index(material), get_args(Attachment).index(attachment), objects, number]
    for draw in range(CANDIDATES):
        rng = np.random.default_rng([*cell, draw])
        length = float(rng.choice(LENGTHS))
        domain = sample(rng, material=material, attachment=attachment, length=length, rigid_objects=objects)
        seed = [*cell, draw]
        made, account = simulate(domain, [seed], pushes=PUSHES)
        start = starts.sample(domain, Streams.of([*seed, account.trajectories_redrawn]).start)
        pushes = made.executed[0].astype(float)
        if _reaches(domain, start, pushes):
            break
    else:
        raise RunError(f"no pusher came as far as the rod in {CANDIDATES} random domains: {material}, {attachment}")
    simulator = Simulator(domain, 1, timestep=FINER)
    finer = [simulator.reset([start]), *(simulator.push(push[None]) for push in pushes)]
    reference = rods.make(domain, start, FINE, sleep=False, rolling_friction=True)
    states = [reference.state(), *(reference.push(push) for push in pushes)]
    kept = slice(domain.segments)
    return Run(
        length=domain.length,
        shipped=made.dlo[0, :, kept, :2].astype(float),
        finer=np.stack([state.dlo[0, kept, :2] for state in finer]),
        reference=np.stack([state.dlo[0, kept, :2] for state in states]),
    )


def _reaches(domain: Domain, start: starts.Start, pushes: Array) -> bool:
    """Tells whether the pusher's path touches the rod where it lies at the start."""
    corners = start.pusher + np.concatenate([np.zeros((1, 2)), np.cumsum(pushes, axis=0)])
    along = np.linspace(0, 1, 25)[:, None, None]
    path = ((1 - along) * corners[:-1] + along * corners[1:]).reshape(-1, 1, 2)
    nearest = np.linalg.norm(path - starts.chain(domain, start), axis=-1).min()
    return bool(nearest < PUSHER_RADIUS + DLO_RADIUS)


def _apart(one: Array, two: Array) -> float:
    """Returns the mean distance of (segments, 2) points, m."""
    return float(np.linalg.norm(one - two, axis=-1).mean())
