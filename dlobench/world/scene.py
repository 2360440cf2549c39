"""Builds the MuJoCo scene of a domain. Pure: the same domain gives the same model, and no random number is drawn.

The deformable linear object (DLO) is a planar chain of 5 mm capsules joined by plastic hinges (docs/adr/0002).
Everything moves in the plane. Weight is carried apart from that: the DLO's supports (small spheres) are pressed by a
plate that comes up from below with just the DLO's weight, so that no contact in the plane can lift or press a segment;
a rigid body's supports hang on a foot that may sink and tilt, so that its weight presses where its mass is. Solids
(capsules, boxes, walls) meet each other only. Friction coefficients follow one table, `friction_table`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import BOX_SIZE, DLO_RADIUS, SEGMENT_LENGTH, WORKSPACE, Domain, RigidBody

TIMESTEP = 0.01  # s
GRAVITY = 9.81  # m/s²
PUSHER_RADIUS = 0.0075  # m
PUSHER_MASS = 0.1  # kg
REACH = WORKSPACE / 2 - PUSHER_RADIUS - 2.5 * DLO_RADIUS  # m, the pusher's axis stays within: a DLO fits behind it
PUSHER_FORCE = 3.0  # N, the bound of each of the two servos
PUSHER_GAINS = {"kp": 1000.0, "kv": 20.0, "ki": 1e4, "imax": 3e-4}  # N/m, N s/m, N/(m s), m s
CYLINDER_RADIUS = 0.0075  # m, the body that an attached DLO ends in
CYLINDER_HEIGHT = 0.015  # m
CYLINDER_DENSITY = 1200.0  # kg/m³
SOLID_FRICTION = 0.3  # DLO on DLO, and the pusher, walls and cylinder on anything
DAMPING_TIME = 0.001  # s, joint damping over joint stiffness
NEVER_YIELDS = 1e3  # rad; keeps plastic state allocated, so that materials share their sizes
SUPPORT_RADIUS = 0.001  # m, spheres under bodies and cylinders

FRAME_MASS = 1e-6  # kg, what MuJoCo wants in the planar frame of a body whose mass is all in its foot

# Contact bits: what carries weight, and what is solid.
_TABLE, _DLO_PLATE, _CYLINDER_PLATE, _WALL, _DLO, _BODY, _PUSHER = (1 << bit for bit in range(7))
_SOLID_SOLREF, _SOLID_SOLIMP = (0.01, 1.0), (0.99, 0.999, 0.001)
_SUPPORT_SOLREF, _SUPPORT_SOLIMP = (0.02, 1.0), (0.3, 0.3, 0.001)
APART = 3  # segments closer than this along the chain are never tested for contact
_HALF_TURN_Y = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # lays a capsule's axis along x


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


@dataclass(frozen=True)
class Layout:
    """Says where the parts of a scene stand in MuJoCo's arrays."""

    segments: NDArray[np.intp]  # body ids, in order along the DLO
    cylinder: int | None  # body id
    bodies: NDArray[np.intp]  # body ids of the rigid bodies
    pusher: int  # body id
    root_qpos: NDArray[np.intp]  # x, y, yaw of the DLO's first body; empty when it is fixed
    joint_qpos: NDArray[np.intp]  # the chain's hinges: segments − 1, one more with a cylinder
    joint_plastic: NDArray[np.intp]  # the same hinges in mjData.plastic
    body_qpos: NDArray[np.intp]  # (bodies, 3) x, y, yaw
    pusher_qpos: NDArray[np.intp]  # x, y


def quiet(message: str) -> None:
    """Keeps MuJoCo from printing a warning and writing a log file: the warning counters say it to whoever steps."""


def build(domain: Domain, timestep: float = TIMESTEP) -> mujoco.MjModel:
    """Compiles the scene of a domain."""
    return spec(domain, timestep).compile()


def spec(domain: Domain, timestep: float = TIMESTEP) -> mujoco.MjSpec:
    """Returns the scene of a domain as an editable specification."""
    out = mujoco.MjSpec()
    out.compiler.degree = False
    out.option.timestep = timestep
    out.option.gravity = [0, 0, -GRAVITY]
    out.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    out.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    out.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    out.option.impratio = 300  # stiff friction on soft supports: little creep, and sliding hardly lifts
    out.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP  # what lies still costs nothing and cannot creep
    out.default.geom.solref[:2] = _SOLID_SOLREF
    out.default.geom.solimp[:3] = _SOLID_SOLIMP
    out.default.geom.condim = 3
    friction = friction_table(domain)
    _add_box(out, friction)
    _add_dlo(out, domain, friction)
    for i, body in enumerate(domain.bodies):
        _add_body(out, i, body, friction)
    _add_pusher(out, friction)
    return out


