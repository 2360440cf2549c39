"""Finds one recorded trajectory: `meta-learning/17` names a domain of a set, a number its trajectory."""

from __future__ import annotations

from dataclasses import dataclass

from dlobench.data.domain_set import SCALES, DomainSet, Span, Unit
from dlobench.data.sets import find
from dlobench.errors import UsageError


@dataclass(frozen=True)
class Address:
    """Names a trajectory of a set, which may be on disk or not."""

    of: DomainSet
    domain: int
    trajectory: int

    @property
    def unit(self) -> Unit:
        """Returns the shard that holds the trajectory."""
        return Unit(self.of.name, self.domain, self.trajectory - self.row, self.of.block)

    @property
    def row(self) -> int:
        """Returns the trajectory's place in its shard."""
        return self.trajectory % self.of.block

    def command(self) -> str:
        """Returns the command that generates the trajectory, and as little else as that command can."""
        for scale in SCALES:
            spans = self.of.spans(scale)
            if any(_holds(span, self.domain, self.trajectory) for span in spans):
                order = list(dict.fromkeys(span.domain for span in spans))
                domains = order.index(self.domain) + 1
                return f"dlobench generate {self.of.name} --scale {scale} --domains {domains}"
        raise AssertionError(f"no scale of {self.of.name} holds {self}")  # `parse` has seen to it


def parse(domain: str, trajectory: int) -> Address:
    """Reads an address such as `meta-learning/17`, 3; raises `UsageError` naming what the set has."""
    name, slash, index = domain.rpartition("/")
    if not slash:
        raise UsageError(f"domain {domain!r} is not SET/INDEX, as in meta-learning/17")
    of = find(name)
    if not (index.isascii() and index.isdigit() and len(index) < 10 and int(index) < len(of)):
        raise UsageError(f"domain {domain!r}: {index!r} is not one of {name}'s domains, 0–{len(of) - 1}")
    spans = [span for span in of.spans("paper") if span.domain == int(index)]  # scales nest
    if not any(_holds(span, int(index), trajectory) for span in spans):
        have = ", ".join(f"{span.first}–{span.first + span.count - 1} ({span.part})" for span in spans)
        raise UsageError(f"trajectory {trajectory} is outside {have}, what domain {domain} has")
    return Address(of, int(index), trajectory)


def _holds(span: Span, domain: int, trajectory: int) -> bool:
    return span.domain == domain and 0 <= trajectory - span.first < span.count
