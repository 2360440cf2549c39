"""Draws Fig. 4: one scene in every style of the renderer, and its depth, by both cameras."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from drawing import main, save
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from dlobench.domain import typical
from dlobench.world import canvas
from dlobench.world import style as styles

PUSHES, SEED = 4, 11


def draw(results: Path, out: Path) -> None:
    """Writes fig4.pdf and fig4.png; reads no record. Raises `RunError` where there is no OpenGL to draw with."""
    del results
    canvas.load()  # before anything else imports MuJoCo, whose import fails where MUJOCO_GL names what is not there
    from scenes import trajectory  # noqa: PLC0415

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
    figure = Figure(figsize=(6.8, 3.9), layout="constrained")
    panels = figure.subplots(len(styles.CAMERAS), len(names) + 1, squeeze=False)
    for row, camera in zip(panels, styles.CAMERAS, strict=True):
        for axes, name in zip(row, names, strict=False):
            axes.imshow(picture(styles.load(name), camera))
        shown = row[-1].imshow(picture(styles.load(), camera, depth=True), cmap="cividis_r")  # what is near is light
        bar = figure.colorbar(shown, ax=row[-1], location="bottom", shrink=0.9, aspect=25, pad=0.03)
        bar.locator = MaxNLocator(4)
        bar.set_label("depth, m")
    for axes, title in zip(panels[0], [*names, "depth"], strict=True):
        axes.set_title(title)
    for axes in panels.flat:
        axes.set_axis_off()
    save(
        figure,
        "fig4",
        out,
        "One state of a soft DLO at a movable end, among three bodies, from above and aslant. "
        "Depth is the same in each style.",
    )


if __name__ == "__main__":
    sys.exit(main(draw))
