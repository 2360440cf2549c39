"""Applies a model to its own predictions, push after push."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dlobench.trajectories import Floats, Mask, Prediction, Query


def roll(predict: Callable[[Query], Prediction], query: Query, ahead: tuple[int, ...]) -> dict[int, Prediction]:
    """Returns what is predicted at some numbers of pushes ahead.

    `predict` tells the state after one push. The pusher is where its action takes it; a segment's yaw is the direction
    from the one before to the one after; rigid bodies that a model does not predict stay where they are.
    """
    found = {}
    for n in range(max(ahead)):
        now = replace(query, actions=query.actions[:, n : n + 1])
        prediction = predict(now)
        if n + 1 in ahead:
            found[n + 1] = prediction
        query = replace(
            query,
            dlo=poses(prediction.dlo[0], query.dlo_mask),
            pusher=query.pusher + query.actions[:, n],
            bodies=query.bodies if prediction.bodies is None else prediction.bodies[0].astype(np.float32),
        )
    return found


def poses(dlo: Floats, mask: Mask) -> Floats:
    """Returns segments (B, 32, 2) with their yaw, (B, 32, 3); 0 where there is none."""
    out = np.zeros((*dlo.shape[:2], 3), np.float32)
    valid = dlo[:, mask]
    along = np.gradient(valid, axis=1) if valid.shape[1] > 1 else np.zeros_like(valid)
    out[:, mask] = np.concatenate([valid, np.arctan2(along[..., 1], along[..., 0])[..., None]], axis=-1)
    return out
