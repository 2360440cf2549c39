"""Lists the checks, in the order in which they are printed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dlobench.errors import UsageError
from dlobench.validation.beams import check_buckling, check_cantilever, check_frequencies
from dlobench.validation.check import Check, Effort, Row
from dlobench.validation.directions import check_directions
from dlobench.validation.dynamic import check_dynamic
from dlobench.validation.energy import check_energy
from dlobench.validation.flex_rod import check_flex_rod
from dlobench.validation.folds import check_folds
from dlobench.validation.pairs import check_pairs
from dlobench.validation.plasticity import check_plasticity
from dlobench.validation.pushes import check_at_rest, check_random_pushes, check_step_size
from dlobench.validation.sameness import check_jacobians, check_same_bits
from dlobench.validation.shapes import check_materials
from dlobench.validation.sliding import check_sliding
from dlobench.validation.spinning import check_spinning
from dlobench.validation.statics import check_weight
from dlobench.validation.sticking import check_creep, check_threshold

CHECKS: dict[str, Check] = {
    "cantilever": check_cantilever,
    "frequencies": check_frequencies,
    "buckling": check_buckling,
    "plasticity": check_plasticity,
    "folds": check_folds,
    "sliding": check_sliding,
    "threshold": check_threshold,
    "creep": check_creep,
    "weight": check_weight,
    "spinning": check_spinning,
    "directions": check_directions,
    "pairs": check_pairs,
    "dynamic-cantilever": check_dynamic,
    "flex-rod": check_flex_rod,
    "step-size": check_step_size,
    "jacobians": check_jacobians,
    "random-pushes": check_random_pushes,
    "at-rest": check_at_rest,
    "energy": check_energy,
    "same-bits": check_same_bits,
    "materials": check_materials,
}


def choose(names: Sequence[str]) -> dict[str, Check]:
    """Returns the checks of these names in the suite's order, all of them for none; raises `UsageError` otherwise."""
    for name in names:
        if name not in CHECKS:
            raise UsageError(f"unknown check {name!r}; there are: {', '.join(CHECKS)}")
    return {name: check for name, check in CHECKS.items() if not names or name in names}


def rows(name: str, check: Check, effort: Effort) -> Iterator[Row]:
    """Yields a check's rows. One that raises fails by a row that says so, and the others still have their turn."""
    try:
        yield from check(effort)
    except Exception as error:
        nothing = float("nan")
        yield Row(f"{name} ends", nothing, 0.0, nothing, 0.0, note=f"{type(error).__name__}: {error}")
