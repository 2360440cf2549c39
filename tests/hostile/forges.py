"""Answers with an array that is larger than what it sends."""

import json
import os
import struct
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
        text = json.dumps({"ask": 1, "done": True, "shared": True, "arrays": [["dlo", "<f4", [2**40], 0]]}).encode()
        for fd in range(3, 64):
            try:
                kind = os.readlink(f"/proc/self/fd/{fd}")
            except OSError:
                continue
            if kind.startswith("socket:"):
                os.write(fd, struct.pack("<QQ", len(text), 0) + text)
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
