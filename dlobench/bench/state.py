"""Takes out of a model what a fit has put into it: plain arrays and a JSON tree, never code.

Whatever a plugin keeps may be taken: arrays, tensors, numbers, texts, lists, dicts, and objects made of these, such as
dataclasses, `torch.nn.Module`s and the estimators of scikit-learn. Functions and classes are taken by their names.
"""

from __future__ import annotations

import json
import math
import sys
import weakref
from collections import OrderedDict
from dataclasses import dataclass
from enum import Enum
from types import BuiltinFunctionType, FunctionType, MemberDescriptorType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench.bench.model import Model
from dlobench.errors import UsageError

DEEP = 60  # levels of what a model holds
MANY = 200_000  # values that a model holds
MOST = 2**31  # bytes of its arrays
PLUGIN = "<plugin>"  # the module of a plugin's own classes, which has another name wherever it is loaded
_TEXT = 2**25  # characters of a tree; safetensors reads headers of up to 10⁸ bytes
_DTYPES = {"bool", "float16", "float32", "float64", *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64))}
SEQUENCES: dict[str, type[Any]] = {"list": list, "tuple": tuple, "set": set, "frozenset": frozenset}
NAMED = FunctionType, BuiltinFunctionType, np.ufunc, type  # what stands in a module, and is found there by its name
DICTS: dict[str, type[Any]] = {"dict": dict, "OrderedDict": OrderedDict}


@dataclass(frozen=True)
class State:
    """Holds what a fit has put into a model: its arrays are the model's own until they are written or sent."""

    tree: Any  # JSON
    arrays: dict[str, NDArray[Any]]


def flatten(model: Model) -> State:
    """Returns the state of a model of this process; raises `UsageError`, naming the field, for what cannot be saved."""
    walk = _Walk(type(model).__module__)
    state = State({name: walk.node(value, name) for name, value in vars(model).items()}, walk.arrays)
    if why := fault(state):
        raise UsageError(f"{type(model).__name__} cannot be saved as weights: {why}")
    return state


def fault(state: State) -> str:
    """Says what is wrong with the form or size of a state that someone else has made; nothing where nothing is."""
    if not isinstance(state.tree, dict):
        return "the tree is no JSON object"
    count, level = 0, [state.tree]
    for _ in range(4 * DEEP):  # a dict takes three levels of JSON
        count += len(level)
        if count > 8 * MANY:
            return "the tree is too large"
        inner = (each.values() if isinstance(each, dict) else each for each in level if isinstance(each, dict | list))
        level = [one for each in inner for one in each]
    if level:
        return "the tree is too deep"
    if len(state.arrays) > MANY or len(json.dumps(state.tree)) > _TEXT:
        return "there are too many arrays, or too much text"
    for name, array in state.arrays.items():
        if array.dtype.name not in _DTYPES or name == "__metadata__" or not name.isascii():
            return f"{name[:200]!a} is an array of {array.dtype}, which weights cannot hold, or not under that name"
    held = sum(array.nbytes for array in state.arrays.values())
    return f"there are {held / 1e9:.3g} GB of arrays, up to {MOST / 1e9:.3g} are kept" if held > MOST else ""


