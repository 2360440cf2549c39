"""Draws Fig. 2: what the material does, where the pusher takes identical paths from the same start."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from drawing import laid_out, main, save
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scenes import CM, Look, path, rod, table, things

from dlobench.domain import MATERIALS, Domain, typical
from dlobench.world.simulate import Simulator
from dlobench.world.starts import Start

COLOURS = {"soft": "#0072B2", "flexible": "#009E73", "elastoplastic": "#CC79A7"}
SHOWN = (0, 3, 6, 10)  # pushes
STEP = 0.018  # m, of a push
# Up through one half of the DLO, aside, and down again through the other
WAY = [(0.0, 1.0)] * 4 + [(-1.0, 0.0)] * 3 + [(0.0, -1.0)] * 3


def start(domain: Domain) -> Start:
    """Returns a straight DLO across the table, the pusher below its right half."""
    return Start(
        root=np.array([-0.08, -0.03, 0.0]),
        bends=np.zeros(domain.segments),
        bodies=np.zeros((0, 3)),
        pusher=np.array([0.03, -0.055]),
    )


def domains() -> list[Domain]:
    """Returns three domains that differ in material alone: stiffness, and whether it yields."""
    return [typical(material=material, attachment="none", length=0.16, rigid_objects=0) for material in MATERIALS]


def rolled(domain: Domain) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns segments (pushes + 1, N, 2) and pusher (pushes + 1, 2), m, of exactly executed commands."""
    simulator = Simulator(domain, 1)
    states = [simulator.reset([start(domain)])]
    states += [simulator.push(STEP * np.array([way])) for way in WAY]
    dlo = np.stack([state.dlo[0, : domain.segments, :2] for state in states])
    return dlo, np.stack([state.pusher[0] for state in states])


def draw(results: Path, out: Path) -> None:
    """Writes fig2.pdf and fig2.png; reads no record."""
    del results
    figure = Figure(figsize=(6.8, 5.6), layout="constrained")
    panels = figure.subplots(len(MATERIALS), len(SHOWN))
    for axes, k in zip(panels[0], SHOWN, strict=True):
        axes.set_title(f"after {k} pushes" if k else "start")
    for row, domain in zip(panels, domains(), strict=True):
        row[0].set_ylabel(domain.material)
        for axes in row:
            table(axes)
    note = "Typical domains that differ in stiffness and yielding alone; ten identical pushes of 18 mm, without noise."
    laid_out(figure, note)
    for row, domain in zip(panels, domains(), strict=True):
        dlo, pusher = rolled(domain)
        for axes, k in zip(row, SHOWN, strict=True):
            things(axes, domain, Look(dlo[k], pusher[k], np.zeros((0, 3))))
            rod(axes, dlo[k], COLOURS[domain.material])
            axes.plot(*(CM * pusher[: k + 1]).T, color="0.2", linewidth=0.8, linestyle=":")
            if k:
                path(axes, pusher[k - 1], pusher[k])
    save(figure, "fig2", out)


if __name__ == "__main__":
    sys.exit(main(draw))
