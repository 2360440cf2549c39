"""Builds the peer whose DLO is a three-dimensional chain of capsules and ball joints.

A ball joint's spring is EI/l in every direction, which is also a round rod's torsion without Poisson's ratio; a clamped
joint is half a joint, as in the shipped scene. Contacts are MuJoCo's defaults in everything. In trials over domains of
three objects (pushes/s of one core, beside other work) these made 7.4; stiffer contacts as many; elliptic cones 5.1,
and 6.2 with stiffer contacts; no sleep 6.0; the `implicitfast` integrator 5.3, and the rod did not keep still;
conjugate gradients 2.7; dense matrices as many. With condim 3 it makes 12, but then it rolls away and never rests.

A capsule touches the table at two points. `spheres` lets one sphere a segment touch it instead: 10.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from dlobench.domain import DLO_RADIUS, SEGMENT_LENGTH, Domain
from dlobench.validation.peers import DLO_MEETS, TIMESTEP, Array, Peer, Read, pose, resist_rolling, surroundings, turn
from dlobench.world import contact
from dlobench.world.chain import APART, CYLINDER_RADIUS, DAMPING_TIME
from dlobench.world.starts import Start


def make(domain: Domain, start: Start, timestep: float = TIMESTEP, sleep: bool = True, spheres: bool = False) -> Peer:
    """Makes the peer at a start, settled."""
    return Peer(domain, start, spec(domain, start, timestep, sleep, spheres), _reader(domain))


def spec(
    domain: Domain, start: Start, timestep: float = TIMESTEP, sleep: bool = True, spheres: bool = False
) -> mujoco.MjSpec:
    """Returns the scene at a start as an editable specification."""
    out = surroundings(domain, start, timestep, sleep)
    resist_rolling(out)
    free = domain.attachment == "none"
    parent = out.worldbody if free else out.body("cylinder")
    pos = [*start.root[:2], DLO_RADIUS] if free else [CYLINDER_RADIUS, 0, DLO_RADIUS]
    root = start.root[2] if free else 0.0
    for i, bend in enumerate(start.bends):
        body = parent.add_body(name=f"segment{i}", pos=pos, quat=turn(bend + root))
        if i == 0 and free:
            body.add_freejoint()
        else:
            stiffness = domain.bending_stiffness / (SEGMENT_LENGTH / 2 if i == 0 else SEGMENT_LENGTH)
            body.add_joint(
                type=mujoco.mjtJoint.mjJNT_BALL, stiffness=stiffness, damping=stiffness * DAMPING_TIME[domain.material]
            )
        _add_segment(body, domain, spheres)
        for j in range(max(0, i - APART), i - 1):
            out.add_exclude(bodyname1=f"segment{j}", bodyname2=body.name)
        if not free and 0 < i <= APART:
            out.add_exclude(bodyname1="cylinder", bodyname2=body.name)
        parent, pos, root = body, [SEGMENT_LENGTH, 0, 0], 0.0
    return out


def _add_segment(body: mujoco.MjsBody, domain: Domain, spheres: bool) -> None:
    """Adds a segment's capsule, from the origin of its body along x, and the sphere that may carry it."""
    friction = [contact.friction_table(domain)["dlo-dlo"], 0, 0]
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0, 0, 0, SEGMENT_LENGTH, 0, 0],
        size=[DLO_RADIUS, 0, 0],
        mass=domain.density * math.pi * DLO_RADIUS**2 * SEGMENT_LENGTH,
        contype=contact.DLO,
        conaffinity=DLO_MEETS & ~contact.TABLE if spheres else DLO_MEETS,
        condim=3,
        friction=friction,
    )
    if spheres:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=[SEGMENT_LENGTH / 2, 0, 0],
            size=[DLO_RADIUS, 0, 0],
            mass=0,
            contype=0,
            conaffinity=contact.TABLE,
            condim=3,
            friction=friction,
        )


def _reader(domain: Domain) -> Read:
    def dlo(data: mujoco.MjData) -> Array:
        """Returns the segments' centres and directions: (segments, 3) x m, y m, yaw rad."""
        out = np.array([pose(data, f"segment{i}") for i in range(domain.segments)])
        out[:, :2] += SEGMENT_LENGTH / 2 * np.stack([np.cos(out[:, 2]), np.sin(out[:, 2])], axis=-1)
        return out

    return dlo
