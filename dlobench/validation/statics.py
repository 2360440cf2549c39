"""Checks that things at rest press on the table with their weight, where their mass is."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import GRAVITY, Attachment, Domain, RigidBody
from dlobench.validation.check import Effort, Row, relative, worst
from dlobench.validation.forces import touch
from dlobench.validation.rig import CYLINDER_MASS, Edit, Rig, segment_mass
from dlobench.world.chain import CYLINDER_RADIUS
from dlobench.world.starts import Start

Array = NDArray[np.float64]

BODIES = (
    RigidBody("L5", (1200.0, 8000.0, 8000.0, 1200.0, 1200.0), 0.7),
    RigidBody("bar2", (8000.0, 1200.0), 0.4),
    RigidBody("T4", (3000.0, 1500.0, 6000.0, 4500.0), 0.2),
)


def rig_of(attachment: Attachment, *, edit: Edit | None = None) -> Rig:
    """Returns a bent DLO and three bodies of unequal boxes at rest; nothing sleeps, since what sleeps has no forces."""
    domain = Domain(0.5, 0.14, 1300.0, "soft", 1e-6, None, attachment, BODIES)
    bends = np.full(domain.segments, 0.06)
    bends[0] = 0.0
    places = np.array([[0.05, 0.05, 0.7], [-0.05, 0.06, -1.0], [0.06, -0.01, 2.0]])
    begin = Start(np.array([-0.09, -0.08, -0.3]), bends, places, np.array([-0.1, 0.1]))
    return Rig(domain, begin, sleep=False, edit=edit)


def weighed(rig: Rig, thing: str) -> tuple[float, Array]:
    """Returns what a thing at rest presses on the table with, N, and the (2,) m point about which that balances."""
    mujoco.mj_forward(rig.model, rig.data)
    found = touch(rig, thing, "table")
    force = float(found.presses.sum())
    return force, found.presses @ found.spots / force


def expected(rig: Rig, thing: str) -> tuple[float, Array, Array]:
    """Returns a thing's weight, N, the (2,) m point where it acts, and a (2,) m point to take moments about.

    That is a body's centroid, which unequal boxes weigh about; the DLO's first end; a cylinder's rim.
    """
    if thing == "cylinder":
        axis = rig.data.xpos[rig.layout.cylinder, :2]
        return CYLINDER_MASS * GRAVITY, axis, axis - CYLINDER_RADIUS * np.array([0.6, 0.8])
    if thing == "dlo":
        places = rig.data.xpos[rig.layout.segments, :2]
        return len(places) * segment_mass(rig.domain) * GRAVITY, places.mean(axis=0), places[0]
    return rig.mass(thing) * GRAVITY, rig.centre(thing), rig.data.xpos[rig.layout.bodies[int(thing[4:])], :2]


def check_weight(effort: Effort, edit: Edit | None = None) -> Iterator[Row]:
    """Yields for every thing at rest what presses on the table, and its moments, against its weight."""
    attachments: tuple[Attachment, ...] = ("movable",) if effort == "quick" else ("none", "movable", "fixed")
    rigs = {attachment: rig_of(attachment, edit=edit) for attachment in attachments}
    for thing in ("dlo", "cylinder", *(f"body{i}" for i in range(len(BODIES)))):
        forces, moments = [], []
        for attachment, rig in rigs.items():
            if thing == "cylinder" and attachment != "movable":
                continue
            pressed, point = weighed(rig, thing)
            weight, centre, about = expected(rig, thing)
            forces.append(relative(f"attachment {attachment}", pressed, weight, 1.0, "N"))
            moment, reference = pressed * (point - about), weight * (centre - about)
            size = float(np.linalg.norm(reference))
            error = 100 * float(np.linalg.norm(moment - reference)) / size
            measured = float(np.linalg.norm(moment))
            moments.append(
                Row(f"attachment {attachment}", measured, size, error, 1.0, "N m", "%", "error of the vector")
            )
        what = f"{thing} ({BODIES[int(thing[4:])].shape})" if thing.startswith("body") else thing
        yield worst(f"force on the table at rest, {what}", forces)
        yield worst(f"both moments at rest, {what}", moments)
