"""Tells what is done, pending and broken of a set."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from dlobench.data.domain_set import SCALES, DomainSet, ScaleName, Unit
from dlobench.data.inventory import folders, places, sealed, within
from dlobench.data.store import Broken, Store


@dataclass
class Status:
    """Sorts units into done, pending and broken."""

    done: list[Unit] = field(default_factory=list)
    pending: list[Unit] = field(default_factory=list)
    broken: dict[Unit, str] = field(default_factory=dict)


def status(store: Store, of: DomainSet, units: Iterable[Unit], *, every_byte: bool = False) -> Status:
    """Looks for units on disk; `every_byte` checks each array against its digest."""
    out = Status()
    for _, group in groupby(units, key=lambda unit: unit.domain):
        of_domain = list(group)
        here = sealed(store.path(of, of_domain[0]).parent)
        for unit in of_domain:
            if unit.first not in here:
                out.pending.append(unit)
                continue
            try:
                if every_byte:
                    store.rows(of, unit)
                else:
                    store.sidecar(of, unit)
            except Broken as error:
                out.broken[unit] = error.why
            else:
                out.done.append(unit)
    return out


@dataclass(frozen=True)
class Tally:
    """Counts what is there of one scale of a set."""

    done: int  # shards
    pending: int
    broken: int
    pushes: int
    bytes: int  # of the arrays that are done
    seconds: float  # processor seconds that they took
    digest: str | None  # SHA-256 over the sorted names and SHA-256s of what is done: alike where two folders are

    @property
    def rate(self) -> float | None:
        """Returns the pushes a second of one core."""
        return self.pushes / self.seconds if self.seconds else None


@dataclass(frozen=True)
class Census:
    """Counts what is there of a set, by sizes and sidecars."""

    scales: dict[ScaleName, Tally]
    broken: dict[Unit, str]
    halves: int  # arrays without a sidecar, which count as pending
    temporary: list[Path]
    strays: list[Path]


def census(store: Store, of: DomainSet) -> Census:
    """Counts what is there of every scale of a set. Reads every sidecar once, and no array."""
    counts = {scale: _Count(of, scale) for scale in SCALES}
    broken, temporary, strays, halves = dict[Unit, str](), list[Path](), list[Path](), 0
    for folder in folders(store, of):
        temporary, strays, halves = temporary + folder.temporary, strays + folder.strays, halves + len(folder.halves)
        for unit in folder.sealed:
            inside = [count for count in counts.values() if within(count.places, unit)]
            try:
                sidecar = store.sidecar(of, unit)
            except Broken as error:
                broken[unit] = error.why
                for count in inside:
                    count.broken += 1
                continue
            if sidecar is not None:
                for count in inside:
                    count.add(unit, sidecar["sha256"], sidecar["bytes"], sidecar["seconds"])
    tallies = {scale: count.tally(of.pushes * of.block) for scale, count in counts.items()}
    return Census(tallies, broken, halves, temporary, strays)


class _Count:
    """Adds up what is there of one scale, unit after unit in their order."""

    def __init__(self, of: DomainSet, scale: ScaleName) -> None:
        self.places = places(of, scale)
        self.done = self.broken = self.bytes = 0
        self.seconds = 0.0
        self.digest = hashlib.sha256(of.key.encode())

    def add(self, unit: Unit, sha256: str, size: int, seconds: float) -> None:
        """Adds a unit that is done."""
        self.done, self.bytes, self.seconds = self.done + 1, self.bytes + size, self.seconds + seconds
        self.digest.update(f"\n{unit.domain:05d}/{unit.first:07d} {sha256}".encode())

    def tally(self, pushes: int) -> Tally:
        """Returns what was added up, given the pushes of a shard."""
        total = sum(len(each) for ranges in self.places.values() for each in ranges)
        return Tally(
            done=self.done,
            pending=total - self.done - self.broken,
            broken=self.broken,
            pushes=self.done * pushes,
            bytes=self.bytes,
            seconds=self.seconds,
            digest=self.digest.hexdigest() if self.done else None,
        )
