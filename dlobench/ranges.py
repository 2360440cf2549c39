"""Refuses values outside of what is documented: one sentence with the field, the value and the range."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from dlobench.errors import UsageError

SHOWN = 80  # characters of a value in an error


def shown(value: object) -> str:
    """Returns a value as an error names it: short, on one line."""
    try:
        text = reprlib.repr(value).replace("\n", " ")
    except ValueError:  # a whole number of more than 4,300 digits
        return f"a huge {type(value).__name__}"
    return text if len(text) <= SHOWN else text[: SHOWN - 1] + "…"


def number(field: str, value: object, low: float, high: float, unit: str = "") -> float:
    """Returns a number from `low` to `high`, both included; raises `UsageError` for anything else."""
    span = f"{low:g}–{high:g}{unit and ' ' + unit}"
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise UsageError(f"{field} = {shown(value)} is not a number within {span}")
    exact = value if isinstance(value, int) else float(value)  # a whole number may be too large for a float
    if not low <= exact <= high:  # NaN is not between
        raise UsageError(f"{field} = {shown(value)} is outside {span}")
    return float(exact)


def whole(field: str, value: object, low: int, high: float = math.inf) -> int:
    """Returns a whole number from `low` to `high`, both included; raises `UsageError` for anything else."""
    span = f"{low}–{high}" if math.isfinite(high) else f"{low}, {low + 1}, {low + 2}, …"
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise UsageError(f"{field} = {shown(value)} is not a whole number within {span}")
    if not low <= value <= high:
        raise UsageError(f"{field} = {shown(value)} is outside {span}")
    return int(value)


def seed(value: object) -> list[int]:
    """Returns a seed as whole numbers, of which it may hold one or several; raises `UsageError` for anything else."""
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str):
        return [whole("seed", each, 0) for each in value]
    return [whole("seed", value, 0)]


def choice(field: str, value: object, choices: tuple[str, ...]) -> None:
    """Raises `UsageError` unless the value is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise UsageError(f"{field} = {shown(value)} is not one of {', '.join(choices)}")


def members(what: str, cls: type, given: object) -> dict[str, Any]:
    """Returns the fields of a JSON object; raises `UsageError` unless they are just those of the dataclass `cls`."""
    names = [field.name for field in fields(cls)]
    if not isinstance(given, dict):
        raise UsageError(f"not a {what}: {shown(given)} has no fields, which are {', '.join(names)}")
    for problem, wrong in (("missing", set(names) - set(given)), ("unknown", set(given) - set(names))):
        if wrong:
            found = ", ".join(sorted(map(shown, wrong))[:3])
            raise UsageError(f"not a {what}: {problem} {found}; the fields are {', '.join(names)}")
    return given
