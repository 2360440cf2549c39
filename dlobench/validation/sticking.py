"""Checks at which steady load things begin to slip, and how little they creep below it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dlobench.validation.check import Effort, Row, at_most, relative, worst
from dlobench.validation.rig import Edit, Rig
from dlobench.validation.sliding import FRICTIONS, KINDS, G, rig_of
from dlobench.world import scene
from dlobench.world.state import PUSH_TIME

Array = NDArray[np.float64]

SHARE = 0.8  # of the slipping load, under which creep is measured
CREEP = 0.1  # mm a push
# What slips under 1.002 times the threshold goes 2 mm in a second at friction 0.2; what creeps as allowed, 0.3 mm.
SLIPPED, PATIENCE = 0.002, 1.0  # m, s
HALVINGS = 8  # of 0.8–1.2 times the threshold: to 0.1 %


def slips(rig: Rig, thing: str, force: Array) -> bool:
    """Tells whether a steady (2,) N load makes the thing slip rather than creep, by how far it goes."""
    before = rig.centre(thing)
    rig.load(thing, force)
    for _ in range(10):
        rig.run(PATIENCE / 10)
        if np.linalg.norm(rig.centre(thing) - before) > SLIPPED:
            return True
    return False


def threshold(
    kind: str, friction: float, *, timestep: float = scene.TIMESTEP, sleep: bool = True, edit: Edit | None = None
) -> float:
    """Returns the least steady load that makes a thing slip, as a share of its weight."""
    low, high = 0.8 * friction, 1.2 * friction
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        rig, thing, along = rig_of(kind, friction, timestep=timestep, sleep=sleep, edit=edit)
        if slips(rig, thing, middle * rig.mass(thing) * G * along):
            high = middle
        else:
            low = middle
    return (low + high) / 2


def creep(
    kind: str, friction: float, *, timestep: float = scene.TIMESTEP, sleep: bool = True, edit: Edit | None = None
) -> float:
    """Returns how far a part of a thing moves at most, m, in the time of a push under 0.8 of the slipping load."""
    rig, thing, along = rig_of(kind, friction, timestep=timestep, sleep=sleep, edit=edit)
    before = rig.parts(thing)[2].copy()
    rig.load(thing, SHARE * friction * rig.mass(thing) * G * along)
    rig.run(PUSH_TIME)
    return float(np.linalg.norm(rig.parts(thing)[2] - before, axis=-1).max())


def check_threshold(effort: Effort, edit: Edit | None = None) -> Iterator[Row]:
    """Yields the load, as a share of the weight, at which a rod and a body begin to slip."""
    for kind in KINDS:
        rows = [
            relative(f"μ {friction:g}", threshold(kind, friction, edit=edit), friction, 2.0)
            for friction in FRICTIONS[effort]
        ]
        yield worst(f"load that makes it slip, {kind}", rows)


def check_creep(effort: Effort, edit: Edit | None = None) -> Iterator[Row]:
    """Yields the creep of a rod and a body under 0.8 of that load."""
    for kind in KINDS:
        rows = []
        for sleep in (True, False):
            asleep = "" if sleep else ", nothing sleeps"
            for friction in FRICTIONS[effort]:
                crept = 1e3 * creep(kind, friction, sleep=sleep, edit=edit)
                rows.append(at_most(f"μ {friction:g}{asleep}", crept, CREEP, "mm"))
        yield worst(f"creep in the time of a push, {kind}", rows)
