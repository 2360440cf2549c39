"""Keeps what the sides of a benchmark made, to be printed beside each other at the end."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest


@dataclass(frozen=True)
class Rate:
    """Holds what one side made."""

    pushes: float  # a second
    shipped: float | None = None  # how many times as fast the shipped simulator was on the same pushes


Rates = dict[str, Rate]  # by side, in the order in which they were measured

KEPT = pytest.StashKey[Rates]()

Tables = dict[str, list[str]]  # lines by title, of what is not counted in pushes per second

TABLES = pytest.StashKey[Tables]()


def lines(rates: Rates) -> Iterator[str]:
    """Yields a line a side."""
    for side, rate in rates.items():
        yield f"{side:44}{rate.pushes:8.1f}" + (f"   shipped is {rate.shipped:.2f} ×" if rate.shipped else "")


def paired(one: Callable[[], object], other: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Returns the median seconds of two functions that take turns."""
    found: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        for function, times in zip((one, other), found, strict=True):
            begin = time.perf_counter()
            function()
            times.append(time.perf_counter() - begin)
    return statistics.median(found[0]), statistics.median(found[1])
