"""Raises what a Ctrl-C raises."""

from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        raise KeyboardInterrupt

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
