"""Tests the beam theory against what is known otherwise, and that its checks find a wrong scene."""

from __future__ import annotations

import math
import sys
from itertools import pairwise

import numpy as np
import pytest
from altered import Edit, alter, displace, stiffen, verdicts

from dlobench.errors import RunError
from dlobench.validation import dynamic, theory
from dlobench.validation.beams import check_buckling, check_cantilever, check_frequencies
from dlobench.validation.check import Check, Row
from dlobench.validation.rod import Array, Rod, specimen
from dlobench.world import scene


def under(load: float) -> tuple[float, theory.Tip]:
    """Returns the end's slope and place under a load, EI / L², by bisection."""
    low, high = 1e-6, math.pi / 2 - 1e-6
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if theory.bent_to(middle).load < load else (low, middle)
    return low, theory.bent_to(low)


# Mattiasson, Numerical results from large deflection beam and frame problems analysed by means of elliptic integrals,
# International Journal for Numerical Methods in Engineering 17, 1981: P L² / EI, deflection, shortening, slope.
MATTIASSON = [(1, 0.30172, 0.05643, 0.46135), (2, 0.49346, 0.16064, 0.78175), (5, 0.71379, 0.38763, 1.21537)]


@pytest.mark.parametrize(("load", "deflection", "shortening", "slope"), MATTIASSON)
def test_the_elastica_is_the_tabulated_one(load: float, deflection: float, shortening: float, slope: float) -> None:
    found, tip = under(load)
    assert (tip.deflection, tip.shortening, found) == pytest.approx((deflection, shortening, slope), abs=6e-6)


def test_a_small_load_bends_as_linear_theory_says() -> None:
    tip = theory.bent_to(1e-3)
    assert tip.load == pytest.approx(2e-3, rel=1e-5)
    assert tip.deflection == pytest.approx(tip.load / 3, rel=1e-5)
    assert tip.shortening == pytest.approx(tip.load**2 / 15, rel=1e-4)  # ½ ∫ (s − s²/2)² P² ds


def test_the_elastica_obeys_its_equation() -> None:
    tip = theory.bent_to(math.radians(60))
    steps = 20_000
    slope, curvature, x, y = (
        0.0,
        tip.load * (1 - tip.shortening),
        0.0,
        0.0,
    )  # the moment at the clamp is P times the reach
    for _ in range(steps):
        curvature -= tip.load * math.cos(slope) / steps / 2
        x, y = x + math.cos(slope + curvature / steps / 2) / steps, y + math.sin(slope + curvature / steps / 2) / steps
        slope += curvature / steps
        curvature -= tip.load * math.cos(slope) / steps / 2
    assert (slope, curvature) == pytest.approx((math.radians(60), 0.0), abs=1e-4)
    assert (1 - x, y) == pytest.approx((tip.shortening, tip.deflection), abs=1e-4)


def finite_beam(points: int, mass: Array, clamped: bool) -> Array:
    """Returns the squared frequencies of a beam of EI = L = 1 in finite differences, its mass at the points."""
    h = 1 / (points - 1)
    rows = [[1 if j in (i - 1, i + 1) else -2 if j == i else 0 for j in range(points)] for i in range(1, points - 1)]
    bend = np.array(rows, dtype=float) / h**2
    weight = np.full(points - 2, h)
    if clamped:  # symmetric about the clamp, with half an interval to bend over
        bend = np.concatenate([[[-2, 2] + [0] * (points - 2)], bend * h**2]) / h**2
        weight = np.concatenate([[h / 2], weight])
    stiffness = bend.T @ (weight[:, None] * bend)
    if clamped:
        stiffness, mass = stiffness[1:, 1:], mass[1:]
    return np.sort(np.linalg.eigvals(stiffness / mass[:, None]).real)


def test_the_frequencies_are_those_of_finite_differences() -> None:
    points = 161
    mass = np.full(points, 1 / (points - 1))
    mass[[0, -1]] /= 2
    free = np.sqrt(finite_beam(points, mass, clamped=False)[2:4])
    np.testing.assert_allclose(free, [theory.free_frequency(mode, 1.0, 1.0, 1.0) for mode in (0, 1)], rtol=2e-3)
    first = math.sqrt(finite_beam(points, mass, clamped=True)[0])
    assert theory.cantilever_frequency(1.0, 1.0, 1.0) == pytest.approx(first, rel=2e-3)


@pytest.mark.parametrize("mode", [0, 1])
def test_the_curvature_of_a_free_beam_and_its_slope_vanish_at_the_ends(mode: int) -> None:
    s = np.linspace(0, 1, 10_001)
    curvature = theory.free_curvature(mode, s)
    largest = np.abs(curvature).max()
    np.testing.assert_allclose(curvature[[0, -1]], 0, atol=1e-6 * largest)
    np.testing.assert_allclose(np.diff(curvature)[[0, -1]], 0, atol=1e-6 * largest)
    assert sum(a * b < 0 for a, b in pairwise(curvature[1:-1])) == mode


