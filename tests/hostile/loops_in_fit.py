"""Logs a fit that never ends."""

from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        step = 0
        while True:
            step += 1
            setting.log(step, 10, loss=0.5)

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
