"""Implements dm_control's abstract Physics over MuJoCo 4, whose models `dm_control.mujoco` cannot load yet."""

from __future__ import annotations

import mujoco
import numpy as np
from dm_control.rl import control

from dlobench.domain import Domain
from dlobench.world import scene
from dlobench.world.starts import Start
from dlobench.world.state import LASTING, Array, State, controls, fixed_point, observe, place


def restart(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Wakes and stops everything, so that nothing but positions and plastic bends is carried over to the next push."""
    time, kept = data.time, {name: getattr(data, name).copy() for name in LASTING}
    mujoco.mj_resetData(model, data)
    for name, value in kept.items():
        getattr(data, name)[:] = value
    data.time = time
    mujoco.mj_kinematics(model, data)


class Physics(control.Physics):  # type: ignore[misc]  # dm_control is untyped
    """Simulates one domain: push by push, with named geometric queries."""

    def __init__(self, domain: Domain, timestep: float = scene.TIMESTEP) -> None:
        mujoco.set_mju_user_warning(scene.quiet)
        self.domain = domain
        self.model = scene.build(domain, timestep)
        self.data = mujoco.MjData(self.model)
        self.layout = scene.layout(self.model, domain)
        self._plan = np.zeros((0, self.model.nu))

    def reset(self) -> None:
        """Puts everything back to the model's reference."""
        mujoco.mj_resetData(self.model, self.data)
        self._plan = self._plan[:0]

    def after_reset(self) -> None:
        """Brings derived quantities up to date."""
        mujoco.mj_kinematics(self.model, self.data)

    def start(self, start: Start) -> None:
        """Places everything, at rest."""
        placed = place(self.model, self.layout, self.domain, start)
        self.data.qpos[:], self.data.plastic[:] = placed.qpos, placed.plastic
        self.data.mocap_pos[:], self.data.mocap_quat[:] = placed.mocap_pos, placed.mocap_quat
        mujoco.mj_kinematics(self.model, self.data)

    def plan(self, displacement: Array) -> int:
        """Plans a push by (2,) m from where the pusher is; returns the number of steps that it takes."""
        pusher = self.data.qpos[None, self.layout.pusher_qpos]
        self._plan = controls(pusher, displacement[None], self.timestep())[0]
        restart(self.model, self.data)
        return len(self._plan)

    def step(self, n_sub_steps: int = 1) -> None:
        """Advances the simulation; the servos follow the planned push, then hold.

        Raises `control.PhysicsError` when MuJoCo warns, which ends an episode.
        """
        for _ in range(n_sub_steps):
            if len(self._plan):
                self.data.ctrl[:] = self._plan[0]
                self._plan = self._plan[1:]
            mujoco.mj_step(self.model, self.data)
        self.check_divergence()
        mujoco.mj_kinematics(self.model, self.data)

    def check_divergence(self) -> None:
        """Raises `control.PhysicsError` when MuJoCo has warned since the reset."""
        for kind, warning in enumerate(self.data.warning):
            if warning.number:
                raise control.PhysicsError(f"MuJoCo warned: {mujoco.mjtWarning(kind).name}")

    def time(self) -> float:
        """Returns the simulated time, s."""
        return float(self.data.time)

    def timestep(self) -> float:
        """Returns the length of a step, s."""
        return float(self.model.opt.timestep)

    def state(self) -> State:
        """Returns the planar poses, with S = 1."""
        return observe(self.layout, self.data.xpos[None], self.data.xmat[None])

    def fixed_cylinder(self) -> Array | None:
        """Returns the (2,) place of a fixed cylinder, m, or None."""
        found = fixed_point(self.layout, self.domain, self.data.xpos[None])
        return None if found is None else found[0]
