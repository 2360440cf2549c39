"""Says what touches what, and how: contact bits, the friction table, and the parts that carry weight.

Supports (small spheres) stand on the table or on a plate; solids meet solids. Nothing else touches.
"""

from __future__ import annotations

import math

import mujoco

from dlobench.domain import WORKSPACE, Domain

SOLID_FRICTION = 0.3  # DLO on DLO, and the pusher, walls and cylinder on anything
SUPPORT_RADIUS = 0.001  # m, spheres under bodies and cylinders

# Contact bits: what carries weight, and what is solid.
TABLE, DLO_PLATE, CYLINDER_PLATE, WALL, DLO, BODY, PUSHER = (1 << bit for bit in range(7))
SOLID_SOLREF, SOLID_SOLIMP = (0.02, 1.0), (0.99, 0.999, 0.001)
_SUPPORT_SOLREF, _SUPPORT_SOLIMP = (0.02, 1.0), (0.3, 0.3, 0.001)


def friction_table(domain: Domain) -> dict[str, float]:
    """Returns the friction coefficient of every kind of contact pair (docs/adr/0002).

    The DLO slides on the table with the surface's coefficient, a body with the geometric mean of the surface's and its
    own, the DLO along a body with the body's; two bodies meet with the larger of theirs.
    """
    table = {"dlo-table": domain.surface_friction, "cylinder-table": domain.surface_friction}
    table |= {"dlo-dlo": SOLID_FRICTION, "pusher-any": SOLID_FRICTION, "wall-any": SOLID_FRICTION}
    table |= {"cylinder-any": SOLID_FRICTION}
    for i, body in enumerate(domain.bodies):
        table[f"body{i}-table"] = math.sqrt(domain.surface_friction * body.friction)
        table[f"dlo-body{i}"] = body.friction
    return table


def add_support(body: mujoco.MjsBody, pos: tuple[float, float, float], radius: float, friction: float, on: int) -> None:
    """Adds a sphere that stands on the table or on a plate, as the bit `on` says."""
    sphere = body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=list(pos),
        size=[radius, 0, 0],
        mass=0,
        contype=0,
        conaffinity=on,
        priority=1,
        friction=[friction, 0, 0],
        group=3,
    )
    sphere.solref[:2], sphere.solimp[:3] = _SUPPORT_SOLREF, _SUPPORT_SOLIMP


def add_plate(out: mujoco.MjSpec, name: str, mass: float, bit: int) -> None:
    """Adds a plate whose top is the table, pressed upwards by the weight of `mass` and free to move only so."""
    body = out.worldbody.add_body(name=name, gravcomp=2)
    add_joints(body, name, "z")
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0, 0, -0.01],
        size=[WORKSPACE, WORKSPACE, 0.01],
        mass=mass,
        contype=bit,
        conaffinity=0,
        friction=[0, 0, 0],  # the supports say how much
        group=4,
    )


def add_joints(body: mujoco.MjsBody, prefix: str, slides: str, hinges: str = "") -> None:
    """Adds slides and hinges along axes, named `<prefix>_x`, … and `<prefix>_roll`, `_pitch`, `_yaw`."""
    names = {"x": "roll", "y": "pitch", "z": "yaw"}
    for axis in slides:
        kind = mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(name=f"{prefix}_{axis}", type=kind, axis=[float(axis == a) for a in "xyz"])
    for axis in hinges:
        kind = mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(name=f"{prefix}_{names[axis]}", type=kind, axis=[float(axis == a) for a in "xyz"])
