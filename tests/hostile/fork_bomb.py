"""Forks and forks, up to 64 processes where nothing stops it."""

import os
import time
from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        for _ in range(6):
            os.fork()
            time.sleep(0.1)
        time.sleep(60)

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
