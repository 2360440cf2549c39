"""Simulates shards again and sets them beside those on disk, whose digests cannot tell that they are what they claim.

Where CPU and versions are those of the shard, the bytes must be the same. Elsewhere the last bits may differ, and a rod
that snaps amplifies them. Tried on ten trajectories of each of 18 domains: when the last bit of every displacement was
changed, two in three came out the same, and the worst moved by 9e-6 m in the mean of its segments; when it was four in
10^12, by 4e-4 m. The median of a domain never moved by more than 3e-11 m, so that shards of another machine are held to
it: the median over their trajectories may be a fiftieth of the execution noise.
"""

from __future__ import annotations

import random
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from dlobench import ranges
from dlobench.data.domain_set import DomainSet, Unit
from dlobench.data.executors import Executor
from dlobench.data.generate import simulate_unit
from dlobench.data.inventory import folders
from dlobench.data.sidecar import origin
from dlobench.data.store import Store, pack, unpack
from dlobench.errors import RunError

TOLERANCE = 1e-5  # m
_DECIDING = ("python", "numpy", "mujoco")  # whose versions decide the bits


@dataclass(frozen=True)
class Reproduced:
    """Says how far a shard that was simulated again is from the one on disk."""

    unit: Unit
    same_machine: bool  # CPU and versions, so that every byte must be the same
    same_bytes: bool
    median: float  # m, over trajectories, of the mean distance of the segments
    mean: float  # m, the distance of segments, over all states
    max: float  # m

    @property
    def agrees(self) -> bool:
        """Tells whether the shard is what its definition makes."""
        return self.same_bytes if self.same_machine else self.median <= TOLERANCE

    @property
    def held_to(self) -> str:
        """Tells in words what decides whether it agrees."""
        return "its bytes" if self.same_machine else f"a median distance of {TOLERANCE:g} m"

    def row(self, path: object) -> dict[str, Any]:
        """Returns what a reader of a table asks for."""
        apart = {"median_m": self.median, "mean_m": self.mean, "max_m": self.max}
        return {"shard": str(path), "agrees": self.agrees, "held_to": self.held_to, **apart}


def reproduce(store: Store, of: DomainSet, units: Sequence[Unit], executor: Executor) -> Iterator[Reproduced]:
    """Yields, for each unit, how far what is simulated now is from what is on disk."""
    yield from executor(partial(again, store=store, of=of), units)


def again(unit: Unit, store: Store, of: DomainSet) -> Reproduced:
    """Simulates a shard again, and compares; raises `Broken` where it is broken."""
    rows, sidecar = store.rows(of, unit), store.sidecar(of, unit)
    here = origin()
    then, now = unpack(rows, of.geometry(unit.domain)), simulate_unit(of, unit)[0]
    apart = np.linalg.norm(then.dlo[..., :2] - now.dlo[..., :2], axis=-1)[..., then.dlo_mask]
    return Reproduced(
        unit,
        same_machine=sidecar is not None
        and sidecar["cpu"] == here["cpu"]
        and all(sidecar["versions"][name] == here["versions"][name] for name in _DECIDING),
        same_bytes=rows.tobytes() == pack(now).tobytes(),
        median=float(np.median(apart.mean(axis=(1, 2)))),
        mean=float(apart.mean()),
        max=float(apart.max()),
    )


def chosen(store: Store, of: DomainSet, count: int, *, seed: int, without: Container[Unit] = ()) -> list[Unit]:
    """Returns whole shards, spread over what is there: one, drawn by the seed, from each of `count` equal stretches.

    Raises `UsageError` for a count below 1, and `RunError` when there are fewer.
    """
    ranges.whole("--regenerate", count, 1)
    there = [unit for folder in folders(store, of) for unit in folder.sealed if unit not in without]
    if len(there) < count:
        raise RunError(f"--regenerate {count} is more than the {len(there)} whole shards of {of.name} in {store.root}")
    rng = random.Random(seed)
    edges = [len(there) * i // count for i in range(count + 1)]
    return [there[rng.randrange(first, last)] for first, last in pairwise(edges)]
