"""Draws scenes from above, in cm: the table between its walls, DLO, pusher, bodies and what a DLO is attached by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle
from numpy.typing import NDArray

from dlobench.domain import DLO_RADIUS, PUSHER_RADIUS, WORKSPACE, Domain
from dlobench.trajectories import Trajectories
from dlobench.world.chain import CYLINDER_RADIUS
from dlobench.world.simulate import simulate

CM = 100.0  # cm in a metre
DLO, BEFORE, PUSHER, BODY, FIXED = "#0072B2", "#999999", "#D55E00", "#E8D9A8", "#000000"


@dataclass(frozen=True)
class Look:
    """Holds one state of a domain, as it is drawn."""

    dlo: NDArray[Any]  # (N, 2) m, the segments that exist
    pusher: NDArray[Any]  # (2,) m
    bodies: NDArray[Any]  # (M, 3) m, m, rad
    cylinder: NDArray[Any] | None = None  # (2,) m


def look(domain: Domain, recorded: Trajectories, row: int, state: int) -> Look:
    """Returns a state of a recorded trajectory."""
    cylinder = None if recorded.cylinder is None or domain.attachment == "none" else recorded.cylinder[row, state, :2]
    return Look(
        dlo=recorded.dlo[row, state, recorded.dlo_mask, :2],
        pusher=recorded.pusher[row, state],
        bodies=recorded.bodies[row, state, : len(domain.bodies)],
        cylinder=cylinder,
    )


def trajectory(domain: Domain, seed: int, pushes: int) -> Trajectories:
    """Simulates one trajectory of the benchmark's own pushes."""
    return simulate(domain, [[seed]], pushes=pushes)[0]


def table(axes: Axes, half: float = WORKSPACE / 2) -> None:
    """Prepares axes: the square between the walls, in cm, without ticks."""
    axes.set_aspect("equal")
    axes.set_xlim(-CM * half * 1.02, CM * half * 1.02)
    axes.set_ylim(-CM * half * 1.02, CM * half * 1.02)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    edge = CM * WORKSPACE / 2
    axes.add_patch(Rectangle((-edge, -edge), 2 * edge, 2 * edge, fill=False, linewidth=1.2, edgecolor="0.2"))


def rod(axes: Axes, dlo: NDArray[Any], colour: str, *, dashed: bool = False, label: str | None = None) -> None:
    """Draws a DLO as wide as it is; dashed where it only was."""
    line = CM * dlo
    (drawn,) = axes.plot(line[:, 0], line[:, 1], color=colour, label=label, solid_capstyle="round")
    if dashed:
        drawn.set(linestyle=(0, (2, 1.5)), linewidth=1.0)
    else:
        drawn.set_linewidth(points(axes, 2 * DLO_RADIUS))


def points(axes: Axes, length: float) -> float:
    """Returns how many points a length in m takes on axes that are laid out."""
    (x0, _), (x1, _) = axes.transData.transform([(0, 0), (CM * length, 0)])
    return float(x1 - x0) * 72 / axes.figure.dpi


def things(axes: Axes, domain: Domain, of: Look) -> None:
    """Draws bodies, the cylinder (hatched where it is fixed) and the pusher."""
    for body, (x, y, yaw) in zip(domain.bodies, of.bodies, strict=True):
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        for cx, cy, _, a, b in body.boxes():
            corners = np.array([[cx - a, cy - b], [cx + a, cy - b], [cx + a, cy + b], [cx - a, cy + b]])
            axes.add_patch(Polygon(CM * (corners @ turn.T + (x, y)), facecolor=BODY, edgecolor="0.3", linewidth=0.6))
    if of.cylinder is not None:
        held = domain.attachment == "fixed"
        face, hatch = ("0.2", None) if held else ("white", "////")
        centre = CM * of.cylinder
        axes.add_patch(Circle(tuple(centre), CM * CYLINDER_RADIUS, facecolor=face, edgecolor=FIXED, hatch=hatch))
    axes.add_patch(Circle(tuple(CM * of.pusher), CM * PUSHER_RADIUS, facecolor=PUSHER, edgecolor="0.2", linewidth=0.6))


def path(axes: Axes, begin: NDArray[Any], end: NDArray[Any]) -> None:
    """Draws where a pusher came from, as an arrow."""
    axes.add_patch(Circle(tuple(CM * begin), CM * PUSHER_RADIUS, fill=False, edgecolor=PUSHER, linewidth=0.8, ls=":"))
    arrow = FancyArrowPatch(
        tuple(CM * begin), tuple(CM * end), arrowstyle="-|>", mutation_scale=6, color="0.1", shrinkA=0, shrinkB=0
    )
    axes.add_patch(arrow)
