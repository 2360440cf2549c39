"""Checks that what should not matter does not: threads, company in a batch, environment or batch, sparse or dense."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product

import mujoco
import numpy as np

from dlobench.data.executors import cores, local
from dlobench.domain import ATTACHMENTS, LENGTHS, MATERIALS, MAX_BODIES, Domain, sample
from dlobench.validation.check import Effort, Row, at_most
from dlobench.validation.probe import Probe, walk
from dlobench.validation.survey import SEED, Piece
from dlobench.world import actions, env
from dlobench.world.simulate import Simulator, Streams
from dlobench.world.state import Array, State

JACOBIAN_BOUND = 1e-5  # m
TRAJECTORIES = 3
PUSHES: dict[Effort, int] = {"quick": 2, "normal": 10, "full": 20}


def check_jacobians(effort: Effort) -> Iterator[Row]:
    """Compares sparse with dense Jacobians: every push from the same state, in every kind of domain."""
    pieces = [
        Piece(i, domain, TRAJECTORIES, PUSHES[effort]) for i, domain in enumerate(domains(objects=(0, MAX_BODIES)))
    ]
    apart = dict(local(denseness, pieces, cores()))
    every = np.concatenate([apart[i] for i in range(len(pieces))])
    worst = pieces[max(apart, key=lambda i: apart[i].max())].domain
    about = f"largest of {len(every)} single pushes, {len(pieces)} domains; median {np.median(every):.1g} m"
    about += f"; worst in {worst.material}–{worst.attachment}–{len(worst.bodies)}"
    yield at_most("sparse against dense Jacobian", float(every.max()), JACOBIAN_BOUND, "m", about)


def check_same_bits(effort: Effort) -> Iterator[Row]:
    """Compares runs that must give the same bits, over every material and attachment."""
    ways: dict[str, Callable[[Domain, int], Sequence[tuple[State, State]]]] = {
        "one thread or two": by_threads,
        "whatever the company": by_company,
        "environment or batch": by_environment,
    }
    for name, way in ways.items():
        pairs = [pair for domain in domains(objects=(1,)) for pair in way(domain, PUSHES[effort])]
        about = f"{len(pairs)} states of {len(MATERIALS) * len(ATTACHMENTS)} domains, float64"
        yield at_most(f"other bits, {name}", sum(not same(*pair) for pair in pairs), 0, "states", about)


def domains(*, objects: Sequence[int]) -> list[Domain]:
    """Samples a domain in every cell, of all lengths in turn."""
    cells = enumerate(product(MATERIALS, ATTACHMENTS, objects))
    return [
        sample(
            np.random.default_rng([SEED, i]),
            material=material,
            attachment=attachment,
            length=LENGTHS[i % len(LENGTHS)],
            rigid_objects=bodies,
        )
        for i, (material, attachment, bodies) in cells
    ]


def dense(model: mujoco.MjModel) -> None:
    """Makes a scene use the other kind of Jacobian than the shipped one."""
    kinds = mujoco.mjtJacobian
    shipped_dense = model.opt.jacobian == kinds.mjJAC_DENSE
    model.opt.jacobian = kinds.mjJAC_SPARSE if shipped_dense else kinds.mjJAC_DENSE


def denseness(piece: Piece) -> tuple[int, Array]:
    """Returns the piece's index and by how much sparse and dense differ after each push, the farthest thing, m."""
    shipped = Probe(piece.domain, piece.trajectories)
    ways = [Probe(piece.domain, piece.trajectories, edit=edit) for edit in (None, dense)]
    apart = []
    for push in walk(shipped, [[SEED, piece.index, k, 0] for k in range(piece.trajectories)], piece.pushes):
        for way in ways:
            way.put(push.before)
        one, two = (places(way.push(push.displacement)) for way in ways)
        apart.append(np.linalg.norm(one - two, axis=-1).max(axis=1))
    return piece.index, np.concatenate(apart)


def places(state: State) -> Array:
    """Returns the centres of all that moves, (S, things, 2) m."""
    return np.concatenate([state.dlo[..., :2], state.bodies[..., :2], state.pusher[:, None]], axis=1)


def same(one: State, two: State) -> bool:
    """Compares bits."""
    return all(getattr(one, f).tobytes() == getattr(two, f).tobytes() for f in ("dlo", "pusher", "bodies", "cylinder"))


def by_threads(domain: Domain, pushes: int) -> list[tuple[State, State]]:
    """Returns the states of the same trajectories on one thread and on two."""
    seeds = range(TRAJECTORIES)
    return list(zip(run(domain, seeds, pushes), run(domain, seeds, pushes, threads=2), strict=True))


def by_company(domain: Domain, pushes: int) -> list[tuple[State, State]]:
    """Returns the states of trajectories among each other, and one of them among others, elsewhere in the batch."""
    at_home, abroad = run(domain, range(TRAJECTORIES), pushes), run(domain, [7, 8, 9, 1], pushes)
    return [(row(home, 1), row(away, 3)) for home, away in zip(at_home, abroad, strict=True)]


def by_environment(domain: Domain, pushes: int) -> list[tuple[State, State]]:
    """Returns the states of a trajectory in a batch, and those of the environment under the same commands."""
    world, stream = env.make(domain, seed=SEED), Streams.of([SEED, 0, 0]).action
    world.reset()
    seen = [world.physics.state()]
    for _ in range(pushes):
        now = seen[-1]
        dlo = now.dlo[0, : domain.segments, :2]
        command, _ = actions.draw(stream, now.pusher[0], dlo, world.physics.fixed_cylinder())
        world.step(command)
        seen.append(world.physics.state())
    batch = run(domain, range(TRAJECTORIES), pushes)
    return [(row(together, 0), alone) for together, alone in zip(batch, seen, strict=True)]


def run(domain: Domain, seeds: Sequence[int], pushes: int, threads: int = 1) -> list[State]:
    """Returns the states of one random trajectory a seed."""
    simulator = Recorder(domain, len(seeds), threads)
    for _ in walk(simulator, [[SEED, seed, 0] for seed in seeds], pushes):
        pass
    return simulator.states


def row(state: State, s: int) -> State:
    """Returns one simulation of a state."""
    return State(state.dlo[s : s + 1], state.pusher[s : s + 1], state.bodies[s : s + 1], state.cylinder[s : s + 1])


class Recorder(Probe):
    """Remembers the states that the shipped simulator returns."""

    def __init__(self, domain: Domain, simulations: int, threads: int) -> None:
        super().__init__(domain, simulations, threads)
        self.states = list[State]()

    def push(self, displacement: Array) -> State:
        """Pushes as the shipped simulator does."""
        state = Simulator.push(self, displacement)
        self.states.append(state)
        return state
