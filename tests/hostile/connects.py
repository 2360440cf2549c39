"""Looks for help in the network."""

import socket
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
        socket.create_connection(("127.0.0.1", 9), 1)
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
