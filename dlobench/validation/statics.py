"""Checks that things at rest press on the table with their weight, where their mass is."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import Attachment, Domain, RigidBody
from dlobench.validation.check import Effort, Row
from dlobench.validation.forces import touch
from dlobench.validation.rig import CYLINDER_MASS, Edit, Rig
from dlobench.world.chain import CYLINDER_RADIUS
from dlobench.world.scene import GRAVITY
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
