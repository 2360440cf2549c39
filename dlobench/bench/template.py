"""Writes a plugin to begin with: a model that is short, learns, and keeps the contract."""

from __future__ import annotations

import keyword
import re
from pathlib import Path

from dlobench.data.store import atomic_write
from dlobench.errors import UsageError

MODEL = '''"""Predicts by a linear map of what is seen; replace it by what you believe in."""

from dataclasses import dataclass

import numpy as np

from dlobench.bench.model import Model
from dlobench.trajectories import Prediction


@dataclass
class {name}(Model):
    """Learns how far every segment moves by ridge regression. Fields with defaults are hyperparameters (--set)."""

    ridge: float = 1e-3

    def fit(self, train, valid, setting):
        """Learns from the training domains: dlobench.trajectories says what they hold, with shapes and units."""
        queries, truths = zip(*(domain.windows(setting.horizon) for domain in train))
        x = np.concatenate([self.features(query) for query in queries])
        y = np.concatenate([truth.dlo[0] - query.dlo[..., :2] for query, truth in zip(queries, truths)])
        self.map = np.linalg.solve(x.T @ x + self.ridge * np.eye(x.shape[1]), x.T @ y.reshape(len(y), -1))

    def features(self, query):
        """Returns what is known of each query, (B, F): segments as the pusher sees them, the actions, and 1."""
        near = (query.dlo[..., :2] - query.pusher[:, None]) * query.dlo_mask[:, None]
        parts = [near.reshape(len(query), -1), query.actions.reshape(len(query), -1), np.ones((len(query), 1))]
        return np.concatenate(parts, axis=1) * 10.0

    def predict(self, query, samples):
        """Returns where the segments are after the actions, (1, B, 32, 2) m."""
        moved = (self.features(query) @ self.map).reshape(len(query), -1, 2)
        return Prediction(dlo=(query.dlo[..., :2] + moved)[None].astype(np.float32))

    def parameters(self):
        """Returns the number of learned numbers."""
        return self.map.size
'''


def write(name: str, folder: Path) -> Path:
    """Writes NAME.py into a folder; raises `UsageError` for what is no name of a module, and where a file is there."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise UsageError(f"{name!r} is no name of a model: small letters, digits and _ make one, such as my_model")
    path = folder / f"{name}.py"
    if path.exists():
        raise UsageError(f"{path} is there already; choose another name")
    atomic_write(path, MODEL.format(name="".join(part.capitalize() for part in name.split("_"))).encode())
    return path
