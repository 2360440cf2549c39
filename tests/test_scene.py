"""Tests the scene that ships: who touches whom and how, what stands where, and that the domain says it all.

How it bends, yields, weighs, sticks and slides is tested with the checks of `dlobench.validation`.
"""

from __future__ import annotations

import math
from itertools import combinations, product
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from test_domain import UNEQUAL, make

from dlobench.domain import (
    BOX_DENSITY,
    BOX_SIZE,
    DLO_RADIUS,
    GRAVITY,
    SEGMENT_LENGTH,
    SHAPES,
    Attachment,
    Domain,
    Material,
    RigidBody,
)
from dlobench.validation.forces import owners
from dlobench.validation.statics import check_weight
from dlobench.world import pressure, scene
from dlobench.world.chain import CYLINDER_RADIUS
from dlobench.world.contact import friction_table
from dlobench.world.physics import Physics
from dlobench.world.starts import Start

Array = NDArray[np.float64]

LOPSIDED = RigidBody("bar4", (8000.0, 1200.0, 1200.0, 1200.0), 0.3)


def start(domain: Domain, *, bends: Any = 0.0, **places: Any) -> Start:
    """Places things apart from each other; the DLO lies straight along x unless told otherwise."""
    bodies = np.array([[0.05, 0.05, 0.7], [-0.05, 0.06, -1.0]])[: len(domain.bodies)]
    default: dict[str, Any] = {"root": [-0.1, -0.05, 0.0], "bodies": bodies, "pusher": [0.08, -0.09]}
    placed = {name: np.array(value, dtype=float) for name, value in {**default, **places}.items()}
    return Start(bends=np.broadcast_to(np.asarray(bends, dtype=float), (domain.segments,)).copy(), **placed)


def pairs(physics: Physics) -> list[tuple[str, str]]:
    """Names the two sides of every contact, in alphabetic order."""
    whose = owners(physics.model)
    return [tuple(sorted((whose[c.geom1], whose[c.geom2]))) for c in physics.data.contact]


def supports(model: mujoco.MjModel, body: str) -> tuple[Array, Array]:
    """Returns where the supports of a body stand in its frame, (n, 2) m, and what they carry, (n,) N."""
    mine = (model.geom_bodyid == model.body(body).id) & (model.geom_adhesion > 0)
    return model.geom_pos[mine, :2], model.geom_adhesion[mine]


def test_everything_presses_with_its_weight_where_its_mass_is() -> None:
    rows = list(check_weight("normal"))
    assert rows and all(row.passed for row in rows), [row for row in rows if not row.passed]


@pytest.mark.parametrize("attachment", ["none", "fixed"])
def test_supports_carry_two_segments_each_where_they_meet(attachment: Attachment) -> None:
    domain = make(attachment=attachment)
    physics = Physics(domain)
    physics.start(start(domain))
    model, data = physics.model, physics.data
    mine = (np.array(owners(model)) == "dlo") & (model.geom_adhesion > 0)
    middles = physics.state().dlo[0, :, 0].reshape(-1, 2).mean(axis=1)
    np.testing.assert_allclose(np.sort(data.geom_xpos[mine, 0]), middles, atol=1e-12)
    segment = 1000.0 * math.pi * DLO_RADIUS**2 * SEGMENT_LENGTH * GRAVITY
    np.testing.assert_allclose(model.geom_adhesion[mine], 2 * segment)


@pytest.mark.parametrize("shape", SHAPES)
def test_every_body_can_stand(shape: str) -> None:
    """Whatever its boxes weigh, supports push and never pull, and they balance the weight and both its moments."""
    for densities in product(BOX_DENSITY, repeat=len(SHAPES[shape])):
        body = RigidBody(shape, densities, 0.5)
        spots, loads = pressure.spread(body)
        weights = np.array(densities) * BOX_SIZE**3 * GRAVITY
        assert loads.min() > 0
        assert loads.sum() == pytest.approx(weights.sum(), rel=1e-9)
        moments = weights @ body.boxes()[:, :2]
        np.testing.assert_allclose(loads @ spots, moments, atol=1e-9 * BOX_SIZE * weights.sum())


