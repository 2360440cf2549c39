"""Keeps the tests to one thread of torch, the slow fresh clone to the end, and one Ray for all that need one."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)  # small networks gain nothing from more, and machines are shared


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the tests of the fresh clone last."""
    items.sort(key=lambda item: item.path.name == "test_clone.py")


@pytest.fixture(scope="session")
def ray_address() -> Iterator[str]:
    """Starts a Ray of one node, of two CPUs, as `ray start --head` does; returns its address."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'dlobench[cluster]'")
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)  # nodes find the tests' functions
        cluster = Cluster(
            initialize_head=True,
            head_node_args={"num_cpus": 2, "object_store_memory": 100_000_000, "include_dashboard": False},
        )
        yield cluster.address
        cluster.shutdown()
