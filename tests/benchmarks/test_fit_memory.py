"""Measures the memory of fits to a million pushes, the size that the paper's single domains end at."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from rates import Tables

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
