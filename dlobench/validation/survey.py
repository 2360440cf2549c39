"""Gathers random pushes over all parameters, once: several checks read the same ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench.data.executors import cores, local
from dlobench.domain import ATTACHMENTS, LENGTHS, MATERIALS, MAX_BODIES, Domain, sample
from dlobench.validation.check import Effort
from dlobench.validation.probe import Edit, Probe, Push, Rest, walk
from dlobench.world import overlaps, scene
from dlobench.world.simulate import PUSHES

Array = NDArray[np.float64]

SEED = 20_240
FINER = 10  # the reference takes a tenth of the step
MOVED = 0.001  # m, mean over segments: pushes that move the DLO by more are compared
# Domains a cell of material, attachment and object count; trajectories a domain; pushes a trajectory.
SIZES: dict[Effort, tuple[int, int, int]] = {"quick": (3, 2, 10), "normal": (7, 4, PUSHES), "full": (7, 20, PUSHES)}


@dataclass(frozen=True)
class Found:
    """Holds what was seen in one domain. A state counts up to and with the one in which its trajectory failed."""

    domain: Domain
    depth: Mapping[str, Array]  # kind of pair → (states,)  deepest penetration, m
    crossings: Array  # (states,)  pairs of segments that cross
    outside: NDArray[np.bool_]  # (states,)  something is beyond a wall, or is no number
    speed: Mapping[str, Array]  # of what → (pushes,)  largest speed of any of its points after each push, m/s
    recorded: NDArray[np.bool_]  # (states,)  of trajectories that would be kept
    warned: NDArray[np.bool_]  # (trajectories,)  MuJoCo raised or warned
    failed: NDArray[np.bool_]  # (trajectories,)  would be redrawn
    commands: int  # feasible commands drawn
    redrawn: int  # infeasible ones
    compared: Compared


@dataclass(frozen=True)
class Compared:
    """Holds C pushes that were made again from the recorded positions: at the shipped step, and at a finer one."""

    motion: Array  # (C,)  of the DLO in the push, mean over segments, m
    step: Array  # (C,)  distance between shipped and finer step, mean over segments, m
    restart: Array  # (C,)  distance to the trajectory, which went on with its velocities, m


@dataclass(frozen=True)
class Piece:
    """Says what to simulate: one domain, and the settings to try."""

    index: int
    domain: Domain
    trajectories: int
    pushes: int
    timestep: float = scene.TIMESTEP
    edit: Edit | None = None


def domains(effort: Effort) -> list[Domain]:
    """Samples domains in every cell of material, attachment and object count, of all lengths."""
    cells = product(MATERIALS, ATTACHMENTS, range(MAX_BODIES + 1))
    found = []
    for i, ((material, attachment, bodies), turn) in enumerate(product(cells, range(SIZES[effort][0]))):
        length = LENGTHS[(i + turn) % len(LENGTHS)] if SIZES[effort][0] < len(LENGTHS) else LENGTHS[turn % len(LENGTHS)]
        rng = np.random.default_rng([SEED, i, turn])
        found.append(sample(rng, material=material, attachment=attachment, length=length, rigid_objects=bodies))
    return found


@cache
def survey(effort: Effort) -> tuple[Found, ...]:
    """Returns what random pushes show in the shipped scene, one entry a domain. Made once a process."""
    return gather(domains(effort), *SIZES[effort][1:])


def gather(
    over: Sequence[Domain],
    trajectories: int,
    pushes: int,
    *,
    timestep: float = scene.TIMESTEP,
    edit: Edit | None = None,
    workers: int = 0,
) -> tuple[Found, ...]:
    """Simulates random pushes in each domain; `timestep` and `edit` try other settings of the scene.

    `workers` 0 takes every core; with more than one, `edit` has to be a function of a module.
    """
    pieces = [Piece(i, domain, trajectories, pushes, timestep, edit) for i, domain in enumerate(over)]
    if (workers or cores()) == 1:
        return tuple(visit(piece)[1] for piece in pieces)
    return tuple(found for _, found in sorted(local(visit, pieces, workers or cores()), key=lambda pair: pair[0]))


def visit(piece: Piece) -> tuple[int, Found]:
    """Simulates the random pushes of one domain."""
    domain = piece.domain
    probe = Probe(domain, piece.trajectories, timestep=piece.timestep, edit=piece.edit)
    made, speeds, warned = list[Push](), [], np.zeros(piece.trajectories, dtype=bool)
    for push in walk(probe, [[SEED, piece.index, k, 0] for k in range(piece.trajectories)], piece.pushes):
        made.append(push)
        speeds.append(probe.speeds())
        warned |= probe.warned()
    running = np.stack([push.running for push in made])

    def kept(rows: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([row[here] for row, here in zip(rows, running, strict=True)])

    depths = [overlaps.depths(domain, push.poses) for push in made]
    return piece.index, Found(
        domain=domain,
        depth={name: kept([depth[name] for depth in depths]) for name in depths[0]},
        crossings=kept([overlaps.crossings(domain, push.poses) for push in made]),
        outside=kept([overlaps.outside(domain, push.poses) for push in made]),
        speed={name: np.stack([speed[name] for speed in speeds[1:]])[running[1:]] for name in speeds[0]},
        recorded=kept([~probe.failed for _ in made]),
        warned=warned,
        failed=probe.failed.copy(),
        commands=sum(push.commands for push in made),
        redrawn=sum(push.redrawn for push in made),
        compared=_compare(piece, made, probe.failed),
    )


def _compare(piece: Piece, made: Sequence[Push], failed: NDArray[np.bool_]) -> Compared:
    """Makes one moving push of each trajectory again, from positions alone, at the shipped and at a finer step."""
    dlo = np.stack([push.poses.dlo[..., :2] for push in made])
    moved = _distance(dlo[1:], dlo[:-1]) > MOVED
    rng = np.random.default_rng([SEED, piece.index])
    picks = [(rng.choice(np.flatnonzero(moved[:, k])), k) for k in np.flatnonzero(moved.any(axis=0) & ~failed)]
    if not picks:
        return Compared(*np.zeros((3, 0)))
    before = Rest.stack([made[t + 1].before.take([k]) for t, k in picks])
    displacement = np.stack([made[t + 1].displacement[k] for t, k in picks])
    start, there = (np.stack([dlo[t + later, k] for t, k in picks]) for later in (0, 1))
    ends = list(_again(piece, before, displacement))
    motion = _distance(ends[0], start)
    rows = np.stack([motion, _distance(ends[0], ends[1]), _distance(ends[0], there)])
    return Compared(*rows[:, motion > MOVED])


def _again(piece: Piece, before: Rest, displacement: Array) -> Iterator[Array]:
    """Yields the segment centres after a push at the step and at a finer one, (S, segments, 2) m."""
    for timestep in (piece.timestep, piece.timestep / FINER):
        probe = Probe(piece.domain, len(displacement), timestep=timestep, edit=piece.edit)
        probe.put(before)
        yield probe.poses(probe.push(displacement)).dlo[..., :2]


def _distance(one: Array, two: Array) -> Array:
    """Returns the distance of segment centres, mean over segments, m."""
    distance: Array = np.linalg.norm(one - two, axis=-1).mean(axis=-1)
    return distance
