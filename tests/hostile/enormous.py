"""Answers with far more than it was asked for."""

from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        pass

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        return Prediction(dlo=np.zeros((1000, *query.dlo.shape[:2], 2), np.float32))
