"""Describes a set that was recorded elsewhere: to run tasks on, not to generate."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from pydantic import TypeAdapter

from dlobench import ranges
from dlobench.data.domain_set import Cell, DomainSet, Part, ScaleName, Span
from dlobench.data.recorded import Boxes, visible
from dlobench.domain import Domain
from dlobench.errors import UsageError
from dlobench.trajectories import Geometry

VERSION = 1  # of how the layout is read
BLOCK = 500  # trajectories a shard, at most
# Parts of the domains of a cell in the order of their salted hashes, over and over. Any three have all parts; where
# cells have fewer, each begins with another one, so that the set has all parts all the same.
THREE: tuple[Part, ...] = ("train", "test", "valid")
DEAL: tuple[Part, ...] = (*THREE, "train", "train", "train", "test", "train")


@dataclass(frozen=True)
class ImportedDomain:
    """Holds what is known of a domain that was recorded elsewhere: neither friction nor stiffness."""

    cell: Cell
    trajectories: int
    boxes: Boxes  # of each body
    params: dict[str, Any]  # its `params.json`
    assumed: tuple[str, ...]  # what the files do not say
    sha256: str  # of its files


DOMAINS = TypeAdapter(dict[int, ImportedDomain])


@dataclass(frozen=True, eq=False)
class ImportedSet(DomainSet):
    """Describes an imported set, whose domains keep their ids. Every scale takes all of it."""

    domains: Mapping[int, ImportedDomain] = field(default_factory=dict)

    @staticmethod
    def make(name: str, domains: Mapping[int, ImportedDomain]) -> ImportedSet:
        """Makes the set of some domains; shards hold as many trajectories as divide those of every domain."""
        shared = math.gcd(*(domain.trajectories for domain in domains.values()))
        return ImportedSet(
            name=name,
            version=VERSION,
            cells=tuple(dict.fromkeys(domain.cell for domain in domains.values())),
            per_cell=0,
            block=max(size for size in range(1, BLOCK + 1) if shared % size == 0),
            extents={},
            parted="domains",
            domains=dict(sorted(domains.items())),
        )

    @cached_property
    def key(self) -> str:
        """Names the folder of the set: how the layout is read, and every byte that was read."""
        files = json.dumps([(index, domain.sha256) for index, domain in self.domains.items()])
        return f"{self.name}-v{self.version}-{hashlib.sha256(files.encode()).hexdigest()[:8]}"

    def __len__(self) -> int:
        return len(self.domains)

    def cell(self, index: int) -> Cell:
        """Returns the cell that domain `index` belongs to; raises `UsageError` when the set has no such domain."""
        if index not in self.domains:
            raise UsageError(f"domain {ranges.shown(index)} is none of the {len(self)} of {self.name}")
        return self.domains[index].cell

    def domain(self, index: int) -> Domain:
        """Raises `UsageError`: nobody knows the parameters of what was recorded elsewhere."""
        raise UsageError(f"{self.name}/{index} was imported: its friction, stiffness and densities are not known")

    def definition(self, index: int) -> dict[str, Any]:
        """Returns what is known of domain `index`, as JSON values."""
        self.cell(index)
        known: dict[str, Any] = DOMAINS.dump_python({index: self.domains[index]}, mode="json")[str(index)]
        return known | {"bodies": known["params"]["rigid_objects"]}

    def geometry(self, index: int) -> Geometry:
        """Returns what is visible of domain `index`: dlo_mask (32,), body_mask (3,), boxes (3, 5, 5)."""
        return visible(self.cell(index).length, self.domains[index].boxes)

    def part(self, index: int) -> Part:
        """Returns the part that domain `index` belongs to, where domains are parted."""
        return self._parts[index]

    def seed(self, domain: int, trajectory: int) -> list[int]:
        """Returns no seed: what was recorded elsewhere has none that we know of."""
        return []

    def spans(self, scale: ScaleName) -> list[Span]:
        """Returns all that there is, whatever the scale.

        Where trajectories are parted, a quarter of each domain's are to test and an eighth to validate.
        """
        if self.parted == "domains":
            return [Span(index, self.part(index), 0, domain.trajectories) for index, domain in self.domains.items()]
        out = []
        for index, domain in self.domains.items():
            K = domain.trajectories
            test = max(1, K // 4) if K > 1 else 0
            valid = max(1, K // 8) if K > 2 else 0
            train = K - valid - test
            spans = (
                Span(index, "train", 0, train),
                Span(index, "valid", train, valid),
                Span(index, "test", train + valid, test),
            )
            out += [span for span in spans if span.count]
        return out

    def parted_like(self, other: DomainSet) -> ImportedSet:
        """Returns the set parted by what another set is parted by; raises `UsageError` for what was never recorded."""
        if other.executions > 1:
            raise UsageError(
                f"{other.name} executes the same commands {other.executions} times, imported sets do it once"
            )
        return replace(self, parted=other.parted)

    @cached_property
    def _parts(self) -> dict[int, Part]:
        cells: dict[Cell, list[int]] = {}
        for index, domain in self.domains.items():
            cells.setdefault(domain.cell, []).append(index)

        def salted(index: int) -> bytes:
            return hashlib.sha256(f"{self.salt}/{index}".encode()).digest()

        return {
            index: THREE[(place + number) % 3] if place < 3 else DEAL[place % len(DEAL)]
            for number, members in enumerate(cells.values())
            for place, index in enumerate(sorted(members, key=salted))
        }
