"""Saves what a fit has put into a model, and restores it: plain arrays and a JSON tree, never code.

Whatever a plugin keeps may be saved: arrays, tensors, numbers, texts, lists, dicts, and objects made of these, such as
dataclasses, `torch.nn.Module`s and the estimators of scikit-learn. An object is restored without calling its class,
which has to be imported already; that happens in the plugin's own process.
"""

from __future__ import annotations

import json
import math
import sys
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from types import BuiltinFunctionType, FunctionType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dlobench.bench.model import Model
from dlobench.data.store import atomic_write
from dlobench.errors import RunError, UsageError

Made = TypeVar("Made", bound=Model)

DEEP = 60  # levels of a tree
MANY = 200_000  # nodes of a tree
PLUGIN = "<plugin>"  # the module of a plugin's own classes, which has another name wherever it is loaded
_SEQUENCES: dict[str, type[Any]] = {"list": list, "tuple": tuple, "set": set, "frozenset": frozenset}
_DICTS: dict[str, type[Any]] = {"dict": dict, "OrderedDict": OrderedDict}


@dataclass(frozen=True)
class State:
    """Holds what a fit has put into a model."""

    tree: Any  # JSON
    arrays: dict[str, NDArray[Any]]


def flatten(model: Model) -> State:
    """Returns the state of a model of this process; raises `UsageError`, naming the field, for what cannot be saved."""
    walk = _Walk(type(model).__module__)
    return State({name: walk.node(value, name) for name, value in vars(model).items()}, walk.arrays)


def restore(cls: type[Made], state: State, *, device: str) -> Made:
    """Returns a model with a state, on a device; raises `UsageError` for a tree that is none of `flatten`'s."""
    model = object.__new__(cls)
    for name, node in state.tree.items():
        object.__setattr__(model, name, _value(node, state.arrays, cls.__module__, device))
    object.__setattr__(model, "device", device)
    return model


def write(path: Path, state: State) -> None:
    """Writes a state as safetensors, whole or not at all; the same state gives the same bytes."""
    from safetensors.numpy import save

    arrays = {name: np.ascontiguousarray(array) for name, array in state.arrays.items()}
    atomic_write(path, save(arrays, metadata={"tree": json.dumps(state.tree)}))


def read(path: Path) -> State:
    """Reads a state; raises `RunError` for what is none."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            tree = json.loads((file.metadata() or {})["tree"])
            return State(tree, {name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror or error}") from error
    except (SafetensorError, KeyError, ValueError) as error:
        raise RunError(f"{path} does not hold weights: {error}") from error


class _Walk:
    """Turns values into nodes: a plain value stands for itself, all else is a list that begins with its kind."""

    def __init__(self, plugin: str) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self._plugin, self._count, self._above = plugin, 0, list[int]()

    def node(self, value: Any, path: str) -> Any:
        """Returns the node of a value; `path` is how errors name it."""
        self._count += 1
        if self._count > MANY or len(self._above) > DEEP or id(value) in self._above:
            raise UsageError(f"{path} is too much to save as weights, or holds itself")
        if value is None or type(value) in (bool, str) or (type(value) is int and abs(value) < 2**53):
            return value
        if type(value) is float:
            return value if math.isfinite(value) else ["float", str(value)]
        self._above.append(id(value))
        try:
            return self._structure(value, path)
        finally:
            self._above.pop()

    def _structure(self, value: Any, path: str) -> Any:
        torch = sys.modules.get("torch")
        if torch is not None and isinstance(value, torch.Tensor):
            kind = "parameter" if isinstance(value, torch.nn.Parameter) else "tensor"
            return [kind, self._array(_numbers(value, path), path), bool(value.requires_grad)]
        if isinstance(value, np.ndarray | np.generic):
            return ["array" if isinstance(value, np.ndarray) else "number", self._array(np.asarray(value), path)]
        for kind, cls in _SEQUENCES.items():
            if type(value) is cls:
                ordered = sorted(value, key=repr) if kind.endswith("set") else value
                return [kind, [self.node(each, f"{path}[{i}]") for i, each in enumerate(ordered)]]
        for kind, cls in _DICTS.items():
            if type(value) is cls:
                return [kind, [[self.node(k, f"{path} key"), self.node(v, f"{path}[{k!r}]")] for k, v in value.items()]]
        if isinstance(value, FunctionType | BuiltinFunctionType | type):
            return ["name", *self._name(value, path)]
        fields = dict(getattr(value, "__dict__", {}))
        slots = [name for cls in type(value).__mro__ for name in getattr(cls, "__slots__", ())]
        fields |= {name: getattr(value, name) for name in slots if hasattr(value, name) and name != "__weakref__"}
        if not fields or isinstance(value, tuple | list | dict | Model):
            raise UsageError(f"{path} is of {type(value).__name__}, which weights cannot hold")
        named = self._name(type(value), path)
        return ["object", *named, {name: self.node(field, f"{path}.{name}") for name, field in fields.items()}]

    def _array(self, array: NDArray[Any], path: str) -> str:
        if array.dtype.kind not in "fiub" or array.dtype.itemsize > 8:
            raise UsageError(f"{path} is an array of {array.dtype}, which weights cannot hold")
        self.arrays[path] = array
        return path

    def _name(self, value: Any, path: str) -> list[str]:
        module, name = str(getattr(value, "__module__", None)), str(getattr(value, "__qualname__", None))
        if _find(module, name) is not value:
            raise UsageError(f"{path} needs {name} of {module}, which cannot be found by that name")
        return [PLUGIN if module == self._plugin else module, name]


def _numbers(tensor: Any, path: str) -> NDArray[Any]:
    try:
        numbers: NDArray[Any] = tensor.detach().cpu().numpy()
    except (TypeError, RuntimeError) as error:
        raise UsageError(f"{path} is a tensor of {tensor.dtype}, which weights cannot hold") from error
    return numbers


def _find(module: str, name: str) -> Any:
    """Returns what a module that is imported already calls by a name, or None."""
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


def _value(node: Any, arrays: dict[str, NDArray[Any]], plugin: str, device: str) -> Any:
    """Returns what a node stands for."""
    if not isinstance(node, list):
        return node
    kind, *rest = node

    def value(inner: Any) -> Any:
        return _value(inner, arrays, plugin, device)

    if kind in _SEQUENCES:
        return _SEQUENCES[kind](value(each) for each in rest[0])
    if kind in _DICTS:
        return _DICTS[kind]((value(key), value(each)) for key, each in rest[0])
    if kind not in ("name", "object"):
        return _numeric(kind, rest, arrays, device)
    found = _find(plugin if rest[0] == PLUGIN else rest[0], rest[1])
    if found is None or (kind == "object" and not isinstance(found, type)):
        raise UsageError(f"weights need {rest[1]} of {rest[0]}, which the plugin has not imported")
    if kind == "object":
        found = object.__new__(found)
        for name, each in rest[2].items():
            object.__setattr__(found, name, value(each))
    return found


def _numeric(kind: str, rest: list[Any], arrays: dict[str, NDArray[Any]], device: str) -> Any:
    """Returns the number, array or tensor that a node stands for."""
    if kind == "float":
        return float(rest[0])
    if kind in ("array", "number"):
        return arrays[rest[0]].copy() if kind == "array" else arrays[rest[0]][()]
    if kind not in ("tensor", "parameter"):
        raise UsageError(f"weights hold {kind!r}, which is no kind of theirs")
    import torch

    tensor = torch.from_numpy(arrays[rest[0]].copy()).to(device)
    return tensor.requires_grad_(rest[1]) if kind == "tensor" else torch.nn.Parameter(tensor, rest[1])
