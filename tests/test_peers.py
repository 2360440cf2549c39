"""Tests the peers of the shipped scene: the same rod, weight, friction and pusher, or a comparison says nothing."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from dlobench.domain import (
    ATTACHMENTS,
    BOX_SIZE,
    DLO_RADIUS,
    GRAVITY,
    PUSHER_RADIUS,
    SEGMENT_LENGTH,
    Attachment,
    Domain,
    Material,
    sample,
)
from dlobench.validation import balls, flex_rod, rods
from dlobench.validation.peers import Peer
from dlobench.world import chain, starts

Make = Callable[..., Peer]
EITHER = pytest.mark.parametrize("make", [rods.make, balls.make], ids=["rod", "balls"])


def world(material: Material, attachment: Attachment, objects: int = 0, length: float = 0.1) -> Domain:
    rng = np.random.default_rng([7, objects])
    return sample(rng, material=material, attachment=attachment, length=length, rigid_objects=objects)


def straight(domain: Domain, pusher: tuple[float, float] = (0.0, -0.03)) -> starts.Start:
    """Lays the DLO along x, its middle at the origin when it is free."""
    root = np.array([-domain.length / 2, 0.0, 0.0])
    return starts.Start(root, np.zeros(domain.segments), np.zeros((0, 3)), np.array(pusher))


def pressed(peer: Peer) -> float:
    """Returns the force (N) that the table carries."""
    mujoco.mj_forward(peer.model, peer.data)
    table, force, total = peer.model.geom("table").id, np.zeros(6), 0.0
    for i in range(peer.data.ncon):
        touched = peer.data.contact[i]
        if table in touched.geom:
            mujoco.mj_contactForce(peer.model, peer.data, i, force)
            total += force[0]
    return total


@pytest.mark.parametrize("attachment", ATTACHMENTS)
@EITHER
def test_starts_as_the_shipped_scene_does_and_stays(make: Make, attachment: Attachment) -> None:
    """The shape of a start, bent as ropes are, is the shape at rest."""
    domain = world("soft", attachment, objects=2, length=0.16)
    start = starts.sample(domain, np.random.default_rng(3))
    peer = make(domain, start)
    joints = starts.chain(domain, start)
    for state, tolerance in ((peer.placed, 1e-9), (peer.state(), 5e-4)):
        np.testing.assert_allclose(state.dlo[0, :, :2], (joints[1:] + joints[:-1]) / 2, atol=tolerance)
        np.testing.assert_allclose(state.bodies[0, :2], start.bodies, atol=2 * tolerance)
        np.testing.assert_allclose(state.pusher[0], start.pusher, atol=tolerance)
    assert not peer.warned


@pytest.mark.parametrize(("attachment", "objects"), [("none", 0), ("none", 2), ("movable", 0)])
@EITHER
def test_table_carries_the_weight(make: Make, attachment: Attachment, objects: int) -> None:
    """Friction is right only if it is; a fixed DLO's clamp may press as well, so it is left out."""
    domain = world("flexible", attachment, objects)
    masses = [domain.density * math.pi * DLO_RADIUS**2 * domain.length]
    masses += [density * BOX_SIZE**3 for body in domain.bodies for density in body.densities]
    if attachment == "movable":
        masses.append(chain.CYLINDER_DENSITY * math.pi * chain.CYLINDER_RADIUS**2 * chain.CYLINDER_HEIGHT)
    peer = make(domain, starts.sample(domain, np.random.default_rng(4)), sleep=False)
    assert pressed(peer) == pytest.approx(GRAVITY * sum(masses), rel=0.015)


def cantilever(make: Make, domain: Domain) -> Peer:
    """Returns a straight rod in the air, held at its fixed end and weightless."""
    start = starts.Start(np.zeros(3), np.zeros(domain.segments), np.zeros((0, 3)), np.array([0.0, -0.1]))
    peer = make(domain, start, sleep=False)
    peer.model.opt.gravity[:] = 0
    peer.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return peer


def bend(peer: Peer, force: float, steps: int) -> float:
    """Pulls the middle of the last segment along y (N), and returns how far (m) it is from the axis after that."""
    last = peer.domain.segments - 1
    ends = [f"vertex{last}", f"vertex{last + 1}"] if peer.model.nflex else [f"segment{last}"]  # at its centre of mass
    for name in ends:
        peer.data.xfrc_applied[peer.model.body(name).id, 1] = force / len(ends)
    mujoco.mj_step(peer.model, peer.data, steps)
    return float(peer.state().dlo[0, last, 1])


@EITHER
def test_cantilever_bends_as_its_stiffness_says(make: Make) -> None:
    """F a³ / 3 EI, the clamp being at the cylinder's face."""
    domain = world("flexible", "fixed")
    arm = domain.length - SEGMENT_LENGTH / 2
    force = 3 * domain.bending_stiffness * 0.02 / arm**2
    assert bend(cantilever(make, domain), force, steps=1000) == pytest.approx(0.02 * arm, rel=0.01)


