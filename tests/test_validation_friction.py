"""Tests the checks of friction and weight: their own reference against closed forms, and that each can fail."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from test_domain import make

from dlobench.domain import BOX_SIZE, RigidBody
from dlobench.validation import directions, pairs, sliding, spinning, statics, sticking
from dlobench.validation.check import at_most, relative, worst
from dlobench.validation.forces import owners
from dlobench.validation.patch import Patch, shares
from dlobench.validation.rig import Edit, Rig, box_masses
from dlobench.world.starts import Start

Array = NDArray[np.float64]

G = 9.81
LOPSIDED = RigidBody("bar4", (8000.0, 1200.0, 1200.0, 1200.0), 0.5)
UNEQUAL = RigidBody("L5", (1200.0, 8000.0, 8000.0, 1200.0, 1200.0), 0.5)
EVEN = RigidBody("bar3", (3000.0,) * 3, 0.5)


def patch(body: RigidBody, friction: float = 0.5, order: int = 12) -> Patch:
    return Patch.of(body.boxes(), box_masses(body), friction, G, order)


@pytest.mark.parametrize("body", [EVEN, UNEQUAL, LOPSIDED])
@pytest.mark.parametrize("friction", [0.2, 0.8])
def test_a_patch_that_only_slides_goes_v_squared_over_two_mu_g(body: RigidBody, friction: float) -> None:
    slide, turn = patch(body, friction).slide(0.7, np.array([0.24, -0.18, 0.0]))
    np.testing.assert_allclose(slide, 0.3**2 / (2 * friction * G) * np.array([0.8, -0.6]), rtol=1e-3, atol=1e-6)
    assert abs(turn) < 1e-6


def test_a_disc_that_only_spins_turns_three_eighths_omega_squared_r_over_mu_g() -> None:
    radius, mass, friction, spin = 0.02, 0.1, 0.4, 15.0
    rings = (np.arange(200) + 0.5) / 200 * radius
    angles = 2 * math.pi * np.arange(64) / 64
    spots = (rings[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)).reshape(-1, 2)
    areas = np.repeat(rings, 64) / (64 * rings.sum())
    disc = Patch(spots, friction * mass * G * areas, mass, mass * radius**2 / 2)
    slide, turn = disc.slide(0.0, np.array([0.0, 0.0, spin]))
    assert turn == pytest.approx(3 / 8 * spin**2 * radius / (friction * G), rel=2e-3)
    assert np.abs(slide).max() < 1e-9


def test_a_bar_that_only_spins_turns_by_its_mean_distance_from_the_middle() -> None:
    a, b = 3 * BOX_SIZE / 2, BOX_SIZE / 2
    d = math.hypot(a, b)
    mean = (2 * d + a**2 / b * math.log((b + d) / a) + b**2 / a * math.log((a + d) / b)) / 6
    slide, turn = patch(EVEN).slide(0.3, np.array([0.0, 0.0, -12.0]))
    assert turn == pytest.approx(-(a**2 + b**2) / 3 * 12.0**2 / (2 * 0.5 * G * mean), rel=3e-3)
    assert np.abs(slide).max() < 1e-6


def test_a_driven_patch_gains_and_loses_what_the_load_gives() -> None:
    body = patch(UNEQUAL)
    load = np.array([1.8 * 0.5 * body.mass * G, 0.0, 0.0])
    slide, turn = body.slide(0.7, np.zeros(3), load, 0.06)
    assert slide[0] == pytest.approx(0.8 * 1.8 * 0.5 * G * 0.06**2 / 2, rel=1e-3)
    assert abs(turn) < 1e-6


def test_a_patch_that_slides_and_spins_loses_its_energy_to_friction_alone() -> None:
    body, motion = patch(UNEQUAL), np.array([0.2, 0.1, 15.0])
    energy = (body.mass * (motion[:2] @ motion[:2]) + body.inertia * motion[2] ** 2) / 2
    change = body.acceleration(0.4, motion, np.zeros(3))
    power = body.mass * change[:2] @ motion[:2] + body.inertia * change[2] * motion[2]
    c, s = math.cos(0.4), math.sin(0.4)
    spots = body.spots @ np.array([[c, s], [-s, c]])
    speeds = np.hypot(motion[0] - motion[2] * spots[:, 1], motion[1] + motion[2] * spots[:, 0])
    assert power == pytest.approx(-(body.rubs @ speeds), rel=1e-12)
    # Spinning takes friction from sliding: it goes further than it would without the spin, but not without end.
    slide, _ = body.slide(0.4, motion)
    alone = motion[:2] @ motion[:2] / (2 * 0.5 * G)
    assert alone < np.linalg.norm(slide) < 2 * energy / (body.mass * 0.5 * G)


@pytest.mark.parametrize("body", [EVEN, UNEQUAL, LOPSIDED])
def test_the_pressure_balances_weight_and_both_moments(body: RigidBody) -> None:
    own = patch(body, order=6)
    share = own.rubs / (0.5 * own.mass * G)
    assert share.sum() == pytest.approx(1.0, rel=1e-12)
    np.testing.assert_allclose(share @ own.spots, 0, atol=1e-9 * BOX_SIZE)
    assert share.min() >= 0
    assert (share == 0).any() == (body is not EVEN)  # where the table would have to pull


def test_even_spots_about_the_middle_share_alike() -> None:
    spots = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    np.testing.assert_allclose(shares(spots, np.ones(4)), 0.25)


def test_the_worst_row_is_the_one_furthest_off_or_without_a_number() -> None:
    rows = [relative("near", 1.01, 1.0, 2.0), at_most("far", 30.0, 2.0), relative("nearer", 1.0, 1.0, 2.0)]
    found = worst("all", rows)
    assert (found.name, found.error, found.passed) == ("all", 30.0, False)
    assert "3" in found.note and "far" in found.note
    assert worst("all", [*rows, relative("lost", math.nan, 1.0, 2.0)]).passed is False


def icy(spec: mujoco.MjSpec) -> None:
    """Takes friction away."""
    for geom in spec.geoms:
        geom.friction[0] = 0


def rig(thing: str, edit: Edit) -> Rig:
    domain = make(attachment="movable" if thing == "dlo" else "none", bodies=(UNEQUAL,))
    begin = Start(np.array([-0.1, -0.08, 0.4]), np.zeros(32), np.array([[0.03, 0.05, 0.7]]), np.array([-0.1, 0.1]))
    return Rig(domain, begin, edit=edit)


@pytest.mark.parametrize("thing", ["dlo", "body0"])
def test_a_load_speeds_a_thing_up_as_its_mass_says_and_does_not_turn_it(thing: str) -> None:
    free = rig(thing, icy)
    free.data.qvel[:] = 0
    before, yaw = free.centre(thing), free.yaw(thing)
    force = 0.3 * free.mass(thing) * G * np.array([0.6, -0.8])
    for _ in range(10):
        free.load(thing, force)
        free.run(free.timestep)
    went = (free.centre(thing) - before) / (free.timestep**2 * 10 * 11 / 2)
    np.testing.assert_allclose(went, force / free.mass(thing), rtol=2e-3)
    assert free.yaw(thing) == pytest.approx(yaw, abs=1e-4)


def test_a_launch_gives_the_centre_of_mass_its_velocity_and_the_body_its_spin() -> None:
    free = rig("body0", icy)
    before, yaw = free.centre("body0"), free.yaw("body0")
    free.launch("body0", np.array([0.2, -0.1]), 1.0)
    free.run(free.timestep)
    np.testing.assert_allclose((free.centre("body0") - before) / free.timestep, [0.2, -0.1], rtol=0.01)
    assert (free.yaw("body0") - yaw) / free.timestep == pytest.approx(1.0, rel=0.01)


def test_every_geom_belongs_to_something() -> None:
    domain = make(attachment="movable", bodies=(UNEQUAL, LOPSIDED))
    begin = Start(np.zeros(3), np.zeros(32), np.array([[0.05, 0.05, 0.0], [-0.05, 0.05, 0.0]]), np.array([0.1, -0.1]))
    model = Rig(domain, begin).model
    whose = owners(model)
    assert set(whose) == {"dlo", "cylinder", "body0", "body1", "pusher", "wall", "table"}
    assert whose.count("wall") == 4
    for thing in ("cylinder", "body0", "body1", "pusher"):
        first = int(model.body_geomadr[model.body(thing).id])
        assert whose[first] == thing


# What breaks a world, so that checks have something to find.


def slippery(spec: mujoco.MjSpec) -> None:
    """Takes 3 % off every coefficient."""
    for geom in spec.geoms:
        geom.friction[0] *= 0.97


def heavy(spec: mujoco.MjSpec) -> None:
    """Adds 3 % to every weight, however it is carried."""
    spec.option.gravity = 1.03 * np.array(spec.option.gravity)
    for geom in spec.geoms:
        geom.adhesion *= 1.03


def askew(spec: mujoco.MjSpec) -> None:
    """Moves every support by a millimetre in its body, and puts more weight on one side, however it is carried."""
    for geom in spec.geoms:
        if geom.pos[0] < 0:
            geom.density *= 1.2
            geom.adhesion *= 1.2
        if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE:
            geom.pos[0] += 0.001


def soft(spec: mujoco.MjSpec) -> None:
    """Gives friction the softness of what presses."""
    spec.option.impratio = 1


MEASURES: dict[str, tuple[Callable[..., Any], tuple[Any, ...], float]] = {
    "stopping distance": (sliding.launched, ("body", 0.5, 0.3), 1 / 0.97),
    "stopping distance of a rod": (sliding.launched, ("rod sideways", 0.2, 0.3), 1 / 0.97),
    "threshold": (sticking.threshold, ("rod lengthways", 0.5), 0.97),
    "threshold of a body": (sticking.threshold, ("body", 0.5), 0.97),
    "pair": (lambda *pair, edit: pairs.coefficient(*pair, edit=edit)[0], ("body0", "body1"), 0.97),
    "direction": (lambda *place, edit: directions.friction(*place, edit=edit)[0][0], ("dlo", 0.5, 0.3, 0.4), 0.97),
    "cylinder": (lambda *place, edit: directions.friction(*place, edit=edit)[0][0], ("cylinder", 0.5, 0.3, 0.4), 0.97),
    "spin": (lambda case, edit: spinning.launched(case, timestep=1e-3, edit=edit)[1], (spinning.CASES[3],), 1 / 0.97),
}


@pytest.mark.parametrize("name", list(MEASURES))
def test_figures_follow_the_friction_in_force(name: str) -> None:
    measure, arguments, expected = MEASURES[name]
    ratio = measure(*arguments, edit=slippery) / measure(*arguments, edit=None)
    assert ratio == pytest.approx(expected, abs=0.008)


@pytest.mark.parametrize(
    ("check", "fault"),
    [
        (sliding.check_sliding, slippery),
        (sticking.check_threshold, slippery),
        (sticking.check_creep, soft),
        (directions.check_directions, slippery),
        (pairs.check_pairs, slippery),
        (spinning.check_spinning, slippery),
    ],
)
def test_checks_see_a_fault(check: Callable[..., Any], fault: Edit) -> None:
    rows = [row for row in check("quick", edit=fault) if row.bound is not None]
    assert rows
    assert not any(row.passed for row in rows if "turn" not in row.name)


@pytest.mark.parametrize(("fault", "what"), [(heavy, "force"), (askew, "moments")])
def test_the_check_of_weight_sees_a_fault(fault: Edit, what: str) -> None:
    rows = list(statics.check_weight("quick", edit=fault))
    assert not any(row.passed for row in rows if what in row.name)
    assert {row.name for row in statics.check_weight("quick")} == {row.name for row in rows}


@pytest.mark.parametrize("check", [sticking.check_threshold, sticking.check_creep, pairs.check_pairs])
def test_the_shipped_world_holds_below_its_friction_and_keeps_the_table(check: Callable[..., Any]) -> None:
    rows = list(check("quick"))
    assert all(row.passed for row in rows), [row for row in rows if not row.passed]
