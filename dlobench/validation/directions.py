"""Checks that friction on the table is the same in all directions, for the rod, a body and an attached cylinder."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import GRAVITY, Domain, RigidBody
from dlobench.validation.check import Effort, Row, worst
from dlobench.validation.forces import touch
from dlobench.validation.rig import CYLINDER_MASS, Edit, Rig
from dlobench.validation.sliding import FRICTIONS
from dlobench.world.contact import friction_table
from dlobench.world.starts import Start

Array = NDArray[np.float64]

G = GRAVITY
THINGS = ("dlo", "body0", "cylinder")
LOAD = 1.3  # times friction: it goes faster and faster, to 0.1–0.35 m/s
SETTLE, MEASURE = 0.05, 0.1  # s
OWN_FRICTION = 0.45  # of the body, so that on the table it is the mean of that and the surface's
ANGLES: dict[Effort, int] = {"quick": 3, "normal": 7, "full": 13}  # from 0 to 90°


def friction(thing: str, surface: float, yaw: float, angle: float, *, edit: Edit | None = None) -> tuple[Array, float]:
    """Returns friction over weight, (2,), of a thing that slides at an angle, rad, to its own x axis; and the table's.

    It is reckoned from what a load cannot speed up; for a cylinder, which its rod comes along with, from its contacts.
    The first component is along the load, the second across.
    """
    bodies = (RigidBody("T4", (3000.0,) * 4, OWN_FRICTION),) if thing == "body0" else ()
    domain = Domain(
        surface, 0.10, 1000.0, "flexible", 1.5e-4, None, "movable" if thing == "cylinder" else "none", bodies
    )
    # What slides starts left of the middle and below it; for a body the rod lies out of the way.
    heading = yaw + angle
    spot = -0.04 * np.array([math.cos(heading), math.sin(heading)])
    end = spot - 0.05 * np.array([math.cos(yaw), math.sin(yaw)])
    root = np.array([-0.11, -0.11, 0.0]) if bodies else np.array([*end, yaw])
    places = np.array([[*spot, yaw]])[: len(bodies)]
    rig = Rig(domain, Start(root, np.zeros(domain.segments), places, np.array([0.11, -0.11])), edit=edit)
    moved = "body0" if bodies else "dlo"
    table = friction_table(domain)[f"{thing}-table"]
    along = np.array([math.cos(heading), math.sin(heading)])
    axes = np.array([along, [-along[1], along[0]]])
    weight = rig.mass(moved) * G
    rig.load(moved, LOAD * table * weight * along)
    rig.run(SETTLE)
    steps, rubs, first = round(MEASURE / rig.timestep), np.zeros(2), rig.velocity(moved)
    for _ in range(steps):
        rig.run(rig.timestep)
        rubs += touch(rig, "cylinder", "table").rubs.sum(axis=0)
    if thing == "cylinder":
        return axes @ -rubs / steps / (CYLINDER_MASS * G), table
    gained = (rig.velocity(moved) - first) / (steps * rig.timestep)
    return axes @ (LOAD * table * along - gained / G), table


def check_directions(effort: Effort, edit: Edit | None = None) -> Iterator[Row]:
    """Yields friction on the table in the direction where it is furthest from the friction table."""
    angles = np.linspace(0, math.pi / 2, ANGLES[effort])
    for thing in THINGS:
        rows = []
        for surface, yaw, angle in product(FRICTIONS[effort], (0.0, 0.6), angles):
            found, table = friction(thing, surface, yaw, angle, edit=edit)
            error = 100 * math.hypot(found[0] - table, found[1]) / table
            name = f"surface μ {surface:g}, yaw {math.degrees(yaw):.0f}°, {math.degrees(angle):.0f}° to it"
            rows.append(Row(name, float(np.linalg.norm(found)), table, error, 1.0, "", "%", "error of the vector"))
        yield worst(f"friction {thing}–table in all directions", rows)
