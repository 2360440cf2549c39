"""Keeps the state of a model in a file of safetensors: its arrays, and its tree as JSON among the metadata."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from dlobench.bench.revival import restore
from dlobench.bench.state import State, fault, flatten
from dlobench.data.store import atomic_write
from dlobench.errors import RunError

__all__ = ["State", "flatten", "read", "restore", "write"]


def write(path: Path, state: State) -> None:
    """Writes a state as safetensors, whole or not at all; the same state gives the same bytes. Raises `RunError`."""
    from safetensors.numpy import save

    if why := fault(state):
        raise RunError(f"cannot write {path}: {why}")
    arrays = {name: np.ascontiguousarray(each).reshape(each.shape) for name, each in state.arrays.items()}
    atomic_write(path, save(arrays, metadata={"tree": json.dumps(state.tree)}))


def read(path: Path) -> State:
    """Reads a state; raises `RunError` for what is none."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            tree = json.loads((file.metadata() or {})["tree"])
            state = State(tree, {name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
        if why := fault(state):
            raise ValueError(why)
        return state
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror or error}") from error
    except (SafetensorError, KeyError, ValueError, TypeError, RecursionError) as error:
        raise RunError(f"{path} does not hold weights: {error}") from error
