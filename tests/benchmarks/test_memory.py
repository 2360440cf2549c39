"""Measures the memory of a simulator that goes on pushing: it is flat in the number of pushes."""

from __future__ import annotations

import subprocess
import sys

PUSHES = 600
BOUND = 4_000_000  # bytes; were the set-points of every push kept, they alone would take more than twice as much

SCRIPT = """
import resource, sys
import numpy as np
from dlobench.domain import sample
from dlobench.world import starts
from dlobench.world.simulate import Simulator

rng = np.random.default_rng(0)
domain = sample(rng, material="soft", attachment="movable", length=0.1, rigid_objects=1)
simulator = Simulator(domain, 8)
simulator.reset([starts.sample(domain, rng) for _ in range(8)])

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)

def push(times):
    for number in range(times):
        simulator.push(np.full((8, 2), 0.004 * (-1) ** number))

push(50)
before = peak()
push(int(sys.argv[1]))
print(peak() - before)
"""


def test_memory_is_flat_in_the_number_of_pushes() -> None:
    """In a process of its own, whose peak nothing else has raised before."""
    grown = subprocess.run([sys.executable, "-c", SCRIPT, str(PUSHES)], capture_output=True, text=True, check=True)
    assert int(grown.stdout) < BOUND
