"""Names parts of the space of domains, for tasks that leave them out of training."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from dlobench.data.domain_set import Cell, DomainSet


@cache
def _value(of: DomainSet, index: int, parameter: str) -> Any:
    """Returns a parameter of a domain; of those that a whole cell has, without making the domain."""
    return getattr(of.cell(index) if parameter in Cell.__dataclass_fields__ else of.domain(index), parameter)


@dataclass(frozen=True)
class Region:
    """Names a part of the space of domains: a parameter has one of some values, or lies outside of a range."""

    name: str
    parameter: str  # a field of the domain
    values: tuple[object, ...] = ()
    outside: tuple[float, float] | None = None

    def holds(self, of: DomainSet, index: int) -> bool:
        """Tells whether domain `index` lies in it; raises `UsageError` where the set does not know its parameters."""
        value = _value(of, index, self.parameter)
        return value in self.values if self.outside is None else not self.outside[0] <= value <= self.outside[1]
