"""Scores predictions of one domain by every score that they have. Pure functions of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from dlobench.bench import calibration, metrics, sampled, validity
from dlobench.bench.statistics import generator
from dlobench.trajectories import Floats, Mask, Prediction

BINS = 20  # of rank histograms in records


def point(prediction: Prediction, truth: Prediction, start: Floats, masks: tuple[Mask, Mask]) -> dict[str, Any]:
    """Returns the scores of one predicted future by name; None for what there is nothing of.

    Of several true samples, the mean over them. `start` (B, 32, 2) m, `masks` of segments and bodies.
    """
    mask, body_mask = masks
    predicted = prediction.dlo.mean(axis=0, dtype=np.float64) if len(prediction.dlo) > 1 else prediction.dlo[0]
    bodies = None
    if prediction.bodies is not None and truth.bodies is not None:
        bodies = metrics.pose_error(prediction.bodies[0], truth.bodies[0], body_mask)
    moving = metrics.where_moving(metrics.euclidean, predicted, truth.dlo[0], start, mask)
    return {
        "mse": np.mean([metrics.mse(predicted, true, mask) for true in truth.dlo]),
        "euclidean": np.mean([metrics.euclidean(predicted, true, mask) for true in truth.dlo]),
        "shape": np.mean([metrics.shape_error(predicted, true, mask) for true in truth.dlo]),
        "euclidean_moving": moving if len(truth.dlo) == 1 else None,
        "body_position": None if bodies is None else bodies.position,
        "body_yaw": None if bodies is None else bodies.angle,
    }


def still(truth: Prediction, start: Floats, seen: Floats, mask: Mask) -> dict[str, Any]:
    """Returns the scores of persistence, which predicts what is `seen`, and how many windows really move."""
    return {
        "windows": len(start),
        "moving": int(metrics.moving(start, truth.dlo, mask).sum()),
        "persistence_mse": np.mean([metrics.mse(seen, true, mask) for true in truth.dlo]),
        "persistence_euclidean": np.mean([metrics.euclidean(seen, true, mask) for true in truth.dlo]),
    }


def valid(prediction: Prediction, mask: Mask) -> dict[str, Any]:
    """Returns how well predicted shapes could be a DLO."""
    dlo = prediction.dlo[0]
    return {
        "spacing": validity.spacing_error(dlo, mask),
        "overlap": validity.self_overlap(dlo, mask, depth=0.001),
    }


def spread(prediction: Prediction, truth: Prediction, start: Floats, mask: Mask, name: str) -> dict[str, Any]:
    """Returns the scores of samples beside true ones; ties of ranks are broken by draws that belong to `name`."""
    samples, true = prediction.dlo, truth.dlo
    out: dict[str, Any] = {
        "energy": sampled.energy(samples, true, mask),
        "energy_floor": sampled.floor(sampled.energy, true, mask),
        "persistence_energy": sampled.energy(start[None], true, mask),
        "segment_energy": sampled.segment_energy(samples, true, mask),
        "variogram": sampled.variogram(samples, true, mask),
        "crps": sampled.crps(samples, true, mask),
    }
    S = len(samples)
    if S == 1:
        return out
    rng = generator("ranks", name)
    rests = calibration.unmoved(start, samples, true, mask)
    ranks = calibration.ranks(samples, true, mask, rng)[~rests]
    shapes = calibration.shape_ranks(samples, true, mask, rng)
    return out | {
        "mmd2": sampled.mmd2(samples, true, mask),
        "coverage50": calibration.coverage(ranks, S, 0.5),
        "coverage90": calibration.coverage(ranks, S, 0.9),
        "unmoved": float(rests.mean()),
        "ranks": _binned(calibration.histogram(ranks, S)),
        "shape_ranks": _binned(calibration.histogram(shapes, S)),
    }


def _binned(counts: Any) -> list[int]:
    """Returns a histogram of S + 1 ranks in `BINS` bins of equal width."""
    return [int(part.sum()) for part in np.split(counts, BINS)]
