"""Defines the sets of the paper's section 2.3, and finds them and their domains by name.

A set is regenerable from its name, its version and seeds. Scales nest: what `mini` generated is reused by `small`, and
that by `paper`. What each holds, and why, stands in docs/adr/0009.
"""

from __future__ import annotations

from itertools import product

from dlobench import ranges
from dlobench.data.domain_set import SCALES, Cell, DomainSet, Extent, ScaleName
from dlobench.domain import ATTACHMENTS, LENGTHS, MATERIALS, Domain
from dlobench.errors import UsageError

EXECUTIONS = 64  # R, of the same commands from the same state
SEQUENCES = 2  # of commands from each initial state

_LARGE = tuple(Cell(m, a, 0.16, objects) for m, a, objects in product(MATERIALS, ATTACHMENTS, (0, 3)))
_ALONE = {"length": 0.16, "rigid_objects": 0}  # the paper's Table 1


def _moments(states: int) -> tuple[Extent, ...]:
    """Returns the extent of a set of re-executed commands from so many initial states a domain."""
    return (Extent(train=0, valid=0, test=states * SEQUENCES * EXECUTIONS),)


_SETS = (
    DomainSet(
        name="single-domain-large",
        version=1,
        cells=_LARGE,
        per_cell=1,
        block=10,
        sampled=False,
        parted="trajectories",
        extents={
            "mini": (Extent(train=50, valid=10, test=20),),
            "small": (
                Extent(train=500, valid=20, test=50),
                Extent(train=5_000, valid=20, test=50, where={"attachment": "none", "rigid_objects": 0}),
            ),
            "paper": (Extent(train=50_000, valid=500, test=500),),
        },
    ),
    DomainSet(
        name="single-domain-medium",
        version=1,
        cells=tuple(Cell(*cell, 0) for cell in product(MATERIALS, ATTACHMENTS, (0.10, 0.13, 0.16))),
        per_cell=1,
        block=10,
        sampled=False,
        parted="trajectories",
        extents={
            "mini": (Extent(train=50, valid=10, test=20),),
            "small": (Extent(train=500, valid=20, test=50),),
            "paper": (Extent(train=5_000, valid=500, test=500),),
        },
    ),
    DomainSet(
        name="meta-learning",
        version=1,
        cells=tuple(Cell(*cell) for cell in product(MATERIALS, ATTACHMENTS, LENGTHS, range(4))),
        per_cell=25,
        block=20,
        parted="domains",
        extents={
            "mini": (
                Extent(train=20, valid=20, test=20, per_cell=8, where=_ALONE),
                Extent(train=20, valid=20, test=20, where={"length": 0.12, "rigid_objects": (1, 3)}),
            ),
            "small": (
                Extent(train=60, valid=60, test=60, per_cell=24, where=_ALONE),
                Extent(train=20, valid=20, test=20),
            ),
            "paper": (Extent(train=500, valid=500, test=500, per_cell=25),),
        },
    ),
    DomainSet(
        name="distribution",
        version=1,
        cells=_LARGE,
        per_cell=1,
        block=SEQUENCES * EXECUTIONS,
        sampled=False,
        parted="trajectories",
        pushes=8,
        executions=EXECUTIONS,
        extents={"mini": _moments(1), "small": _moments(5), "paper": _moments(500)},
    ),
)
SETS = {each.name: each for each in _SETS}


def find(name: str) -> DomainSet:
    """Returns a set by name; raises `UsageError` naming the choices."""
    if name not in SETS:
        raise UsageError(f"unknown set {ranges.shown(name)}; there are: {', '.join(SETS)}")
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
    """Returns the domain that an id, such as `meta-learning/17`, stands for; raises `UsageError` as `locate` does."""
    of, index = locate(domain_id)
    return of.domain(index)


def find_scale(name: str) -> ScaleName:
    """Returns a scale by name; raises `UsageError` naming the choices."""
    for scale in SCALES:
        if name == scale:
            return scale
    raise UsageError(f"unknown scale {ranges.shown(name)}; there are: {', '.join(SCALES)}")