def layout(model: mujoco.MjModel, domain: Domain) -> Layout:
    """Finds the parts of a domain's compiled scene."""

    def qpos(*joints: str) -> NDArray[np.intp]:
        return np.array([model.joint(name).qposadr[0] for name in joints], dtype=np.intp)

    first = 0 if domain.attachment != "none" else 1
    hinges = [f"bend{i}" for i in range(first, domain.segments)]
    planar = [qpos(f"body{i}_x", f"body{i}_y", f"body{i}_yaw") for i in range(len(domain.bodies))]
    return Layout(
        segments=np.array([model.body(f"segment{i}").id for i in range(domain.segments)], dtype=np.intp),
        cylinder=None if domain.attachment == "none" else model.body("cylinder").id,
        bodies=np.array([model.body(f"body{i}").id for i in range(len(domain.bodies))], dtype=np.intp),
        pusher=model.body("pusher").id,
        root_qpos=qpos() if domain.attachment == "fixed" else qpos("dlo_x", "dlo_y", "dlo_yaw"),
        joint_qpos=qpos(*hinges),
        joint_plastic=np.array([model.jnt_plasticadr[model.joint(name).id] for name in hinges], dtype=np.intp),
        body_qpos=np.array(planar, dtype=np.intp).reshape(-1, 3),
        pusher_qpos=qpos("pusher_x", "pusher_y"),
    )


def _add_box(out: mujoco.MjSpec, friction: dict[str, float]) -> None:
    half = WORKSPACE / 2
    out.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[half, half, 0.01],
        contype=_TABLE,
        conaffinity=0,
        friction=[0, 0, 0],  # the supports say how much
    )
    for name, x, y in (("west", 1, 0), ("east", -1, 0), ("south", 0, 1), ("north", 0, -1)):
        out.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            pos=[-x * half, -y * half, 0],
            quat=_facing(x, y),
            size=[half, half, 0.01],
            contype=_WALL,
            conaffinity=0,
            priority=2,
            friction=[friction["wall-any"], 0, 0],
            group=3,
        )


def _facing(x: float, y: float) -> list[float]:
    """Returns the quaternion that turns the z axis to (x, y, 0)."""
    return [math.sqrt(0.5), -y * math.sqrt(0.5), x * math.sqrt(0.5), 0.0]


def _add_support(
    body: mujoco.MjsBody, pos: tuple[float, float, float], radius: float, friction: float, on: int
) -> None:
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


def _add_plate(out: mujoco.MjSpec, name: str, mass: float, bit: int) -> None:
    """Adds a plate whose top is the table, pressed upwards by the weight of `mass` and free to move only so."""
    body = out.worldbody.add_body(name=name, gravcomp=2)
    _add_joints(body, name, "z")
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


def _add_joints(body: mujoco.MjsBody, prefix: str, slides: str, hinges: str = "") -> None:
    names = {"x": "roll", "y": "pitch", "z": "yaw"}
    for axis in slides:
        kind = mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(name=f"{prefix}_{axis}", type=kind, axis=[float(axis == a) for a in "xyz"])
    for axis in hinges:
        kind = mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(name=f"{prefix}_{names[axis]}", type=kind, axis=[float(axis == a) for a in "xyz"])


def _add_dlo(out: mujoco.MjSpec, domain: Domain, friction: dict[str, float]) -> None:
    """Adds the chain, rooted in the cylinder where it has one, and the plate that carries its weight."""
    parent = out.worldbody
    offset = [0.0, 0.0, DLO_RADIUS]
    if domain.attachment != "none":
        parent = _add_cylinder(out, domain, friction)
        offset = [CYLINDER_RADIUS + SEGMENT_LENGTH / 2, 0.0, DLO_RADIUS]
    _add_plate(out, "dlo_plate", domain.density * math.pi * DLO_RADIUS**2 * domain.length, _DLO_PLATE)
    segment_mass = domain.density * math.pi * DLO_RADIUS**2 * SEGMENT_LENGTH
    across = segment_mass * (SEGMENT_LENGTH**2 / 12 + DLO_RADIUS**2 / 4)
    for i in range(domain.segments):
        body = parent.add_body(name=f"segment{i}", pos=offset if i == 0 else [SEGMENT_LENGTH, 0, 0])
        body.explicitinertial = True
        body.mass = segment_mass
        body.inertia = [segment_mass * DLO_RADIUS**2 / 2, across, across]
        if i == 0 and domain.attachment == "none":
            _add_joints(body, "dlo", "xy", "z")
        else:
            _add_bend(body, i, domain)
        _add_support(body, (0, 0, 0), DLO_RADIUS, friction["dlo-table"], _DLO_PLATE)
        body.add_geom(
            name=f"segment{i}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[DLO_RADIUS, SEGMENT_LENGTH / 2, 0],
            quat=_HALF_TURN_Y,
            mass=0,
            contype=_DLO,
            conaffinity=_WALL | _DLO,
            friction=[friction["dlo-dlo"], 0, 0],
        )
        for j in range(max(0, i - APART), i - 1):
            out.add_exclude(bodyname1=f"segment{j}", bodyname2=body.name)
        if domain.attachment != "none" and 0 < i <= APART:
            out.add_exclude(bodyname1="cylinder", bodyname2=body.name)
        parent = body


