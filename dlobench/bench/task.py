"""Defines what a task plugin is: a protocol in ten lines of data, from which cells and splits follow."""

from __future__ import annotations

import hashlib
import json
import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from dlobench.data.sets import PUSHES, Cell, DomainSet, ScaleName, find
from dlobench.errors import UsageError

DISJOINT_SUPPORTS = 10  # supports that a small K is averaged over, where the pool holds as many


@dataclass(frozen=True)
class Split:
    """Says how domains are parted: inside each stratum, sorted by SHA-256 of salt and id, then cut."""

    salt: str
    test: float  # share of the domains
    valid: float  # share of the domains
    unit: Literal["domain"] = "domain"
    stratify: Literal["cell"] = "cell"


@dataclass(frozen=True)
class Scale:
    """Says how much of its set a task uses at one scale; K + query never exceed what a domain has."""

    trajectories: tuple[int, ...]  # a training domain, one fit each
    support: int  # trajectories of an unseen domain that supports are drawn from
    query: int  # trajectories of an unseen domain that are scored, the same for every K
    K: tuple[int, ...]  # trajectories in a support


@dataclass(frozen=True)
class Fit:
    """Names one fit: how much it trains on and how far ahead it predicts. It serves every K."""

    trajectories: int
    horizon: int


@dataclass(frozen=True)
class Partition:
    """Holds the domains of a task by the part that they play."""

    train: tuple[int, ...]
    valid: tuple[int, ...]
    test: tuple[int, ...]

    @property
    def digest(self) -> str:
        """Returns the SHA-256 of who is where."""
        parts = {"train": self.train, "valid": self.valid, "test": self.test}
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


@dataclass(frozen=True)
class Task:
    """Describes a protocol. A published task is never edited: a new version is a new task."""

    name: str
    version: int
    set: str
    horizon: tuple[int, ...]  # n, pushes ahead
    split: Split
    mini: Scale
    small: Scale
    paper: Scale
    where: Mapping[str, object] = field(default_factory=dict)  # fields of the set's cells and the values they must have

    def check(self, scale: ScaleName) -> None:
        """Raises `UsageError`, naming field and value, for what no run could honour at a scale."""
        chosen, of = self.scale(scale), find(self.set)
        most = of.extents[scale].trajectories

        def numbers(field: str, values: object, low: int, high: int) -> None:
            if not isinstance(values, tuple) or not values or len(set(values)) < len(values):
                raise UsageError(f"task {self.name!r}: {field} = {values!r} is not a tuple of different numbers")
            for value in values:
                if type(value) is not int or not low <= value <= high:
                    raise UsageError(
                        f"task {self.name!r}: {field} = {value!r} is not a whole number from {low} to {high}"
                    )

        if not isinstance(self.name, str) or not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", self.name):
            raise UsageError(f"task name {self.name!r} goes into paths; use letters, digits and any of _ . -")
        numbers("version", (self.version,), 1, 10**6)
        numbers("horizon", self.horizon, 1, PUSHES)
        numbers(f"{scale}.trajectories", chosen.trajectories, 1, most)
        numbers(f"{scale}.support", (chosen.support,), 0, most)
        numbers(f"{scale}.query", (chosen.query,), 1, most)
        numbers(f"{scale}.support + query", (chosen.support + chosen.query,), 1, most)
        numbers(f"{scale}.K", chosen.K, 0, chosen.support)
        for part in ("test", "valid"):
            share = getattr(self.split, part)
            if not isinstance(share, float) or not 0 < share < 1:
                raise UsageError(f"task {self.name!r}: split.{part} = {share!r} is not a share between 0 and 1")
        if not self.domains(scale):
            raise UsageError(f"task {self.name!r}: no domain of {self.set}/{scale} has {dict(self.where)}")

    def scale(self, name: ScaleName) -> Scale:
        """Returns what the task uses at a scale."""
        chosen: Scale = getattr(self, name)
        return chosen

    def domains(self, scale: ScaleName) -> list[int]:
        """Returns the domains of the set's scale that the task is about."""
        of = find(self.set)
        fields = Cell.__dataclass_fields__
        for name in self.where:
            if name not in fields:
                raise UsageError(f"task {self.name}: where has {name!r}, a cell has: {', '.join(fields)}")
        return [i for i in of.domains(scale) if all(getattr(of.cell(i), k) == v for k, v in self.where.items())]

    def trajectories(self, scale: ScaleName) -> int:
        """Returns how many trajectories of every domain the task reads."""
        chosen = self.scale(scale)
        return max(*chosen.trajectories, chosen.support + chosen.query)

    def partition(self, scale: ScaleName) -> Partition:
        """Parts the domains of a scale into train, valid and test."""
        return partition(find(self.set), self.domains(scale), self.split)

    def fits(self, scale: ScaleName) -> list[Fit]:
        """Returns the fits of a scale, smallest first."""
        return [Fit(trajectories, n) for trajectories in self.scale(scale).trajectories for n in self.horizon]

    def cell_id(self, fit: Fit, K: int) -> str:
        """Names one point of the sweep, such as `meta/trajectories20-h4-k10`."""
        return f"{self.name}/trajectories{fit.trajectories}-h{fit.horizon}-k{K}"


def partition(of: DomainSet, domains: list[int], split: Split) -> Partition:
    """Parts domains by salted hash inside each cell: test first, then valid, at least one of each, train the rest.

    Raises `UsageError` when a stratum is too small to have all three parts.
    """
    strata: dict[str, list[int]] = defaultdict(list)
    for index in domains:
        strata[str(of.cell(index))].append(index)
    train, valid, test = list[int](), list[int](), list[int]()
    for name, members in strata.items():
        if len(members) < 3:
            raise UsageError(f"stratum {name} has {len(members)} domains, too few for train, valid and test")
        ordered = sorted(members, key=lambda i: hashlib.sha256(f"{split.salt}/{of.name}/{i}".encode()).digest())
        tested = max(1, round(split.test * len(members)))
        validated = max(1, round(split.valid * len(members)))
        if tested + validated >= len(members):
            raise UsageError(f"stratum {name} has {len(members)} domains, of which none is left to train on")
        test += ordered[:tested]
        valid += ordered[tested : tested + validated]
        train += ordered[tested + validated :]
    return Partition(tuple(sorted(train)), tuple(sorted(valid)), tuple(sorted(test)))


def supports(pool: int, K: int) -> list[slice]:
    """Returns disjoint supports of K trajectories out of a pool: at most ten; for K = 0 one empty one."""
    if K == 0:
        return [slice(0, 0)]
    return [slice(i * K, (i + 1) * K) for i in range(min(DISJOINT_SUPPORTS, pool // K))]
