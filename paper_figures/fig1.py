"""Draws Fig. 1: pushing scenes of every material and attachment, before (dashed) and after a push."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from drawing import laid_out, main, save
from matplotlib.figure import Figure
from scenes import BEFORE, DLO, look, path, rod, table, things, trajectory

from dlobench.domain import ATTACHMENTS, MATERIALS, typical

PUSHES, SEED = 8, 4


def draw(results: Path, out: Path) -> None:
    """Writes fig1.pdf and fig1.png; reads no record."""
    del results
    figure = Figure(figsize=(6.4, 6.9), layout="constrained")
    panels = figure.subplots(len(MATERIALS), len(ATTACHMENTS))
    for row, material in zip(panels, MATERIALS, strict=True):
        for axes, attachment in zip(row, ATTACHMENTS, strict=True):
            table(axes)
            axes.set_title(f"{material}, {attachment}")
    note = (
        "Typical domains, 16 cm, 25 cm between the walls: of 8 pushes of a trajectory the one that moves the DLO most: "
        "dashed where it lay, solid where it lies then, as bodies do. "
        "The pusher is orange, a movable cylinder hatched, a fixed one black."
    )
    laid_out(figure, note)
    for row, material in zip(panels, MATERIALS, strict=True):
        for axes, attachment in zip(row, ATTACHMENTS, strict=True):
            domain = typical(material=material, attachment=attachment, length=0.16, rigid_objects=3)
            seen = trajectory(domain, SEED, PUSHES)
            moved = np.linalg.norm(np.diff(seen.dlo[0][:, seen.dlo_mask, :2], axis=0), axis=-1).mean(axis=1)
            k = int(moved.argmax())
            before, after = look(domain, seen, 0, k), look(domain, seen, 0, k + 1)
            things(axes, domain, after)
            rod(axes, after.dlo, DLO)
            rod(axes, before.dlo, BEFORE, dashed=True)
            path(axes, before.pusher, after.pusher)
    save(figure, "fig1", out)


if __name__ == "__main__":
    sys.exit(main(draw))
