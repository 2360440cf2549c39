"""Checks the point of the paper's Fig. 2: the same path of the pusher leaves three materials in three shapes.

A straight DLO of 16 cm with a fixed end is pushed sideways by 10 cm at its third, in several pushes, and left alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import DLO_RADIUS, MATERIALS, PUSHER_RADIUS, STIFFNESS, YIELD_CURVATURE, Domain, Material
from dlobench.validation.check import Effort, Row, at_most
from dlobench.world.chain import CYLINDER_RADIUS
from dlobench.world.simulate import Simulator
from dlobench.world.starts import Start
from dlobench.world.state import State

Array = NDArray[np.float64]

LENGTH = 0.16  # m
FRICTION, DENSITY = 0.3, 1000.0  # and kg/m³
SIDE = (-0.085, -0.06)  # m, the cylinder's place
CLEAR = 0.001  # m, between pusher and DLO at the start
STRIDE, PUSHES, RETREATS = 0.02, 5, 5  # m a push; the pusher goes back the way it came
BENT = 1.0  # rad, the least bend at the peak that can tell anything
KEPT = 50.0  # % of the peak's bend: more is a shape that stays, less one that straightens
DIFFERENT = 100 * 2 * DLO_RADIUS / LENGTH  # % of the length: further apart on average than the DLO is thick


def check_materials(effort: Effort) -> Iterator[Row]:  # noqa: ARG001 one size
    """Bends the three materials by the same path and tells what stays of it."""
    yield from shape_rows({material: np.stack([s.dlo[0] for s in path(material)]) for material in MATERIALS})


def shape_rows(paths: Mapping[Material, Array]) -> Iterator[Row]:
    """Yields bends and distances of the paths, (states, segments, 3) each: start, pushes, retreat."""
    for material, dlo in paths.items():
        bends = bend(dlo)
        peak, after = float(bends[: PUSHES + 1].max()), float(bends[-1])
        yield at_least(f"bend at the peak, {material}", peak, BENT, "rad")
        judge = at_most if material == "flexible" else at_least
        kept = 100 * after / max(peak, 1e-9)
        yield judge(f"bend kept after the retreat, {material}", kept, KEPT, "%", f"{after:.2f} rad")
    for one, two in combinations(paths, 2):
        apart = np.linalg.norm(paths[one][-1, :, :2] - paths[two][-1, :, :2], axis=-1).mean() / LENGTH
        yield at_least(f"shapes apart, {one} and {two}", 100 * float(apart), DIFFERENT, "% L", "mean over segments")


def at_least(name: str, measured: float, least: float, unit: str, note: str = "") -> Row:
    """Returns a row that passes where the measured figure reaches its reference."""
    return Row(name, measured, least, max(least - measured, 0.0), 0.0, unit, unit, note)


def domain_of(material: Material) -> Domain:
    """Returns the middle of a material's ranges."""
    yields = math.sqrt(math.prod(YIELD_CURVATURE)) if material == "elastoplastic" else None
    return Domain(FRICTION, LENGTH, DENSITY, material, math.sqrt(math.prod(STIFFNESS[material])), yields, "fixed")


def path(material: Material) -> list[State]:
    """Returns the states of the fixed path: the start, after every push, after every step of the retreat."""
    domain = domain_of(material)
    simulator = Simulator(domain, 1)
    third = SIDE[0] + CYLINDER_RADIUS + LENGTH / 3
    start = Start(
        root=np.array([*SIDE, 0.0]),
        bends=np.zeros(domain.segments),
        bodies=np.zeros((0, 3)),
        pusher=np.array([third, SIDE[1] - DLO_RADIUS - PUSHER_RADIUS - CLEAR]),
    )
    strides = [STRIDE] * PUSHES + [-STRIDE] * RETREATS
    return [simulator.reset([start]), *(simulator.push(np.array([[0.0, stride]])) for stride in strides)]


def bend(dlo: Array) -> Array:
    """Returns the total bend of (…, segments, 3) poses, the sum of all joints' angles without their signs, rad."""
    turns = np.diff(dlo[..., 2], axis=-1)
    total: Array = np.abs((turns + np.pi) % (2 * np.pi) - np.pi).sum(axis=-1)
    return total
