"""Solves beams in closed form: the clamped elastica, Euler's buckling load, a free beam's modes.

Lengths are in units of the beam's length L, forces in EI / L². The quadrature is exact to rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CANTILEVER_ROOT = 1.8751040687119611  # of cos β cosh β = −1
FREE_ROOTS = (4.730040744862704, 7.853204624095838)  # of cos β cosh β = 1
BUCKLING_LOAD = math.pi**2 / 4  # of a cantilever pressed along its axis
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(64)


@dataclass(frozen=True)
class Tip:
    """Holds a cantilever's end under a load that stays across the straight beam."""

    load: float  # P L² / EI
    shortening: float  # along the straight beam, from the straight beam's end
    deflection: float  # across it


def bent_to(slope: float) -> Tip:
    """Returns the load that turns the end by `slope`, rad, and where it then is (0 < slope < π/2).

    The first integral of EI θ″ = −P cos θ with θ′ = 0 at the end, in Legendre's form: with 2 k² = 1 + sin θ_L and
    2 k² sin² φ = 1 + sin θ, the arc length is (EI / P)^½ ∫ dφ / (1 − k² sin² φ)^½.
    """
    k2 = (1 + math.sin(slope)) / 2
    first = math.asin(1 / math.sqrt(2 * k2))
    half = (math.pi / 2 - first) / 2
    delta = np.sqrt(1 - k2 * np.sin(first + half * (_POINTS + 1)) ** 2)
    arc = half * float(_WEIGHTS @ (1 / delta))  # (P L² / EI)^½
    deflection = 1 - 2 * half * float(_WEIGHTS @ delta) / arc
    # The moment at the clamp is P times the reach of the end, and (θ′)² = 2 P sin θ_L / EI there.
    return Tip(load=arc**2, shortening=1 - math.sqrt(2 * math.sin(slope)) / arc, deflection=deflection)


def cantilever_frequency(stiffness: float, mass: float, length: float) -> float:
    """Returns the first angular frequency, rad/s, of a cantilever of EI N m², kg/m and m."""
    return CANTILEVER_ROOT**2 * math.sqrt(stiffness / mass) / length**2


def free_frequency(mode: int, stiffness: float, mass: float, length: float) -> float:
    """Returns the angular frequency, rad/s, of a free beam's bending mode 0 or 1, of EI N m², kg/m and m."""
    return FREE_ROOTS[mode] ** 2 * math.sqrt(stiffness / mass) / length**2


def free_curvature(mode: int, s: Array) -> Array:
    """Returns the curvature of a free beam's bending mode 0 or 1 at arc lengths s in 0–1, in any unit."""
    root = FREE_ROOTS[mode]
    ratio = (math.cosh(root) - math.cos(root)) / (math.sinh(root) - math.sin(root))
    shape: Array = np.cosh(root * s) - np.cos(root * s) - ratio * (np.sinh(root * s) - np.sin(root * s))
    return shape
