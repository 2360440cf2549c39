"""Runs Adam on any loss until it is converged or the budget is spent, and fits networks so."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dlobench.errors import RunError, UsageError
from dlobench.nn.budget import Budget, Log
from dlobench.nn.networks import Layers, detached, flat, initial, mlp, size, weighted_mse
from dlobench.nn.windows import COORDINATES, Scaling, Target, Windows, standardise
from dlobench.trajectories import Prediction, Query, Trajectories

REPORT = 25  # steps between two entries of the learning curve
WARM = 0.05  # share of a fit in which a cosine rate rises
DIVERGED = 100.0  # times the first loss
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
    is not finite or has grown a hundredfold.
    """
    optimizer = torch.optim.Adam(weights, lr=plan.learning_rate, fused=True)
    total = budget.steps_of(plan.steps)
    share = budget.progress(total)
    first, since, reported = math.nan, torch.zeros((), device=weights[0].device), 0
    best, kept, waited = math.inf, [w.detach().clone() for w in weights], 0
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
        validate = valid_loss is not None and (last or step % plan.every == 0)
        if step == 1 or step % REPORT == 0 or last or validate:
            values = {"loss": since.item() / (step - reported)}  # reading the loss at every step would stall a GPU
            since, reported = since.zero_(), step
            first = values["loss"] if step == 1 else first
            if not math.isfinite(values["loss"]) or values["loss"] > DIVERGED * first:
                raise RunError(f"diverged at step {step} of {total}: loss {values['loss']:g}, at first {first:g}")
            if validate and valid_loss is not None:
                with torch.no_grad():
                    values["valid"] = valid_loss()
                if values["valid"] < best:
                    best, kept, waited = values["valid"], [w.detach().clone() for w in weights], 0
                else:
                    waited += 1
            log(step, total, **values)
        if last or waited >= plan.patience:
            break
    if valid_loss is not None and best < math.inf:
        with torch.no_grad():
            for weight, value in zip(weights, kept, strict=True):
                weight.copy_(value)


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


@dataclass(frozen=True)
class Regression:
    """Says what to regress: which network on which representation, how fast and for how long."""

    width: int
    depth: int  # hidden layers
    bodies: bool  # whether the rigid bodies are features
    target: Target
    batch: int  # windows
    plan: Plan
    normalise: bool = True
    epochs: int | None = None  # instead of the plan's patience: validates once an epoch, waits for so many

    def __post_init__(self) -> None:
        positive(self, "width", "depth", "batch", *(["epochs"] if self.epochs is not None else []))

    def plan_of(self, windows: int) -> Plan:
        """Returns the plan for a training set of so many windows."""
        if self.epochs is None:
            return self.plan
        return replace(self.plan, every=max(1, windows // self.batch), patience=self.epochs)


def regress(
    how: Regression,
    train: Sequence[Trajectories],
    valid: Sequence[Trajectories],
    *,
    horizon: int,
    seed: int,
    device: str,
    budget: Budget,
    log: Log,
) -> Network:
    """Fits one network to the windows of all training domains, pooled, and stops on the validation domains.

    Raises `RunError` when there is nothing to learn from, on values that are not finite, or when the fit diverges.
    """
    windows, scaling = standardise(
        train, horizon=horizon, bodies=how.bodies, target=how.target, normalise=how.normalise, device=device
    )
    unseen = scaling.windows(valid, device) if valid else None
    generator = torch.Generator().manual_seed(seed)
    sizes = [windows.inputs.shape[-1], *[how.width] * how.depth, COORDINATES]
    layers = initial(sizes, generator, device)

    def train_loss() -> Tensor:
        index = torch.randint(len(windows), (how.batch,), generator=generator).to(device)
        inputs, targets, weight = windows.pick(index)
        return weighted_mse(mlp(layers, inputs), targets, weight)

    def valid_loss(of: Windows) -> float:
        chunks = [of.pick(slice(i, i + CHUNK)) for i in range(0, len(of), CHUNK)]
        return sum(float(weighted_mse(mlp(layers, x), y, w)) * len(x) for x, y, w in chunks) / len(of)

    check = None if unseen is None else lambda: valid_loss(unseen)
    descend(flat(layers), train_loss, check, plan=how.plan_of(len(windows)), budget=budget, log=log)
    return Network(detached(layers), scaling)
