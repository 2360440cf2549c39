"""Tests the scene that ships against closed forms: weight, friction, stiffness and plasticity."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from test_domain import UNEQUAL, make

from dlobench.domain import BOX_SIZE, DLO_RADIUS, SEGMENT_LENGTH, Attachment, Domain, Material, RigidBody
from dlobench.world import scene
from dlobench.world.contact import friction_table
from dlobench.world.physics import Physics
from dlobench.world.starts import Start, possible

Array = NDArray[np.float64]

G = 9.81
LOPSIDED = RigidBody("bar4", (8000.0, 1200.0, 1200.0, 1200.0), 0.3)
SPARE = np.zeros((0, 3))


def start(domain: Domain, *, bends: Any = 0.0, **places: Any) -> Start:
    """Places things apart from each other; the DLO lies straight along x unless told otherwise."""
    bodies = np.array([[0.05, 0.05, 0.7], [-0.05, 0.06, -1.0]])[: len(domain.bodies)]
    default: dict[str, Any] = {"root": [-0.1, -0.05, 0.0], "bodies": bodies, "pusher": [0.08, -0.09]}
    placed = {name: np.array(value, dtype=float) for name, value in {**default, **places}.items()}
    return Start(bends=np.broadcast_to(np.asarray(bends, dtype=float), (domain.segments,)).copy(), **placed)


def settled(domain: Domain, begin: Start, seconds: float = 1.0, *, sleep: bool = True) -> Physics:
    """Returns the world after it lay still for a while."""
    physics = Physics(domain)
    if not sleep:  # what sleeps has no contact forces to read
        physics.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    with physics.reset_context():
        physics.start(begin)
    physics.plan(np.zeros(2))
    physics.step(round(seconds / physics.timestep()))
    return physics


def owner(model: mujoco.MjModel, geom: int) -> str:
    """Names what a geom belongs to: table, wall, pusher, cylinder, dlo, body0 …"""
    name = str(model.body(model.geom_bodyid[geom]).name)
    name = str(model.geom(geom).name) if name == "world" else name
    if name == "table" or name.endswith("_plate"):
        return "table"
    if name in ("west", "east", "south", "north"):
        return "wall"
    return "dlo" if name.startswith("segment") else name.replace("foot", "body")


def pairs(physics: Physics) -> list[tuple[str, str]]:
    """Names the two sides of every contact, in alphabetic order."""
    model, contacts = physics.model, physics.data.contact
    return [tuple(sorted(owner(model, g) for g in (c.geom1, c.geom2))) for c in contacts]  # type: ignore[misc]


def presses(physics: Physics) -> dict[str, Array]:
    """Returns what presses on the table: by owner, (contacts, 3) x m, y m, vertical force N."""
    mujoco.mj_forward(physics.model, physics.data)
    found: dict[str, list[list[float]]] = {}
    force = np.zeros(6)
    for i, (contact, pair) in enumerate(zip(physics.data.contact, pairs(physics), strict=True)):
        assert "table" in pair, f"{pair} touch"
        mujoco.mj_contactForce(physics.model, physics.data, i, force)
        along = np.array(contact.frame).reshape(3, 3)
        vertical = abs(float(force[:3] @ along[:, 2]))
        [who] = [name for name in pair if name != "table"]
        found.setdefault(who, []).append([*contact.pos[:2], vertical])
    return {who: np.array(rows) for who, rows in found.items()}


@pytest.mark.parametrize("attachment", ["none", "movable", "fixed"])
def test_everything_presses_with_its_weight(attachment: Attachment) -> None:
    domain = make(attachment=attachment, density=1300.0, length=0.14, bodies=(UNEQUAL, LOPSIDED))
    begin = start(domain)
    assert possible(domain, begin)
    pressed = {who: rows[:, 2].sum() for who, rows in presses(settled(domain, begin, sleep=False)).items()}
    expected = {"dlo": 1300.0 * math.pi * DLO_RADIUS**2 * 0.14 * G}
    expected |= {f"body{i}": sum(body.densities) * BOX_SIZE**3 * G for i, body in enumerate(domain.bodies)}
    if attachment == "movable":
        expected["cylinder"] = 1200.0 * math.pi * 0.0075**2 * 0.015 * G
    assert pressed == pytest.approx(expected, rel=0.01)


def test_the_weight_of_the_dlo_is_spread_evenly() -> None:
    domain = make()
    pressed = presses(settled(domain, start(domain), sleep=False))["dlo"][:, 2]
    assert len(pressed) == 32
    np.testing.assert_allclose(pressed, 1000.0 * math.pi * DLO_RADIUS**2 * SEGMENT_LENGTH * G, rtol=0.03)


@pytest.mark.parametrize("body", [UNEQUAL, LOPSIDED])
def test_the_weight_of_a_body_presses_where_its_mass_is(body: RigidBody) -> None:
    domain = make(bodies=(body,))
    begin = start(domain)
    rows = presses(settled(domain, begin, sleep=False))["body0"]
    x, y, yaw = begin.bodies[0]
    mass = np.array(body.densities) * BOX_SIZE**3
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    moment = mass @ body.boxes()[:, :2] @ turn.T * G  # of the weights about the centroid, N m
    assert np.abs(moment).min() > 0.03 * mass.sum() * G * BOX_SIZE  # both say something
    pressed = rows[:, 2] @ (rows[:, :2] - [x, y])
    assert np.linalg.norm(pressed - moment) < 0.01 * np.linalg.norm(moment)
    assert rows[:, 2].sum() == pytest.approx(mass.sum() * G, rel=0.01)


@pytest.mark.parametrize("body", [UNEQUAL, LOPSIDED])
def test_supports_resist_turning_as_the_area_they_stand_for(body: RigidBody) -> None:
    model = scene.build(make(attachment="movable", bodies=(body,)))
    spheres = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    cells = body.boxes()[:, :2]
    on_foot = model.geom_pos[spheres & (model.geom_bodyid == model.body("foot0").id)][:, :2]
    # Second moments of the area: each box's about the centroid and, by Steiner, a²/12 about its own centre.
    area = cells.T @ cells / len(cells) + np.eye(2) * BOX_SIZE**2 / 12
    np.testing.assert_allclose(on_foot.T @ on_foot / len(on_foot), area, atol=1e-12)
    on_cylinder = model.geom_pos[spheres & (model.geom_bodyid == model.body("cylinder").id)][:, :2]
    np.testing.assert_allclose(on_cylinder.mean(axis=0), 0, atol=1e-12)
    # Uniform pressure on a disc resists turning with 2/3 of friction times radius.
    np.testing.assert_allclose(np.linalg.norm(on_cylinder, axis=1), 2 / 3 * 0.0075)


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


@pytest.mark.parametrize("friction", [0.2, 0.8])
@pytest.mark.parametrize("direction", [(0.0, 1.0), (1.0, 0.0)])
def test_a_rod_holds_below_its_friction_and_slides_above(friction: float, direction: tuple[float, float]) -> None:
    domain = make(surface_friction=friction)
    weight = 1000.0 * math.pi * DLO_RADIUS**2 * SEGMENT_LENGTH * G
    moved = {}
    for share in (0.8, 1.2):
        physics = settled(domain, start(domain, root=[-0.12, -0.05, 0.0]), 0.3)
        before = physics.state().dlo[0, :, :2]
        load = physics.data.xfrc_applied
        load[physics.layout.segments, :2] = share * friction * weight * np.array(direction)
        physics.step(round(0.3 / physics.timestep()))
        moved[share] = physics.state().dlo[0, :, :2] - before
    assert np.linalg.norm(moved[0.8], axis=-1).max() < 1e-4
    fallen = 0.2 * friction * G * 0.3**2 / 2
    np.testing.assert_allclose(moved[1.2].mean(axis=0), fallen * np.array(direction), atol=0.1 * fallen)


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


def bend(domain: Domain, hinge: int, angle: float) -> tuple[float, float, float]:
    """Bends one hinge slowly, in free space, and lets go: returns the bend, the moment that held it and what stays."""
    spec = scene.spec(domain)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    motor = spec.add_actuator(name="bender", target=f"bend{hinge}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_position(kp=5.0, kv=0.05)
    model = scene.compile(spec)
    hinges = model.jnt_dofadr[model.jnt_stiffness > 0]
    model.dof_damping[hinges] = 0.2 * model.jnt_stiffness[model.jnt_stiffness > 0]  # so that it does not swing for long
    data = mujoco.MjData(model)
    actuator, joint = model.actuator("bender").id, model.joint(f"bend{hinge}")
    for wanted in [*np.linspace(0, angle, 100), *[angle] * 300]:
        data.ctrl[model.actuator_ctrladr[actuator]] = wanted
        mujoco.mj_step(model, data)
    bent, moment = float(data.qpos[joint.qposadr[0]]), float(data.actuator_force[actuator])
    model.actuator_gainprm[actuator], model.actuator_biasprm[actuator] = 0, 0
    for _ in range(300):
        mujoco.mj_step(model, data)
    rest = float(data.qpos[joint.qposadr[0]])
    np.testing.assert_allclose(data.plastic[model.jnt_plasticadr[joint.id]], rest, atol=2e-3 * abs(angle))
    others = np.delete(data.plastic, model.jnt_plasticadr[joint.id])
    assert np.abs(others).max() < 1e-9  # one hinge yields, its neighbours do not
    return bent, moment, rest


@pytest.mark.parametrize(("attachment", "hinge"), [("none", 1), ("none", 15), ("none", 31), ("fixed", 0)])
@pytest.mark.parametrize(("kappa", "angle"), [(0.5, 0.05), (2.0, -0.1)])
def test_plastic_hinges_spring_back_by_their_yield_angle(
    attachment: Attachment, hinge: int, kappa: float, angle: float
) -> None:
    domain = make(material="elastoplastic", yield_curvature=kappa, attachment=attachment)
    bent, moment, rest = bend(domain, hinge, angle)
    sign = np.sign(angle)
    yield_angle = kappa * (SEGMENT_LENGTH if hinge else SEGMENT_LENGTH / 2)
    assert abs(bent) > 0.98 * abs(angle) > 2 * yield_angle
    assert rest == pytest.approx(bent - sign * yield_angle, rel=0.01)
    assert moment == pytest.approx(sign * domain.bending_stiffness * kappa, rel=0.01)


@pytest.mark.parametrize("material", ["soft", "flexible"])
def test_elastic_hinges_spring_back_whole(material: Material) -> None:
    domain = make(material=material)
    bent, moment, rest = bend(domain, 15, 1.0)
    assert moment == pytest.approx(domain.bending_stiffness / SEGMENT_LENGTH * bent, rel=0.01)
    assert bent > 0.95 and abs(rest) < 2e-3 * bent


def test_plastic_hinges_below_their_yield_angle_are_elastic() -> None:
    domain = make(material="elastoplastic", yield_curvature=2.0)
    bent, moment, rest = bend(domain, 15, 0.008)
    assert moment == pytest.approx(domain.bending_stiffness / SEGMENT_LENGTH * bent, rel=0.01)
    assert bent > 0.0075 and abs(rest) < 2e-3 * bent


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
    assert set(pairs(settled(domain, start(domain), 0.3, sleep=False))) == {("dlo", "table")}


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
