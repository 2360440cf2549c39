"""Plans a generation: how long it takes and how much it holds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dlobench.data.domain_set import Cell, DomainSet, Span
from dlobench.data.executors import Executor
from dlobench.data.store import data_bytes

# Processor seconds of a push, all materials and attachments, fitted to 108 domains of 10, 13 and 16 cm with 0 to 3
# bodies on a 2.6 GHz Xeon (Sapphire Rapids): 356 pushes a second of the shortest DLO alone, 156 of the longest one,
# 110 beside three bodies. `dlobench data plan` measures the machine that it runs on.
SECONDS_PER_METRE = 0.060
FREE_METRES = 0.053
SECONDS_PER_BODY = 0.00095

HEADER = 128  # bytes of an array's file before its numbers
BLOCK = 4096  # bytes that a file system allocates at a time


def estimated_hours(of: DomainSet, spans: Iterable[Span]) -> float:
    """Returns the core-hours that generating these spans takes on the machine that the constants come from."""
    return sum(span.count * of.pushes * push_seconds(of.cell(span.domain)) for span in spans) / 3600


def push_seconds(cell: Cell) -> float:
    """Returns the processor seconds that a push takes there, on average over materials and attachments."""
    return SECONDS_PER_METRE * (cell.length - FREE_METRES) + SECONDS_PER_BODY * cell.rigid_objects


@dataclass(frozen=True)
class Plan:
    """Says what generating some spans takes."""

    pushes: int
    shards: int
    files: int  # an array and a sidecar a shard
    samples: int  # shards of which the cost was measured
    uncertainty: float  # standard error of the hours, as a part of them
    core_hours: float
    workers: int
    wall_hours: float  # with so many workers like those that were measured
    array_bytes: int
    sidecar_bytes: int
    allocated_bytes: int  # in blocks of 4 KiB


def plan(
    of: DomainSet,
    spans: Sequence[Span],
    executor: Executor,
    *,
    workers: int,
    seconds: float,
    progress: Callable[[int, int], None],
) -> Plan:
    """Plans the generation of spans on so many workers, after measuring for some `seconds` where the executor runs."""
    from dlobench.data.cost import measure  # imports the world, which lists of sets can do without

    units = list(of.units(sorted(spans, key=lambda span: _likeness(of, span))))
    costs = measure(units, executor, seconds, progress)
    count, core = len(units), np.array([cost.core_seconds for cost in costs])
    array = HEADER + data_bytes(of, units[:1])
    sidecar = float(np.mean([cost.sidecar for cost in costs]))
    return Plan(
        pushes=count * of.block * of.pushes,
        shards=count,
        files=2 * count,
        samples=len(costs),
        uncertainty=float(core.std(ddof=1) / math.sqrt(len(core)) / core.mean()),
        core_hours=count * float(core.mean()) / 3600,
        workers=workers,
        wall_hours=count * float(np.mean([cost.wall_seconds for cost in costs])) / workers / 3600,
        array_bytes=count * array,
        sidecar_bytes=round(count * sidecar),
        allocated_bytes=count * BLOCK * (math.ceil(array / BLOCK) + math.ceil(sidecar / BLOCK)),
    )


def _likeness(of: DomainSet, span: Span) -> tuple[object, ...]:
    """Returns what spans of like cost have in common."""
    cell = of.cell(span.domain)
    return cell.rigid_objects, cell.length, cell.material, cell.attachment, span.domain, span.first