def test_both_rods_swing_back_alike() -> None:
    """Mass, stiffness and damping agree: a cantilever let go comes back on the same course in both.

    As long as it is bent, that is: MuJoCo 4.0's flex is undamped while it passes through its straight shape.
    """
    courses = []
    for make in (rods.make, balls.make):
        peer = cantilever(make, world("flexible", "fixed"))
        bend(peer, 0.002, steps=1000)
        courses.append([bend(peer, 0, steps=5) for _ in range(15)])
    flex, balled = np.array(courses)
    bent = balled > 0.15 * balled[0]
    np.testing.assert_allclose(flex[bent], balled[bent], atol=0.01 * balled[0])
    assert not bent[-1]  # it did come back


@pytest.mark.parametrize("friction", [0.2, 0.8])
@pytest.mark.parametrize("rolling", [False, True])
def test_sliding_rod_stops_where_friction_says(friction: float, rolling: bool) -> None:
    """A straight rod sliding sideways comes v²/2μg far."""
    domain = Domain(friction, 0.1, 1000.0, "flexible", 1e-4, None, "none")
    start = straight(domain, pusher=(0.0, -0.1))
    peer = rods.make(domain, start, timestep=0.0005, sleep=False, rolling_friction=rolling)
    across = [peer.model.jnt_dofadr[peer.model.body(f"vertex{i}").jntadr[0] + 1] for i in range(domain.segments + 1)]
    speed, before = 0.3, peer.state().dlo[0, : domain.segments, 1]
    peer.data.qvel[across] = speed
    mujoco.mj_step(peer.model, peer.data, 600)
    came = (peer.state().dlo[0, : domain.segments, 1] - before).mean()
    assert came == pytest.approx(speed**2 / (2 * friction * GRAVITY), rel=0.02)


def test_both_rods_pushed_end_alike() -> None:
    """A free rod pushed off its centre slides and turns the same in both, does not roll on, and the pusher arrives."""
    domain = world("flexible", "none", length=0.16)
    start = straight(domain, pusher=(0.02, -0.02))
    ends = []
    for make in (rods.make, balls.make):
        peer = make(domain, start)
        peer.push(np.array([0.0, 0.02]))
        state = peer.push(np.array([0.0, 0.01]))
        np.testing.assert_allclose(state.pusher[0], [0.02, 0.01], atol=2e-4)
        np.testing.assert_allclose(peer.push(np.zeros(2)).dlo[..., :2], state.dlo[..., :2], atol=5e-4)
        ends.append(state.dlo[0])
    assert np.abs(ends[0][:, 1]).max() > 0.01
    np.testing.assert_allclose(ends[0][:, :2], ends[1][:, :2], atol=0.002)


@EITHER
def test_pushed_body_moves_as_far_as_the_pusher(make: Make) -> None:
    domain = world("soft", "none", objects=1)
    body = np.array([0.0, 0.05, 0.0])
    edge = min(y - half for _, y, _, half, _ in domain.bodies[0].boxes())
    middle = domain.bodies[0].boxes()[:, 0].mean()
    pusher = np.array([middle, body[1] + edge - PUSHER_RADIUS - 0.002])
    start = starts.Start(np.array([-0.05, -0.08, 0.0]), np.zeros(domain.segments), body[None], pusher)
    peer = make(domain, start)
    assert peer.push(np.array([0.0, 0.012])).bodies[0, 0, 1] == pytest.approx(body[1] + 0.01, abs=5e-4)
    assert not peer.warned


def test_frozen_rod_fails_the_check() -> None:
    """Whoever never moves errs by all of the reference's motion; whoever moves with it does not err."""
    reference = np.zeros((6, 20, 2))
    reference[3:, :, 0] = 0.02
    frozen = flex_rod.errors([(0.1, np.zeros_like(reference), reference)])
    np.testing.assert_allclose(frozen, (20, 100, 1))
    np.testing.assert_allclose(flex_rod.errors([(0.1, reference, reference)]), (0, 0, 1))
    still = np.zeros_like(reference)
    assert np.isnan(flex_rod.errors([(0.1, still, still)])[0])


def test_check_compares_the_same_pushes() -> None:
    """A run of the check: the three courses begin alike and go the same way."""
    run = flex_rod.simulate_run("flexible", "none", 0, 0)
    for course in (run.shipped, run.finer):
        assert course.shape == run.reference.shape
        np.testing.assert_allclose(course[0], run.reference[0], atol=1e-4)
    assert np.linalg.norm(run.reference[-1] - run.reference[0], axis=-1).mean() > flex_rod.MOVED
    assert np.linalg.norm(run.finer[-1] - run.reference[-1], axis=-1).mean() < 0.03
