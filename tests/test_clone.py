"""Tests what a newcomer does: clone, `make run`, read the board. The slowest test, a few minutes on two cores."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from dlobench.bench.record import Record
from dlobench.bench.results import read_all

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Clone:
    """Holds a fresh clone in which `make run` was called once."""

    folder: Path
    data: Path
    cloned: float  # time
    first: subprocess.CompletedProcess[str]

    def call(self, *command: str) -> subprocess.CompletedProcess[str]:
        """Calls a command in the clone."""
        return called(self.folder, self.data, *command)


def called(folder: Path, data: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Calls a command in a folder, with nothing of this process's Python but the packages."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "MAKE"))}
    environment |= {
        "DLOBENCH_DATA": str(data),
        "OMP_NUM_THREADS": "1",
        "PIP_NO_BUILD_ISOLATION": "0",  # pip reads 0 as: no isolation; setuptools comes from this environment
    }
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Clone:
    """Clones the commit that is checked out, lends it this environment's packages, and calls `make run`."""
    if not (ROOT / ".git").exists() or not shutil.which("git") or not shutil.which("make"):
        pytest.skip("a clone needs a checkout, git and make")
    outside = tmp_path_factory.mktemp("clone")
    folder, data = outside / "dlobench-clone", outside / "data"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
    cloned = time.time()
    # Only the packages are lent: a path in a .pth file brings in none of the .pth files there, so no other dlobench.
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / ".venv")], check=True)
    paths = sysconfig.get_paths()
    site = sysconfig.get_path("purelib", "venv", {"base": str(folder / ".venv"), "platbase": str(folder / ".venv")})
    lent = dict.fromkeys([paths["purelib"], paths["platlib"]])
    (Path(site) / "lent.pth").write_text("".join(f"{path}\n" for path in lent))
    first = called(folder, data, "make", "run", "ARGS=--max-steps 300")
    assert first.returncode == 0, first.stdout + first.stderr
    return Clone(folder, data, cloned, first)


def test_the_clone_runs_its_own_code(clone: Clone, tmp_path: Path) -> None:
    code = (
        "import dlobench; from dlobench.bench.plugins import find; import dlobench.world.scene as scene;"
        "print(dlobench.__file__, scene.__file__, find('models')['maml'].path, find('tasks')['meta'].path, sep='\\n')"
    )
    done = called(tmp_path, clone.data, str(clone.folder / ".venv" / "bin" / "python"), "-c", code)
    assert done.returncode == 0, done.stderr
    found = [Path(line).resolve() for line in done.stdout.splitlines()]
    assert found == [
        (clone.folder / name).resolve()
        for name in ("dlobench/__init__.py", "dlobench/world/scene.py", "models/maml.py", "tasks/meta.py")
    ]


def test_make_run_prints_the_board(clone: Clone) -> None:
    rows = [line.split() for line in clone.first.stdout.splitlines()]
    (row,) = [row for row in rows if row and row[0] == "meta/trajectories20-h4-k10"]
    assert row[1] == "1", "its place"
    assert row[2].startswith("maml@")
    assert "0 shards reused" in clone.first.stderr


def test_make_run_makes_data_and_record(clone: Clone) -> None:
    shards = list(clone.data.rglob("*.npy"))
    assert len(shards) == len(list(clone.data.rglob("*.json"))) == 72
    (record,) = read_all(clone.folder / "runs")
    for path in [*shards, record.path(clone.folder / "runs"), clone.folder / "runs" / "leaderboard.csv"]:
        assert path.stat().st_mtime > clone.cloned
    head = clone.call("git", "rev-parse", "HEAD").stdout.strip()
    assert (record.provenance.commit, record.provenance.dirty) == (head, False)
    assert record.provenance.budget["steps"] == 300


def test_make_run_again_reuses_everything(clone: Clone) -> None:
    before = {path: path.stat().st_mtime_ns for path in clone.data.rglob("*.*")}
    again = clone.call("make", "run", "ARGS=--max-steps 300")
    assert again.returncode == 0, again.stderr
    assert "all 72 shards reused" in again.stderr
    assert "reused the record" in again.stderr
    assert "meta/trajectories20-h4-k10" in again.stdout
    assert {path: path.stat().st_mtime_ns for path in clone.data.rglob("*.*")} == before


def test_the_clone_stays_clean(clone: Clone) -> None:
    assert clone.call("git", "status", "--porcelain").stdout == ""


@pytest.mark.parametrize("model", ["multitask", "models/mlp.py", "maml"])
def test_what_learns_beats_standing_still(model: str, clone: Clone, tmp_path: Path) -> None:
    command = [".venv/bin/dlobench", "run", "--task", "meta", "--model", model, "--max-steps", "1500", "--K", "10"]
    done = clone.call(*command, "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    record: Record
    (record,) = read_all(tmp_path / "out")
    (cell,) = record.cells
    assert cell.skill > 0.1
    assert record.parameters > 5000
    assert record.fits[0].curve[-1]["step"] <= 1500
