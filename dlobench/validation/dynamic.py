"""Checks how the DLO moves against PyElastica, a code of others: a cantilever under a load that comes all at once.

PyElastica 1.0 (docs.cosseratrods.org) solves Cosserat rods, with shear and stretch, explicitly in time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from dlobench.domain import DLO_RADIUS
from dlobench.errors import RunError
from dlobench.validation import theory
from dlobench.validation.check import Effort, Row, at_most, relative
from dlobench.validation.rod import FREE_SPACE, Array, Rod, specimen
from dlobench.world import scene

LENGTH, STIFFNESS = 0.16, 1e-4  # m, N m²
LOAD = 1.0  # P L² / EI: the end swings to about twice the deflection of 0.3 L at which this load could rest
LOOKS = 200  # at the end, over one period of the first mode
FINE = 2e-4  # s
ELEMENTS = 40  # of the reference
COURANT = 0.5  # of the reference: its step over the time that stretch takes along an element


def check_dynamic(effort: Effort) -> Iterator[Row]:
    """Yields how far the end's path is from the reference's, and its first peak: without damping on either side.

    Left out when it has to be quick. Raises `RunError` when PyElastica is not installed.
    """
    if effort == "quick":
        return
    domain = specimen("flexible", STIFFNESS, LENGTH, "fixed")
    mass = Rod(domain).mass
    period = 2 * math.pi / theory.cantilever_frequency(STIFFNESS, mass, LENGTH)
    force = LOAD * STIFFNESS / LENGTH**2
    times = np.linspace(0, period, LOOKS + 1)
    reference = _reference(mass / (math.pi * DLO_RADIUS**2), force, times)
    largest = float(np.linalg.norm(reference, axis=1).max())
    for step, damped in ((FINE, False), (scene.TIMESTEP, False), (scene.TIMESTEP, True)):
        rod = Rod(domain, step)
        if not damped:
            rod.damp(0.0)
        path = _path(rod, force, times)
        note = f"{'fine' if step == FINE else 'shipped'} step of {1e3 * step:g} ms, "
        note += f"{'shipped damping' if damped else 'damping off'}; {FREE_SPACE}"
        bound = 2.0 if step == FINE else None
        apart = float(np.linalg.norm(path - reference, axis=1).max())
        yield at_most("dynamic cantilever, path / largest displacement", 100 * apart / largest, bound, "%", note)
        for what, unit, scale, ours, theirs in zip(
            ("deflection", "time"), ("mm", "ms"), (1e3, 1e3), _peak(times, path), _peak(times, reference), strict=True
        ):
            yield relative(f"dynamic cantilever, {what} of the peak", scale * ours, scale * theirs, bound, unit, note)


def _path(rod: Rod, force: float, times: Array) -> Array:
    """Returns how far the end of our rod has gone at each time: (T, 2) m."""
    rod.load(0.0, force)
    steps = math.ceil(times[-1] / rod.timestep)
    ends = [rod.end]
    for _ in range(steps):
        rod.step()
        ends.append(rod.end)
    return _at(times, rod.timestep * np.arange(steps + 1), np.array(ends))


def _reference(density: float, force: float, times: Array) -> Array:
    """Returns the same of PyElastica's rod: (T, 2) m.

    It clamps a whole element, so the first one lies half behind the clamp: the first element may then bend from there.
    """
    try:
        import elastica
    except ImportError as error:
        message = "the dynamic cantilever needs PyElastica to be held against: pip install 'dlobench[validation]'"
        raise RunError(message) from error

    class Simulator(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing):  # type: ignore[misc]
        """Steps one rod, with one end clamped and the other loaded."""

    element = LENGTH / (ELEMENTS - 0.5)
    modulus = STIFFNESS / (math.pi / 4 * DLO_RADIUS**4)
    rod = elastica.CosseratRod.straight_rod(
        ELEMENTS,
        start=np.array([-element / 2, 0.0, 0.0]),
        direction=np.array([1.0, 0.0, 0.0]),
        normal=np.array([0.0, 0.0, 1.0]),
        base_length=ELEMENTS * element,
        base_radius=DLO_RADIUS,
        density=density,
        youngs_modulus=modulus,
    )
    simulator = Simulator()
    simulator.append(rod)
    simulator.constrain(rod).using(elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,))
    tip = np.array([0.0, force, 0.0])
    simulator.add_forcing_to(rod).using(elastica.EndpointForces, 0 * tip, tip, ramp_up_time=1e-9)
    simulator.finalize()
    stepper = elastica.PositionVerlet()
    steps = math.ceil(times[-1] / (COURANT * element / math.sqrt(modulus / density)))
    step, time = times[-1] / steps, np.float64(0.0)
    ends = [rod.position_collection[:2, -1].copy()]
    for _ in range(steps):
        time = stepper.step(simulator, time, step)
        ends.append(rod.position_collection[:2, -1].copy())
    return _at(times, step * np.arange(steps + 1), np.array(ends) - ends[0])


def _at(times: Array, clock: Array, path: Array) -> Array:
    """Returns a (C, 2) path that was followed by a clock at other times."""
    return np.stack([np.interp(times, clock, path[:, axis]) for axis in (0, 1)], axis=1)


def _peak(times: Array, path: Array) -> tuple[float, float]:
    """Returns the largest deflection, m, and when it comes, s: the top of a parabola through the highest looks."""
    top = int(path[:, 1].argmax())
    near = slice(max(0, top - LOOKS // 20), top + LOOKS // 20 + 1)
    a, b, c = np.polyfit(times[near] - times[top], path[near, 1], 2)
    return float(c - b**2 / (4 * a)), float(times[top] - b / (2 * a))
