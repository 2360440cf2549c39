"""Defines what a task plugin is: a protocol in ten lines of data, from which cells and splits follow."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from dlobench.data.domain_set import PARTS, Cell, DomainSet, Part, ScaleName, Span
from dlobench.data.imported_set import ImportedSet
from dlobench.data.sets import find
from dlobench.errors import UsageError

DISJOINT_SUPPORTS = 10  # supports that a small K is averaged over, where the pool holds as many


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
    domain: int | None = None  # the only one it is about, where a task fits every domain apart


@dataclass(frozen=True)
class Task:
    """Describes a protocol. A published task is never edited: a new version is a new task."""

    name: str
    version: int
    set: str
    horizon: tuple[int, ...]  # n, pushes ahead
    mini: Scale
    small: Scale
    paper: Scale
    where: Mapping[str, object] = field(default_factory=dict)  # fields of the set's cells; a tuple: any of its values
    apart: bool = False  # whether every domain has a fit of its own, scored on other trajectories of that domain
    imported: ImportedSet | None = None  # the set, where it is none of ours

    @property
    def of(self) -> DomainSet:
        """Returns the set that the task reads."""
        return find(self.set) if self.imported is None else self.imported

    def on(self, imported: ImportedSet) -> Task:
        """Returns the task on an imported set, whose every byte its name tells: a board never mixes it with another."""
        of = imported.parted_like(self.of)
        return replace(self, name=f"{self.name}-on-{of.key}", set=of.name, imported=of)

    def check(self, scale: ScaleName) -> None:
        """Raises `UsageError`, naming field and value, for what no run could honour at a scale."""
        chosen, of = self.scale(scale), self.of
        counts = {part: [span.count for span in self._spans(scale) if span.part == part] for part in PARTS}
        most = {part: min(found, default=0) for part, found in counts.items()}
        unseen = most["test"] if self.apart else min(most["valid"], most["test"])

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
        if not all(most.values()):
            part = next(part for part, count in most.items() if not count)
            raise UsageError(f"task {self.name!r}: no {part} domain of {self.set}/{scale} has {dict(self.where)}")
        if self.apart and of.parted != "trajectories":
            raise UsageError(
                f"task {self.name!r}: apart needs domains that have all parts, those of {self.set} have one"
            )
        numbers("horizon", self.horizon, 1, of.pushes)
        largest = max(counts["train"]) if self.apart else most["train"]  # what some domains lack others may have
        numbers(f"{scale}.trajectories", chosen.trajectories, 1, largest)
        numbers(f"{scale}.support", (chosen.support,), 0, unseen)
        numbers(f"{scale}.query", (chosen.query,), 1, unseen)
        numbers(f"{scale}.support + query", (chosen.support + chosen.query,), 1, unseen)
        numbers(f"{scale}.K", chosen.K, 0, chosen.support)

    def scale(self, name: ScaleName) -> Scale:
        """Returns what the task uses at a scale."""
        chosen: Scale = getattr(self, name)
        return chosen

    def spans(self, scale: ScaleName) -> dict[Part, list[Span]]:
        """Returns what the task reads at a scale, part by part: domains and how many trajectories of each."""
        chosen, found = self.scale(scale), self._spans(scale)
        unseen = chosen.support + chosen.query

        def count(span: Span) -> int:
            if span.part == "train":
                return max((size for size in chosen.trajectories if size <= span.count), default=0)
            return span.count if self.apart and span.part == "valid" else unseen

        return {part: [span.head(count(span)) for span in found if span.part == part] for part in PARTS}

    def _spans(self, scale: ScaleName) -> list[Span]:
        """Returns the set's spans that the task is about, whole and in the order of their domains."""
        of, fields = self.of, Cell.__dataclass_fields__
        for name in self.where:
            if name not in fields:
                raise UsageError(f"task {self.name}: where has {name!r}, a cell has: {', '.join(fields)}")
        spans = [span for span in of.spans(scale) if of.cell(span.domain).within(self.where)]
        return sorted(spans, key=lambda span: (span.domain, span.first))

    def fits(self, scale: ScaleName) -> list[Fit]:
        """Returns the fits of a scale, domain by domain where they are fitted apart, smallest first."""
        sizes, train = self.scale(scale).trajectories, self.spans(scale)["train"]
        domains = {span.domain: span.count for span in train} if self.apart else {None: max(sizes)}
        return [
            Fit(size, n, domain)
            for domain, most in domains.items()
            for size in sizes
            if size <= most
            for n in self.horizon
        ]

    def cell_id(self, fit: Fit, K: int) -> str:
        """Names one point of the sweep, such as `meta/trajectories20-h4-k10`; without K where domains are apart."""
        return f"{self.name}/trajectories{fit.trajectories}-h{fit.horizon}{'' if self.apart else f'-k{K}'}"


def split_digest(spans: Mapping[Part, Sequence[Span]]) -> str:
    """Returns the SHA-256 of which trajectories of which domains play which part."""
    parts = {part: [(s.domain, s.first, s.count) for s in members] for part, members in spans.items()}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def supports(pool: int, K: int) -> list[slice]:
    """Returns disjoint supports of K trajectories out of a pool: at most ten; for K = 0 one empty one."""
    if K == 0:
        return [slice(0, 0)]
    return [slice(i * K, (i + 1) * K) for i in range(min(DISJOINT_SUPPORTS, pool // K))]
