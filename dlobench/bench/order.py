"""Orders runs: what to run, checked before anything is generated or fitted."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from dlobench.bench.plugins import ModelPlugin, hyperparameters
from dlobench.bench.task import Fit, Task
from dlobench.data.domain_set import DomainSet, Part, ScaleName, Span
from dlobench.errors import UsageError
from dlobench.nn.budget import Budget

MOST_SEEDS = 1000
# of Linux, Jetson, WSL and ROCm
_ACCELERATORS = ("/dev/nvidiactl", "/dev/nvidia0", "/dev/nvhost-gpu", "/dev/dxg", "/dev/kfd")


@dataclass(frozen=True)
class Order:
    """Says what to run. Built by `order`, which checks it."""

    task: Task
    scale: ScaleName
    plugin: ModelPlugin
    fits: tuple[Fit, ...]
    K: tuple[int, ...]
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)  # hyperparameters that differ from their defaults
    budget: Budget = field(default_factory=Budget)
    device: str = "cpu"

    @property
    def of(self) -> DomainSet:
        """Returns the set that the task reads."""
        return self.task.of

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """Returns every hyperparameter of the model by name."""
        return hyperparameters(self.plugin.model) | dict(self.settings)

    @cached_property
    def spans(self) -> dict[Part, list[Span]]:
        """Returns the trajectories that the run reads, part by part."""
        return self.task.spans(self.scale)

    def seeded(self, seed: int) -> Order:
        """Returns the same order with another seed of the model."""
        return replace(self, seed=seed)


def order(task: Task, scale: ScaleName, plugin: ModelPlugin, K: int | None, horizon: int | None, **rest: Any) -> Order:
    """Checks and completes an order; raises `UsageError` naming the choices."""
    task.check(scale)
    recordable(hyperparameters(plugin.model) | dict(rest.get("settings", {})))
    chosen = task.scale(scale)
    if K is not None and not 0 <= K <= chosen.support:
        raise UsageError(
            f"--K {K} does not fit into the support pool of {chosen.support} trajectories of {task.name}/{scale}"
        )
    if horizon is not None and task.rolled:
        raise UsageError(f"--horizon {horizon}: {task.name} scores every horizon of one fit; leave it away")
    if horizon is not None and horizon not in task.horizon:
        raise UsageError(f"--horizon {horizon} is not one of {task.name}: {', '.join(map(str, task.horizon))}")
    fits = tuple(fit for fit in task.fits(scale) if horizon in (None, fit.horizon))
    return Order(task, scale, plugin, fits, chosen.K if K is None else (K,), **rest)


def parse_seeds(text: str) -> tuple[int, ...]:
    """Reads seeds such as 3, 0-4 or 0,7, in the order given; raises `UsageError` for anything else."""
    found: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,9})(?:-([0-9]{1,9}))?\s*", part)
        if match is None:
            raise UsageError(f"--seeds {text!r} is not a seed, a range such as 0-4 or a list such as 0,7")
        numbers = range(int(match[1]), int(match[2] or match[1]) + 1)
        if not 1 <= len(numbers) <= MOST_SEEDS - len(found):
            raise UsageError(f"--seeds {text!r} has an empty range, or more than {MOST_SEEDS} seeds")
        found += numbers
    if len(set(found)) < len(found):
        raise UsageError(f"--seeds {text!r} names a seed twice")
    return tuple(found)


def recordable(hyper: Mapping[str, Any]) -> dict[str, Any]:
    """Returns hyperparameters as a record can hold them; raises `UsageError` for a value that JSON has no word for."""
    out = {name: str(value) if isinstance(value, Path) else value for name, value in hyper.items()}
    for name, value in out.items():
        try:
            json.dumps(value, allow_nan=False).encode()
        except (TypeError, ValueError, RecursionError) as error:
            raise UsageError(
                f"hyperparameter {name} = {value!r} cannot be recorded as JSON; give it a value"
            ) from error
    return out


def resolve_device(device: str) -> str:
    """Returns "cpu" or "cuda"; raises `UsageError` for another name or a CUDA device that is not there.

    Asks torch only where a device may be: to import it here takes longer than many a fit.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise UsageError(f"unknown device {device!r}; there are: auto, cpu, cuda")
    there = False
    if device != "cpu" and any(Path(node).exists() for node in _ACCELERATORS):
        import torch

        there = torch.cuda.is_available()
    if device == "cuda" and not there:
        raise UsageError("--device cuda: there is no CUDA device here; cpu and auto are to be had")
    return "cuda" if there else "cpu"
