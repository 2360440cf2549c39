"""Holds the shipped scene as a test rig: loads and launches its things, and reads poses and forces as totals.

What is weighed and where it lies comes from the `Domain`, never from the compiled model: that is what is being checked.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import BOX_SIZE, DLO_RADIUS, SEGMENT_LENGTH, Domain, RigidBody
from dlobench.world import scene
from dlobench.world.chain import CYLINDER_DENSITY, CYLINDER_HEIGHT, CYLINDER_RADIUS
from dlobench.world.starts import Start
from dlobench.world.state import PUSH_TIME, controls, place

Array = NDArray[np.float64]
Edit = Callable[[mujoco.MjSpec], None]

CYLINDER_MASS = CYLINDER_DENSITY * math.pi * CYLINDER_RADIUS**2 * CYLINDER_HEIGHT  # kg


def segment_mass(domain: Domain) -> float:
    """Returns the mass of one segment of the DLO, kg."""
    return domain.density * math.pi * DLO_RADIUS**2 * SEGMENT_LENGTH


def box_masses(body: RigidBody) -> Array:
    """Returns the masses of a body's boxes: (boxes,) kg."""
    return np.array(body.densities) * BOX_SIZE**3


class Rig:
    """Steps one domain's scene.

    A thing is "dlo", with its movable cylinder if it has one, or "body0", "body1" …
    """

    def __init__(
        self,
        domain: Domain,
        begin: Start,
        *,
        timestep: float = scene.TIMESTEP,
        sleep: bool = True,
        edit: Edit | None = None,
    ) -> None:
        """Builds the scene, places everything and lets it settle for the time of a push.

        `edit` may change the specification first, to try a setting or to break one.
        """
        mujoco.set_mju_user_warning(scene.quiet)
        spec = scene.spec(domain, timestep)
        if not sleep:
            spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        if edit is not None:
            edit(spec)
        self.domain = domain
        self.model = scene.compile(spec)
        self.data = mujoco.MjData(self.model)
        self.layout = scene.layout(self.model, domain)
        placed = place(self.model, self.layout, domain, begin)
        for field in dataclasses.fields(placed):
            getattr(self.data, field.name)[:] = getattr(placed, field.name)
        mujoco.mj_kinematics(self.model, self.data)
        pusher = self.data.qpos[None, self.layout.pusher_qpos]
        self.data.ctrl[:] = controls(pusher, np.zeros((1, 2)), self.timestep)[0, 0]  # it stays where it is
        self.run(PUSH_TIME)

    @property
    def timestep(self) -> float:
        """Returns the length of a step, s."""
        return float(self.model.opt.timestep)

    def run(self, seconds: float, each: Callable[[], None] | None = None) -> None:
        """Steps for a while, to the nearest step; calls `each` before every step."""
        for _ in range(round(seconds / self.timestep)):
            if each is not None:
                each()
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_kinematics(self.model, self.data)

    def dofs(self, thing: str) -> NDArray[np.intp]:
        """Returns a thing's degrees of freedom: (3,) x, y and yaw; (2,) of "pusher"; those of the "hinges"."""
        layout = self.layout
        named = {"dlo": layout.root_qpos, "hinges": layout.joint_qpos, "pusher": layout.pusher_qpos}
        qpos = named[thing] if thing in named else layout.body_qpos[int(thing[4:])]
        joints = [np.flatnonzero(self.model.jnt_qposadr == q)[0] for q in qpos]
        return np.asarray(self.model.jnt_dofadr[joints], dtype=np.intp)

    def parts(self, thing: str) -> tuple[NDArray[np.intp], Array, Array]:
        """Returns body ids (n,), masses (n,) kg and centres (n, 2) m of what the thing is made of."""
        xpos = self.data.xpos
        if thing == "dlo":
            ids, masses = self.layout.segments, np.full(self.domain.segments, segment_mass(self.domain))
            if self.domain.attachment == "movable" and self.layout.cylinder is not None:
                ids, masses = np.append(ids, self.layout.cylinder), np.append(masses, CYLINDER_MASS)
            return ids, masses, xpos[ids, :2]
        which = int(thing[4:])
        body, frame = self.domain.bodies[which], self.layout.bodies[which]
        places = xpos[frame, :2] + body.boxes()[:, :2] @ self.data.xmat[frame].reshape(3, 3)[:2, :2].T
        return np.full(len(places), frame), box_masses(body), places

    def mass(self, thing: str) -> float:
        """Returns the thing's mass, kg."""
        return float(self.parts(thing)[1].sum())

    def centre(self, thing: str) -> Array:
        """Returns the thing's centre of mass: (2,) m."""
        _, masses, places = self.parts(thing)
        centre: Array = masses @ places / masses.sum()
        return centre

    def yaw(self, thing: str) -> float:
        """Returns the turn of the thing's frame, unwrapped, rad."""
        which = self.dofs(thing)[2]
        [joint] = np.flatnonzero(self.model.jnt_dofadr == which)
        return float(self.data.qpos[self.model.jnt_qposadr[joint]])

    def velocity(self, thing: str) -> Array:
        """Returns the velocity of the thing's frame: (2,) m/s, which is that of all its parts unless it turns."""
        return np.array(self.data.qvel[self.dofs(thing)[:2]])

    def launch(self, thing: str, velocity: Array, spin: float = 0.0) -> None:
        """Gives the thing's centre of mass a (2,) m/s velocity, and the thing a spin, rad/s."""
        dofs = self.dofs(thing)
        arm = self.data.xanchor[self.model.dof_jntid[dofs[2]], :2] - self.centre(thing)
        self.data.qvel[dofs] = [velocity[0] - spin * arm[1], velocity[1] + spin * arm[0], spin]

    def load(self, thing: str, force: Array, moment: float = 0.0) -> None:
        """Applies a horizontal (2,) N force, spread as the mass is and at the table's height, and a moment, N m.

        At the table's height neither the load nor friction tilts anything.
        """
        ids, masses, places = self.parts(thing)
        self.data.xfrc_applied[ids] = 0
        for body, share, spot in zip(ids, masses / masses.sum(), places, strict=True):
            part = np.array([*(share * force), 0.0])
            arm = np.array([*spot, 0.0]) - self.data.xipos[body]
            turning = np.cross(arm, part)
            self.data.xfrc_applied[body] += [*part, turning[0], turning[1], turning[2] + share * moment]