@pytest.mark.parametrize("shape", SHAPES)
def test_supports_of_an_even_body_stand_for_its_area(shape: str) -> None:
    body = RigidBody(shape, (2000.0,) * len(SHAPES[shape]), 0.5)
    spots, loads = supports(scene.build(make(bodies=(body,))), "body0")
    # Second moments of the area: each box's about the centroid and, by Steiner, a²/12 about its own centre.
    boxes = body.boxes()[:, :2]
    area = boxes.T @ boxes / len(boxes) + np.eye(2) * BOX_SIZE**2 / 12
    np.testing.assert_allclose(loads * spots.T @ spots / loads.sum(), area, atol=1e-12)


def test_supports_of_a_cylinder_resist_turning_as_a_disc_does() -> None:
    spots, loads = supports(scene.build(make(attachment="movable")), "cylinder")
    np.testing.assert_allclose(loads @ spots, 0, atol=1e-12)
    # Even pressure on a disc resists turning with 2/3 of friction times radius.
    np.testing.assert_allclose(np.linalg.norm(spots, axis=1), 2 / 3 * CYLINDER_RADIUS)


@pytest.mark.parametrize(("attachment", "freedoms"), [("none", 34), ("movable", 35), ("fixed", 32)])
def test_nothing_leaves_the_plane(attachment: Attachment, freedoms: int) -> None:
    model = scene.build(make(attachment=attachment, bodies=(UNEQUAL, LOPSIDED)))
    assert model.nv == freedoms + 2 * 3 + 2  # DLO and cylinder, two bodies, pusher
    slides, hinges = (
        model.jnt_axis[model.jnt_type == kind] for kind in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    )
    assert len(slides) + len(hinges) == model.njnt
    assert not slides[:, 2].any() and not hinges[:, :2].any()


KINDS = {("dlo", "dlo"), ("dlo", "pusher"), ("dlo", "wall"), ("dlo", "table"), ("body0", "body1")} | {
    pair for i in "01" for pair in [(f"body{i}", other) for other in ("dlo", "pusher", "wall", "table")]
}  # fmt: skip
CYLINDER = {("cylinder", "dlo"), ("cylinder", "pusher"), ("body0", "cylinder"), ("body1", "cylinder")}


@pytest.mark.parametrize(
    ("attachment", "kinds"),
    [
        ("none", KINDS),
        ("movable", KINDS | CYLINDER | {("cylinder", "wall"), ("cylinder", "table")}),
        ("fixed", KINDS | CYLINDER),
    ],
)
def test_friction_in_force_is_that_of_the_table(attachment: Attachment, kinds: set[tuple[str, str]]) -> None:
    bodies = (RigidBody("bar2", (2000.0,) * 2, 0.25), RigidBody("L3", (2000.0,) * 3, 0.75))
    domain = make(attachment=attachment, surface_friction=0.45, bodies=bodies)
    # A heap in a corner, where everything touches everything.
    heap = {"bodies": [[0.115, 0.112, 0.7], [0.118, 0.11, -1.0]], "pusher": [0.118, 0.118]}
    physics = Physics(domain)
    physics.start(start(domain, root=[0.12, 0.11, 0.3], bends=0.3, **heap))
    mujoco.mj_collision(physics.model, physics.data)
    table = friction_table(domain)
    documented = {
        "dlo-table": 0.45,
        "cylinder-table": 0.45,
        "dlo-dlo": 0.3,
        "pusher-any": 0.3,
        "wall-any": 0.3,
        "cylinder-any": 0.3,
        "body0-table": math.sqrt(0.45 * 0.25),
        "body1-table": math.sqrt(0.45 * 0.75),
        "dlo-body0": 0.25,
        "dlo-body1": 0.75,
    }
    assert table == pytest.approx(documented, rel=1e-12)

    def coefficient(a: str, b: str) -> float:
        if (a, b) == ("body0", "body1"):
            return max(table["dlo-body0"], table["dlo-body1"])
        if {a, b} & {"pusher", "wall"}:
            return table["pusher-any" if "pusher" in (a, b) else "wall-any"]
        keys = [key for key in (f"{a}-{b}", f"{b}-{a}", "cylinder-any") if key in table]
        return table[keys[0]]

    found = pairs(physics)
    assert set(found) == kinds
    for contact, pair in zip(physics.data.contact, found, strict=True):
        np.testing.assert_allclose(contact.friction[:2], coefficient(*pair), rtol=1e-12, err_msg=str(pair))
        assert contact.dim == 3, pair  # Coulomb in the plane: no contact is without friction, none rolls