def test_the_buckling_load_is_that_of_a_quarter_wave() -> None:
    # EI w″ = −F w from the free end, where w = 0, to the clamp, where w′ = 0: w = sin(√F s) with √F = π / 2.
    s = np.linspace(0, 1, 1001)
    w = np.sin(math.sqrt(theory.BUCKLING_LOAD) * s)
    np.testing.assert_allclose(np.gradient(np.gradient(w, s), s)[5:-5], -theory.BUCKLING_LOAD * w[5:-5], atol=1e-4)
    assert w[-1] - w[-2] == pytest.approx(0, abs=2e-6)


CHECKS: list[Check] = [check_cantilever, check_frequencies, check_buckling]


@pytest.mark.parametrize("check", CHECKS)
def test_the_shipped_scene_bends_as_beams_do(check: Check) -> None:
    found = verdicts(check("quick"))
    assert found and all(found.values()), found


@pytest.mark.parametrize(
    ("check", "edit"),
    [
        (check_cantilever, stiffen(1.03)),
        (check_cantilever, stiffen(0.97)),
        (check_cantilever, stiffen(0.5, only="bend0")),  # a whole joint where half a one is clamped
        (check_frequencies, stiffen(1.08)),
        (check_frequencies, stiffen(0.95)),
        (check_frequencies, displace),
        (check_buckling, stiffen(1.03)),
        (check_buckling, stiffen(0.97)),
        (check_buckling, stiffen(0.5, only="bend0")),
    ],
)
def test_a_wrong_scene_fails(monkeypatch: pytest.MonkeyPatch, check: Check, edit: Edit) -> None:
    alter(monkeypatch, edit)
    assert not all(verdicts(check("quick")).values())


def test_every_row_that_has_another_step_stands_beside_the_shipped_one() -> None:
    shipped = f"shipped step of {1e3 * scene.TIMESTEP:.3g} ms"
    for check in (check_frequencies, check_buckling):
        rows = list(check("quick"))
        fine = [row.name for row in rows if "fine step" in row.note]
        assert fine and fine == [row.name for row in rows if shipped in row.note]


def test_the_machine_bends_every_hinge_by_the_same_moment() -> None:
    rod = Rod(specimen("flexible", 1e-4, 0.12, "fixed"))
    rod.grip(1.0, 0.5)
    rod.settle(0.1, 1e-7)
    assert rod.bend == pytest.approx(0.5, rel=0.01)
    np.testing.assert_allclose(1e-4 * rod.angles / rod.span, rod.moment, rtol=1e-3)


def test_a_rod_that_never_rests_is_an_error() -> None:
    rod = Rod(specimen("flexible", 1e-4, 0.12, "fixed"))
    rod.load(0.0, 1e-3)
    with pytest.raises(RunError, match=r"EI = 0\.0001 N m² did not come to rest within 0\.2 s"):
        rod.settle(0.001, -1.0)


def dynamic_rows(monkeypatch: pytest.MonkeyPatch, stiffness: float) -> list[Row]:
    """Holds our rod against one of another stiffness that is ours too: PyElastica takes its time to compile."""

    def reference(density: float, force: float, times: Array) -> Array:
        rod = Rod(specimen("flexible", stiffness, dynamic.LENGTH, "fixed"), dynamic.FINE / 2)
        rod.damp(0.0)
        return dynamic._path(rod, force, times)

    monkeypatch.setattr(dynamic, "_reference", reference)
    return list(dynamic.check_dynamic("normal"))


def test_the_dynamic_cantilever_tells_a_stiffer_rod(monkeypatch: pytest.MonkeyPatch) -> None:
    assert all(verdicts(dynamic_rows(monkeypatch, dynamic.STIFFNESS)).values())
    other = {row.name: row.passed for row in dynamic_rows(monkeypatch, 1.08 * dynamic.STIFFNESS) if row.bound}
    assert other and not any(other.values())


def test_the_peak_is_found_between_the_looks() -> None:
    times = np.linspace(0, 1, dynamic.LOOKS + 1)
    path = np.stack([times, 3 - (times - 0.3337) ** 2], axis=1)
    assert dynamic._peak(times, path) == pytest.approx((3.0, 0.3337))


def test_a_missing_pyelastica_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "elastica", None)
    with pytest.raises(RunError, match=r"pip install 'dlobench\[validation\]'"):
        list(dynamic.check_dynamic("normal"))
    assert not list(dynamic.check_dynamic("quick"))
