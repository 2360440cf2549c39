"""Judges what a plugin does and returns: each fault is the rest of a sentence that begins with the plugin's name."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench.errors import RunError
from dlobench.trajectories import Query


class Misdeed(RunError):
    """Says what a plugin did, such as "raised ValueError at mine.py:7: no"; whoever called it puts its name before."""


def blame(error: BaseException) -> str:
    """Says what was raised, and where: the plugin's own line rather than that of a library it calls."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "site-packages" not in frame.filename and "<" not in frame.filename]
    line = (own or frames)[-1]
    return f"raised {type(error).__name__} at {Path(line.filename).name}:{line.lineno}: {error}"


def counted(count: object) -> int:
    """Returns a number of parameters; raises `Misdeed` when it is not a whole number below 2⁶³."""
    if type(count) is not int or not 0 <= count < 2**63:
        shown = "int" if type(count) is int and abs(count) >= 2**63 else repr(count)
        raise Misdeed(f"returned {shown}, a whole number below 2⁶³ was asked for")
    return count


def plain(prediction: object, query: Query) -> dict[str, NDArray[Any]]:
    """Returns the arrays of a prediction by name.

    Raises `Misdeed` for one without numbers, and for one that lies in the memory of its query, where it would change
    with whatever becomes of that.
    """
    arrays = {}
    for name in ("dlo", "bodies"):
        array = getattr(prediction, name, None)
        if array is None and name == "bodies":
            continue
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
            got = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            raise Misdeed(f"returned {name} of {got}, a float array was asked for")
        for field in fields(query):
            if np.may_share_memory(array, getattr(query, field.name)):
                raise Misdeed(f"returned a view of query.{field.name}, a copy was asked for")
        arrays[name] = array
    return arrays


@contextmanager
def watched(arrays: Mapping[str, NDArray[Any]], name: str) -> Iterator[None]:
    """Raises `Misdeed` when one of these arrays, the fields of `name`, was written into meanwhile."""
    before = {field: array.tobytes() for field, array in arrays.items()}
    yield
    for field, array in arrays.items():
        if array.tobytes() != before[field]:
            raise Misdeed(f"changed {name}.{field}, which is not its own")
