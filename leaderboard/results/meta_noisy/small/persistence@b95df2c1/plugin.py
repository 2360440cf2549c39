"""Predicts that nothing moves: the error that any other model must beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model, Setting
from dlobench.trajectories import Prediction, Query, Trajectories


@dataclass
class Persistence(Model):
    """Returns the state it was asked about; learns nothing and has no parameters.

    Its error is how far things move in n pushes. Cost: none. Not in the paper.
    """

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Learns nothing."""

    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2) and the bodies (1, B, 3, 3) where they are; S = 1."""
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]), bodies=np.array(query.bodies[None]))
