"""Adapts by changing itself."""

from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    offset: float = 0.0  # m

    def fit(self, train, valid, setting):
        pass

    def adapt(self, support):
        self.offset += 0.001 * len(support)
        return self

    def predict(self, query, samples):
        return Prediction(dlo=query.dlo[None, ..., :2] + np.float32(self.offset))
