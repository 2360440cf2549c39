"""Looks for data in whoever started it: its environment, its open files, its memory."""

import os
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
        found = []
        pid = os.getpid()
        while pid > 1:
            pid = int(open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()[1])
            if pid > 1:
                for name in ("environ", "mem", "root/etc/hostname", "cwd/."):
                    try:
                        os.close(os.open(f"/proc/{pid}/{name}", os.O_RDONLY))
                        found.append(name)
                    except OSError:
                        pass
        raise ValueError(f"found {found}")
