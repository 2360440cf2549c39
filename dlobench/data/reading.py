"""Reads a set as people use data: domains as a DataFrame, trajectories as arrays that are mapped when asked for."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING

from dlobench import ranges
from dlobench.data.domain_set import PARTS, SCALES, DomainSet, Span
from dlobench.data.inventory import listed
from dlobench.data.joined import map_rows
from dlobench.data.minibatches import Minibatches
from dlobench.data.sets import find, find_scale
from dlobench.data.store import Rows, Store, unpack
from dlobench.data.table import domains_table
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Trajectories

if TYPE_CHECKING:
    import pandas as pd


class Reading(Mapping[int, Trajectories]):
    """Maps the trajectories of domains, by their numbers. A domain is opened when it is first asked for.

    Arrays are float32, read-only and memory-mapped: what is not used is not read. They hold all that is recorded;
    `Trajectories.observed` leaves out what models must not see.
    """

    def __init__(self, store: Store, of: DomainSet, spans: list[Span]) -> None:
        self._store, self._of = store, of
        self._spans = {span.domain: span for span in spans}
        self._rows: dict[int, Rows] = {}

    def __getitem__(self, domain: int) -> Trajectories:
        return unpack(self.rows(domain), self._of.geometry(domain))

    def __iter__(self) -> Iterator[int]:
        return iter(self._spans)

    def __len__(self) -> int:
        return len(self._spans)

    def __contains__(self, domain: object) -> bool:
        return domain in self._spans

    def rows(self, domain: int) -> Rows:
        """Returns what is on disk of a domain: (K, T+1, 114), see `dlobench.data.store.COLUMNS`."""
        if domain not in self._rows:
            if domain not in self._spans:
                raise KeyError(f"domain {domain} of {self._of.name} is not among the {len(self)} that were loaded")
            self._rows[domain] = map_rows(self._store, self._of, self._spans[domain])
        return self._rows[domain]

    def minibatches(self, *, horizon: int) -> Minibatches:
        """Returns the minibatches of all windows of `horizon` pushes, for which it opens all domains."""
        return Minibatches({domain: self.rows(domain) for domain in self}, horizon=horizon)

    @cached_property
    def spans(self) -> tuple[Span, ...]:
        """Returns which trajectories of each domain these are."""
        return tuple(self._spans.values())


def load(
    set: str,  # noqa: A002  # our word for it
    scale: str = "mini",
    part: str = "train",
    data: str | os.PathLike[str] | None = None,
) -> tuple[pd.DataFrame, Reading]:
    """Loads a part of a set: its domains, a row each, and their trajectories, memory-mapped.

    Args:
        set: the name of a set, see `dlobench list sets`.
        scale: mini, small or paper.
        part: train, valid or test.
        data: the data folder, by default $DLOBENCH_DATA, else the platform's cache.

    Raises:
        UsageError: where there is no such set, scale or part.
        RunError: where trajectories are still to be generated; it names the command.

    Examples:
        >>> import numpy as np
        >>> domains, trajectories = load("meta-learning", "mini", part="train")
        >>> domains.loc[600, "material"], float(domains.loc[600, "length_m"]), int(domains.loc[600, "trajectories"])
        ('soft', 0.16, 20)
        >>> trajectories[600].dlo.shape  # x m, y m, yaw rad; memory-mapped
        (20, 21, 32, 3)
        >>> batch = next(trajectories.minibatches(horizon=4).epoch(64, np.random.default_rng(0)))
        >>> batch.dlo.shape, batch.actions.shape, batch.torch().dlo_after.shape
        ((64, 32, 3), (64, 4, 2), torch.Size([64, 32, 3]))

    """
    of, chosen = find(set), find_scale(scale)
    ranges.choice("part", part, PARTS)
    spans = sorted(of.spans(chosen), key=lambda span: span.domain)
    mine = [span for span in spans if span.part == part]
    if not mine:
        have = ", ".join(name for name in PARTS if any(span.part == name for span in spans))
        raise UsageError(f"{set} has no part {part!r} at scale {scale}; there are: {have}")
    store = Store.open(data)
    missing = sorted({span.domain for span in mine if _lacks(store, of, span)})
    if missing:
        folder = "" if data is None else f" --data {shlex.quote(str(data))}"
        command = f"dlobench generate {set} --scale {scale}{folder}"
        raise RunError(
            f"{len(missing)} of {len(mine)} domains of {set}/{scale} ({part}) are not in {store.root}; `{command}` "
            "makes them"
        )
    held = {span.domain: span.count for span in mine}
    table = domains_table(of, chosen).set_index("domain").loc[list(held)]
    table = table.drop(columns=[name for name in map(str, table) if name.split("_")[0] in SCALES] + ["parts"])
    return table.assign(part=part, trajectories=list(held.values())), Reading(store, of, mine)


def _lacks(store: Store, of: DomainSet, span: Span) -> bool:
    """Tells whether a shard of a span is still to be made, by the names in its folder alone."""
    units = list(of.units([span]))
    there = {*listed(store.path(of, units[0]).parent)}
    return not {store.path(of, unit).with_suffix(".json").name for unit in units} <= there
