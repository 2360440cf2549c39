"""Measures memory: of a simulator that goes on pushing, and of fits to a million pushes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from rates import Tables

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


TRAIN = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from toy import toy_domains
from dlobench.bench.model import Setting
from dlobench.bench.plugins import load_model
from dlobench.nn.budget import Budget

model = load_model(sys.argv[2]).model()
many = toy_domains(1, trajectories=50_000, pushes=20, segments=32)
Path("/proc/self/clear_refs").write_text("5")  # making them does not count
model.fit(many, many[0:0], Setting(horizon=1, K=(0,), budget=Budget(steps=30)))
[line] = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
print(1024 * int(line.split()[1]))
"""
RESIDENT = 3e9  # bytes
TABLE = "resident memory of a fit to a million pushes, at its highest, GB"


@pytest.mark.skipif(sys.platform != "linux", reason="the peak of resident memory is read, and set back, in /proc")
@pytest.mark.parametrize("model", ["mlp", "gnn"])
def test_a_million_pushes_are_trained_on_in_three_gigabytes(model: str, tables: Tables) -> None:
    """Data, features, libraries and the fit itself, in a process of its own."""
    tests = str(Path(__file__).parent.parent)
    done = subprocess.run([sys.executable, "-c", TRAIN, tests, model], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    tables.setdefault(TABLE, []).append(f"{model:28}{int(done.stdout) / 1e9:10.2f}")
    assert int(done.stdout) < RESIDENT
