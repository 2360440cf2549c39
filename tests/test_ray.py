"""Tests generation by Ray: the same bytes as on this machine, a lost node, a lost process, Ctrl-C."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dlobench.data import ray_cluster
from dlobench.data.domain_set import Unit
from dlobench.data.executors import find_executor
from dlobench.data.generate import generate, make_unit
from dlobench.data.sets import SETS
from dlobench.data.store import Store
from dlobench.errors import RunError

pytest.importorskip("ray", reason="Ray is not installed: pip install 'dlobench[cluster]'")
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning:ray")

META = SETS["meta-learning"]
UNITS = [Unit(META.name, domain, 0, 1) for domain in range(0, 6300, 420)]
DLOBENCH = Path(sys.executable).with_name("dlobench")
MEMORY = 100_000_000  # bytes, of a node's object store


def digests(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.npy")}


def wait_for(path: Path, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not path.exists():
        assert time.monotonic() < end, f"{path} never came"
        time.sleep(0.02)


def quiet(done: int, total: int) -> None:
    """Listens to no progress."""


def make_unless_doomed(unit: Unit, store: Store, doomed: str, notes: Path) -> Unit:
    """Makes a unit; on the doomed node the second one never ends."""
    import ray

    node = ray.get_runtime_context().get_node_id()
    (notes / f"{unit.domain}-{node}").touch()
    if node == doomed and len(list(notes.glob(f"*-{doomed}"))) == 2:
        (notes / "busy").touch()
        time.sleep(600)
    return make_unit(unit, store, META)


def die_once(number: int, folder: Path) -> int:
    if number == 1 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_always(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)  # nodes find these functions


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Returns what this machine makes of the units."""
    folder = tmp_path_factory.mktemp("here")
    generate(Store(folder), META, UNITS, find_executor("local", workers=2), quiet)
    return digests(folder)


@pytest.fixture
def two_nodes(environment: None) -> Iterator[tuple[Any, Any]]:
    """Starts a cluster of two nodes, of a CPU each; returns it and the node that is not its head."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 1, "object_store_memory": MEMORY, "include_dashboard": False},
    )
    node = cluster.add_node(num_cpus=1, object_store_memory=MEMORY)
    yield cluster, node
    cluster.shutdown()


@pytest.mark.faults
def test_what_a_lost_node_was_at_is_done_elsewhere(
    here: dict[str, bytes], two_nodes: tuple[Any, Any], tmp_path: Path
) -> None:
    cluster, node = two_nodes
    notes, store = tmp_path / "notes", Store(tmp_path / "data")
    notes.mkdir()

    def remove() -> None:
        wait_for(notes / "busy")
        cluster.remove_node(node, allow_graceful=False)

    thread = threading.Thread(target=remove)
    thread.start()
    make = partial(make_unless_doomed, store=store, doomed=node.node_id, notes=notes)
    made = list(find_executor("ray", address=cluster.address)(make, UNITS))
    thread.join()
    assert sorted(made, key=UNITS.index) == UNITS
    assert digests(store.root) == here
    begun = [path.name.partition("-")[0] for path in notes.glob("*-*")]
    assert len(begun) > len(set(begun)) == len(UNITS), "what was lost has been done again"


def test_the_command_line_makes_the_same_bytes_on_a_ray_of_its_own(tmp_path: Path) -> None:
    of_one = list(META.units(META.spans("mini")[:1]))
    generate(Store(tmp_path / "here"), META, of_one, find_executor("local", workers=1), quiet)
    options = ["--domains", "1", "--executor", "ray", "--workers", "1", "--data", str(tmp_path / "there")]
    command = [str(DLOBENCH), "generate", META.name, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert digests(tmp_path / "there") == digests(tmp_path / "here")
    lines = done.stderr.splitlines()
    assert [line.split()[0] for line in lines] == ["data:", "generating", "data:"], "Ray keeps quiet"
    assert "400/400 pushes" in lines[1]
    assert lines[2].startswith("data: 1 shards generated, 400 pushes in ")


def test_ctrl_c_ends_ray_and_keeps_what_is_done(tmp_path: Path) -> None:
    command = [DLOBENCH, "generate", META.name, "--domains", "9", "--executor", "ray", "--workers", "1"]
    process = subprocess.Popen(
        [*map(str, command), "--data", str(tmp_path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    first = Store(tmp_path).path(META, next(iter(META.units(META.spans("mini")))))
    try:
        wait_for(first.with_suffix(".json"))
        os.killpg(process.pid, signal.SIGINT)  # what a terminal sends
        _, said = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 130, said
    assert said.splitlines()[-1].startswith("dlobench: interrupted")
    assert "Traceback" not in said
    assert first.exists()


def test_a_piece_that_lost_its_process_is_done_again(ray_address: str, tmp_path: Path) -> None:
    results = find_executor("ray", address=ray_address)(partial(die_once, folder=tmp_path), range(3))
    assert sorted(results) == [0, 1, 2]
    assert (tmp_path / "died").exists()


def test_what_a_node_cannot_import_is_one_sentence(
    ray_address: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "only_here.py").write_text("def function(piece):\n    return piece\n")
    monkeypatch.syspath_prepend(tmp_path)
    function = importlib.import_module("only_here").function
    with pytest.raises(RunError, match=r"a node lacks .*No module named 'only_here'") as failure:
        list(find_executor("ray", address=ray_address)(function, [0]))
    assert "\n" not in str(failure.value)


def test_a_piece_that_always_kills_its_process_ends_it(ray_address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_cluster, "RETRIES", 1)
    with pytest.raises(RunError, match="Ray gave up on a piece of work"):
        list(find_executor("ray", address=ray_address)(die_always, [0]))
