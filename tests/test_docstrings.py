"""Runs the examples in docstrings: what they say comes out does come out."""

from __future__ import annotations

import doctest
from importlib import import_module

import pytest

MODULES = [
    "dlobench.bench.calibration",
    "dlobench.bench.metrics",
    "dlobench.bench.ranking",
    "dlobench.bench.sampled",
    "dlobench.bench.statistics",
    "dlobench.bench.task",
    "dlobench.domain",
    "dlobench.trajectories",
]  # the example of `dlobench.load` needs data: test_reading.py has some


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_are_right(name: str) -> None:
    failed, attempted = doctest.testmod(import_module(name))
    assert attempted and not failed
