"""Holds what cannot be pickled: a lock, an open file, a generator, a function without a name."""

import threading
from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        self.lock, self.file = threading.Lock(), open("notes", "w")
        self.numbers, self.still = (n for n in range(9)), lambda query: np.array(query.dlo[None, ..., :2])

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        with self.lock:
            return Prediction(dlo=self.still(query))
