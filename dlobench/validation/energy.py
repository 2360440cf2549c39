"""Checks that nothing feeds the world once the pusher rests: kinetic and elastic energy only ever fall.

Each push is followed by a pause, since a push leaves little time between the pusher's rest and its own end.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator

import mujoco
import numpy as np

from dlobench.data.executors import cores, local
from dlobench.validation.check import Effort, Row, at_most
from dlobench.validation.probe import Probe, Trace, walk
from dlobench.validation.survey import SEED, Piece, domains
from dlobench.world.state import MOVE_TIME, Array

STILL = 0.001  # m/s, the pusher rests below it
TOLERANCE = 0.01  # of the energy when the pusher comes to rest
# Trajectories a domain, one domain a cell; pushes a trajectory.
SIZES: dict[Effort, tuple[int, int]] = {"quick": (1, 3), "normal": (4, 10), "full": (20, 20)}


def check_energy(effort: Effort) -> Iterator[Row]:
    """Looks for pushes in which kinetic plus elastic energy grows after the pusher has come to rest."""
    trajectories, pushes = SIZES[effort]
    pieces = [Piece(i, domain, trajectories, pushes) for i, domain in enumerate(domains("quick"))]
    yield from energy_rows(np.concatenate(list(local(growths, pieces, cores()))))


def energy_rows(grown: Array) -> Iterator[Row]:
    """Yields how many pushes gain energy, from (pushes, 2) growths.

    Where fewer than half of the pushes have a pusher that comes to rest there is no figure, and so no pass.
    """
    for title, growth, bound in (("pusher", grown[:, 0], 0), ("set-point", grown[:, 1], None)):
        seen = growth[~np.isnan(growth)]
        count = float((seen > TOLERANCE).sum()) if 2 * len(seen) > len(growth) else float("nan")
        about = f"by more than {100 * TOLERANCE:g} %; it rests in {len(seen)} of {len(growth)} pushes"
        about += f"; most {100 * seen.max(initial=0):.2g} %"
        yield at_most(f"pushes that gain energy once the {title} rests", count, bound, note=about)


def growths(piece: Piece) -> Array:
    """Returns by how much the energy grows in each push after the pusher, and its set-point, came to rest: (P, 2).

    A pause as long as the push follows it. Relative to what there was at that moment; not a number where the pusher
    never came to rest.
    """
    probe, again = (Probe(piece.domain, piece.trajectories, timestep=piece.timestep, edit=piece.edit) for _ in "ab")
    made = walk(probe, [[SEED, piece.index, k, 0] for k in range(piece.trajectories)], piece.pushes)
    next(made)  # nothing is pushed while it settles
    found = []
    for push in made:
        again.put(push.before)
        moving, pause = again.trace(push.displacement), again.trace(np.zeros_like(push.displacement))
        trace = Trace.joined(moving, pause)
        found += [growth(again, trace, int(s)) for s in np.flatnonzero(push.running & ~again.warned())]
    return np.array(found).reshape(-1, 2)


def growth(probe: Probe, trace: Trace, s: int) -> tuple[float, float]:
    """Returns the largest rise of the energy of simulation s once the pusher, and its set-point, rest; relative."""
    held = round(MOVE_TIME / probe.model.opt.timestep)
    energy = energies(probe, trace, s, held)
    start = resting(probe, trace.qvel[s, held:])
    pusher = float("nan") if start is None else rise(energy[start:]) / (energy[start] + slow(probe))
    return float(pusher), float(rise(energy) / (energy[0] + slow(probe)))


def rise(energy: Array) -> float:
    """Returns how far a series climbs above what it has fallen to."""
    return float((energy - np.minimum.accumulate(energy)).max())


def resting(probe: Probe, qvel: Array) -> int | None:
    """Returns the first of some steps from which the pusher rests to the end, or None."""
    fast = np.linalg.norm(qvel[:, probe.layout.pusher_qpos], axis=1) >= STILL
    first = int(np.flatnonzero(fast).max(initial=-1)) + 1
    return first if first < len(qvel) - 1 else None


def energies(probe: Probe, trace: Trace, s: int, start: int) -> Array:
    """Returns kinetic plus elastic energy of all but the pusher in simulation s, from step `start` on, J."""
    model = _weightless(probe.model)
    data = mujoco.MjData(model)
    out = []
    for qpos, qvel, plastic in zip(trace.qpos[s, start:], trace.qvel[s, start:], trace.plastic[s, start:], strict=True):
        data.qpos[:], data.qvel[:], data.plastic[:] = qpos, qvel, plastic
        data.qvel[probe.layout.pusher_qpos] = 0
        out.append(_mechanical(model, data))
    return np.array(out)


def slow(probe: Probe) -> float:
    """Returns the energy that everything but the pusher has at 1 mm/s, J: below it the world counts as still."""
    mass = probe.model.body_mass.sum() - probe.model.body_mass[probe.layout.pusher]
    return float(mass) * STILL**2 / 2


def _weightless(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns the model without gravity: weight is carried vertically, and everything moves in the plane."""
    out = copy.copy(model)
    out.opt.gravity[:] = 0
    return out


def _mechanical(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_makeM(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    return float(data.energy.sum())
