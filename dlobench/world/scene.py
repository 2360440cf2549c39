"""Builds the MuJoCo scene of a domain. Pure: the same domain gives the same model, and no random number is drawn.

The deformable linear object (DLO) is a planar chain of 5 mm capsules joined by plastic hinges (docs/adr/0002).
Everything moves in the plane. Weight is carried apart from that: the DLO's supports (small spheres) are pressed by a
plate that comes up from below with just the DLO's weight, so that no contact in the plane can lift or press a segment;
a rigid body's supports hang on a foot that may sink and tilt, so that its weight presses where its mass is. Solids
(capsules, boxes, walls) meet each other only. Friction coefficients follow one table, `contact.friction_table`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import BOX_SIZE, DLO_RADIUS, WORKSPACE, Domain, RigidBody
from dlobench.world import contact
from dlobench.world.chain import add_dlo

TIMESTEP = 0.01  # s
GRAVITY = 9.81  # m/s²
PUSHER_RADIUS = 0.0075  # m
PUSHER_MASS = 0.1  # kg
REACH = WORKSPACE / 2 - PUSHER_RADIUS - 2.5 * DLO_RADIUS  # m, the pusher's axis stays within: a DLO fits behind it
PUSHER_FORCE = 1.2  # N, the bound of each of the two servos: the heaviest body resists with 1.1 N
PUSHER_GAINS = {"kp": 1000.0, "kv": 20.0, "ki": 1e4, "imax": 3e-5}  # N/m, N s/m, N/(m s), m s
FRAME_MASS = 1e-6  # kg, what MuJoCo wants in the planar frame of a body whose mass is all in its foot


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
    out.default.geom.solref[:2] = contact.SOLID_SOLREF
    out.default.geom.solimp[:3] = contact.SOLID_SOLIMP
    out.default.geom.condim = 3
    friction = contact.friction_table(domain)
    _add_box(out, friction)
    add_dlo(out, domain, friction)
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
        contype=contact.TABLE,
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
            contype=contact.WALL,
            conaffinity=0,
            priority=2,
            friction=[friction["wall-any"], 0, 0],
            group=3,
        )


def _facing(x: float, y: float) -> list[float]:
    """Returns the quaternion that turns the z axis to (x, y, 0)."""
    return [math.sqrt(0.5), -y * math.sqrt(0.5), x * math.sqrt(0.5), 0.0]


def _add_body(out: mujoco.MjSpec, i: int, rigid: RigidBody, friction: dict[str, float]) -> None:
    """Adds a composite body: solid boxes on a planar frame, mass and supports on its foot.

    Four supports a box at the Gauss points integrate an affine pressure over the box, and its moments, exactly.
    """
    frame = out.worldbody.add_body(name=f"body{i}")
    frame.explicitinertial = True
    frame.mass, frame.inertia = FRAME_MASS, [FRAME_MASS * BOX_SIZE**2] * 3
    contact.add_joints(frame, f"body{i}", "xy", "z")
    foot = frame.add_body(name=f"foot{i}")
    contact.add_joints(foot, f"foot{i}", "z", "xy")
    gauss = BOX_SIZE / 2 / math.sqrt(3)
    for (x, y, _, half, _), density in zip(rigid.boxes(), rigid.densities, strict=True):
        box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "pos": [x, y, BOX_SIZE / 2], "size": [half, half, BOX_SIZE / 2]}
        frame.add_geom(
            **box,
            mass=0,
            contype=contact.BODY,
            conaffinity=contact.WALL | contact.DLO | contact.BODY,
            priority=1,
            friction=[friction[f"dlo-body{i}"], 0, 0],
        )
        foot.add_geom(**box, density=density, contype=0, conaffinity=0, group=4)
        for dx in (-gauss, gauss):
            for dy in (-gauss, gauss):
                spot = (x + dx, y + dy, contact.SUPPORT_RADIUS)
                contact.add_support(foot, spot, contact.SUPPORT_RADIUS, friction[f"body{i}-table"], contact.TABLE)


def _add_pusher(out: mujoco.MjSpec, friction: dict[str, float]) -> None:
    body = out.worldbody.add_body(name="pusher")
    contact.add_joints(body, "pusher", "xy")
    body.add_geom(
        name="pusher",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        pos=[0, 0, 0.02],
        size=[PUSHER_RADIUS, 0.02, 0],
        mass=PUSHER_MASS,
        contype=contact.PUSHER,
        conaffinity=contact.DLO | contact.BODY,
        priority=2,
        friction=[friction["pusher-any"], 0, 0],
    )
    for axis in "xy":
        servo = out.add_actuator(
            name=f"pusher_{axis}", target=f"pusher_{axis}", trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True
        )
        servo.forcerange = [-PUSHER_FORCE, PUSHER_FORCE]
        servo.set_to_pid(**PUSHER_GAINS)
