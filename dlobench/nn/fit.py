"""Runs Adam on any loss until it is converged or the budget is spent, and fits networks so."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dlobench.errors import RunError, UsageError
from dlobench.nn.budget import Budget, Log
from dlobench.nn.networks import Layers, mlp, size
from dlobench.nn.windows import Scaling
from dlobench.trajectories import Prediction, Query

REPORT = 25  # steps between two entries of the learning curve
WARM = 0.05  # share of a fit in which a cosine rate rises
DIVERGED = 100.0  # times the loss of the first `REPORT` steps: one batch may happen to be of things that rest
CHUNK = 8192  # windows a forward pass without gradient takes at once


def positive(holder: object, *names: str) -> None:
    """Raises `UsageError` for the first of these hyperparameters that is not a positive number."""
    for name in names:
        value = getattr(holder, name)
        if not (math.isfinite(value) and value > 0):
            raise UsageError(f"{name} = {value!r} is not a positive number")


@dataclass(frozen=True)
class Plan:
    """Says how long to descend and how fast."""

    steps: int
    learning_rate: float
    patience: int  # validations without a new best before it stops
    every: int = 500  # steps between two validations
    cosine: bool = False  # whether the rate rises over the first 5 % and falls to 0 at the end
    clip: float | None = None  # the norm that gradients are cut to

    def __post_init__(self) -> None:
        positive(self, "steps", "learning_rate", "patience", "every")


class Course:
    """Follows one fit: reports its losses, keeps its best validated weights, and tells when it is over."""

    def __init__(self, plan: Plan, total: int, log: Log) -> None:
        self.plan, self.total, self.log = plan, total, log
        self.first, self.reported = math.nan, 0
        self.best, self.kept, self.waited = math.inf, list[Tensor](), 0

    def due(self, step: int, *, last: bool) -> bool:
        """Returns whether to report after this step; not at every step, since reading a loss would stall a GPU."""
        return last or step == 1 or step % REPORT == 0 or step % self.plan.every == 0

    def report(
        self,
        step: int,
        total_loss: float,
        weights: Sequence[Tensor],
        valid_loss: Callable[[], float] | None,
        last: bool,
    ) -> bool:
        """Takes the sum of the losses since the last report, and validates where it is time; returns whether to stop.

        Raises `RunError` when the loss is not finite or has grown a hundredfold.
        """
        values = {"loss": total_loss / (step - self.reported)}
        if not self.reported:
            self.first = values["loss"]
        elif self.reported < REPORT and math.isfinite(total_loss):
            self.first = (total_loss + self.reported * self.first) / step
        self.reported = step
        if not math.isfinite(values["loss"]) or values["loss"] > DIVERGED * self.first:
            raise RunError(f"diverged at step {step} of {self.total}: loss {values['loss']:g}, at first {self.first:g}")
        if valid_loss is not None and (last or step % self.plan.every == 0):
            with torch.no_grad():
                values["valid"] = valid_loss()
            self.waited += 1
            if values["valid"] < self.best:
                self.best, self.kept, self.waited = values["valid"], [w.detach().clone() for w in weights], 0
        self.log(step, self.total, **values)
        return last or self.waited >= self.plan.patience

    def restore(self, weights: Sequence[Tensor]) -> None:
        """Puts the best of the validated weights back, where there are any."""
        with torch.no_grad():
            for weight, value in zip(weights if self.kept else [], self.kept, strict=True):
                weight.copy_(value)


def descend(
    weights: Sequence[Tensor],
    train_loss: Callable[[], Tensor],
    valid_loss: Callable[[], float] | None,
    *,
    plan: Plan,
    budget: Budget,
    log: Log,
) -> None:
    """Takes Adam steps on `weights`, in place, and leaves there the best of those that were validated.

    `train_loss` draws its own batch; without `valid_loss` the last weights stay. Raises `RunError` when the loss
    is not finite or has grown a hundredfold; the best weights are left then, too.
    """
    optimizer = torch.optim.Adam(weights, lr=plan.learning_rate, fused=True)
    total = budget.steps_of(plan.steps)
    share, course = budget.progress(total), Course(plan, total, log)
    since = torch.zeros((), device=weights[0].device)
    try:
        for step in range(1, total + 1):
            if plan.cosine:
                optimizer.param_groups[0]["lr"] = plan.learning_rate * _cosine(share(step))
            optimizer.zero_grad()
            loss = train_loss()
            loss.backward()  # type: ignore[no-untyped-call]
            if plan.clip is not None:
                torch.nn.utils.clip_grad_norm_(weights, plan.clip)
            optimizer.step()
            since += loss.detach()
            last = share(step) >= 1
            if course.due(step, last=last):
                if course.report(step, since.item(), weights, valid_loss, last):
                    break
                since.zero_()
    finally:
        course.restore(weights)


def _cosine(share: float) -> float:
    """Returns the part of the learning rate that is due when this share of a fit is done."""
    return min(1.0, share / WARM) * (1 + math.cos(math.pi * share)) / 2


@dataclass(frozen=True)
class Network:
    """Joins a fitted network and the scaling of what goes in and comes out."""

    layers: Layers
    scaling: Scaling

    @torch.no_grad()
    def predict(self, query: Query) -> Prediction:
        """Returns what the network says of any number of queries: one sample, no bodies."""
        inputs, device = self.scaling.inputs(query), self.layers[0][0].device
        outputs = [mlp(self.layers, chunk.to(device)).cpu() for chunk in torch.split(inputs, CHUNK)]
        return Prediction(dlo=self.scaling.positions(torch.cat(outputs), query)[None])

    def parameters(self) -> int:
        """Returns the number of weights and biases."""
        return size(self.layers)
