"""Tests starts: all that are sampled are possible, by MuJoCo's judgement rather than by the sampler's own."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from test_domain import UNEQUAL, make
from test_scene import pairs, start

from dlobench.domain import ATTACHMENTS, MATERIALS, SHAPES, WORKSPACE, Attachment, Domain, Material, RigidBody
from dlobench.errors import RunError, UsageError
from dlobench.world import starts
from dlobench.world.physics import Physics
from dlobench.world.scene import REACH

BODIES = (UNEQUAL, RigidBody("bar4", (2000.0,) * 4, 0.3), RigidBody("T5", (2000.0,) * 5, 0.3))


def extent(physics: Physics) -> float:
    """Returns how far the solids reach from the centre along x or y, m."""
    model, data = physics.model, physics.data
    reached = 0.0
    for geom in range(model.ngeom):
        kind, place, size = model.geom_type[geom], data.geom_xpos[geom], model.geom_size[geom]
        turn = data.geom_xmat[geom].reshape(3, 3)
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            half = np.abs(turn[:2, 2]) * size[1] + size[0]
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            half = np.abs(turn[:2]) @ size
        else:
            continue
        reached = max(reached, float((np.abs(place[:2]) + half).max()))
    return reached


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("attachment", ATTACHMENTS)
def test_starts_are_possible_in_the_engine(material: Material, attachment: Attachment) -> None:
    domain = make(material=material, attachment=attachment, bodies=BODIES)
    physics = Physics(domain)
    rng = np.random.default_rng(0)
    for _ in range(12):
        start = starts.sample(domain, rng)
        assert start.root.shape == (3,) and start.bends.shape == (32,) and start.bends[0] == 0
        assert start.bodies.shape == (3, 3) and start.pusher.shape == (2,)
        with physics.reset_context():
            physics.start(start)
        mujoco.mj_collision(physics.model, physics.data)
        touching = {pair for pair in pairs(physics) if "table" not in pair}
        assert not touching
        assert extent(physics) < WORKSPACE / 2
        assert np.abs(start.pusher).max() <= REACH
        state = physics.state()
        np.testing.assert_allclose(state.pusher[0], start.pusher, atol=1e-12)
        np.testing.assert_allclose(state.bodies[0], start.bodies, atol=1e-12)
        joints = starts.chain(domain, start)
        np.testing.assert_allclose(state.dlo[0, :, :2], (joints[1:] + joints[:-1]) / 2, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(np.diff(joints, axis=0), axis=1), 0.005)


@pytest.mark.parametrize(
    "change",
    [
        {"pusher": [-0.1, -0.037]},  # on the cylinder
        {"pusher": [0.0, -0.043]},  # on the DLO
        {"pusher": [0.05, 0.05]},  # on a body
        {"pusher": [0.118, -0.09]},  # in a wall
        {"root": [-0.119, -0.05, 0.0]},  # the cylinder in a wall
        {"root": [0.0, -0.05, 0.0]},  # the DLO in a wall
        {"bodies": [[0.05, 0.05, 0.7], [-0.02, -0.045, 0.0]]},  # a body on the DLO
        {"bodies": [[0.05, 0.05, 0.7], [0.03, 0.06, -1.0]]},  # one body in the other
        {"bodies": [[0.05, 0.05, 0.7], [-0.05, 0.11, -1.0]]},  # the second body in a wall
        {"bodies": [[0.05, 0.05, 0.7], [-0.113, -0.05, np.pi / 2]]},  # a body on the cylinder
        {"bends": [0.0, *[0.0] * 10, *[0.3] * 21]},  # the DLO through itself
        {
            "root": [-0.05, -0.05, 0.0],
            "bends": [0.0, *[0.0] * 6, *[0.4] * 9, *[0.0] * 16],
        },  # the DLO back to its cylinder
    ],
)
def test_a_start_with_one_thing_in_the_way_is_impossible(change: dict[str, Any]) -> None:
    domain = make(attachment="movable", bodies=BODIES[:2])
    for begin, expected in ((start(domain), True), (start(domain, **change), False)):
        physics = Physics(domain)
        physics.start(begin)
        mujoco.mj_collision(physics.model, physics.data)
        clear = all("table" in pair for pair in pairs(physics)) and extent(physics) < WORKSPACE / 2
        assert clear is expected  # the engine's word, so that the case is what it says
        assert starts.possible(domain, begin) is expected


@pytest.mark.parametrize("attachment", ATTACHMENTS)
def test_the_dlo_is_at_rest_in_its_first_shape(attachment: Attachment) -> None:
    domain = make(material="elastoplastic", attachment=attachment)
    physics = Physics(domain)
    begin = starts.sample(domain, np.random.default_rng(4))
    with physics.reset_context():
        physics.start(begin)
    before = physics.state().dlo[0]
    assert np.abs(begin.bends.sum()) > 0.3
    physics.step(physics.plan(np.zeros(2)))
    assert np.abs(physics.state().dlo[0] - before)[:, :2].max() < 1e-4


def test_starts_follow_their_seed() -> None:
    domain = make(attachment="movable", bodies=BODIES)
    one, two, other = (starts.sample(domain, np.random.default_rng(seed)) for seed in (7, 7, 8))
    for name in vars(one):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
        assert not np.array_equal(getattr(one, name), getattr(other, name))


def test_an_impossible_domain_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(starts, "ATTEMPTS", 30)
    monkeypatch.setattr(starts, "BODY_SPREAD", 1e-3)  # three bodies in one place
    domain = make(bodies=BODIES)
    with pytest.raises(RunError, match=r"no possible start in 30 draws for Domain\(.*bar4.*\)"):
        starts.sample(domain, np.random.default_rng(0))


def test_everything_is_drawn_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A start that is kept in part would be likelier for what was kept."""
    drawn: list[starts.Start] = []

    def sixth(domain: Domain, start: starts.Start) -> bool:
        drawn.append(start)
        return len(drawn) == 6

    monkeypatch.setattr(starts, "possible", sixth)
    domain = make(attachment="fixed", bodies=BODIES[:1])
    kept = starts.sample(domain, np.random.default_rng(2))
    assert kept is drawn[-1]
    for name in vars(kept):
        values = [getattr(each, name)[1 if name == "bends" else 0 :] for each in drawn]
        assert len({value.tobytes() for value in values}) == 6, name
        assert all((a != b).all() for a, b in itertools.pairwise(values)), name


