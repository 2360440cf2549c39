"""Limits a fit and listens to it: `Budget` says when to stop, `Log` carries the learning curves."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from dlobench.errors import UsageError

Listener = Callable[[int, int, dict[str, float]], None]


@dataclass(frozen=True)
class Budget:
    """Limits a fit; None is no limit. A model's own number of steps is cut to it, never raised.

    Raises `UsageError` for less than one step or for negative minutes; 0 minutes are one step.
    """

    steps: int | None = None
    minutes: float | None = None

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise UsageError(f"a budget of {self.steps} steps is none: it takes 1 or more")
        if self.minutes is not None and not self.minutes >= 0:
            raise UsageError(f"a budget of {self.minutes} minutes is none: it takes 0 or more")

    def steps_of(self, wanted: int) -> int:
        """Returns the steps to take when a model wants `wanted`."""
        return wanted if self.steps is None else min(wanted, self.steps)

    def progress(self, total: int) -> Callable[[int], float]:
        """Starts the clock and returns a function of the step that tells which share of the budget is spent, 0 to 1."""
        start, seconds = time.monotonic(), math.inf if self.minutes is None else 60 * self.minutes
        return lambda step: min(1.0, max(step / total, (time.monotonic() - start) / seconds if seconds else 1.0))


@dataclass
class Log:
    """Carries a fit's progress to whoever listens: the record, the progress bar."""

    listeners: list[Listener] = field(default_factory=list)

    def __call__(self, step: int, total: int, **values: float) -> None:
        """Reports that `step` of `total` steps are done, with losses or other curve values by name."""
        for listener in self.listeners:
            listener(step, total, values)
