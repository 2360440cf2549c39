"""Holds what a model sees: trajectories, queries and predictions. The one home of shapes and units.

SI, world frame, origin at the centre of the workspace, float32. B queries, K trajectories of T pushes,
n actions ahead, S samples. Padded segments and bodies are 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import (
    ATTACHMENTS,
    DLO_DENSITY,
    LENGTHS,
    MATERIALS,
    MAX_BODIES,
    MAX_BOXES,
    MAX_SEGMENTS,
    STIFFNESS,
    SURFACE_FRICTION,
    YIELD_CURVATURE,
    Domain,
)

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
Geometry = tuple[Mask, Mask, Floats]  # what is visible of a domain: dlo_mask (32,), body_mask (3,), boxes (3, 5, 5)


@dataclass(frozen=True)
class Query:
    """Holds B moments of one domain, and the next n actions of each."""

    dlo: Floats  # (B, 32, 3)  segment centres x m, y m, yaw rad
    dlo_mask: Mask  # (32,)  which segments exist
    pusher: Floats  # (B, 2)  x m, y m
    bodies: Floats  # (B, 3, 3)  rigid bodies x m, y m, yaw rad
    body_mask: Mask  # (3,)  which bodies exist
    boxes: Floats  # (3, 5, 5)  each body's boxes in its frame: x m, y m, yaw rad, half sizes m
    actions: Floats  # (B, n, 2)  the next displacements of the pusher, m
    parameters: Floats | None = None  # (11,)  of the domain, see `parameters`; None but for a privileged model

    def __len__(self) -> int:
        return len(self.dlo)

    @property
    def horizon(self) -> int:
        """Returns n, the number of actions ahead."""
        return int(self.actions.shape[1])

    def take(self, index: NDArray[np.intp]) -> Query:
        """Returns the queries at `index`, in its order."""
        rows = {name: getattr(self, name)[index] for name in ("dlo", "pusher", "bodies", "actions")}
        return replace(self, **rows)


@dataclass(frozen=True)
class Prediction:
    """Holds S samples of the state after the last action of each of B queries. The truth is one with S = 1."""

    dlo: Floats  # (S, B, 32, 2)  segment centres x m, y m
    bodies: Floats | None = None  # (S, B, 3, 3)  x m, y m, yaw rad; None where a model does not predict them


@dataclass(frozen=True)
class Trajectories:
    """Holds K trajectories of T pushes in one domain. What is unobserved (the `Domain`) is not here.

    Examples:
        >>> from dlobench.domain import typical
        >>> K, T, shapes = 5, 20, geometry(typical(material="soft", attachment="none", length=0.10, rigid_objects=0))
        >>> dlo, bodies, pusher = np.zeros((K, T + 1, 32, 3)), np.zeros((K, T + 1, 3, 3)), np.zeros((K, T + 1, 2))
        >>> pushes = np.zeros((K, T, 2))
        >>> five = Trajectories(dlo, shapes[0], pusher, bodies, *shapes[1:], commanded=pushes, executed=pushes)
        >>> len(five), five.pushes, int(five.dlo_mask.sum())
        (5, 20, 20)
        >>> support, rest = five.take(slice(0, 2)), five.take(np.array([2, 3, 4]))
        >>> query, truth = rest.windows(horizon=4)  # 3 trajectories × 17 starts
        >>> query.dlo.shape, query.actions.shape, truth.dlo.shape
        ((51, 32, 3), (51, 4, 2), (1, 51, 32, 2))

    """

    dlo: Floats  # (K, T+1, 32, 3)  segment centres x m, y m, yaw rad
    dlo_mask: Mask  # (32,)  which segments exist
    pusher: Floats  # (K, T+1, 2)  x m, y m
    bodies: Floats  # (K, T+1, 3, 3)  rigid bodies x m, y m, yaw rad
    body_mask: Mask  # (3,)  which bodies exist
    boxes: Floats  # (3, 5, 5)  each body's boxes in its frame: x m, y m, yaw rad, half sizes m
    commanded: Floats  # (K, T, 2)  displacement asked for, m
    executed: Floats  # (K, T, 2)  displacement asked for plus execution noise, m
    cylinder: Floats | None = (
        None  # (K, T+1, 3)  what an attached DLO ends in: x m, y m, yaw rad; never shown to models
    )
    parameters: Floats | None = None  # (11,)  of the domain, see `parameters`; None but for a privileged model

    def __len__(self) -> int:
        return len(self.dlo)

    @property
    def pushes(self) -> int:
        """Returns T, the number of pushes of each trajectory."""
        return int(self.executed.shape[1])

    def take(self, index: slice | NDArray[np.intp]) -> Trajectories:
        """Returns the trajectories at `index`."""
        rows = {name: getattr(self, name)[index] for name in ("dlo", "pusher", "bodies", "commanded", "executed")}
        cylinder = None if self.cylinder is None else self.cylinder[index]
        return replace(self, **rows, cylinder=cylinder)

    def observed(self) -> Trajectories:
        """Returns what a model may see: all but the cylinder, which would tell how the DLO is attached."""
        return replace(self, cylinder=None)

    def windows(self, horizon: int) -> tuple[Query, Prediction]:
        """Returns every window of `horizon` executed pushes, trajectory by trajectory, and the state after it.

        B = K (T − horizon + 1). Raises `ValueError` when the horizon does not fit into a trajectory.
        """
        K, T = len(self), self.pushes
        if not 1 <= horizon <= T:
            raise ValueError(f"horizon = {horizon} does not fit into trajectories of {T} pushes")
        starts = T - horizon + 1
        ahead = np.arange(starts)[:, None] + np.arange(horizon)

        def flat(rows: Floats) -> Floats:
            return rows.reshape(K * starts, *rows.shape[2:])

        query = Query(
            dlo=flat(self.dlo[:, :starts]),
            dlo_mask=self.dlo_mask,
            pusher=flat(self.pusher[:, :starts]),
            bodies=flat(self.bodies[:, :starts]),
            body_mask=self.body_mask,
            boxes=self.boxes,
            actions=flat(self.executed[:, ahead]),
            parameters=self.parameters,
        )
        truth = Prediction(dlo=flat(self.dlo[:, horizon:, :, :2])[None], bodies=flat(self.bodies[:, horizon:])[None])
        return query, truth


def geometry(domain: Domain) -> Geometry:
    """Returns what is visible of a domain: dlo_mask (32,), body_mask (3,) and boxes (3, 5, 5)."""
    dlo_mask = np.arange(MAX_SEGMENTS) < domain.segments
    body_mask = np.arange(MAX_BODIES) < len(domain.bodies)
    boxes = np.zeros((MAX_BODIES, MAX_BOXES, 5), np.float32)
    for row, body in zip(boxes, domain.bodies, strict=False):
        placed = body.boxes()
        row[: len(placed)] = placed
    return dlo_mask, body_mask, boxes


def parameters(domain: Domain) -> Floats:
    """Returns what is unobserved of the DLO of a domain, for privileged models: (11,), most within −1 and 1.

    Surface friction, density, length, log stiffness and log yield curvature (1 where it never yields), each from −1 to
    1 over its range (that of all materials), then which material and which attachment, three of 0 and 1 each.

    Examples:
        >>> from dlobench.domain import typical
        >>> parameters(typical(material="soft", attachment="fixed", length=0.16, rigid_objects=0))[4:].tolist()
        [1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]

    """

    def scaled(value: float, low: float, high: float) -> float:
        return 2 * (value - low) / (high - low) - 1

    bounds = [bound for span in STIFFNESS.values() for bound in span]
    stiffness = scaled(math.log(domain.bending_stiffness), math.log(min(bounds)), math.log(max(bounds)))
    curvature = domain.yield_curvature
    yields = 1.0 if curvature is None else scaled(math.log(curvature), *map(math.log, YIELD_CURVATURE))
    numbers = [
        scaled(domain.surface_friction, *SURFACE_FRICTION),
        scaled(domain.density, *DLO_DENSITY),
        scaled(domain.length, LENGTHS[0], LENGTHS[-1]),
        stiffness,
        yields,
    ]
    kinds = [domain.material == each for each in MATERIALS] + [domain.attachment == each for each in ATTACHMENTS]
    return np.array([*numbers, *kinds], np.float32)


def concatenate(parts: Sequence[Trajectories]) -> Trajectories:
    """Joins trajectories of one domain; raises `ValueError` when their geometry differs."""
    first = parts[0]
    for part in parts[1:]:
        shared = ("dlo_mask", "body_mask", "boxes", "parameters")
        if not all(np.array_equal(getattr(part, name), getattr(first, name)) for name in shared):
            raise ValueError("trajectories of different domains cannot be joined")
    names = ("dlo", "pusher", "bodies", "commanded", "executed", *(() if first.cylinder is None else ("cylinder",)))
    return replace(first, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
