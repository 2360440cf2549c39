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
LINES = {"soft": "-", "flexible": "--", "elastoplastic": "-."}  # where all three lie over each other
SHOWN = (0, 2, 4, 8)  # pushes
STEP = 0.018  # m, of a push
WAY = [(0.0, 1.0)] * 4 + [(0.0, -1.0)] * 4  # up against the DLO, and back, which lets it go
END = (-0.09, -0.03)  # m, the cylinder's axis


def start(domain: Domain) -> Start:
    """Returns a straight DLO that is held at its left end, the pusher below its middle."""
    return Start(
        root=np.array([*END, 0.0]),
        bends=np.zeros(domain.segments),
        bodies=np.zeros((0, 3)),
        pusher=np.array([-0.02, -0.05]),
    )


def domains() -> list[Domain]:
    """Returns three domains that differ in material alone: stiffness, and whether it yields."""
    return [typical(material=material, attachment="fixed", length=0.16, rigid_objects=0) for material in MATERIALS]


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
    figure = Figure(figsize=(6.8, 7.3), layout="constrained")
    panels = figure.subplots(len(MATERIALS) + 1, len(SHOWN))
    for axes, k in zip(panels[0], SHOWN, strict=True):
        axes.set_title(f"after {k} pushes" if k else "start")
    for row, name in zip(panels, [*MATERIALS, "all three"], strict=True):
        row[0].set_ylabel(name)
        for axes in row:
            table(axes)
    note = (
        "Typical domains that differ in stiffness and yielding alone, 16 cm, 25 cm between the walls; the black "
        "cylinder is fixed. The same eight pushes of 18 mm without noise, four up and four back along the dotted line."
    )
    laid_out(figure, note)
    for row, domain in zip(panels, domains(), strict=False):
        dlo, pusher = rolled(domain)
        for axes, below, k in zip(row, panels[-1], SHOWN, strict=True):
            for each in (axes, below):
                things(each, domain, Look(dlo[k], pusher[k], np.zeros((0, 3)), np.array(END)))
            rod(axes, dlo[k], COLOURS[domain.material])
            axes.plot(*(CM * pusher[: k + 1]).T, color="0.2", linewidth=0.8, linestyle=":")
            if k:
                path(axes, pusher[k - 1], pusher[k])
            style = {"color": COLOURS[domain.material], "linestyle": LINES[domain.material]}
            below.plot(*(CM * dlo[k]).T, linewidth=1.5, label=domain.material, **style)
    panels[-1, 0].legend(loc="upper left", fontsize=6.5, handlelength=2.6)
    save(figure, "fig2", out)


if __name__ == "__main__":
    sys.exit(main(draw))
