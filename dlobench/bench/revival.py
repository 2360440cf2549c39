"""Makes a model of its state: objects are filled rather than built, so that nothing of anyone's runs.

No class is called, no property set and no module imported: a class has to be there already, which it is in the
plugin's own process.
"""

from __future__ import annotations

import weakref
from inspect import getattr_static
from types import MemberDescriptorType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dlobench.bench.model import Model
from dlobench.bench.state import DICTS, NAMED, PLUGIN, SEQUENCES, State, fault, find
from dlobench.errors import UsageError

Made = TypeVar("Made", bound=Model)


def restore(cls: type[Made], state: State, *, device: str) -> Made:
    """Returns a model with a state, on a device; raises `UsageError` for a state that is none of `flatten`'s."""
    try:
        if why := fault(state):
            raise ValueError(why)
        reading = _Reading(state.arrays, cls.__module__, device)
        model: Made = reading.filled(cls, state.tree)
        return model
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError) as error:
        raise UsageError(f"these are no weights of {cls.__name__}: {error}") from error


class _Reading:
    """Turns nodes back into values."""

    def __init__(self, arrays: dict[str, NDArray[Any]], plugin: str, device: str) -> None:
        self._arrays, self._plugin, self._device = arrays, plugin, device
        self._known: dict[tuple[str, str], Any] = {}  # arrays and tensors by kind and name

    def filled(self, cls: type[Any], fields: dict[str, Any]) -> Any:
        """Returns an object of a class with these fields; calls neither the class nor a property of it."""
        made = object.__new__(cls)
        for name, node in fields.items():
            slot = getattr_static(cls, name, None)
            if isinstance(slot, MemberDescriptorType):
                slot.__set__(made, self._value(node))
            else:
                object.__getattribute__(made, "__dict__")[name] = self._value(node)
        if isinstance(made, Model):
            object.__getattribute__(made, "__dict__")["device"] = self._device
        return made

    def _value(self, node: Any) -> Any:
        if not isinstance(node, list):
            return node
        kind, *rest = node
        if kind in SEQUENCES:
            return SEQUENCES[kind](map(self._value, rest[0]))
        if kind in DICTS:
            return DICTS[kind]((self._value(key), self._value(each)) for key, each in rest[0])
        if kind in ("array", "number", "tensor", "parameter"):
            if (kind, rest[0]) not in self._known:
                self._known[kind, rest[0]] = self._numeric(kind, *rest)
            return self._known[kind, rest[0]]
        if kind in ("float", "weak"):
            return float(rest[0]) if kind == "float" else weakref.ref(self._value(rest[0]))
        if kind in ("named", "object", "namedtuple", "member"):
            return self._instance(kind, *rest)
        raise ValueError(f"they hold {kind!r}, which is no kind of theirs")

    def _instance(self, kind: str, module: str, name: str, content: Any = None) -> Any:
        """Returns what is named, or what is made of a class that is named."""
        found: Any = find(self._plugin if module == PLUGIN else module, name)
        if kind == "named" and isinstance(found, NAMED):
            return found
        if kind == "named" or not isinstance(found, type):
            raise ValueError(f"they need {name} of {module}, which the plugin does not import as it is loaded")
        if kind == "object":
            return self.filled(found, content)
        if kind == "namedtuple":
            return tuple.__new__(found, map(self._value, content))
        return vars(found)["_member_map_"][content]

    def _numeric(self, kind: str, name: str, *rest: Any) -> Any:
        *grad, order = rest if rest and isinstance(rest[-1], list) else (*rest, None)
        array = self._arrays[name]
        array = np.array(array if order is None else array.transpose(np.argsort(order)), order="K")  # a copy
        if kind in ("array", "number"):
            return array if kind == "array" else array[()]
        import torch

        tensor = torch.from_numpy(array).clone().to(self._device)  # in memory of torch, which is aligned for its sums
        return tensor.requires_grad_(*grad) if kind == "tensor" else torch.nn.Parameter(tensor, *grad)
