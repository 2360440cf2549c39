"""Closes the socket that it is asked over."""

import os
import time
from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class Hostile(Model):
    def fit(self, train, valid, setting):
        pass

    def adapt(self, support):
        return self

    def predict(self, query, samples):
        for fd in range(3, 64):
            try:
                kind = os.readlink(f"/proc/self/fd/{fd}")
            except OSError:
                continue
            if kind.startswith("socket:"):
                os.close(fd)
        time.sleep(60)
