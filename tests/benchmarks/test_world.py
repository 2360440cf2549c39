"""Measures the world: pushes per second of the batched simulator and, beside it, of the environment.

Run with `pytest tests/benchmarks --benchmark-enable`. Nothing is asserted about time: machines differ.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_domain import UNEQUAL, make

from dlobench.domain import RigidBody
from dlobench.trajectories import Trajectories
from dlobench.world import env
from dlobench.world.simulate import PUSHES, simulate

DOMAIN = make(
    attachment="movable",
    bodies=(UNEQUAL, RigidBody("bar3", (2000.0,) * 3, 0.3), RigidBody("T4", (2000.0,) * 4, 0.5)),
)
SEEDS = [[0], [1], [2], [3]]


@pytest.fixture(scope="module")
def reference() -> Trajectories:
    return simulate(DOMAIN, SEEDS)[0]


def test_simulator(benchmark: Any, reference: Trajectories) -> None:
    """One thread, starts and actions included."""
    made, _ = benchmark.pedantic(simulate, args=(DOMAIN, SEEDS), kwargs={"threads": 1}, rounds=3)
    np.testing.assert_array_equal(made.dlo, reference.dlo)
    report(benchmark)


def test_environment(benchmark: Any, reference: Trajectories) -> None:
    """The same pushes, one by one through `dm_control`'s Environment, noise and all."""

    def play() -> Any:
        worlds = [env.make(DOMAIN, seed) for seed in SEEDS]
        for world in worlds:
            world.reset()
        return [
            [world.step(command.astype(float)).observation["dlo"] for command in row]
            for world, row in zip(worlds, reference.commanded, strict=True)
        ]

    seen = benchmark.pedantic(play, rounds=3)
    # Commands were recorded as float32, so the pushes are the same to a tenth of a micrometre, not to the bit.
    np.testing.assert_allclose(np.array(seen)[:, 0, :32, :2], reference.dlo[:, 1, :32, :2], atol=1e-4)
    report(benchmark)


def report(benchmark: Any) -> None:
    """Adds what a reader asks for to the benchmark's record."""
    pushes = len(SEEDS) * PUSHES
    benchmark.extra_info["pushes"] = pushes
    if benchmark.stats is not None:  # None where benchmarks are disabled
        benchmark.extra_info["pushes_per_second"] = pushes / benchmark.stats.stats.median
