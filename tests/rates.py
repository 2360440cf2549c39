"""Keeps what the sides of a benchmark made, to be printed beside each other at the end."""

from __future__ import annotations

from collections.abc import Iterator
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
