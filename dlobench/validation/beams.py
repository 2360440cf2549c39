"""Checks the elastic DLO against beam theory: a loaded cantilever, a free beam's frequencies, Euler's buckling load.

Each row is the worst over what its note lists. Everything scales with EI, but for the step and the engine's thresholds:
hence both ends of the ranges.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import product

import numpy as np

from dlobench.domain import LENGTHS, STIFFNESS, Material
from dlobench.validation import theory
from dlobench.validation.check import Effort, Row, relative
from dlobench.validation.rod import FREE_SPACE, Rod, specimen
from dlobench.world import scene

SLOPES = (20.0, 40.0, 60.0)  # degrees, of the loaded end
ENDS = (LENGTHS[0], LENGTHS[-1])  # m
FINE = 0.005  # rad of an oscillation that a fine step covers
SAMPLES = 12  # an oscillation, to find its frequency from
STILL = 1e-5  # of what hinges are bent by on average: what may move in a loaded rod that has settled
AMPLITUDE = 1e-3  # rad, the largest joint angle of what swings; of what buckles it is the largest curvature, 1/m

Elastic = tuple[Material, float]  # EI N m²


def check_cantilever(effort: Effort) -> Iterator[Row]:
    """Yields the end's deflection and shortening under a load across the fixed DLO, each relative to itself.

    The step is the shipped one. Statics do not depend on damping, which is set to what comes to rest soonest. The
    shipped solver's worst figures stand beside those of the one that heeds every force (see `Rod`).
    """
    lengths = ENDS[:1] if effort == "quick" else ENDS
    beside: list[Row] = []
    for elastic in _elastic(effort):
        yield from _deflections(elastic, lengths, heedful=True)
        beside += _deflections(elastic, lengths, heedful=False)
    yield _worst(row for row in beside if "deflection" in row.name)
    yield _worst(row for row in beside if "shortening" in row.name)


def check_frequencies(effort: Effort) -> Iterator[Row]:
    """Yields a free DLO's first two bending frequencies, without damping, at a fine step and at the shipped one.

    The shipped damping is beyond critical for many of them: there would be nothing to see.
    """
    del effort  # it takes a second
    for elastic, mode, fine in product(_elastic("quick"), (0, 1), (True, False)):
        yield _worst(_frequency(elastic, length, mode, fine) for length in ENDS)


def check_buckling(effort: Effort) -> Iterator[Row]:
    """Yields the load along the fixed DLO at which a small bend neither grows nor decays, as a part of Euler's.

    The shipped step is bounded too: what keeps still does so at any step. The shipped solver would not see so small a
    bend (see `Rod`).
    """
    del effort
    for elastic, fine in product(_elastic("quick"), (True, False)):
        yield _worst(_buckling(elastic, length, fine) for length in ENDS)


def _elastic(effort: Effort) -> list[Elastic]:
    """Returns both ends of the ranges of what is elastic; when it has to be quick the softest and the stiffest."""
    ends: list[Elastic] = [(m, EI) for m in ("soft", "flexible") for EI in STIFFNESS[m]]
    return [ends[0], ends[-1]] if effort == "quick" else ends


def _worst(rows: Iterable[Row]) -> Row:
    return max(rows, key=lambda row: row.error if math.isfinite(row.error) else math.inf)


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _worst_length(length: float, lengths: Sequence[float] = ENDS) -> str:
    return f"{100 * length:g} cm, the worst of {_list([100 * each for each in lengths])}"


def _say(what: str, elastic: Elastic) -> str:
    return f"{what}, {elastic[0]} {elastic[1]:g} N m²"


def _deflections(elastic: Elastic, lengths: Sequence[float], *, heedful: bool) -> list[Row]:
    """Returns the worst deflection and the worst shortening over lengths and slopes."""
    material, EI = elastic
    bound, solver = (1.0, "solver PGS") if heedful else (None, "shipped solver")
    rows: dict[str, list[Row]] = {"deflection": [], "shortening": []}
    for length in lengths:
        rod = Rod(specimen(material, EI, length, "fixed"), heedful=heedful)
        pace = 2 / theory.cantilever_frequency(EI, rod.mass, length)
        rod.damp(pace)
        for slope in SLOPES:
            tip = theory.bent_to(math.radians(slope))
            rod.load(0.0, tip.load * EI / length**2)
            if heedful:
                rod.settle(pace, STILL * math.radians(slope) / len(rod.span))
            else:
                rod.run(12 * pace)  # it never settles: what moves under forces below the threshold goes on moving
            x, y = rod.end
            note = f"end at {slope:g}°, the worst of {_list(SLOPES)}; {_worst_length(length, lengths)}; {FREE_SPACE}"
            for what, measured, reference in (("deflection", y, tip.deflection), ("shortening", -x, tip.shortening)):
                rows[what].append(
                    relative(
                        _say(f"cantilever {what}", elastic),
                        1e3 * measured,
                        1e3 * length * reference,
                        bound,
                        "mm",
                        f"{note}, damping raised, {solver}",
                    )
                )
    return [_worst(each) for each in rows.values()]


def _frequency(elastic: Elastic, length: float, mode: int, fine: bool) -> Row:
    material, EI = elastic
    domain = specimen(material, EI, length, "none")
    reference = theory.free_frequency(mode, EI, Rod(domain).mass, length)
    rod = Rod(domain, FINE / reference if fine else scene.TIMESTEP, heedful=fine)
    solver = "solver PGS" if fine else "shipped solver"
    return relative(
        _say(f"free beam's frequency {mode + 1}", elastic),
        _swing(rod, mode, reference) / (2 * math.pi),
        reference / (2 * math.pi),
        2.0 if fine else None,
        "Hz",
        f"{_worst_length(length)}; {_step(rod, fine)}; {FREE_SPACE}, damping off, {solver}",
    )


def _step(rod: Rod, fine: bool) -> str:
    return f"{'fine' if fine else 'shipped'} step of {1e3 * rod.timestep:.3g} ms"


def _swing(rod: Rod, mode: int, expected: float) -> float:
    """Returns the angular frequency, rad/s, at which the rod swings when it is let go bent as its mode is.

    Samples of a damped oscillation obey q₊ = a q + b q₋; the angle of the roots of z² = a z + b is the frequency.
    """
    rod.damp(0.0)
    shape = theory.free_curvature(mode, rod.arc / rod.length)
    rod.place(AMPLITUDE * shape / np.abs(shape).max())
    stride = max(1, round(2 * math.pi / SAMPLES / expected / rod.timestep))
    samples = [shape @ rod.angles]
    for _ in range(2 * SAMPLES):
        rod.step(stride)
        samples.append(shape @ rod.angles)
    q = np.array(samples)
    a, b = np.linalg.lstsq(np.stack([q[1:-1], q[:-2]], axis=1), q[2:])[0]
    return float(np.abs(np.angle(np.roots([1, -a, -b]))).max()) / stride / rod.timestep


def _buckling(elastic: Elastic, length: float, fine: bool) -> Row:
    material, EI = elastic
    domain = specimen(material, EI, length, "fixed")
    euler = theory.BUCKLING_LOAD * EI / length**2
    pace = 2 / theory.cantilever_frequency(EI, Rod(domain).mass, length)
    rods = [Rod(domain, FINE * pace if fine else scene.TIMESTEP, heedful=True) for _ in range(2)]
    low, high = 0.98, 1.02
    slower, faster = _growth(rods[0], low * euler, pace), _growth(rods[1], high * euler, pace)
    return relative(
        _say("buckling load / Euler's", elastic),
        low - slower * (high - low) / (faster - slower),
        1.0,
        2.0,
        "",
        f"{_worst_length(length)}; {_step(rods[0], fine)}; {FREE_SPACE}, damping raised, solver PGS",
    )


def _growth(rod: Rod, load: float, pace: float) -> float:
    """Returns how fast a small bend grows under a load along the rod, 1/s."""
    rod.damp(pace)
    rod.place(AMPLITUDE * np.cos(math.pi / 2 * rod.arc / rod.length) * rod.span)
    rod.load(-load, 0.0)
    rod.run(5 * pace)  # until the slowest mode alone is left
    before = rod.end[1]
    rod.run(5 * pace)
    return math.log(abs(rod.end[1] / before)) / (5 * pace)
