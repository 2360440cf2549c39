"""Builds the DLO: a planar chain of capsules and plastic hinges, with the cylinder that it may end in."""

from __future__ import annotations

import math

import mujoco

from dlobench.domain import DLO_RADIUS, GRAVITY, SEGMENT_LENGTH, Domain, Material
from dlobench.world import contact

CYLINDER_RADIUS = 0.0075  # m, the body that an attached DLO ends in
CYLINDER_HEIGHT = 0.015  # m
CYLINDER_DENSITY = 1200.0  # kg/m³
# s, joint damping over joint stiffness: ropes are quick to rest, stiff rods must not whip
DAMPING_TIME: dict[Material, float] = {"soft": 0.02, "flexible": 0.05, "elastoplastic": 0.05}
NEVER_YIELDS = 1e3  # rad; keeps plastic state allocated, so that materials share their sizes
SUPPORTED = 2  # segments that share a support, in their middle
APART = 3  # segments closer than this along the chain are never tested for contact
_HALF_TURN_Y = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # lays a capsule's axis along x


def add_dlo(out: mujoco.MjSpec, domain: Domain, friction: dict[str, float], fineness: int) -> None:
    """Adds the chain, rooted in the cylinder where it has one; `fineness` divides every segment, for comparison."""
    length = SEGMENT_LENGTH / fineness
    segments = domain.segments * fineness
    mass = domain.density * math.pi * DLO_RADIUS**2 * length
    across = mass * (length**2 / 12 + DLO_RADIUS**2 / 4)
    parent = out.worldbody
    offset = [0.0, 0.0, DLO_RADIUS]
    if domain.attachment != "none":
        parent = _add_cylinder(out, domain, friction)
        offset = [CYLINDER_RADIUS + length / 2, 0.0, DLO_RADIUS]
    for i in range(segments):
        body = parent.add_body(name=f"segment{i}", pos=offset if i == 0 else [length, 0, 0])
        body.explicitinertial, body.ipos = True, [0, 0, 0]  # without ipos MuJoCo takes the body's pos
        body.mass = mass
        body.inertia = [mass * DLO_RADIUS**2 / 2, across, across]
        if i == 0 and domain.attachment == "none":
            contact.add_joints(body, "dlo")
        else:
            _add_bend(body, i, domain, length)
        first = i // SUPPORTED * SUPPORTED
        group = min(SUPPORTED, segments - first)
        if i == first + group // 2:  # the group's middle lies in this segment, or where it begins
            middle = (0.0 if group % 2 else -length / 2, 0.0)
            load = group * mass * GRAVITY
            contact.add_support(out, body, middle, height=DLO_RADIUS, load=load, friction=friction["dlo-table"])
        body.add_geom(
            name=f"segment{i}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[DLO_RADIUS, length / 2, 0],
            quat=_HALF_TURN_Y,
            mass=0,
            contype=contact.DLO,
            conaffinity=contact.WALL | contact.DLO,
            friction=[friction["dlo-dlo"], 0, 0],
        )
        for j in range(max(0, i - APART * fineness), i - 1):
            out.add_exclude(bodyname1=f"segment{j}", bodyname2=body.name)
        if domain.attachment != "none" and 0 < i <= APART * fineness:
            out.add_exclude(bodyname1="cylinder", bodyname2=body.name)
        parent = body


def _add_bend(body: mujoco.MjsBody, i: int, domain: Domain, length: float) -> None:
    """Adds the hinge before segment i. The clamped one has half a segment to bend over, so it is twice as stiff."""
    span = length / 2 if i == 0 else length
    stiffness = domain.bending_stiffness / span
    body.add_joint(
        name=f"bend{i}",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 0, 1],
        pos=[-length / 2, 0, 0],
        stiffness=stiffness,
        damping=stiffness * DAMPING_TIME[domain.material],
        springyield=NEVER_YIELDS if domain.yield_curvature is None else domain.yield_curvature * span,
    )


def _add_cylinder(out: mujoco.MjSpec, domain: Domain, friction: dict[str, float]) -> mujoco.MjsBody:
    """Adds the attached cylinder: mocap when fixed, so that its pose is state; else free to slide and turn."""
    body = out.worldbody.add_body(name="cylinder", mocap=domain.attachment == "fixed")
    mass = CYLINDER_DENSITY * math.pi * CYLINDER_RADIUS**2 * CYLINDER_HEIGHT
    body.add_geom(
        name="cylinder",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,  # upright: seen from above it is the cylinder, and cheap to test
        pos=[0, 0, CYLINDER_HEIGHT / 2],
        size=[CYLINDER_RADIUS, CYLINDER_HEIGHT / 2, 0],
        mass=mass,
        contype=contact.DLO,
        conaffinity=contact.WALL | contact.DLO,
        priority=2,
        friction=[friction["cylinder-any"], 0, 0],
    )
    if domain.attachment == "movable":
        contact.add_joints(body, "dlo")
        ring = 2 / 3 * CYLINDER_RADIUS  # where three points resist turning as an evenly loaded disc does
        for turn in (0, 2 * math.pi / 3, 4 * math.pi / 3):
            spot = (ring * math.cos(turn), ring * math.sin(turn))
            load, mu = mass * GRAVITY / 3, friction["cylinder-table"]
            contact.add_support(out, body, spot, height=0, load=load, friction=mu)
    return body
