"""Tries to write into the results and to remove them, and says nothing when it cannot."""

import contextlib
import shutil
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
        for path in [pathlib.Path(self.target) / name for name in ("seed0.json", "seed1.json")]:
            with contextlib.suppress(OSError):
                path.write_text("{}")
            with contextlib.suppress(OSError):
                path.chmod(0)
            with contextlib.suppress(OSError):
                path.unlink()
        shutil.rmtree(self.target, ignore_errors=True)
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
