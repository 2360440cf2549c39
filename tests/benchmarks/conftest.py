"""Prints how many times as fast as each of its peers the shipped simulator was."""

from __future__ import annotations

from typing import Any

import pytest
from rates import KEPT, Rates, lines


@pytest.fixture
def rates(request: pytest.FixtureRequest) -> Rates:
    """Returns what this session has measured so far, to be added to."""
    return request.config.stash.setdefault(KEPT, {})


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Prints the table, where anything was measured."""
    if config.stash.get(KEPT, None):
        terminalreporter.section("pushes per second of processor time, three rigid objects")
        for line in lines(config.stash[KEPT]):
            terminalreporter.write_line(line)
