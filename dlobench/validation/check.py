"""Says what a check is: a function that yields rows, each a measured figure beside its reference."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

Effort = Literal["quick", "normal", "full"]
EFFORTS: tuple[Effort, ...] = get_args(Effort)


@dataclass(frozen=True)
class Row:
    """Holds one figure of the world beside what it should be, in `unit`."""

    name: str
    measured: float
    reference: float
    error: float  # as the bound counts it: relative where `unit` of the bound is %, else absolute
    bound: float | None  # None: printed to be read, judged by nobody
    unit: str = ""  # of measured and reference
    error_unit: str = ""  # of error and bound: "%" or a unit
    note: str = ""

    @property
    def passed(self) -> bool | None:
        """Tells whether the error keeps the bound; None without a bound. What is no number never passes."""
        if self.bound is None:
            return None
        return bool(math.isfinite(self.measured) and math.isfinite(self.error) and self.error <= self.bound)


Check = Callable[[Effort], Iterator[Row]]


def relative(  # noqa: PLR0917
    name: str, measured: float, reference: float, percent: float | None, unit: str = "", note: str = ""
) -> Row:
    """Returns a row whose error is |measured − reference| / |reference| in %."""
    error = 100 * abs(measured - reference) / abs(reference)
    return Row(name, measured, reference, error, percent, unit, "%", note)


def at_most(name: str, measured: float, bound: float | None, unit: str = "", note: str = "") -> Row:
    """Returns a row whose reference is 0: the measured figure itself is the error."""
    return Row(name, measured, 0.0, measured, bound, unit, unit, note)


def worst(name: str, rows: Sequence[Row]) -> Row:
    """Returns the row with the largest error under another name; its note says which of how many it is."""
    found = max(rows, key=lambda row: row.error if math.isfinite(row.error) else math.inf)
    which = f"worst of {len(rows)}: {found.name}"
    return replace(found, name=name, note=f"{which}; {found.note}" if found.note else which)