MATERIALS: list[tuple[Material, float, float | None]] = [
    ("soft", 2e-6, None),
    ("flexible", 1.5e-4, None),
    ("elastoplastic", 8e-5, 0.6),
]


@pytest.mark.parametrize(("material", "EI", "kappa"), MATERIALS)
@pytest.mark.parametrize("attachment", ["none", "movable", "fixed"])
def test_hinges_are_as_stiff_as_the_length_they_stand_for(
    material: Material, EI: float, kappa: float | None, attachment: Attachment
) -> None:
    domain = make(material=material, bending_stiffness=EI, yield_curvature=kappa, attachment=attachment)
    model = scene.build(domain)
    clamped = attachment != "none"
    hinges = [model.joint(f"bend{i}").id for i in range(0 if clamped else 1, 32)]
    span = np.full(len(hinges), SEGMENT_LENGTH)
    span[0] = SEGMENT_LENGTH / 2 if clamped else SEGMENT_LENGTH
    np.testing.assert_allclose(model.jnt_stiffness[hinges], EI / span)
    if kappa is None:
        assert (model.jnt_springyield[hinges] > 2 * np.pi).all()
    else:
        np.testing.assert_allclose(model.jnt_springyield[hinges], kappa * span)
    others = np.setdiff1d(np.arange(model.njnt), hinges)
    assert not model.jnt_stiffness[others].any()
    assert (model.jnt_plasticadr[hinges] >= 0).all()  # materials share their sizes


def test_neighbours_never_touch_and_far_segments_do() -> None:
    domain = make(attachment="movable")
    physics = Physics(domain)
    physics.start(start(domain, root=[0.0, 0.0, 0.0], bends=[0.0] + [2.0] * 31))
    model, data = physics.model, physics.data
    mujoco.mj_collision(model, data)
    geoms = [model.geom("cylinder").id, *[model.geom(f"segment{i}").id for i in range(32)]]
    # The cylinder stands before segment 0, so number −1 gives it the same distance along the chain.
    number = {geom: place - 1 for place, geom in enumerate(geoms)}
    touching = {
        tuple(sorted((number[c.geom1], number[c.geom2])))
        for c in data.contact
        if c.geom1 in number and c.geom2 in number
    }
    overlapping = {
        (number[a], number[b])
        for a, b in combinations(geoms, 2)
        if mujoco.mj_geomDistance(model, data, a, b, 1, None) < 0
    }
    near = {(a, b) for a, b in overlapping if b - a <= 3}
    assert {b - a for a, b in near} == {1, 2, 3}
    assert {(-1, 1), (-1, 2)} & near  # those excluded from the cylinder overlap with it here
    assert {b - a for a, b in touching if a >= 0} >= {4, 5, 6}
    assert touching == {(a, b) for a, b in overlapping if b - a > (3 if a >= 0 else 4)}


def test_a_straight_dlo_touches_nothing_but_the_table() -> None:
    domain = make()
    physics = Physics(domain)
    physics.start(start(domain))
    mujoco.mj_collision(physics.model, physics.data)
    assert set(pairs(physics)) == {("dlo", "table")}


def saved(model: mujoco.MjModel) -> bytes:
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def test_the_scene_is_a_function_of_the_domain() -> None:
    domain = make(attachment="movable", material="elastoplastic", bodies=(UNEQUAL, LOPSIDED))
    state = str(np.random.get_state())  # noqa: NPY002
    first = saved(scene.build(domain))
    other = saved(scene.build(make()))
    assert saved(scene.build(Domain.from_json(domain.to_json()))) == first != other
    assert str(np.random.get_state()) == state  # noqa: NPY002


@pytest.mark.parametrize(
    "change",
    [
        {"surface_friction": 0.51},
        {"density": 1001.0},
        {"bending_stiffness": 1.01e-4},
        {"yield_curvature": 1.01},
        {"length": 0.15},
        {"attachment": "movable"},
        {"bodies": ()},
        {"bodies": (RigidBody("L5", UNEQUAL.densities, 0.71),)},
        {"bodies": (RigidBody("L5", UNEQUAL.densities[::-1], 0.7),)},
    ],
)
def test_every_parameter_reaches_the_scene(change: dict[str, Any]) -> None:
    same: dict[str, Any] = {"material": "elastoplastic", "bodies": (UNEQUAL,)}
    assert saved(scene.build(make(**{**same, **change}))) != saved(scene.build(make(**same)))
