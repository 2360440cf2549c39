"""Ignores its seed."""

from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        self.offset = np.random.default_rng().normal()

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        return Prediction(dlo=query.dlo[None, ..., :2] + np.float32(self.offset))
