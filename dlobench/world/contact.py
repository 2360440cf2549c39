"""Says what touches what, and how: contact bits, the friction table, and the supports that stand on the table.

Supports carry weight; solids meet solids. Nothing else touches.
"""

from __future__ import annotations

import math

import mujoco

from dlobench.domain import Domain

SOLID_FRICTION = 0.3  # DLO on DLO, and the pusher, walls and cylinder on anything
SOLID_SOLREF, SOLID_SOLIMP = (0.01, 1.0), (0.99, 0.999, 0.001)

# Contact bits: the table, and what is solid.
TABLE, WALL, DLO, BODY, PUSHER = (1 << bit for bit in range(5))

# Sliding on the table is Coulomb's to 0.1 %. MuJoCo regularises friction: a support at rest slips with an acceleration
# of up to SLIP, and one that slides presses harder by the ratio of its speed's change to SLIP × IMPRATIO.
SLIP = 0.1  # m/s², about 1 % of gravity
IMPRATIO = 2e6  # softness of the normal over that of friction; nothing moves along the normal, so it may be soft
STICK = 5.0  # 1/steps, the rate at which a support that should rest stops
TABLE_INVERSE_WEIGHT = 1e5  # 1/kg, so large that supports' softness does not depend on what they carry
_SUPPORT_RADIUS = 0.001  # m


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


def add_table(out: mujoco.MjSpec, half: float) -> None:
    """Adds the table that supports stand on, a square of 2 `half` m."""
    out.worldbody.add_body(name="table").add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[half, half, 0.01],
        contype=TABLE,
        conaffinity=0,
        friction=[0, 0, 0],  # the supports say how much
    )


def add_support(
    out: mujoco.MjSpec, body: mujoco.MjsBody, pos: tuple[float, float], *, height: float, load: float, friction: float
) -> None:
    """Adds a point of a body that stands on the table and carries `load` N, whatever happens in the plane.

    `pos` is x m, y m in the body's frame, `height` m that of the frame above the table. The load is MuJoCo's adhesion:
    friction is reckoned from it, and nothing moves vertically, so that nothing in the plane can change it.
    """
    sphere = body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=[*pos, _SUPPORT_RADIUS - height],
        size=[_SUPPORT_RADIUS, 0, 0],
        margin=_SUPPORT_RADIUS,
        mass=0,
        contype=0,
        conaffinity=TABLE,
        priority=1,
        friction=[friction, 0, 0],
        group=3,
    )
    sphere.adhesion = load
    softness = SLIP * IMPRATIO / load  # 1/kg, R of the normal row
    impedance = TABLE_INVERSE_WEIGHT / (TABLE_INVERSE_WEIGHT + softness)
    sphere.solref[:2] = 0.0, -impedance * STICK / out.option.timestep  # no spring: height does not matter
    sphere.solimp[:3] = impedance, impedance, 0.001


def add_joints(body: mujoco.MjsBody, prefix: str, pivot: tuple[float, float] = (0.0, 0.0)) -> None:
    """Lets a body slide along x and y and turn about `pivot` (m, in its frame): `<prefix>_x`, `_y`, `_yaw`."""
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    body.add_joint(name=f"{prefix}_x", type=slide, axis=[1, 0, 0])
    body.add_joint(name=f"{prefix}_y", type=slide, axis=[0, 1, 0])
    body.add_joint(name=f"{prefix}_yaw", type=hinge, axis=[0, 0, 1], pos=[*pivot, 0])
