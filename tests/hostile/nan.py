"""Predicts a number that is none, once."""

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
        dlo = np.array(query.dlo[None, ..., :2])
        dlo[0, -1, 3, 1] = np.nan
        return Prediction(dlo=dlo)
