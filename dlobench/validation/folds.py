"""Checks that bending does not collapse into one joint: random pushes of plastic DLOs, and again on a finer chain."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.data.executors import cores, local
from dlobench.domain import ATTACHMENTS, LENGTHS, Domain, sample
from dlobench.validation.check import Effort, Row, at_most
from dlobench.validation.probe import Probe, walk
from dlobench.validation.survey import MOVED, SEED, Piece
from dlobench.world import scene, starts
from dlobench.world.physics import restart
from dlobench.world.scene import Layout
from dlobench.world.simulate import Streams
from dlobench.world.starts import Start
from dlobench.world.state import controls, place

Array = NDArray[np.float64]

FINENESS = 2  # segments of 2.5 mm
BOUND = 3.0  # % of the length, median
JUDGED = 5  # pushes of a trajectory from the first that moves it on; later two chains are pushed at different places
FOLDED = 0.2  # rad, what counts as a fold
# Lengths of each attachment, trajectories a domain, pushes a trajectory.
SIZES: dict[Effort, tuple[int, int, int]] = {"quick": (1, 2, 10), "normal": (7, 2, 20), "full": (7, 10, 20)}


@dataclass(frozen=True)
class Pair:
    """Holds the trajectories of one domain on both chains; N trajectories of T pushes."""

    apart: Array  # (N, T)  distance between both, mean over segments, over the length
    motion: Array  # (N, T)  of the shipped chain since the start, mean over segments, m
    turn: Array  # (N, T)  largest turn from one 5 mm segment to the next, rad
    turn_fine: Array  # (N, T)  the same over 5 mm of the finer chain, rad


def check_folds(effort: Effort) -> Iterator[Row]:
    """Compares plastic DLOs with finer ones under the same pushes."""
    lengths, trajectories, pushes = SIZES[effort]
    pieces = [
        Piece(i, plastic(i, attachment, length), trajectories, pushes)
        for i, (attachment, length) in enumerate(product(ATTACHMENTS, LENGTHS[-lengths:]))
    ]
    yield from fold_rows(list(local(compare, pieces, cores())))


def fold_rows(pairs: list[Pair]) -> Iterator[Row]:
    """Yields how far both chains are apart, over all and where it is folded, and the sharpest folds of each."""
    moved = [pair.motion > MOVED for pair in pairs]
    judged = np.concatenate([(m & (np.cumsum(m, axis=1) <= JUDGED)).ravel() for m in moved])
    apart, turns, fine = (
        np.concatenate([getattr(p, f).ravel() for p in pairs]) for f in ("apart", "turn", "turn_fine")
    )
    for title, states, bound in (
        ("plastic shapes, 5 mm against 2.5 mm segments", judged, BOUND),
        (f"of these with a fold over {FOLDED:g} rad", judged & (np.maximum(turns, fine) > FOLDED), None),
    ):
        own = 100 * apart[states]
        median, high = np.percentile(own, [50, 95]) if len(own) else (np.nan, np.nan)  # what rests proves nothing
        about = f"median of {len(own)} states, up to {JUDGED} pushes; 95th percentile {high:.1f} % L"
        yield at_most(title, float(median), bound, "% L", about)
    about = f"reference: the finer chain over 5 mm; {len(turns)} states; 99th percentiles"
    about += f" {np.percentile(turns, 99):.2f} and {np.percentile(fine, 99):.2f} rad"
    largest, finest = float(turns.max()), float(fine.max())
    yield Row("largest joint angle, plastic", largest, finest, abs(largest - finest), None, "rad", "rad", about)


def plastic(i: int, attachment: str, length: float) -> Domain:
    """Samples an elastoplastic DLO alone."""
    rng = np.random.default_rng([SEED, i])
    return sample(rng, material="elastoplastic", attachment=attachment, length=length, rigid_objects=0)  # type: ignore[arg-type]


def compare(piece: Piece) -> Pair:
    """Pushes the shipped chain at random, and the finer one by the same displacements."""
    seeds = [[SEED, piece.index, k, 0] for k in range(piece.trajectories)]
    made = list(walk(Probe(piece.domain, len(seeds)), seeds, piece.pushes))
    shipped = np.stack([push.poses.dlo for push in made], axis=1)
    moves = np.stack([push.displacement for push in made], axis=1)
    finer = np.stack([_replay(piece.domain, seed, own) for seed, own in zip(seeds, moves, strict=True)])
    middle = finer[:, :, ::FINENESS, :2] + _half(finer[:, :, ::FINENESS, 2], piece.domain)
    apart = np.linalg.norm(middle - shipped[..., :2], axis=-1).mean(axis=-1) / piece.domain.length
    motion = np.linalg.norm(shipped[..., :2] - shipped[:, :1, :, :2], axis=-1).mean(axis=-1)
    return Pair(apart[:, 1:], motion[:, 1:], _turn(shipped, 1)[:, 1:], _turn(finer, FINENESS)[:, 1:])


def _half(yaw: Array, domain: Domain) -> Array:
    """Returns the way from a fine segment's centre to its end, which is the centre of a 5 mm segment."""
    reach = domain.length / domain.segments / FINENESS / 2
    return reach * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def _turn(dlo: Array, over: int) -> Array:
    """Returns the largest turn between segments that are `over` apart: (N, T) rad."""
    turns = dlo[..., over:, 2] - dlo[..., :-over, 2]
    largest: Array = np.abs((turns + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)
    return largest


def _replay(domain: Domain, seed: list[int], moves: Array) -> Array:
    """Returns the finer chain's (T + 1, segments, 3) poses in the trajectory of a seed, under its displacements."""
    model = scene.build(domain, scene.TIMESTEP, fineness=FINENESS)
    data = mujoco.MjData(model)
    layout = scene.layout(model, domain)
    _place(data, layout, domain, starts.sample(domain, Streams.of(seed).start))
    poses = []
    for move in moves:  # the first is the settling
        restart(model, data)
        for control in controls(data.qpos[None, layout.pusher_qpos], move[None], model.opt.timestep)[0]:
            data.ctrl[:] = control
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        x, turned = data.xpos[layout.segments], data.xmat[layout.segments]
        poses.append(np.column_stack([x[:, :2], np.arctan2(turned[:, 3], turned[:, 0])]))
    return np.stack(poses)


def _place(data: mujoco.MjData, layout: Layout, domain: Domain, start: Start) -> None:
    """Places the finer chain on the very polygon in which the shipped one starts."""
    shipped = scene.build(domain)
    placed = place(shipped, scene.layout(shipped, domain), domain, start)
    x, y, yaw = start.root
    data.mocap_pos[:], data.mocap_quat[:] = placed.mocap_pos, placed.mocap_quat
    data.qpos[layout.root_qpos] = placed.qpos[scene.layout(shipped, domain).root_qpos]
    if domain.attachment == "none":  # the root is the middle of the first segment
        half = domain.length / domain.segments / FINENESS / 2
        data.qpos[layout.root_qpos] = [x + half * np.cos(yaw), y + half * np.sin(yaw), yaw]
    bends = np.zeros(FINENESS * domain.segments)
    bends[::FINENESS] = start.bends
    bends = bends[-len(layout.joint_qpos) :]
    data.qpos[layout.joint_qpos] = data.plastic[layout.joint_plastic] = bends
    data.qpos[layout.pusher_qpos] = start.pusher
