"""Measures the world: pushes per second of the batched simulator and, beside it, of the environment.

Run with `pytest tests/benchmarks --benchmark-enable`. Nothing is asserted about time: machines differ.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dlobench.domain import ATTACHMENTS, MATERIALS, sample
from dlobench.trajectories import Trajectories
from dlobench.world import env
from dlobench.world.simulate import PUSHES, simulate

# Three rigid bodies in each; every material and attachment once, since a single domain says little.
DOMAINS = [
    sample(np.random.default_rng([2021, i]), material=material, attachment=ATTACHMENTS[i], length=0.16, rigid_objects=3)
    for i, material in enumerate(MATERIALS)
]
SEED = 0
SEEDS = [[SEED, trajectory] for trajectory in range(8)]


@pytest.fixture(scope="module")
def reference() -> list[Trajectories]:
    return [simulate(domain, SEEDS)[0] for domain in DOMAINS]


def test_simulator(benchmark: Any, reference: list[Trajectories]) -> None:
    """One thread, starts and actions included."""
    made = benchmark.pedantic(lambda: [simulate(domain, SEEDS, threads=1)[0] for domain in DOMAINS], rounds=3)
    for one, two in zip(made, reference, strict=True):
        np.testing.assert_array_equal(one.dlo, two.dlo)
    report(benchmark)


def test_environment(benchmark: Any, reference: list[Trajectories]) -> None:
    """The same pushes, one by one through `dm_control`'s Environment, noise and all."""

    def play() -> Any:
        seen = []
        for domain, made in zip(DOMAINS, reference, strict=True):
            world = env.make(domain, SEED)
            for row in made.commanded:
                world.reset()
                seen.append([world.step(command.astype(float)).observation["dlo"] for command in row])
        return np.array(seen)

    seen = benchmark.pedantic(play, rounds=3)
    # Commands were recorded as float32, so the first pushes are the same to a tenth of a millimetre, not to the bit.
    first = np.concatenate([made.dlo[:, 1, :32, :2] for made in reference])
    np.testing.assert_allclose(seen[:, 0, :32, :2], first, atol=1e-4)
    report(benchmark)


def report(benchmark: Any) -> None:
    """Adds what a reader asks for to the benchmark's record."""
    pushes = len(DOMAINS) * len(SEEDS) * PUSHES
    benchmark.extra_info["pushes"] = pushes
    if benchmark.stats is not None:  # None where benchmarks are disabled
        benchmark.extra_info["pushes_per_second"] = pushes / benchmark.stats.stats.median
