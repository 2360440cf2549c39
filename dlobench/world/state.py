"""Moves between the world's words and MuJoCo's arrays: start → qpos, poses → state, displacement → controls.

Environment and batch share these functions, which is why they give the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import MAX_BODIES, MAX_SEGMENTS, Domain
from dlobench.world.scene import Layout
from dlobench.world.starts import Start, check

Array = NDArray[np.float64]

PUSH_TIME = 0.3  # s, settling included
MOVE_TIME = 0.24  # s, of which the pusher moves


LASTING = ("qpos", "plastic", "mocap_pos", "mocap_quat")  # what a push leaves to the next; all else is forgotten


@dataclass(frozen=True)
class State:
    """Holds the planar poses of S simulations of one domain at one moment; padding is 0."""

    dlo: Array  # (S, 32, 3)  segment centres x m, y m, yaw rad
    pusher: Array  # (S, 2)  x m, y m
    bodies: Array  # (S, 3, 3)  x m, y m, yaw rad
    cylinder: Array  # (S, 3)  where an attached DLO ends: x m, y m, yaw rad; 0 without


@dataclass(frozen=True)
class Placement:
    """Holds a start in MuJoCo's arrays."""

    qpos: Array  # (nq,)
    plastic: Array  # (nplastic,)  the hinges' relaxed angles
    mocap_pos: Array  # (nmocap, 3)
    mocap_quat: Array  # (nmocap, 4)


def place(model: mujoco.MjModel, layout: Layout, domain: Domain, start: Start) -> Placement:
    """Writes a start as MuJoCo's positions and plastic state; raises `UsageError` for one of another domain's sizes."""
    check(domain, start)
    qpos, plastic = model.qpos0.copy(), np.zeros(len(layout.joint_plastic))
    # Without a cylinder the first segment has no clamped hinge; the root is its end, its body frame its centre.
    bends = start.bends if domain.attachment != "none" else start.bends[1:]
    qpos[layout.joint_qpos] = bends
    plastic[layout.joint_plastic] = bends
    mocap_pos, mocap_quat = np.zeros((model.nmocap, 3)), np.zeros((model.nmocap, 4))
    x, y, yaw = start.root
    if domain.attachment == "fixed":
        mocap_pos[0] = [x, y, 0]
        mocap_quat[0] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    elif domain.attachment == "movable":
        qpos[layout.root_qpos] = start.root
    else:
        half = float(model.geom("segment0").size[1])
        qpos[layout.root_qpos] = [x + half * np.cos(yaw), y + half * np.sin(yaw), yaw]
    # A body turns about its centre of mass; its slides are what is left to bring its frame to its place.
    c, s = np.cos(start.bodies[:, 2:]), np.sin(start.bodies[:, 2:])
    px, py = layout.body_pivot[:, :1], layout.body_pivot[:, 1:]
    turned = np.concatenate([c * px - s * py, s * px + c * py], axis=1)
    qpos[layout.body_qpos] = start.bodies
    qpos[layout.body_qpos[:, :2]] += turned - layout.body_pivot
    qpos[layout.pusher_qpos] = start.pusher
    return Placement(qpos, plastic, mocap_pos, mocap_quat)


def observe(layout: Layout, xpos: Array, xmat: Array) -> State:
    """Reads planar poses from body frames: xpos (S, nbody, 3), xmat (S, nbody, 9)."""
    S = len(xpos)
    yaw = np.arctan2(xmat[..., 3], xmat[..., 0])
    poses = np.concatenate([xpos[..., :2], yaw[..., None]], axis=-1)
    dlo, bodies = np.zeros((S, MAX_SEGMENTS, 3)), np.zeros((S, MAX_BODIES, 3))
    dlo[:, : len(layout.segments)] = poses[:, layout.segments]
    bodies[:, : len(layout.bodies)] = poses[:, layout.bodies]
    cylinder = np.zeros((S, 3)) if layout.cylinder is None else poses[:, layout.cylinder]
    return State(dlo=dlo, pusher=poses[:, layout.pusher, :2], bodies=bodies, cylinder=cylinder)


def stack(states: Sequence[State]) -> dict[str, Array]:
    """Joins the states of S simulations at T + 1 moments, field by field: (S, T + 1, …)."""
    return {f.name: np.stack([getattr(state, f.name) for state in states], axis=1) for f in fields(State)}


def fixed_point(layout: Layout, domain: Domain, xpos: Array) -> Array | None:
    """Returns the (S, 2) place of a fixed cylinder, or None when there is none."""
    return xpos[:, layout.cylinder, :2].copy() if domain.attachment == "fixed" else None


def controls(pusher: Array, displacement: Array, timestep: float) -> Array:
    """Returns the servos' set-points of one push: (S, steps, 4) x m, vx m/s, y m, vy m/s at every step.

    The pusher moves for 0.24 s, fastest after a third of it, and comes to rest so gently that what it pushes stays with
    it at the least friction; then it holds.
    """
    steps = round(PUSH_TIME / timestep)
    t = np.clip((np.arange(steps) + 1) * timestep / MOVE_TIME, 0, 1)[:, None]
    position = pusher[:, None] + t**2 * (6 - 8 * t + 3 * t**2) * displacement[:, None]
    velocity = 12 * t * (1 - t) ** 2 / MOVE_TIME * displacement[:, None]
    return np.stack([position, velocity], axis=-1).reshape(len(pusher), steps, 4)
