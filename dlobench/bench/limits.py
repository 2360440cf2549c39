"""Limits what a plugin may take of the machine."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field

from dlobench.errors import UsageError


def _most_memory() -> int:
    """Returns three quarters of this machine's memory, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 3 // 4


@dataclass(frozen=True)
class Limits:
    """Limits what a plugin may take."""

    seconds: float = 6 * 3600.0  # of wall time, for each call of fit, adapt and predict
    memory: int = field(default_factory=_most_memory)  # bytes, the training data aside
    processes: int = 64
    output: int = 2**20  # bytes that it prints, for each call


def limits(seconds: float, gigabytes: float | None) -> Limits:
    """Returns limits of time and memory (GB); raises `UsageError` for one that is not a finite number above 0."""
    for option, value in (("--time-limit", seconds), ("--memory-limit", gigabytes)):
        if value is not None and not (math.isfinite(1e9 * value) and value > 0):
            raise UsageError(f"{option} {value} is not a finite number above 0")
    return Limits(seconds) if gigabytes is None else Limits(seconds, math.ceil(gigabytes * 1e9))
