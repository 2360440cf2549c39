"""Leaves a process behind that has left its session and its parent; it says who it is by its name."""

import os
from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    target: str = ""  # what it goes for

    def fit(self, train, valid, setting):
        if not os.fork():
            os.setsid()
            if not os.fork():
                os.execv("/bin/sleep", [self.target, "60"])
            os._exit(0)

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