def _add_bend(body: mujoco.MjsBody, i: int, domain: Domain) -> None:
    """Adds the hinge before segment i. The clamped one has half a segment to bend over, so it is twice as stiff."""
    span = SEGMENT_LENGTH / 2 if i == 0 else SEGMENT_LENGTH
    stiffness = domain.bending_stiffness / span
    body.add_joint(
        name=f"bend{i}",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 0, 1],
        pos=[-SEGMENT_LENGTH / 2, 0, 0],
        stiffness=stiffness,
        damping=stiffness * DAMPING_TIME,
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
        contype=_DLO,
        conaffinity=_WALL | _DLO,
        priority=2,
        friction=[friction["cylinder-any"], 0, 0],
    )
    if domain.attachment == "movable":
        _add_joints(body, "dlo", "xy", "z")
        _add_plate(out, "cylinder_plate", mass, _CYLINDER_PLATE)
        ring = 2 / 3 * CYLINDER_RADIUS  # where three points resist turning as an evenly loaded disc does
        for turn in (0, 2 * math.pi / 3, 4 * math.pi / 3):
            spot = (ring * math.cos(turn), ring * math.sin(turn), SUPPORT_RADIUS)
            _add_support(body, spot, SUPPORT_RADIUS, friction["cylinder-table"], _CYLINDER_PLATE)
    return body


def _add_body(out: mujoco.MjSpec, i: int, rigid: RigidBody, friction: dict[str, float]) -> None:
    """Adds a composite body: solid boxes on a planar frame, mass and supports on its foot.

    Four supports a box at the Gauss points integrate an affine pressure over the box, and its moments, exactly.
    """
    frame = out.worldbody.add_body(name=f"body{i}")
    frame.explicitinertial = True
    frame.mass, frame.inertia = FRAME_MASS, [FRAME_MASS * BOX_SIZE**2] * 3
    _add_joints(frame, f"body{i}", "xy", "z")
    foot = frame.add_body(name=f"foot{i}")
    _add_joints(foot, f"foot{i}", "z", "xy")
    gauss = BOX_SIZE / 2 / math.sqrt(3)
    for (x, y, _, half, _), density in zip(rigid.boxes(), rigid.densities, strict=True):
        box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "pos": [x, y, BOX_SIZE / 2], "size": [half, half, BOX_SIZE / 2]}
        frame.add_geom(
            **box,
            mass=0,
            contype=_BODY,
            conaffinity=_WALL | _DLO | _BODY,
            priority=1,
            friction=[friction[f"dlo-body{i}"], 0, 0],
        )
        foot.add_geom(**box, density=density, contype=0, conaffinity=0, group=4)
        for dx in (-gauss, gauss):
            for dy in (-gauss, gauss):
                spot = (x + dx, y + dy, SUPPORT_RADIUS)
                _add_support(foot, spot, SUPPORT_RADIUS, friction[f"body{i}-table"], _TABLE)


def _add_pusher(out: mujoco.MjSpec, friction: dict[str, float]) -> None:
    body = out.worldbody.add_body(name="pusher")
    _add_joints(body, "pusher", "xy")
    body.add_geom(
        name="pusher",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        pos=[0, 0, 0.02],
        size=[PUSHER_RADIUS, 0.02, 0],
        mass=PUSHER_MASS,
        contype=_PUSHER,
        conaffinity=_DLO | _BODY,
        priority=2,
        friction=[friction["pusher-any"], 0, 0],
    )
    for axis in "xy":
        servo = out.add_actuator(
            name=f"pusher_{axis}", target=f"pusher_{axis}", trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True
        )
        servo.forcerange = [-PUSHER_FORCE, PUSHER_FORCE]
        servo.set_to_pid(**PUSHER_GAINS)
