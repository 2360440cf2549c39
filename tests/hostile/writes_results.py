"""Writes a record of its own into the results."""

import pathlib
from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    target: str = ""  # what it goes for

    def fit(self, train, valid, setting):
        pass

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        (pathlib.Path(self.target) / "seed1.json").write_text("{}")
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
