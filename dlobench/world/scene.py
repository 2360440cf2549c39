"""Builds the MuJoCo scene of a domain. Pure: the same domain gives the same model, and no random number is drawn.

The deformable linear object (DLO) is a planar chain of 5 mm capsules joined by plastic hinges (docs/adr/0002).
Everything moves in the plane, and only there. Weight is known beforehand: supports (small spheres) carry shares of it,
and friction on the table is reckoned from them. Solids (capsules, boxes, walls) meet each other only. Friction
coefficients follow one table, `contact.friction_table`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import BOX_SIZE, DLO_RADIUS, PUSHER_RADIUS, WORKSPACE, Domain, RigidBody
from dlobench.world import contact
from dlobench.world.chain import add_dlo
from dlobench.world.pressure import spread

TIMESTEP = 0.004  # s; docs/adr/0008
TALL = 0.15  # m, half the height of a body's boxes; nothing else depends on it
PUSHER_MASS = 0.02  # kg
REACH = WORKSPACE / 2 - PUSHER_RADIUS - 4.5 * DLO_RADIUS  # m, the pusher's axis stays within: two DLOs fit behind it
PUSHER_FORCE = 1.5  # N, the bound of each of the two servos: the heaviest body resists with 1.1 N
PUSHER_GAINS = {"kp": 1000.0, "kv": 15.0, "ki": 1000.0, "imax": 1e-4}  # N/m, N s/m, N/(m s), m s


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
    body_qpos: NDArray[np.intp]  # (bodies, 3) x, y, yaw, turning about the pivot
    body_pivot: NDArray[np.float64]  # (bodies, 2) centre of mass in the body's frame, x m, y m
    pusher_qpos: NDArray[np.intp]  # x, y


def quiet(message: str) -> None:
    """Keeps MuJoCo from printing a warning and writing a log file: the warning counters say it to whoever steps."""


def build(domain: Domain, timestep: float = TIMESTEP, fineness: int = 1) -> mujoco.MjModel:
    """Compiles the scene of a domain."""
    return compile(spec(domain, timestep, fineness))


def compile(out: mujoco.MjSpec) -> mujoco.MjModel:  # noqa: A001  # what MuJoCo calls it
    """Compiles a specification; to be used instead of its own `compile`, which knows nothing of the table."""
    model = out.compile()
    model.body_invweight0[model.body("table").id] = contact.TABLE_INVERSE_WEIGHT
    return model


def spec(domain: Domain, timestep: float = TIMESTEP, fineness: int = 1) -> mujoco.MjSpec:
    """Returns the scene of a domain as an editable specification.

    `fineness` divides every segment of the DLO, to see what the length of a segment does; worlds have 1.
    """
    out = mujoco.MjSpec()
    out.compiler.degree = False
    out.option.timestep = timestep
    out.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    out.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    out.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    out.option.tolerance = 1e-6
    out.option.ls_iterations = 500  # 50, MuJoCo's own, end some line searches halfway, and the step with them
    out.option.impratio = contact.IMPRATIO
    out.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP  # what lies still costs nothing and cannot creep
    out.default.geom.solref[:2] = contact.SOLID_SOLREF
    out.default.geom.solimp[:3] = contact.SOLID_SOLIMP
    out.default.geom.condim = 3
    friction = contact.friction_table(domain)
    contact.add_table(out, WORKSPACE / 2)
    _add_walls(out, friction)
    add_dlo(out, domain, friction, fineness)
    for i, body in enumerate(domain.bodies):
        _add_body(out, i, body, friction)
    _add_pusher(out, friction)
    return out


def layout(model: mujoco.MjModel, domain: Domain) -> Layout:
    """Finds the parts of a domain's compiled scene."""

    def qpos(*joints: str) -> NDArray[np.intp]:
        return np.array([model.joint(name).qposadr[0] for name in joints], dtype=np.intp)

    names = {model.body(i).name for i in range(model.nbody)}
    segments = sum(name.startswith("segment") for name in names)
    first = 0 if domain.attachment != "none" else 1
    hinges = [f"bend{i}" for i in range(first, segments)]
    planar = [qpos(f"body{i}_x", f"body{i}_y", f"body{i}_yaw") for i in range(len(domain.bodies))]
    return Layout(
        segments=np.array([model.body(f"segment{i}").id for i in range(segments)], dtype=np.intp),
        cylinder=None if domain.attachment == "none" else model.body("cylinder").id,
        bodies=np.array([model.body(f"body{i}").id for i in range(len(domain.bodies))], dtype=np.intp),
        pusher=model.body("pusher").id,
        root_qpos=qpos() if domain.attachment == "fixed" else qpos("dlo_x", "dlo_y", "dlo_yaw"),
        joint_qpos=qpos(*hinges),
        joint_plastic=np.array([model.jnt_plasticadr[model.joint(name).id] for name in hinges], dtype=np.intp),
        body_qpos=np.array(planar, dtype=np.intp).reshape(-1, 3),
        body_pivot=np.array([model.joint(f"body{i}_yaw").pos[:2] for i in range(len(domain.bodies))]).reshape(-1, 2),
        pusher_qpos=qpos("pusher_x", "pusher_y"),
    )


def _add_walls(out: mujoco.MjSpec, friction: dict[str, float]) -> None:
    half = WORKSPACE / 2
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
    """Adds a composite body of boxes, which turns about its centre of mass, and the supports that it stands on."""
    body = out.worldbody.add_body(name=f"body{i}")
    boxes, densities = rigid.boxes(), np.array(rigid.densities)
    centre = densities @ boxes[:, :2] / densities.sum()
    contact.add_joints(body, f"body{i}", pivot=(float(centre[0]), float(centre[1])))
    for (x, y, _, half, _), density in zip(boxes, densities, strict=True):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[x, y, 0],
            size=[half, half, TALL],  # so that whatever is in it is pushed out sideways
            mass=density * BOX_SIZE**3,
            contype=contact.BODY,
            conaffinity=contact.WALL | contact.DLO | contact.BODY,
            priority=1,
            friction=[friction[f"dlo-body{i}"], 0, 0],
        )
    for (x, y), load in zip(*spread(rigid), strict=True):
        contact.add_support(out, body, (x, y), height=0, load=float(load), friction=friction[f"body{i}-table"])


def _add_pusher(out: mujoco.MjSpec, friction: dict[str, float]) -> None:
    body = out.worldbody.add_body(name="pusher")
    for axis, along in (("x", [1, 0, 0]), ("y", [0, 1, 0])):
        body.add_joint(name=f"pusher_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=along)
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
