"""Draws Fig. 5: the nine shapes of rigid bodies, made of boxes of 15 mm."""

from __future__ import annotations

import sys
from pathlib import Path

from drawing import main, save
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scenes import BODY, CM

from dlobench.domain import BOX_DENSITY, SHAPES, RigidBody


def draw(results: Path, out: Path) -> None:
    """Writes fig5.pdf and fig5.png; reads no record."""
    del results
    figure = Figure(figsize=(6.4, 1.25), layout="constrained")
    panels = figure.subplots(1, len(SHAPES), sharex=True, sharey=True)
    for axes, shape in zip(panels, SHAPES, strict=True):
        body = RigidBody(shape, (sum(BOX_DENSITY) / 2,) * len(SHAPES[shape]), 0.4)
        for x, y, _, a, b in body.boxes():
            corner = CM * (x - a), CM * (y - b)
            axes.add_patch(Rectangle(corner, 2 * CM * a, 2 * CM * b, facecolor=BODY, edgecolor="0.2", linewidth=0.8))
        axes.plot([0], [0], "+", color="0.2", markersize=5)
        axes.set_aspect("equal")
        axes.set_xlim(-3.2, 3.2)
        axes.set_ylim(-3.2, 3.2)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.grid(visible=False)
        for spine in axes.spines.values():
            spine.set_visible(False)
        axes.set_title(shape)
    bar = panels[0]
    bar.plot([-3.0, -1.5], [-2.9, -2.9], color="0.1", linewidth=1.5)
    bar.text(-3.0, -2.5, "15 mm", fontsize=6)
    save(figure, "fig5", out, "Boxes have densities of their own in the sets; the cross is the centroid of the shape.")


if __name__ == "__main__":
    sys.exit(main(draw))
