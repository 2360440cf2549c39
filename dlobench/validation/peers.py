"""Builds peers of the shipped scene: the same world as a good engineer would write it in MuJoCo without our tricks.

A peer has the same `Domain`, `Start` and pushes. Walls, table, pusher and servo are the shipped ones, friction follows
`contact.friction_table`, DLO against DLO is on. The rest is three-dimensional: a rigid body has a free joint and its
boxes, an attached cylinder stands on the table, weight presses through real contacts. The DLO is MuJoCo's own rod
(`validation.rods`) or a chain of ball joints (`validation.balls`). Neither yields: a plastic domain becomes elastic.

Settings are MuJoCo's defaults (Newton, islands, sparse matrices, which it chooses by itself from 60 degrees of freedom
on) but for what a user would change at once: the `discrete` integrator, which the documentation recommends for stiff
springs, and sleep, which made both peers faster by a fifth. Where a peer departs further, its module says why.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import BOX_SIZE, DLO_RADIUS, MAX_BODIES, MAX_SEGMENTS, Domain
from dlobench.world import contact, scene
from dlobench.world.chain import CYLINDER_DENSITY, CYLINDER_HEIGHT, CYLINDER_RADIUS
from dlobench.world.starts import Start
from dlobench.world.state import State, controls

Array = NDArray[np.float64]
Read = Callable[[mujoco.MjData], Array]

TIMESTEP = 0.002  # s, MuJoCo's default
DLO_MEETS = contact.TABLE | contact.WALL | contact.DLO  # the conaffinity of the DLO's geometry
# Rolling friction over the torque that makes a sliding rod roll. A cone shares its force between sliding and rolling:
# at 2, a rod slid with 0.89 of its friction under elliptic cones and 0.67 under pyramids, at 30 with 1.00 and 0.97.
_ROLLING = 30.0
_SPIN = 1e-5  # m, the least torsional friction that MuJoCo knows: a point of our DLO resists no turning on the spot


class Peer:
    """Simulates one start of a peer scene, push by push, on one thread."""

    def __init__(self, domain: Domain, start: Start, spec: mujoco.MjSpec, dlo: Read) -> None:
        """Places everything and lets it settle for the time of a push.

        `dlo` reads the (segments, 3) planar poses of the segments, x m, y m, yaw rad, from data after `mj_flex`.
        """
        mujoco.set_mju_user_warning(scene.quiet)
        self.domain = domain
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._dlo = dlo
        self._pusher = [self.model.joint(f"pusher_{axis}").qposadr[0] for axis in "xy"]
        self.data.qpos[self._pusher] = start.pusher
        self.placed = self.state()
        self.push(np.zeros(2))

    def push(self, displacement: Array) -> State:
        """Moves the pusher by (2,) m along the shipped set-points; returns the state after the push, with S = 1."""
        plan = controls(self.data.qpos[None, self._pusher], displacement[None], self.model.opt.timestep)[0]
        self.data.qvel[:], self.data.act[:] = 0, 0  # every push begins at rest, as in the shipped world
        for setpoint in plan:
            self.data.ctrl[:] = setpoint
            mujoco.mj_step(self.model, self.data)
        return self.state()

    def state(self) -> State:
        """Returns the planar poses, with S = 1."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_flex(self.model, self.data)
        dlo, bodies = np.zeros((1, MAX_SEGMENTS, 3)), np.zeros((1, MAX_BODIES, 3))
        dlo[0, : self.domain.segments] = self._dlo(self.data)
        for i in range(len(self.domain.bodies)):
            bodies[0, i] = pose(self.data, f"body{i}")
        cylinder = np.zeros((1, 3)) if self.domain.attachment == "none" else pose(self.data, "cylinder")[None]
        return State(dlo=dlo, pusher=pose(self.data, "pusher")[None, :2], bodies=bodies, cylinder=cylinder)

    @property
    def warned(self) -> bool:
        """Tells whether MuJoCo has warned, say of a divergence."""
        return any(warning.number for warning in self.data.warning)


