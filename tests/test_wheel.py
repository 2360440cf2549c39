"""Tests the wheel as a stranger meets it: in a fresh environment, far from any checkout, in an empty folder.

The environment is fresh but for the dependencies, which a .pth file lends from the one that runs the tests: to install
them again would take minutes. A path in a .pth file brings in none of the .pth files there, so no other dlobench.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
from test_cli import mini  # noqa: F401

import dlobench
from dlobench.bench.results import read_all

ROOT = Path(__file__).parents[1]
ROW = "meta/trajectories20-h4-k10"


def called(*command: object, folder: Path, **environment: str) -> str:
    """Calls a command in a folder, with nothing of this process's Python, and returns what it prints."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "DLOBENCH"))}
    done = subprocess.run(
        [str(word) for word in command],
        cwd=folder, env=kept | {"OMP_NUM_THREADS": "1"} | environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Builds the wheel from a copy of the sources, so that nothing is left among them."""
    if not (ROOT / "pyproject.toml").exists():
        pytest.skip("a wheel is built from a checkout")
    sources = tmp_path_factory.mktemp("sources")
    for name in ("dlobench", "models", "tasks"):
        shutil.copytree(ROOT / name, sources / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    called(sys.executable, "-c", build, sources / "dist", folder=sources)
    (built,) = (sources / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Installs the wheel into a fresh environment and returns its folder of programs."""
    folder = tmp_path_factory.mktemp("environment")
    called(sys.executable, "-m", "venv", "--without-pip", folder, folder=folder)
    programs = folder / Path(sysconfig.get_path("scripts", "venv", {"base": "."}))
    called(
        sys.executable, "-m", "pip", "--python", programs / "python", "install", "--quiet", "--no-deps", "--no-index",
        "--disable-pip-version-check", wheel, folder=folder,
    )  # fmt: skip
    site = folder / Path(sysconfig.get_path("purelib", "venv", {"base": "."}))
    lent = dict.fromkeys(path for path in sys.path if Path(path).name == "site-packages")
    (site / "lent.pth").write_text("".join(f"{path}\n" for path in lent))
    return programs


def test_the_wheel_holds_every_file_of_the_packages(wheel: Path) -> None:
    tracked = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "dlobench", "models", "tasks"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if tracked.returncode:
        pytest.skip("what belongs to it is known of a checkout only")
    wanted = {name if name.startswith("dlobench/") else f"dlobench/{name}" for name in tracked.stdout.split()}
    assert {"dlobench/world/styles/wood.toml", "dlobench/bench/page/page.js", "dlobench/models/maml.py"} <= wanted
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == wanted, "and nothing else"


def test_a_stranger_gets_a_row_in_an_empty_folder(environment: Path, mini: Path, tmp_path: Path) -> None:  # noqa: F811
    program, data = environment / "dlobench", {"DLOBENCH_DATA": str(mini)}
    where = called(environment / "python", "-c", "import dlobench; print(dlobench.__file__)", folder=tmp_path)
    assert Path(where.strip()).is_relative_to(environment.parent)
    assert not any(tmp_path.iterdir())
    command = (program, "run", "--task", "meta", "--model", "maml", "--K", "10", "--max-steps", "2")
    (row,) = [line.split() for line in called(*command, folder=tmp_path, **data).splitlines() if line.startswith(ROW)]
    assert row[1] == "1" and row[2].startswith("maml@")
    (record,) = read_all(tmp_path / "runs")
    assert record.provenance.versions["dlobench"] == dlobench.__version__
    assert (tmp_path / "runs" / "leaderboard.csv").read_text().count(ROW) == 1
    called(program, "leaderboard", "build", "--results", "runs", folder=tmp_path)
    assert ROW in (tmp_path / "runs" / "index.html").read_text()
