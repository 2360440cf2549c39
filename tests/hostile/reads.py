"""Reads a file or lists a folder that it was never given."""

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
        target = pathlib.Path(self.target)
        found = list(target.iterdir()) if target.is_dir() else target.read_bytes()
        raise ValueError(f"found {found!r:.60}")