def pose(data: mujoco.MjData, body: str) -> Array:
    """Returns a body's planar pose: (3,) x m, y m, yaw rad."""
    found = data.body(body)
    return np.array([*found.xpos[:2], math.atan2(found.xmat[3], found.xmat[0])])


def turn(yaw: float) -> list[float]:
    """Returns the quaternion of a turn by yaw (rad) about the z axis."""
    return [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]


def surroundings(domain: Domain, start: Start, timestep: float, sleep: bool) -> mujoco.MjSpec:
    """Returns everything but the DLO, where it stands at the start; the pusher's joints are left at 0.

    The DLO's geometry is to have contype `contact.DLO` and conaffinity `DLO_MEETS`; it must be kept
    from rolling, as it may not in a planar world.
    """
    out = scene.spec(domain)
    for body in list(out.worldbody.bodies):
        if body.name not in {"table", "pusher"}:
            out.delete(body)
    out.option = mujoco.MjSpec().option
    out.option.timestep = timestep
    out.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    if sleep:
        out.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    fresh = mujoco.MjSpec().default.geom
    for geom in out.geoms:
        geom.solref, geom.solimp = fresh.solref, fresh.solimp
    friction = contact.friction_table(domain)
    table = out.geom("table")
    table.contype, table.conaffinity, table.priority = contact.TABLE, 0, 1
    table.friction = [friction["dlo-table"], 0, 0]
    for i in range(len(domain.bodies)):
        _add_body(out, domain, start, i, friction)
    if domain.attachment != "none":
        _add_cylinder(out, domain, start, friction)
    return out


def resist_rolling(out: mujoco.MjSpec) -> None:
    """Gives the table rolling friction (condim 6), so much that a DLO only slides on it."""
    table = out.geom("table")
    sliding = float(table.friction[0])
    table.condim, table.friction = 6, [sliding, _SPIN, _ROLLING * sliding * DLO_RADIUS]


def _add_body(out: mujoco.MjSpec, domain: Domain, start: Start, i: int, friction: dict[str, float]) -> None:
    rigid, (x, y, yaw) = domain.bodies[i], start.bodies[i]
    body = out.worldbody.add_body(name=f"body{i}", pos=[x, y, 0], quat=turn(yaw))
    body.add_freejoint()
    for j, ((dx, dy, _, half, _), density) in enumerate(zip(rigid.boxes(), rigid.densities, strict=True)):
        body.add_geom(
            name=f"body{i}_{j}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[dx, dy, BOX_SIZE / 2],
            size=[half, half, BOX_SIZE / 2],
            density=density,
            contype=contact.BODY,
            conaffinity=contact.WALL | contact.DLO | contact.BODY,
            priority=1,
            condim=3,
            friction=[friction[f"dlo-body{i}"], 0, 0],
        )
        _stand(out, f"body{i}_{j}", friction[f"body{i}-table"])


def _add_cylinder(out: mujoco.MjSpec, domain: Domain, start: Start, friction: dict[str, float]) -> None:
    """Adds the attached cylinder. A movable one slides, sinks and turns, but does not tilt.

    With a free joint, MuJoCo 4.0's flex diverged: a clamped rod's torsional damping acts explicitly on the body.
    """
    body = out.worldbody.add_body(name="cylinder", pos=[*start.root[:2], 0], quat=turn(start.root[2]))
    body.add_geom(
        name="cylinder",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=[0, 0, CYLINDER_HEIGHT / 2],
        size=[CYLINDER_RADIUS, CYLINDER_HEIGHT / 2, 0],
        density=CYLINDER_DENSITY,
        contype=contact.DLO,
        conaffinity=contact.WALL | contact.DLO,
        priority=2,
        condim=3,
        friction=[friction["cylinder-any"], 0, 0],
    )
    if domain.attachment == "movable":
        for axis in np.eye(3):
            body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
        _stand(out, "cylinder", friction["cylinder-table"])


def _stand(out: mujoco.MjSpec, geom: str, friction: float) -> None:
    """Lets a geom stand on the table with a coefficient of their own, which the mixing of two could not give."""
    pair = out.add_pair(geomname1="table", geomname2=geom, condim=3)
    pair.friction[:2] = friction
