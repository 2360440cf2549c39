"""Prints how many times as fast as each of their peers simulator and readers were."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from rates import KEPT, TABLES, Rates, Tables, lines


@pytest.fixture
def two_threads(benchmark: BenchmarkFixture) -> Iterator[None]:
    """Gives torch two threads while something is measured, one otherwise."""
    before = torch.get_num_threads()
    torch.set_num_threads(2 if benchmark.enabled else 1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def rates(request: pytest.FixtureRequest) -> Rates:
    """Returns what this session has measured so far, to be added to."""
    return request.config.stash.setdefault(KEPT, {})


@pytest.fixture
def tables(request: pytest.FixtureRequest) -> Tables:
    """Returns the tables that this session prints at its end, to be added to."""
    return request.config.stash.setdefault(TABLES, {})


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Prints the tables, where anything was measured."""
    for title, rows in config.stash.get(TABLES, {}).items():
        terminalreporter.section(title)
        for line in rows:
            terminalreporter.write_line(line)
    if config.stash.get(KEPT, None):
        terminalreporter.section("pushes per second of processor time, three rigid objects")
        for line in lines(config.stash[KEPT]):
            terminalreporter.write_line(line)
