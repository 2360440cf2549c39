"""Keeps the tests to one thread of torch, and the slow fresh clone to the end."""

import pytest
import torch

torch.set_num_threads(1)  # small networks gain nothing from more, and machines are shared


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the tests of the fresh clone last."""
    items.sort(key=lambda item: item.path.name == "test_clone.py")
