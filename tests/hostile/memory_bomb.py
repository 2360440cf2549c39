"""Takes all memory, or 4 GB where nothing stops it."""

from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        self.taken = [np.ones(2**23) for _ in range(64)]

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
