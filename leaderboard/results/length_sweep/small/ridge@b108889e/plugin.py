"""Predicts displacements that are linear in positions and actions: the floor of what learning brings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dlobench.bench.model import Model, Setting
from dlobench.errors import RunError
from dlobench.nn.fit import positive
from dlobench.nn.windows import Scaling, Windows, standardise
from dlobench.trajectories import Prediction, Query, Trajectories

PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)  # what is tried, as a share of the windows
CHUNK = 65_536  # windows whose products are added up at once


@dataclass
class Ridge(Model):
    """Learns a ridge regression from pusher, segments, bodies and n actions, standardised, to displacements.

    Solved in closed form, in float64 (Hoerl and Kennard 1970). The penalty that is best on validation windows is taken,
    or the middle one where there are none. A segment is regressed over the domains that have it. Not in the paper.
    Shapes: (B, 78 + 2 n) to (B, 64). Cost: 5,184 parameters at n = 1; two passes over the windows.
    """

    penalty: float | None = None  # None chooses among `PENALTIES`
    bodies: bool = True  # whether rigid bodies are features

    scaling: Scaling = field(init=False, repr=False, compare=False)
    coefficients: Tensor = field(init=False, repr=False, compare=False)  # (F + 1, 64), the last of the constant

    def __post_init__(self) -> None:
        """Raises `UsageError` for a penalty that is none."""
        if self.penalty is not None:
            positive(self, "penalty")

    def fit(self, train: Sequence[Trajectories], valid: Sequence[Trajectories], setting: Setting) -> None:
        """Solves for every penalty and keeps the best."""
        windows, self.scaling = standardise(
            train, horizon=setting.horizon, bodies=self.bodies, target="displacement", device=self.device
        )
        unseen = self.scaling.windows(valid, self.device) if valid else None
        tried = PENALTIES if self.penalty is None else (self.penalty,)
        found = [_solved(windows, penalty) for penalty in tried]
        losses = [_loss(unseen, one) if unseen is not None else abs(i - len(found) // 2) for i, one in enumerate(found)]
        best = min(range(len(found)), key=losses.__getitem__)
        if not found[best].isfinite().all():
            raise RunError(f"the regression has no solution with a penalty of {tried[best]:g}")
        self.coefficients = found[best].float()
        setting.log(1, 1, **({"valid": losses[best]} if unseen is not None else {}), penalty=tried[best])

    @torch.no_grad()
    def predict(self, query: Query, samples: int) -> Prediction:
        """Returns the segments (1, B, 32, 2)."""
        inputs = self.scaling.inputs(query).to(self.device)
        outputs = torch.addmm(self.coefficients[-1], inputs, self.coefficients[:-1])
        return Prediction(dlo=self.scaling.positions(outputs, query)[None])

    def parameters(self) -> int:
        """Returns the number of coefficients."""
        return self.coefficients.numel()


def _rows(windows: Windows) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Returns inputs with a constant (B, F + 1), targets and weights (B, 64), chunk by chunk, in float64."""
    chunks = [windows.pick(slice(i, i + CHUNK)) for i in range(0, len(windows), CHUNK)]
    return [(torch.cat([x, torch.ones_like(x[:, :1])], 1).double(), y.double(), w.double()) for x, y, w in chunks]


def _solved(windows: Windows, penalty: float) -> Tensor:
    """Returns the coefficients (F + 1, 64); columns that the same domains have are solved at once."""
    has = windows.weight > 0
    patterns, which = torch.unique(has, dim=1, return_inverse=True)
    out = torch.zeros(windows.inputs.shape[-1] + 1, has.shape[1], dtype=torch.float64, device=has.device)
    for number, pattern in enumerate(patterns.T):
        columns = which == number
        if not pattern.any():
            continue
        gram, cross, count = torch.zeros(1), torch.zeros(1), 0
        for x, y, w in _rows(windows):
            there = w[:, columns][:, 0] > 0
            rows = x[there]
            gram, cross = gram.to(x) + rows.T @ rows, cross.to(x) + rows.T @ y[there][:, columns]
            count += len(rows)
        ridge = torch.full((len(out),), penalty * count, dtype=torch.float64, device=has.device)
        ridge[-1] = 0  # the constant is free
        out[:, columns] = torch.linalg.solve(gram + torch.diag(ridge), cross)
    return out


def _loss(windows: Windows, coefficients: Tensor) -> float:
    """Returns the weighted squared error of windows, the mean."""
    return sum(float(((x @ coefficients - y).square() * w).sum()) for x, y, w in _rows(windows)) / len(windows)
