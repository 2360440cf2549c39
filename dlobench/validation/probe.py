"""Looks into the shipped simulator: reads and puts whole states, tries other settings, measures what moves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields

import mujoco
import numpy as np
from mujoco.batch import SimulationError
from numpy.typing import NDArray

from dlobench.domain import Domain
from dlobench.world import actions, scene, starts
from dlobench.world.overlaps import Poses, outline
from dlobench.world.simulate import Simulator, Streams
from dlobench.world.state import Array, State, controls, observe

Edit = Callable[[mujoco.MjModel], None]  # changes settings of a compiled scene, not its sizes

MOMENT = 1e-6  # s, over which a point's speed is measured


@dataclass(frozen=True)
class Rest:
    """Holds S physics states at rest: positions alone. Velocities and the servos' integrals are 0."""

    qpos: Array  # (S, nq)
    plastic: Array  # (S, nplastic)  relaxed angles of the hinges, rad
    mocap_pos: Array  # (S, nmocap, 3)
    mocap_quat: Array  # (S, nmocap, 4)

    def take(self, index: Sequence[int]) -> Rest:
        """Returns the states at `index`."""
        return Rest(*(getattr(self, f.name)[list(index)] for f in fields(Rest)))

    @staticmethod
    def stack(parts: Sequence[Rest]) -> Rest:
        """Joins states of one domain."""
        return Rest(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Rest)))


@dataclass(frozen=True)
class Trace:
    """Holds the steps of one push of S simulations."""

    qpos: Array  # (S, steps, nq)
    qvel: Array  # (S, steps, nv)
    plastic: Array  # (S, steps, nplastic)  rad

    @staticmethod
    def joined(*parts: Trace) -> Trace:
        """Joins pushes that follow each other."""
        return Trace(*(np.concatenate([getattr(part, f.name) for part in parts], axis=1) for f in fields(Trace)))


class Probe(Simulator):
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

    def rest(self) -> Rest:
        """Returns the positions of every simulation."""
        return Rest(*(self._batch.bind(f.name).copy() for f in fields(Rest)))

    def put(self, rest: Rest) -> None:
        """Places every simulation in a state at rest; nothing settles."""
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.failed[:] = False
        for f in fields(Rest):
            self._batch.bind(f.name)[:] = getattr(rest, f.name)
        self._batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS)

    def warned(self) -> NDArray[np.bool_]:
        """Tells which simulations, (S,), raised or warned in the last push."""
        warning = self._batch.warning.reshape(len(self.failed), -1).any(axis=1)
        out: NDArray[np.bool_] = (self._batch.status != 0) | warning
        return out

    def trace(self, displacement: Array) -> Trace:
        """Pushes by (S, 2) m, as `push` does, and returns every step on the way."""
        plan = controls(self._batch.qpos[:, self.layout.pusher_qpos], displacement, self.model.opt.timestep)
        self._restart()
        names = tuple(f.name for f in fields(Trace))
        out = {name: np.zeros((*plan.shape[:2], self._batch.bind(name).shape[1])) for name in names}
        with contextlib.suppress(SimulationError):
            self._batch.rollout(plan.shape[1], plan, record=names, out=out)
        return Trace(**out)

    def poses(self, state: State) -> Poses:
        """Returns a state without its padding."""
        segments, bodies = len(self.layout.segments), len(self.layout.bodies)
        cylinder = None if self.layout.cylinder is None else state.cylinder
        return Poses(state.dlo[:, :segments], state.pusher, state.bodies[:, :bodies], cylinder)

    def speeds(self) -> dict[str, Array]:
        """Returns the largest speed of any point of the DLO, of bodies and cylinder, and of the pusher: (S,) m/s."""
        rest, qvel = self.rest(), self._batch.bind("qvel")
        now = self._outline(rest, rest.qpos)
        later = self._outline(rest, rest.qpos + MOMENT * qvel)  # every joint has one degree of freedom
        far = [np.linalg.norm(two - one, axis=-1).max(axis=1, initial=0) for one, two in zip(now, later, strict=True)]
        pusher = np.linalg.norm(qvel[:, self.layout.pusher_qpos], axis=-1)
        return {"DLO": far[0] / MOMENT, "bodies and cylinder": far[1] / MOMENT, "pusher": pusher}

    def _outline(self, rest: Rest, qpos: Array) -> tuple[Array, Array]:
        """Returns the outermost points of the DLO, and of the rest but the pusher, at other positions."""
        model, data = self.model, mujoco.MjData(self.model)
        frames = list[tuple[Array, Array]]()
        for s in range(len(qpos)):
            data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos[s], rest.mocap_pos[s], rest.mocap_quat[s]
            mujoco.mj_kinematics(model, data)
            frames.append((data.xpos.copy(), data.xmat.copy()))
        xpos, xmat = (np.stack(part) for part in zip(*frames, strict=True))
        return outline(self.domain, self.poses(observe(self.layout, xpos, xmat)))


@dataclass(frozen=True)
class Push:
    """Holds one push of S trajectories."""

    before: Rest
    displacement: Array  # (S, 2)  executed, m
    poses: Poses  # after it
    running: NDArray[np.bool_]  # (S,)  which had not failed before it
    commands: int  # feasible commands drawn
    redrawn: int  # infeasible ones


def walk(probe: Probe, seeds: Sequence[Sequence[int]], pushes: int) -> Iterator[Push]:
    """Yields the random pushes of one trajectory a seed, as the shipped generator draws them; first the settling.

    What has failed stays in the batch and is no longer `running`; nothing is redrawn from another seed.
    """
    streams = [Streams.of(seed) for seed in seeds]
    state = probe.reset([starts.sample(probe.domain, stream.start) for stream in streams])
    still = np.zeros((len(seeds), 2))
    yield Push(probe.rest(), still, probe.poses(state), np.ones(len(seeds), dtype=bool), commands=0, redrawn=0)
    fixed = probe.fixed_cylinders()
    for _ in range(pushes):
        before, displacement, redrawn, running = probe.rest(), still.copy(), 0, ~probe.failed
        for s in np.flatnonzero(running):
            dlo = state.dlo[s, : probe.domain.segments, :2]
            place = None if fixed is None else fixed[s]
            try:
                command, again = actions.draw(streams[s].action, state.pusher[s], dlo, place)
            except actions.Stuck:
                probe.failed[s], running[s] = True, False
                continue
            displacement[s] = command + actions.noise(streams[s].noise)
            redrawn += again
        state = probe.push(displacement)
        yield Push(before, displacement, probe.poses(state), running, int(running.sum()), redrawn)
