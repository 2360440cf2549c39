"""Describes a set: which domains it holds, how they are parted, how much of them a scale takes, what a shard is."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib.metadata import version
from typing import Any, Literal, get_args

import numpy as np

from dlobench import ranges
from dlobench.domain import Attachment, Domain, Material, sample, typical
from dlobench.errors import UsageError
from dlobench.trajectories import Geometry, geometry
from dlobench.world import VERSION as WORLD_VERSION

ScaleName = Literal["mini", "small", "paper"]
SCALES: tuple[ScaleName, ...] = get_args(ScaleName)
Part = Literal["train", "valid", "test"]
PARTS: tuple[Part, ...] = get_args(Part)
PUSHES = 20  # n_P, pushes a trajectory

GROUP: tuple[Part, ...] = ("test", "test", "valid", "train", "train", "train", "train", "train")  # of neighbours
FIRST: dict[Part, int] = {"train": 0, "valid": 1_000_000, "test": 2_000_000}  # trajectory of a part of one domain


@dataclass(frozen=True)
class Cell:
    """Fixes what all domains of a cell share; the other parameters are sampled, or typical."""

    material: Material
    attachment: Attachment
    length: float  # m
    rigid_objects: int

    def __str__(self) -> str:
        return f"{self.material}-{self.attachment}-{round(self.length * 100)}cm-{self.rigid_objects}"

    def within(self, where: Mapping[str, object]) -> bool:
        """Tells whether fields have the values asked for, a tuple meaning any of its values."""
        return all(
            getattr(self, name) in (wanted if isinstance(wanted, tuple) else (wanted,))
            for name, wanted in where.items()
        )


@dataclass(frozen=True)
class Extent:
    """Says how much a scale takes of the cells that it reaches: domains a cell, trajectories of each part of them."""

    train: int  # trajectories of a domain, or of this part of it
    valid: int
    test: int
    per_cell: int = 1  # domains
    where: Mapping[str, object] = field(default_factory=dict)  # which cells it reaches


@dataclass(frozen=True)
class Span:
    """Names consecutive trajectories of one domain that belong to one part."""

    domain: int
    part: Part
    first: int  # trajectory
    count: int  # trajectories

    def head(self, count: int) -> Span:
        """Returns the first `count` trajectories; raises `UsageError` when there are fewer."""
        if not 0 <= count <= self.count:
            raise UsageError(
                f"{count} trajectories are asked for, domain {self.domain} has {self.count} to {self.part}"
            )
        return Span(self.domain, self.part, self.first, count)


@dataclass(frozen=True)
class Unit:
    """Names the work of one shard: some trajectories of one domain. Generating it twice gives the same bytes."""

    set_name: str
    domain: int
    first: int  # trajectory
    count: int  # trajectories


@dataclass(frozen=True, eq=False)
class DomainSet:
    """Describes a set: cells × domains a cell, each with trajectories, of which scales take extents.

    Parts never share a trajectory. Where domains are parted, a domain with all its trajectories belongs to one part:
    of every eight neighbours within a cell the salted SHA-256 of their ids makes two test and one validation. Where
    trajectories are parted, every domain has all parts, and their trajectories have numbers, so seeds, of their own.
    """

    name: str
    version: int
    cells: tuple[Cell, ...]
    per_cell: int  # domains
    block: int  # trajectories a shard
    extents: dict[ScaleName, tuple[Extent, ...]]
    parted: Literal["domains", "trajectories"]
    salt: str = "parts-1"
    sampled: bool = True  # whether the parameters that a cell leaves open are sampled, or the middle of their ranges
    pushes: int = PUSHES  # a trajectory
    executions: int = 1  # how often the same commands are executed from the same state, trajectory by trajectory

    @cached_property
    def key(self) -> str:
        """Names the folder of the set: everything that decides its bytes on one kind of CPU."""
        return f"{self.name}-v{self.version}-world{WORLD_VERSION}-mujoco{version('mujoco')}"

    def __len__(self) -> int:
        return len(self.cells) * self.per_cell

    def cell(self, index: int) -> Cell:
        """Returns the cell that domain `index` belongs to; raises `UsageError` when the set has no such domain."""
        return self.cells[ranges.whole(f"domain of {self.name}", index, 0, len(self) - 1) // self.per_cell]

    def domain(self, index: int) -> Domain:
        """Returns domain `index`, whose open parameters are drawn from a seed of its own."""
        cell = vars(self.cell(index))
        return sample(np.random.default_rng([*self._seed, index]), **cell) if self.sampled else typical(**cell)

    def definition(self, index: int) -> dict[str, Any]:
        """Returns what defines domain `index`, as JSON values."""
        return self.domain(index).to_json()

    def geometry(self, index: int) -> Geometry:
        """Returns what is visible of domain `index`: dlo_mask (32,), body_mask (3,), boxes (3, 5, 5)."""
        return geometry(self.domain(index))

    def part(self, index: int) -> Part:
        """Returns the part that domain `index` belongs to, where domains are parted."""
        first = index - index % self.per_cell % len(GROUP)
        group = range(first, first + len(GROUP))
        ordered = sorted(group, key=lambda i: hashlib.sha256(f"{self.salt}/{self.name}/{i}".encode()).digest())
        return GROUP[ordered.index(index)]

    def seed(self, domain: int, trajectory: int) -> list[int]:
        """Returns the seed of one trajectory."""
        return [*self._seed, domain, trajectory]

    def fresh(self, seed: int) -> DomainSet:
        """Returns a set like this one whose domains and trajectories nobody has seen: they come from another name."""
        return replace(self, name=f"{self.name}-fresh{seed}")

    def spans(self, scale: ScaleName) -> list[Span]:
        """Returns what a scale takes, in an order that visits every cell before it comes back to the first."""
        found: dict[tuple[int, Part], int] = {}
        for extent in self.extents[scale]:
            for number, cell in enumerate(self.cells):
                if cell.within(extent.where):
                    start = number * self.per_cell
                    for index in range(start, start + extent.per_cell):
                        for part in PARTS if self.parted == "trajectories" else (self.part(index),):
                            found[index, part] = max(found.get((index, part), 0), getattr(extent, part))
        first = FIRST if self.parted == "trajectories" and self.executions == 1 else dict.fromkeys(PARTS, 0)
        spans = [Span(index, part, first[part], count) for (index, part), count in found.items() if count]
        return sorted(spans, key=lambda span: (span.domain % self.per_cell, span.domain, span.first))

    def units(self, spans: Iterable[Span]) -> Iterator[Unit]:
        """Yields the shards that hold these spans."""
        for span in spans:
            for first in range(span.first - span.first % self.block, span.first + span.count, self.block):
                yield Unit(self.name, span.domain, first, self.block)

    def total(self, spans: Iterable[Span]) -> int:
        """Returns the number of pushes in these spans."""
        return sum(span.count for span in spans) * self.pushes

    def digest(self, spans: Iterable[Span]) -> str:
        """Returns the definition digest (SHA-256) of some spans: domains, trajectories, parts; the same everywhere."""
        spans = sorted(spans, key=lambda span: (span.domain, span.first))
        definition = {
            "key": self.key,
            "pushes": self.pushes,
            "executions": self.executions,
            "spans": [asdict(span) for span in spans],
            "domains": {index: self.definition(index) for index in sorted({span.domain for span in spans})},
        }
        return hashlib.sha256(json.dumps(definition, sort_keys=True).encode()).hexdigest()

    @cached_property
    def _seed(self) -> list[int]:
        name = hashlib.sha256(self.name.encode()).digest()
        return [int.from_bytes(name[:4], "big"), self.version]
