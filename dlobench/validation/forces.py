"""Reads contact forces as a scale would: what presses and rubs on what, where, and how hard.

Checks use sums over these, so that they hold for any number of support points.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.validation.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Touch:
    """Holds the contacts between two things."""

    spots: Array  # (contacts, 2)  x m, y m
    presses: Array  # (contacts,)  N, what friction is reckoned from: the normal force and, where a load is laid on, it
    rubs: Array  # (contacts, 2)  N, friction on the first thing, its part in the plane


def owners(model: mujoco.MjModel) -> list[str]:
    """Names the thing that each geom belongs to: dlo, cylinder, pusher, body0 …, wall, else table."""
    names = [str(model.body(i).name) for i in range(model.nbody)]

    def thing(name: str) -> str | None:
        if name.startswith("segment"):
            return "dlo"
        known = name in ("cylinder", "pusher") or (name.startswith("body") and name[4:].isdigit())
        return name if known else None

    def of_body(body: int) -> str:
        above = body
        while above:  # the world is 0
            if (found := thing(names[above])) is not None:
                return found
            above = int(model.body_parentid[above])
        return "table"

    def of_geom(geom: int) -> str:
        if body := int(model.geom_bodyid[geom]):
            return of_body(body)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        return "table" if turn[8] > 0.5 else "wall"

    return [of_geom(geom) for geom in range(model.ngeom)]


def touch(rig: Rig, a: str, b: str) -> Touch:
    """Returns the contacts between two things as the latest step solved them."""
    whose = owners(rig.model)
    spots, presses, rubs = [], [], []
    force = np.zeros(6)
    for i, contact in enumerate(rig.data.contact):
        pair = (whose[contact.geom1], whose[contact.geom2])
        if pair not in ((a, b), (b, a)):
            continue
        mujoco.mj_contactForce(rig.model, rig.data, i, force)
        sign = 1.0 if pair == (b, a) else -1.0  # MuJoCo's normal points from the first geom to the second
        spots.append(contact.pos[:2].copy())
        presses.append(force[0] + contact.adhesion)
        rubs.append(sign * (force[1:3] @ contact.frame.reshape(3, 3)[1:])[:2])
    n = len(spots)
    return Touch(np.reshape(spots, (n, 2)), np.array(presses), np.reshape(rubs, (n, 2)))
