"""Checks what random pushes leave behind: their step-size error, whether all is well, whether it lies still."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import ATTACHMENTS, MATERIALS, MAX_BODIES, Domain
from dlobench.validation.check import Effort, Row, at_most
from dlobench.validation.survey import FINER, Found, survey

Array = NDArray[np.float64]

JUDGED = 100  # pushes that a mean needs to be judged: a few pushes that can go either way make most of it
STEP_BOUND = 0.3  # mm, mean over pushes
DEPTH_BOUND, DEPTH_PERCENTILE = 1.0, 99.9  # mm
STILL = 0.001  # m/s
STILL_BOUND = 0.1  # % of the pushes that may end faster


def check_step_size(effort: Effort) -> Iterator[Row]:
    """Compares pushes with the same pushes at a tenth of the step, from the same state at rest."""
    yield from step_rows(survey(effort))


def check_random_pushes(effort: Effort) -> Iterator[Row]:
    """Looks for what must never be in a recorded state: no numbers, warnings, leaks, crossings, overlaps."""
    yield from sanity_rows(survey(effort))


def check_at_rest(effort: Effort) -> Iterator[Row]:
    """Looks how fast anything still is when a push ends, and what it matters that a record has no velocities."""
    yield from rest_rows(survey(effort))


def step_rows(found: Sequence[Found]) -> Iterator[Row]:
    """Yields the step-size error of every material, attachment and object count, and over all."""
    for name, part in [("all", list(found)), *_parts(found)]:
        error, motion = (np.concatenate([getattr(f.compared, row) for f in part]) for row in ("step", "motion"))
        about = f"against step/{FINER}; {len(error)} pushes of {1e3 * _mean(motion):.1f} mm"
        about += f"; median {_percentile(error, 50):.2f} mm, 95th percentile {_percentile(error, 95):.2f} mm"
        if name == "all":
            about += f"; most in {_worst(found, [_mean(f.compared.step) for f in found])}"
        bound = STEP_BOUND if name == "all" or len(error) >= JUDGED or not len(error) else None
        yield at_most(f"step-size error a push, {name}", 1e3 * _mean(error), bound, "mm", about)


def sanity_rows(found: Sequence[Found]) -> Iterator[Row]:
    """Yields the counts of impossible states, the deep end of the penetrations, and what was redrawn."""
    simulated = np.concatenate([np.max(list(f.depth.values()), axis=0) for f in found])
    deepest = simulated[np.concatenate([f.recorded for f in found])]
    states = f"{sum(f.commands for f in found)} random pushes, {len(deepest)} states of trajectories that are kept"
    yield at_most("states that are no number", int((~np.isfinite(deepest)).sum()), 0, note=states)
    yield at_most("trajectories with an engine warning", int(sum(f.warned.sum() for f in found)), 0)
    yield at_most("states with something beyond a wall", int(sum((f.outside & f.recorded).sum() for f in found)), 0)
    yield at_most(
        "states in which the DLO crosses itself", int(sum(((f.crossings > 0) & f.recorded).sum() for f in found)), 0
    )
    over = f"{100 * (deepest > DEPTH_BOUND / 1e3).mean():.3f} % of states over {DEPTH_BOUND:g} mm"
    depth = _percentile(deepest, DEPTH_PERCENTILE)
    yield at_most(f"penetration, {DEPTH_PERCENTILE} % of states", depth, DEPTH_BOUND, "mm", over)
    every = f"{100 * (simulated > DEPTH_BOUND / 1e3).mean():.3f} % of states over {DEPTH_BOUND:g} mm, which ends them"
    depth = _percentile(simulated, DEPTH_PERCENTILE)
    yield at_most("penetration, redrawn trajectories included", depth, None, "mm", every)
    pairs = dict[str, Array]()
    for name in sorted({name for f in found for name in f.depth}):
        pairs[name] = np.concatenate([f.depth[name] for f in found if name in f.depth])
    for name, depths in sorted(pairs.items(), key=lambda pair: -_percentile(pair[1], DEPTH_PERCENTILE)):
        where = _worst(found, [float(f.depth[name].max()) if name in f.depth else 0.0 for f in found])
        about = f"deepest {1e3 * depths.max():.2f} mm, in {where}"
        yield at_most(f"penetration, {name}", _percentile(depths, DEPTH_PERCENTILE), None, "mm", about)
    redrawn = {name: 100 * float(np.concatenate([f.failed for f in part]).mean()) for name, part in _cells(found)}
    worst = max(redrawn, key=lambda name: redrawn[name])
    share = 100 * float(np.concatenate([f.failed for f in found]).mean())
    yield at_most("trajectories redrawn", share, None, "%", f"worst cell {worst}: {redrawn[worst]:.1f} %")
    again, kept = sum(f.redrawn for f in found), sum(f.commands for f in found)
    yield at_most("commands redrawn", 100 * again / (again + kept), None, "%", "infeasible ones, of all drawn")


def rest_rows(found: Sequence[Found]) -> Iterator[Row]:
    """Yields the share of pushes that end in motion, and what a restart from positions alone changes."""
    for name, part in [("all", list(found)), *_parts(found)]:
        speeds = {name: np.concatenate([f.speed[name] for f in part]) for name in part[0].speed}
        speed = np.max(list(speeds.values()), axis=0)
        about = ", ".join(f"{name} {_share(own):.2f} %" for name, own in speeds.items())
        about += f"; fastest {1e3 * speed.max():.0f} mm/s"
        bound = STILL_BOUND if name == "all" else None
        yield at_most(f"pushes that end faster than 1 mm/s, {name}", _share(speed), bound, "%", about)
    change, motion = (np.concatenate([getattr(f.compared, row) for f in found]) for row in ("restart", "motion"))
    about = f"mean over segments after the next push; 95th percentile {_percentile(change, 95):.2f} mm"
    about += f", motion {1e3 * _mean(motion):.1f} mm"
    yield at_most("restart from positions alone", 1e3 * _mean(change), None, "mm", about)


def _worst(found: Sequence[Found], figures: Sequence[float]) -> str:
    """Names the cell of the domain whose figure is largest; what is no number is not."""
    return _cell(found[int(np.argmax(np.nan_to_num(figures, nan=-np.inf)))].domain)


def _mean(values: Array) -> float:
    """Returns the mean; of nothing it is no number, which fails: a world that does not move has no error."""
    return float(values.mean()) if len(values) else float("nan")


def _percentile(metres: Array, percent: float) -> float:
    """Returns a percentile in mm; of nothing it is no number."""
    return 1e3 * float(np.percentile(metres, percent)) if len(metres) else float("nan")


def _share(speed: Array) -> float:
    """Returns the share in % that is not still; what is no number is not."""
    return 100 * float((~(speed < STILL)).mean())


def _parts(found: Sequence[Found]) -> Iterator[tuple[str, list[Found]]]:
    """Yields what was found of every material, attachment and object count."""
    kinds: list[tuple[Sequence[object], Callable[[Domain], object], str]] = [
        (MATERIALS, lambda domain: domain.material, ""),
        (ATTACHMENTS, lambda domain: domain.attachment, "attachment "),
        (range(MAX_BODIES + 1), lambda domain: len(domain.bodies), "rigid objects "),
    ]
    for values, of, title in kinds:
        for value in values:
            if part := [f for f in found if of(f.domain) == value]:
                yield f"{title}{value}", part


def _cells(found: Sequence[Found]) -> Iterator[tuple[str, list[Found]]]:
    """Yields what was found of every cell of material, attachment and object count."""
    cells = dict[str, list[Found]]()
    for f in found:
        cells.setdefault(_cell(f.domain), []).append(f)
    yield from cells.items()


def _cell(domain: Domain) -> str:
    return f"{domain.material}–{domain.attachment}–{len(domain.bodies)}"