class _Walk:
    """Turns values into nodes: a plain value stands for itself, all else is a list that begins with its kind."""

    def __init__(self, plugin: str) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self._plugin, self._count, self._above = plugin, 0, list[int]()
        self._known: dict[int, tuple[object, list[Any]]] = {}  # arrays and tensors that had their turn, by id

    def node(self, value: Any, path: str) -> Any:
        """Returns the node of a value; `path` is how errors name it."""
        self._count += 1
        if self._count > MANY or len(self._above) > DEEP:
            raise UsageError(f"{path} is too much for weights: {MANY} values and {DEEP} levels are kept")
        if value is None or type(value) in (bool, str) or (type(value) is int and abs(value) < 2**64):
            return value
        if type(value) is float:
            return value if math.isfinite(value) else ["float", str(value)]
        if id(value) in self._above:
            raise UsageError(f"{path} holds itself, which weights cannot")
        self._above.append(id(value))
        try:
            if isinstance(value, NAMED):
                return ["named", *self._name(value, path)]
            return self._numeric(value, path) or self._structure(value, path)
        finally:
            self._above.pop()

    def _numeric(self, value: Any, path: str) -> list[Any] | None:
        """Returns the node of a number, array or tensor, the same for one that is held twice; else None."""
        if id(value) in self._known:
            return self._known[id(value)][1]
        torch = sys.modules.get("torch")
        if type(value) is np.ndarray or isinstance(value, np.generic):
            node = ["array" if type(value) is np.ndarray else "number", *self._array(np.asarray(value), path)]
        elif torch is not None and type(value) in (torch.Tensor, torch.nn.Parameter):
            name, *order = self._array(_numbers(value, path), path)
            node = ["tensor" if type(value) is torch.Tensor else "parameter", name, bool(value.requires_grad), *order]
        else:
            return None
        self._known[id(value)] = value, node
        return node

    def _structure(self, value: Any, path: str) -> list[Any]:
        cls = type(value)
        for kind, plain in SEQUENCES.items():
            if cls is plain:
                ordered = sorted(value, key=repr) if kind.endswith("set") else value
                return [kind, [self.node(each, f"{path}[{i}]") for i, each in enumerate(ordered)]]
        for kind, plain in DICTS.items():
            if cls is plain:
                return [kind, [[self.node(k, f"{path} key"), self.node(v, f"{path}[{k!r}]")] for k, v in value.items()]]
        if cls is weakref.ref and self._numeric(value(), path):  # LSTMs of torch point at their own weights
            return ["weak", self.node(value(), path)]
        if isinstance(value, Enum):
            if cls._member_map_.get(str(value.name)) is not value:
                raise UsageError(f"{path} is {value!r}, which has no name that weights could hold")
            return ["member", *self._name(cls, path), value.name]
        if isinstance(value, tuple) and hasattr(cls, "_fields") and not getattr(value, "__dict__", None):
            named = zip(cls._fields, value, strict=True)
            return ["namedtuple", *self._name(cls, path), [self.node(each, f"{path}.{name}") for name, each in named]]
        try:
            object.__new__(cls)  # refuses whatever has more than its fields: functions, files, generators, C types
        except TypeError as error:
            article = "an" if cls.__name__[0] in "aeiouAEIOU" else "a"
            raise UsageError(f"{path} is {article} {cls.__name__}, which weights cannot hold") from error
        fields = {name: self.node(each, f"{path}.{name}") for name, each in _fields(value).items()}
        return ["object", *self._name(cls, path), fields]

    def _array(self, array: NDArray[Any], path: str) -> list[Any]:
        """Returns the name under which numbers are held and, unless it is C's, the order of their axes in memory."""
        if array.dtype.name not in _DTYPES:
            raise UsageError(f"{path} is an array of {array.dtype}, which weights cannot hold")
        name = path.encode("ascii", "backslashreplace").decode()
        while name in self.arrays:
            name += "'"
        order = sorted(range(array.ndim), key=lambda axis: -abs(array.strides[axis]))
        if array.flags.c_contiguous or order == sorted(order):
            self.arrays[name] = array
            return [name]
        self.arrays[name] = array.transpose(order)  # sums run in the order of memory, and round by it
        return [name, order]

    def _name(self, value: Any, path: str) -> list[str]:
        """Returns the module and the name by which a class or function is found."""
        name, module = value.__name__, getattr(value, "__module__", None)
        if find(str(module), getattr(value, "__qualname__", name)) is value:
            return [PLUGIN if module == self._plugin else str(module), getattr(value, "__qualname__", name)]
        if isinstance(value, BuiltinFunctionType | np.ufunc):  # torch.tanh does not know where it stands
            for other in sorted(sys.modules):
                if find(other, name) is value:
                    return [other, name]
        raise UsageError(f"{path} is a {name} of {module}, which cannot be found by that name")


def _numbers(tensor: Any, path: str) -> NDArray[Any]:
    try:
        numbers: NDArray[Any] = tensor.detach().cpu().numpy()
    except (TypeError, RuntimeError) as error:
        raise UsageError(f"{path} is a tensor of {tensor.dtype}, which weights cannot hold") from error
    return numbers


def _fields(value: object) -> dict[str, Any]:
    """Returns the fields of an object, those of slots among them."""
    fields = dict(getattr(value, "__dict__", {}))
    for cls in type(value).__mro__:
        for name, slot in vars(cls).items():
            if isinstance(slot, MemberDescriptorType) and hasattr(value, name):
                fields.setdefault(name, getattr(value, name))
    return fields


def find(module: str, name: str) -> Any:
    """Returns what a module that is imported already holds by a name, or None; imports nothing, asks no one."""
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = vars(found).get(part) if hasattr(found, "__dict__") else None
    return found