def test_the_most_crowded_domains_have_starts_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two draws in a thousand are far more than what makes running out of draws unthinkable."""
    count, draw = [0], starts._draw

    def counted(domain: Domain, rng: np.random.Generator) -> starts.Start:
        count[0] += 1
        return draw(domain, rng)

    monkeypatch.setattr(starts, "_draw", counted)
    rng = np.random.default_rng(0)
    for shape in ("bar4", "L5", "T5"):  # the widest
        body = RigidBody(shape, (2000.0,) * len(SHAPES[shape]), 0.3)
        domain = make(material="flexible", attachment="fixed", bodies=(body,) * 3)
        for _ in range(5):
            starts.sample(domain, rng)
    assert count[0] < 15 / 0.002
    assert (1 - 0.002) ** starts.ATTEMPTS < 1e-80


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bends": [0.0] * 20}, r"bends of a start has shape \(20,\).* 32 segments .* 2 rigid bodies needs \(32,\)"),
        ({"bodies": [[0.05, 0.05, 0.7]]}, r"bodies of a start has shape \(1, 3\).* needs \(2, 3\)"),
        ({"root": [0.0, 0.0]}, r"root of a start has shape \(2,\).* needs \(3,\)"),
        ({"pusher": [0.0, np.nan]}, r"pusher of a start = array\(\[.*nan\]\) is not finite"),
    ],
)
def test_a_start_of_another_size_is_refused(change: dict[str, Any], message: str) -> None:
    domain = make(attachment="movable", bodies=BODIES[:2])
    starts.check(domain, start(domain))
    with pytest.raises(UsageError, match=f"^{message}$"):
        starts.check(domain, replace(start(domain), **{name: np.array(value) for name, value in change.items()}))


def test_ropes_lie_bent_and_rods_nearly_straight() -> None:
    rng = np.random.default_rng(0)
    bend = {
        material: np.std([starts.sample(make(material=material), rng).bends.sum() for _ in range(150)])
        for material in MATERIALS
    }
    assert bend["soft"] > 1.4 * bend["elastoplastic"] > 1.4 * 1.4 * bend["flexible"]
    assert bend["flexible"] == pytest.approx(0.3, rel=0.2)  # rad; long bends are rejected, short ones never


def test_places_are_spread_over_the_table() -> None:
    domain = make(length=0.10, bodies=BODIES[:1])
    rng = np.random.default_rng(1)
    drawn = [starts.sample(domain, rng) for _ in range(200)]
    for places, reach in (
        (np.array([s.pusher for s in drawn]), REACH),
        (np.array([s.bodies[0, :2] for s in drawn]), starts.BODY_SPREAD),
    ):
        assert np.abs(places).max() <= reach
        assert (places.max(axis=0) > 0.9 * reach).all() and (places.min(axis=0) < -0.9 * reach).all()
    yaws = np.concatenate([[s.root[2], s.bodies[0, 2]] for s in drawn])
    assert np.ptp(yaws) > 0.95 * 2 * np.pi
