"""Prints without end, or 64 MB where nothing stops it."""

from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        for _ in range(64):
            print("x" * 2**20)

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
