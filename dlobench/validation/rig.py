"""Drives the shipped simulator by hand: reads and puts whole states, tries other settings, records what moves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import Domain
from dlobench.validation.overlaps import Poses
from dlobench.world import actions, scene, starts
from dlobench.world.simulate import Simulator, Streams
from dlobench.world.state import Array, State

Edit = Callable[[mujoco.MjModel], None]  # changes settings of a compiled scene, not its sizes


@dataclass(frozen=True)
class Rest:
    """Holds S physics states at rest: positions alone. Velocities and the servos' integrals are 0."""

    qpos: Array  # (S, nq)
    plastic: Array  # (S, nplastic)  relaxed angles of the hinges, rad
    mocap_pos: Array  # (S, nmocap, 3)
    mocap_quat: Array  # (S, nmocap, 4)

    def take(self, index: NDArray[np.intp]) -> Rest:
        """Returns the states at `index`."""
        return Rest(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    @staticmethod
    def stack(parts: Sequence[Rest]) -> Rest:
        """Joins states of one domain."""
        names = Rest.__dataclass_fields__
        return Rest(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class Rig(Simulator):
    """Steps S simulations of one domain as the shipped simulator does, and lets itself be looked into."""

    def __init__(
        self,
        domain: Domain,
        simulations: int,
        threads: int = 1,
        timestep: float = scene.TIMESTEP,
        edit: Edit | None = None,
    ) -> None:
        super().__init__(domain, simulations, threads, timestep)
        if edit is not None:
            edit(self.model)
            self._batch.set_models(self.model)
        self._probe = mujoco.MjData(self.model)

    def rest(self) -> Rest:
        """Returns the positions of every simulation."""
        return Rest(*(self._batch.bind(name).copy() for name in Rest.__dataclass_fields__))

    def put(self, rest: Rest) -> None:
        """Places every simulation in a state at rest; nothing settles."""
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.failed[:] = False
        for name in Rest.__dataclass_fields__:
            self._batch.bind(name)[:] = getattr(rest, name)
        self._batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS)

    def warned(self) -> NDArray[np.bool_]:
        """Tells which simulations, (S,), raised or warned in the last push."""
        warning = self._batch.warning.reshape(len(self.failed), -1).any(axis=1)
        out: NDArray[np.bool_] = (self._batch.status != 0) | warning
        return out

    def velocities(self) -> Array:
        """Returns MuJoCo's velocities of every simulation, (S, nv)."""
        moving: Array = self._batch.bind("qvel").copy()
        return moving

    def poses(self, state: State) -> Poses:
        """Returns a state without its padding, with the cylinder."""
        cylinder = None if self.layout.cylinder is None else self._xpos[:, self.layout.cylinder, :2].copy()
        segments, bodies = len(self.layout.segments), len(self.layout.bodies)
        return Poses(state.dlo[:, :segments], state.pusher, state.bodies[:, :bodies], cylinder)

    def speeds(self) -> tuple[Array, Array]:
        """Returns the largest speed of any point of the DLO and of anything else but the pusher, (S,) m/s each."""
        rest, moving = self.rest(), self.velocities()
        out = np.array([self._speed(rest.take(np.array([s])), moving[s]) for s in range(len(moving))])
        return out[:, 0], out[:, 1]

    def _speed(self, rest: Rest, moving: Array) -> tuple[float, float]:
        """Returns the largest speed of a point of the DLO, and of a body or the cylinder, m/s."""
        model, data = self.model, self._probe
        data.qpos[:], data.qvel[:] = rest.qpos[0], moving
        data.mocap_pos[:], data.mocap_quat[:] = rest.mocap_pos[0], rest.mocap_quat[0]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        speed = []
        for bodies in (self.layout.segments, self._others()):
            solid = np.isin(model.geom_bodyid, bodies) & (model.geom_contype != 0)
            body, middle = model.geom_bodyid[solid], data.geom_xpos[solid][:, :2]
            axes = data.geom_xmat[solid].reshape(-1, 3, 3)[:, :2]
            # A capsule's ends lie along its z axis; an upright one and a box reach as far as their size.
            box = model.geom_type[solid] == mujoco.mjtGeom.mjGEOM_BOX
            size = model.geom_size[solid]
            along = np.where(box[:, None], size[:, :1] * axes[..., 0], size[:, 1:2] * axes[..., 2])
            across = np.where(box[:, None], size[:, 1:2] * axes[..., 1], 0)
            spin, moved = data.cvel[body, 2], data.cvel[body, 3:5]
            pivot = data.subtree_com[model.body_rootid[body], :2]
            for p in (along + across, along - across, -along + across, -along - across, 0 * along):
                arm = middle + p - pivot
                point = moved + spin[:, None] * np.stack([-arm[:, 1], arm[:, 0]], axis=-1)
                speed.append(np.linalg.norm(point, axis=-1).max(initial=0))
        return max(speed[:5]), max(speed[5:])

    def _others(self) -> NDArray[np.intp]:
        cylinder = [] if self.layout.cylinder is None else [self.layout.cylinder]
        return np.append(self.layout.bodies, cylinder).astype(np.intp)


@dataclass(frozen=True)
class Push:
    """Holds one push of S trajectories."""

    before: Rest
    displacement: Array  # (S, 2)  executed, m
    poses: Poses  # after it
    running: NDArray[np.bool_]  # (S,)  which had not failed before it
    commands: int  # feasible commands drawn
    redrawn: int  # infeasible ones


def walk(rig: Rig, seeds: Sequence[Sequence[int]], pushes: int) -> Iterator[Push]:
    """Yields the random pushes of one trajectory a seed, as the shipped generator draws them; first the settling.

    What has failed stays in the batch and is no longer `running`; nothing is redrawn from another seed.
    """
    streams = [Streams.of(seed) for seed in seeds]
    begin = [starts.sample(rig.domain, stream.start) for stream in streams]
    state = rig.reset(begin)
    S = len(seeds)
    first = Push(rig.rest(), np.zeros((S, 2)), rig.poses(state), np.ones(S, dtype=bool), 0, 0)
    yield first
    fixed = rig.fixed_cylinders()
    for _ in range(pushes):
        displacement, drawn, redrawn, running = np.zeros((S, 2)), 0, 0, ~rig.failed
        for s in np.flatnonzero(running):
            dlo = state.dlo[s, : rig.domain.segments, :2]
            command, again = actions.draw(streams[s].action, state.pusher[s], dlo, None if fixed is None else fixed[s])
            displacement[s] = command + actions.noise(streams[s].noise)
            drawn, redrawn = drawn + 1, redrawn + again
        before = rig.rest()
        state = rig.push(displacement)
        yield replace(
            first,
            before=before,
            displacement=displacement,
            poses=rig.poses(state),
            running=running,
            commands=drawn,
            redrawn=redrawn,
        )
