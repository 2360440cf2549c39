"""Defines the sets of the paper's section 2.3: which domains they hold, and how much of them each scale takes.

A set is regenerable from its name, its version and the seeds derived here. Scales nest: what `mini` generated is
reused by `small`, and that by `paper`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from itertools import product
from typing import Literal, get_args

import numpy as np

from dlobench import ranges
from dlobench.domain import ATTACHMENTS, LENGTHS, MATERIALS, Attachment, Domain, Material, sample
from dlobench.errors import UsageError
from dlobench.world import VERSION as WORLD_VERSION

ScaleName = Literal["mini", "small", "paper"]
SCALES: tuple[ScaleName, ...] = get_args(ScaleName)
PUSHES = 20  # n_P, pushes a trajectory


@dataclass(frozen=True)
class Cell:
    """Fixes what all domains of a cell share; the other parameters are sampled."""

    material: Material
    attachment: Attachment
    length: float  # m
    rigid_objects: int

    def __str__(self) -> str:
        return f"{self.material}-{self.attachment}-{round(self.length * 100)}cm-{self.rigid_objects}"


@dataclass(frozen=True)
class Extent:
    """Says how much of a set a scale takes; None takes all."""

    trajectories: int  # a domain
    per_cell: int  # domains
    length: float | None = None  # m
    rigid_objects: int | None = None

    def takes(self, cell: Cell) -> bool:
        """Tells whether the extent reaches into a cell."""
        return self.length in (None, cell.length) and self.rigid_objects in (None, cell.rigid_objects)


@dataclass(frozen=True)
class Unit:
    """Names the work of one shard: some trajectories of one domain. Generating it twice gives the same bytes."""

    set_name: str
    domain: int
    first: int  # trajectory
    count: int  # trajectories


@dataclass(frozen=True)
class DomainSet:
    """Describes a set: cells × domains a cell, of which scales take extents."""

    name: str
    version: int
    cells: tuple[Cell, ...]
    per_cell: int
    block: int  # trajectories a shard
    extents: dict[ScaleName, Extent]

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
        """Samples domain `index` from its own seed."""
        cell = self.cell(index)
        rng = np.random.default_rng([*self._seed, index])
        return sample(
            rng,
            material=cell.material,
            attachment=cell.attachment,
            length=cell.length,
            rigid_objects=cell.rigid_objects,
        )

    def seed(self, domain: int, trajectory: int) -> list[int]:
        """Returns the seed of one trajectory."""
        return [*self._seed, domain, trajectory]

    def domains(self, scale: ScaleName) -> list[int]:
        """Returns the indices of the domains that a scale takes, cell by cell."""
        extent = self.extents[scale]
        starts = (i * self.per_cell for i, cell in enumerate(self.cells) if extent.takes(cell))
        return [start + k for start in starts for k in range(extent.per_cell)]

    def spread(self, scale: ScaleName) -> list[int]:
        """Returns the same domains in an order that visits every cell before it comes back to the first."""
        return sorted(self.domains(scale), key=lambda index: (index % self.per_cell, index))

    def pushes(self, scale: ScaleName) -> int:
        """Returns the number of pushes of a scale."""
        return len(self.domains(scale)) * self.extents[scale].trajectories * PUSHES

    def units(self, domains: list[int], trajectories: int) -> Iterator[Unit]:
        """Yields the shards that hold the first `trajectories` of each domain."""
        for domain in domains:
            for first in range(0, trajectories, self.block):
                yield Unit(self.name, domain, first, self.block)

    def digest(self, domains: list[int], trajectories: int) -> str:
        """Returns the definition digest (SHA-256) of some trajectories of some domains, the same on every machine."""
        definition = {
            "key": self.key,
            "trajectories": trajectories,
            "domains": {index: self.domain(index).to_json() for index in domains},
        }
        return hashlib.sha256(json.dumps(definition, sort_keys=True).encode()).hexdigest()

    @cached_property
    def _seed(self) -> list[int]:
        name = hashlib.sha256(self.name.encode()).digest()
        return [int.from_bytes(name[:4], "big"), self.version]


_SETS = (
    DomainSet(
        name="meta-learning",
        version=1,
        cells=tuple(Cell(*cell) for cell in product(MATERIALS, ATTACHMENTS, LENGTHS, range(4))),
        per_cell=25,
        block=20,
        extents={
            "mini": Extent(trajectories=20, per_cell=8, length=0.16, rigid_objects=0),
            "small": Extent(trajectories=60, per_cell=22, length=0.16, rigid_objects=0),
            "paper": Extent(trajectories=500, per_cell=25),
        },
    ),
)
SETS = {each.name: each for each in _SETS}


def find(name: str) -> DomainSet:
    """Returns a set by name; raises `UsageError` naming the choices."""
    if name not in SETS:
        raise UsageError(f"unknown set {name!r}; there are: {', '.join(SETS)}")
    return SETS[name]


def locate(domain_id: str) -> tuple[DomainSet, int]:
    """Returns the set and the index that a domain's id, such as `meta-learning/17`, stands for.

    Raises `UsageError` for an unknown set, an index that the set does not have, and what is no id.
    """
    name, _, index = domain_id.partition("/") if isinstance(domain_id, str) else ("", "", "")
    if not (name and index.isascii() and index.isdigit() and len(index) < 10):
        sets = ", ".join(f"{of.name}/0–{len(of) - 1}" for of in SETS.values())
        raise UsageError(f"domain id {ranges.shown(domain_id)} is not <set>/<number>; there are: {sets}")
    of, number = find(name), int(index)
    of.cell(number)
    return of, number


def domain(domain_id: str) -> Domain:
    """Samples the domain that an id, such as `meta-learning/17`, stands for; raises `UsageError` as `locate` does."""
    of, index = locate(domain_id)
    return of.domain(index)


def find_scale(name: str) -> ScaleName:
    """Returns a scale by name; raises `UsageError` naming the choices."""
    for scale in SCALES:
        if name == scale:
            return scale
    raise UsageError(f"unknown scale {name!r}; there are: {', '.join(SCALES)}")
