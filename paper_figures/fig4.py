"""Draws Fig. 4: colour and depth of one scene, in every style of the renderer."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from drawing import main, save
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scenes import trajectory

from dlobench.domain import typical
from dlobench.world import canvas
from dlobench.world import style as styles

PUSHES, SEED = 4, 11


def draw(results: Path, out: Path) -> None:
    """Writes fig4.pdf and fig4.png; reads no record. Raises `RunError` where there is no OpenGL to draw with."""
    del results
    canvas.load()  # before anything else imports MuJoCo
    from dlobench.world.render import frames  # noqa: PLC0415

    domain = typical(material="soft", attachment="movable", length=0.16, rigid_objects=3)
    seen = trajectory(domain, SEED, PUSHES)
    cylinder = None if seen.cylinder is None else seen.cylinder[0, -1:]

    def picture(look: styles.Style, camera: styles.CameraName, *, depth: bool = False) -> NDArray[Any]:
        (frame,) = frames(
            domain,
            dlo=seen.dlo[0, -1:],
            pusher=seen.pusher[0, -1:],
            bodies=seen.bodies[0, -1:],
            cylinder=cylinder,
            style=look,
            camera=camera,
            depth=depth,
        )
        return np.asarray(frame)

    names = styles.names()
    figure = Figure(figsize=(2.1 * len(names), 6.6), layout="constrained")
    panels = figure.subplots(3, len(names), squeeze=False)
    for column, name in zip(panels.T, names, strict=True):
        look = styles.load(name)
        column[0].imshow(picture(look, "top"))
        column[1].imshow(picture(look, "oblique"))
        shown = column[2].imshow(picture(look, "oblique", depth=True), cmap="cividis")
        column[0].set_title(name)
        for axes in column:
            axes.set_axis_off()
    bar = figure.colorbar(shown, ax=list(panels[2]), location="bottom", shrink=0.5, aspect=40, pad=0.02)
    bar.set_label("depth, m")
    save(
        figure,
        "fig4",
        out,
        "One state of a soft DLO at a movable end, among three bodies: from above, aslant, and as depth.",
    )


if __name__ == "__main__":
    sys.exit(main(draw))
