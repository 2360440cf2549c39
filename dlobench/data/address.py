"""Finds one recorded trajectory: `meta-learning/17` names a domain of a set, a number its trajectory."""

from __future__ import annotations

from dataclasses import dataclass

from dlobench.data.sets import SCALES, DomainSet, Unit, find
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
        *_, last = self.of.units([self.domain], self.trajectory + 1)
        return last

    @property
    def row(self) -> int:
        """Returns the trajectory's place in its shard."""
        return self.trajectory - self.unit.first

    def command(self) -> str:
        """Returns the command that generates the trajectory, and as little else as that command can."""
        for scale in SCALES:
            spread = self.of.spread(scale)
            if self.domain in spread and self.trajectory < self.of.extents[scale].trajectories:
                return f"dlobench generate {self.of.name} --scale {scale} --domains {spread.index(self.domain) + 1}"
        raise AssertionError(f"no scale of {self.of.name} holds {self}")  # `parse` has seen to it


def parse(domain: str, trajectory: int) -> Address:
    """Reads an address such as `meta-learning/17`, 3; raises `UsageError` naming what the set has."""
    name, slash, index = domain.rpartition("/")
    if not slash:
        raise UsageError(f"domain {domain!r} is not SET/INDEX, as in meta-learning/17")
    of = find(name)
    most = {d: of.extents[scale].trajectories for scale in SCALES for d in of.domains(scale)}  # scales nest
    if not (index.isascii() and index.isdigit() and int(index) in most):
        raise UsageError(f"domain {domain!r}: {index!r} is not one of {name}'s domains, {min(most)}–{max(most)}")
    if not 0 <= trajectory < most[int(index)]:
        raise UsageError(f"trajectory {trajectory} is outside 0–{most[int(index)] - 1}, what domain {domain} has")
    return Address(of, int(index), trajectory)
