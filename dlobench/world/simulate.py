"""Simulates many trajectories of one domain at once, on `mujoco.batch`.

A trajectory depends on its domain and seed alone: not on its neighbours in the batch, nor on the number of threads.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from dlobench import ranges
from dlobench.domain import Domain
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Trajectories, geometry
from dlobench.world import actions, overlaps, scene, starts
from dlobench.world.state import LASTING, Array, State, controls, fixed_point, observe, place, stack

PUSHES = 20  # n_P, pushes a trajectory
PENETRATION = 0.001  # m; a push that ends with things deeper in each other ends its trajectory
RETRIES = 20  # derived seeds that a trajectory may use up before its domain is called broken


@dataclass
class Streams:
    """Holds the random streams of one trajectory, so that what one draws never shifts another."""

    start: np.random.Generator
    action: np.random.Generator
    noise: np.random.Generator

    @staticmethod
    def of(seed: Sequence[int]) -> Streams:
        """Derives the streams from a seed of whole numbers."""
        return Streams(*(np.random.default_rng([*seed, stream]) for stream in range(3)))


class Simulator:
    """Steps S simulations of one domain, push by push; raises `UsageError` for what does not fit their number."""

    def __init__(self, domain: Domain, simulations: int, threads: int = 1, timestep: float = scene.TIMESTEP) -> None:
        if not isinstance(domain, Domain):
            raise UsageError(f"domain = {ranges.shown(domain)} is not a Domain")
        simulations, threads = ranges.whole("simulations", simulations, 1), ranges.whole("threads", threads, 1, 1024)
        mujoco.set_mju_user_warning(scene.quiet)
        self.domain = domain
        self.model = scene.build(domain, timestep)
        self.layout = scene.layout(self.model, domain)
        self._batch = Batch(self.model, simulations, threads, persistent=True)  # sleeping needs it
        self._xpos, self._xmat = self._batch.bind("xpos"), self._batch.bind("xmat")
        self.failed = np.zeros(simulations, dtype=bool)  # since the reset: raised, warned, pressed solids together

    def reset(self, begin: Sequence[starts.Start]) -> State:
        """Places every simulation at its start, lets it settle for the time of a push, and returns the state."""
        if len(begin) != len(self.failed):
            raise UsageError(f"{len(begin)} starts do not fit a batch of {len(self.failed)} simulations")
        placed = [place(self.model, self.layout, self.domain, start) for start in begin]
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.failed[:] = False
        for name in LASTING:
            self._batch.bind(name)[:] = np.stack([getattr(p, name) for p in placed])
        return self.push(np.zeros((len(placed), 2)))

    def push(self, displacement: Array) -> State:
        """Moves every pusher by its (S, 2) m displacement and returns the state after the push.

        Every push begins at rest, so that positions (and what plastic bending left) are the whole state.
        """
        try:
            displacement = np.asarray(displacement, dtype=float)
        except (TypeError, ValueError, OverflowError) as error:
            raise UsageError(f"displacement = {ranges.shown(displacement)} is not made of numbers") from error
        shape, needed = displacement.shape, (len(self.failed), 2)
        if shape != needed or not np.isfinite(displacement).all():
            problem = f"has shape {shape}" if shape != needed else "is not finite everywhere"
            raise UsageError(f"displacement {problem}, the batch needs two finite numbers a simulation: {needed}")
        qpos = self._batch.bind("qpos")
        plan = controls(qpos[:, self.layout.pusher_qpos], displacement, self.model.opt.timestep)
        self._restart()
        with contextlib.suppress(SimulationError):  # the others have finished; status says which raised
            self._batch.rollout(plan.shape[1], plan)
        self.failed |= (self._batch.status != 0) | self._batch.warning.reshape(len(self.failed), -1).any(axis=1)
        self._batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS)
        state = observe(self.layout, self._xpos, self._xmat)
        self.failed |= impossible(self.domain, state)
        return state

    def _restart(self) -> None:
        """Wakes and stops everything, so that nothing but positions and plastic bends is carried over."""
        kept = {name: self._batch.bind(name).copy() for name in LASTING}
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        for name, value in kept.items():
            self._batch.bind(name)[:] = value

    def save(self) -> dict[str, Array]:
        """Returns the whole state of the first simulation, which `restore` takes, in a batch of any number too."""
        return {name: self._batch.bind(name)[0].copy() for name in LASTING}

    def restore(self, saved: dict[str, Array]) -> State:
        """Places every simulation in a saved state, at rest, and returns it."""
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.failed[:] = False
        for name, value in saved.items():
            self._batch.bind(name)[:] = value
        self._batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS)
        return observe(self.layout, self._xpos, self._xmat)

    def fixed_cylinders(self) -> Array | None:
        """Returns the (S, 2) places of the fixed cylinders, m, or None."""
        return fixed_point(self.layout, self.domain, self._xpos)


def impossible(domain: Domain, state: State) -> NDArray[np.bool_]:
    """Tells which simulations (S,) have pressed things deeper into each other or a wall than solids may be."""
    poses = overlaps.Poses(
        dlo=state.dlo[:, : domain.segments],
        pusher=state.pusher,
        bodies=state.bodies[:, : len(domain.bodies)],
        cylinder=None if domain.attachment == "none" else state.cylinder,
    )
    deepest = np.max(list(overlaps.depths(domain, poses).values()), axis=0)
    wrong: NDArray[np.bool_] = ~(deepest <= PENETRATION) | (overlaps.crossings(domain, poses) > 0)  # also no number
    return wrong


@dataclass(frozen=True)
class Account:
    """Counts what was thrown away on the way to some trajectories."""

    commands_redrawn: int  # infeasible commands
    commands: int  # feasible commands
    trajectories_redrawn: int  # simulations that raised, warned, pressed solids together or got stuck


def simulate(
    domain: Domain, seeds: Sequence[Sequence[int]], threads: int = 1, pushes: int = PUSHES
) -> tuple[Trajectories, Account]:
    """Simulates one trajectory a seed, with biased pushes executed with noise.

    A trajectory whose simulation raises, warns or presses solids into each other, or whose pusher has nowhere to go, is
    redrawn from its seed and the attempt's number, and counted. Raises `RunError` when one fails too often, and
    `UsageError` for a number that makes no sense.
    """
    if not isinstance(seeds, Sequence | np.ndarray) or isinstance(seeds, str):
        raise UsageError(f"seeds = {ranges.shown(seeds)} is not a list of seeds")
    seeds, pushes = [ranges.seed(seed) for seed in seeds], ranges.whole("pushes", pushes, 1)
    ranges.whole("number of seeds", len(seeds), 1)
    done: dict[int, dict[str, Array]] = {}
    missing = list(range(len(seeds)))
    commands = redrawn = failures = 0
    for attempt in range(RETRIES):
        rows, drawn, again, failed = _attempt(domain, [[*seeds[i], attempt] for i in missing], threads, pushes)
        commands, redrawn = commands + drawn, redrawn + again
        failures += int(failed.sum())
        done |= {i: {f: rows[f][k] for f in rows} for k, i in enumerate(missing) if not failed[k]}
        missing = [i for k, i in enumerate(missing) if failed[k]]
        if not missing:
            break
    else:
        raise RunError(f"{RETRIES} simulations in a row failed from seed {list(seeds[missing[0]])} in {domain}")
    whole = {name: np.stack([done[i][name] for i in range(len(seeds))]) for name in done[0]}
    return record(domain, whole), Account(redrawn, commands, failures)


def record(domain: Domain, arrays: Mapping[str, Array]) -> Trajectories:
    """Returns the trajectories of a domain that float64 arrays, by the names of their fields, hold."""
    dlo_mask, body_mask, boxes = geometry(domain)
    rows = {name: value.astype(np.float32) for name, value in arrays.items()}
    return Trajectories(dlo_mask=dlo_mask, body_mask=body_mask, boxes=boxes, **rows)


def _attempt(
    domain: Domain, seeds: Sequence[Sequence[int]], threads: int, pushes: int
) -> tuple[dict[str, Array], int, int, NDArray[np.bool_]]:
    """Returns the recorded arrays (S first) by name, how many commands were drawn and redrawn, and who failed."""
    streams = [Streams.of(seed) for seed in seeds]
    simulator = Simulator(domain, len(seeds), threads)
    state = simulator.reset([starts.sample(domain, s.start) for s in streams])
    fixed = simulator.fixed_cylinders()
    states, commanded, executed = [state], [], []
    drawn = redrawn = 0
    for _ in range(pushes):
        command, noise = np.zeros((2, len(seeds), 2))
        for s in np.flatnonzero(~simulator.failed):
            dlo = state.dlo[s, : domain.segments, :2]
            place = None if fixed is None else fixed[s]
            try:
                command[s], again = actions.draw(streams[s].action, state.pusher[s], dlo, place)
            except actions.Stuck:  # in the corner of a wall and a fixed cylinder, say
                simulator.failed[s] = True
                continue
            noise[s] = actions.noise(streams[s].noise)
            drawn, redrawn = drawn + 1, redrawn + again
        state = simulator.push(command + noise)
        states.append(state)
        commanded.append(command)
        executed.append(command + noise)
    acts = {"commanded": np.stack(commanded, axis=1), "executed": np.stack(executed, axis=1)}
    return stack(states) | acts, drawn, redrawn, simulator.failed
