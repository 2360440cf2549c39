"""Draws predicted shapes over true ones as SVG."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

from dlobench.errors import UsageError
from dlobench.trajectories import Floats

SIDE, GAP = 160, 12  # of a window's picture, and between two
MOST = 4  # windows that are drawn
STYLES = {"start": 'class="start"', "true": 'class="true"', "predicted": 'class="predicted" stroke-dasharray="5 3"'}


@dataclass(frozen=True)
class Windows:
    """Holds shapes of a few windows, valid segments alone."""

    start: Floats  # (B, n, 2)  m
    true: Floats  # (B, n, 2)  m
    predicted: Floats  # (B, n, 2)  m


def rollout(windows: Windows | None, name: str = "") -> str:
    """Returns an SVG of at most four windows side by side, each to its own scale; "" of None.

    The start is thin and grey, the truth solid, the prediction dashed. Raises `UsageError` for other shapes and for
    values that are not finite.
    """
    if windows is None:
        return ""
    shape = windows.start.shape
    if len(shape) != 3 or shape[2] != 2 or 0 in shape:
        raise UsageError(f"windows of shape {shape} cannot be drawn: (B, n, 2) can")
    shapes = {each: np.asarray(getattr(windows, each), np.float64) for each in STYLES}
    if any(each.shape != shape or not np.isfinite(each).all() for each in shapes.values()):
        raise UsageError("start, true and predicted have to be finite and of one shape")
    count = min(MOST, shape[0])
    parts = []
    for b in range(count):
        every = np.concatenate([each[b] for each in shapes.values()])
        middle = (every.min(axis=0) + every.max(axis=0)) / 2
        scale = (SIDE - 2 * GAP) / max(float(np.ptp(every, axis=0).max()), 1e-6)
        left = b * (SIDE + GAP)
        parts.append(f'<rect x="{left}" y="0" width="{SIDE}" height="{SIDE}" class="ground"/>')
        for each, style in STYLES.items():
            points = (shapes[each][b] - middle) * scale * (1, -1) + SIDE / 2 + (left, 0)
            parts.append(f'<polyline {style} points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in points)}"/>')
    width = count * (SIDE + GAP) - GAP
    label = escape(f"Prediction over truth: {name}" if name else "Prediction over truth", quote=True)
    return f'<svg class="rollout" viewBox="0 0 {width} {SIDE}" role="img" aria-label="{label}">{"".join(parts)}</svg>'
