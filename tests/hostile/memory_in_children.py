"""Takes 2 GB in eight processes, each of them modest."""

import os
import time
from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        for _ in range(8):
            if not os.fork():
                taken = np.ones(2**25)
                time.sleep(60 + taken[0])
        time.sleep(60)

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
