"""Tests the geometry of recorded poses: depths against support functions, crossings, and what lies outside."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from test_domain import UNEQUAL, make

from dlobench.domain import DLO_RADIUS, PUSHER_RADIUS, SEGMENT_LENGTH, WORKSPACE, RigidBody
from dlobench.world.chain import APART, CYLINDER_RADIUS
from dlobench.world.overlaps import Poses, crossings, depths, outline, outside

Array = NDArray[np.float64]

BAR = RigidBody("bar2", (2000.0, 2000.0), 0.5)
DOMAIN = make(length=0.10, attachment="movable", bodies=(BAR, UNEQUAL))
HALF = WORKSPACE / 2
PAIRS = {"dlo-dlo", "dlo-wall", "dlo-pusher", "dlo-body", "body-body", "body-wall", "body-pusher"}
PAIRS |= {"dlo-cylinder", "body-cylinder", "pusher-cylinder", "cylinder-wall"}


def apart() -> dict[str, Array]:
    """Places everything of DOMAIN apart from everything else, in one state."""
    dlo = np.zeros((1, DOMAIN.segments, 3))
    dlo[0, :, 0] = -0.05 + SEGMENT_LENGTH * (np.arange(DOMAIN.segments) + 0.5)
    bodies = np.array([[[-0.07, 0.07, 0.0], [0.06, 0.07, 0.0]]])
    cylinder = np.array([[-0.05 - CYLINDER_RADIUS, 0.0, 0.0]])
    return {"dlo": dlo, "pusher": np.array([[0.0, -0.08]]), "bodies": bodies, "cylinder": cylinder}


def moved(part: str, index: tuple[int, ...], place: tuple[float, ...]) -> Poses:
    """Returns the state in which one part is elsewhere."""
    poses = apart()
    poses[part][(0, *index)] = place
    return Poses(**poses)


def test_nothing_overlaps_where_all_is_apart() -> None:
    poses = Poses(**apart())
    assert {name: float(depth[0]) for name, depth in depths(DOMAIN, poses).items()} == dict.fromkeys(PAIRS, 0.0)
    assert not crossings(DOMAIN, poses).any() and not outside(DOMAIN, poses).any()


X = -0.05 + SEGMENT_LENGTH * 10.5  # where segment 10 is
EDGE = 0.015 / 2  # from the middle of BAR to its long side
OVERLAPS: dict[str, tuple[str, tuple[int, ...], tuple[float, ...]]] = {
    "dlo-dlo": ("dlo", (19,), (X, 2 * DLO_RADIUS - 0.001, 0.0)),
    "dlo-wall": ("dlo", (19,), (HALF + 0.001 - DLO_RADIUS - SEGMENT_LENGTH / 2, 0.0, np.pi)),
    "dlo-pusher": ("pusher", (), (X, DLO_RADIUS + PUSHER_RADIUS - 0.001)),
    "dlo-body": ("bodies", (0,), (X, EDGE + DLO_RADIUS - 0.001, 0.0)),
    "dlo-cylinder": ("cylinder", (), (X, DLO_RADIUS + CYLINDER_RADIUS - 0.001, 0.0)),
    "body-body": ("bodies", (1,), (-0.07, 0.07 + 2 * EDGE - UNEQUAL.boxes()[:, 1].min() - 0.001, 0.0)),
    "body-wall": ("bodies", (0,), (0.0, EDGE - 0.001 - HALF, 0.0)),
    "body-pusher": ("pusher", (), (-0.07, 0.07 + EDGE + PUSHER_RADIUS - 0.001)),
    "body-cylinder": ("cylinder", (), (-0.07, 0.07 - EDGE - CYLINDER_RADIUS + 0.001, 0.0)),
    "pusher-cylinder": ("pusher", (), (-0.05 - CYLINDER_RADIUS, PUSHER_RADIUS + CYLINDER_RADIUS - 0.001)),
    "cylinder-wall": ("cylinder", (), (0.0, HALF - CYLINDER_RADIUS + 0.001, 0.0)),
}


@pytest.mark.parametrize("pair", sorted(PAIRS))
def test_an_overlap_of_a_millimetre_is_seen_in_its_pair(pair: str) -> None:
    part, index, place = OVERLAPS[pair]
    found = {name: depth[0] for name, depth in depths(DOMAIN, moved(part, index, place)).items()}
    assert found[pair] == pytest.approx(0.001, abs=1e-9)
    assert sum(depth > 0 for depth in found.values()) == 1


def test_depths_are_those_of_support_functions() -> None:
    """The deepest overlap of two convex things is the least over all directions of how far they reach into it."""
    rng = np.random.default_rng(0)
    N = 12
    poses = Poses(
        dlo=np.concatenate([rng.uniform(-0.04, 0.04, (N, 20, 2)), rng.uniform(-4, 4, (N, 20, 1))], axis=-1),
        pusher=rng.uniform(-0.04, 0.04, (N, 2)),
        bodies=np.concatenate([rng.uniform(-0.04, 0.04, (N, 2, 2)), rng.uniform(-4, 4, (N, 2, 1))], axis=-1),
        cylinder=rng.uniform(-0.04, 0.04, (N, 3)),
    )
    found = depths(DOMAIN, poses)
    angles = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    axes = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for n in range(N):
        things = parts(poses, n)
        reach = [(points @ axes.T).max(axis=0) + radius for _, _, points, radius in things]
        expected = dict.fromkeys(PAIRS, 0.0)
        for (i, one), (j, two) in combinations(enumerate(things), 2):
            name = "-".join(sorted((one[0], two[0]), key=["dlo", "body", "pusher", "cylinder"].index))
            bodies_own = one[0] == two[0] == "body" and one[1] == two[1]
            neighbours = one[0] == two[0] == "dlo" and two[1] - one[1] <= APART
            held = {one[0], two[0]} == {"dlo", "cylinder"} and one[1] <= APART
            if not (bodies_own or neighbours or held):
                depth = float((reach[i] + np.roll(reach[j], len(angles) // 2)).min())
                # Lines that cross are at distance 0, however far they would have to move.
                expected[name] = max(expected[name], min(depth, 2 * DLO_RADIUS) if name == "dlo-dlo" else depth)
        for name in PAIRS - {"dlo-wall", "body-wall", "cylinder-wall"}:
            assert found[name][n] == pytest.approx(expected[name], abs=5e-5), name


def parts(poses: Poses, n: int) -> list[tuple[str, int, Array, float]]:
    """Returns the convex parts of a state: kind, number, corner points (P, 2) m, radius m."""
    out: list[tuple[str, int, Array, float]] = []
    for i, (x, y, yaw) in enumerate(poses.dlo[n]):
        along = SEGMENT_LENGTH / 2 * np.array([[-1.0], [1.0]]) * [np.cos(yaw), np.sin(yaw)]
        out.append(("dlo", i, along + np.array([x, y]), DLO_RADIUS))
    for i, body in enumerate(DOMAIN.bodies):
        x, y, yaw = poses.bodies[n, i]
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        for u, v, _, a, b in body.boxes():
            corners = np.array([[u + a, v + b], [u + a, v - b], [u - a, v - b], [u - a, v + b]])
            out.append(("body", i, corners @ turn + [x, y], 0.0))
    assert poses.cylinder is not None
    discs = (("pusher", poses.pusher[n], PUSHER_RADIUS), ("cylinder", poses.cylinder[n, :2], CYLINDER_RADIUS))
    return out + [(kind, 0, place[None], radius) for kind, place, radius in discs]


def test_a_crossing_is_seen_but_not_between_neighbours() -> None:
    across = moved("dlo", (19,), (X, 0.0, np.pi / 2))
    assert crossings(DOMAIN, across).tolist() == [1]
    assert depths(DOMAIN, across)["dlo-dlo"][0] == pytest.approx(2 * DLO_RADIUS)
    assert crossings(DOMAIN, moved("dlo", (11,), (X, 0.0, np.pi / 2))).tolist() == [0]


@pytest.mark.parametrize(
    ("part", "index", "place"),
    [
        ("dlo", (3,), (0.0, HALF + 1e-6, 0.0)),
        ("pusher", (), (-HALF - 1e-6, 0.0)),
        ("bodies", (1,), (0.0, HALF + 0.004, np.pi)),
        ("cylinder", (), (HALF + 1e-6, 0.0, 0.0)),
    ],
)
def test_what_is_beyond_a_wall_is_seen(part: str, index: tuple[int, ...], place: tuple[float, ...]) -> None:
    assert outside(DOMAIN, moved(part, index, place)).tolist() == [True]


@pytest.mark.parametrize("part", ["dlo", "pusher", "bodies", "cylinder"])
def test_what_is_no_number_is_neither_inside_nor_apart(part: str) -> None:
    poses = apart()
    poses[part][:] = np.nan
    assert outside(DOMAIN, Poses(**poses)).all()
    assert np.isnan(np.max(list(depths(DOMAIN, Poses(**poses)).values()), axis=0)).all()


def test_a_domain_without_bodies_and_cylinder_has_fewer_pairs() -> None:
    poses = Poses(apart()["dlo"], apart()["pusher"], np.zeros((1, 0, 3)), None)
    found = depths(make(length=0.10), poses)
    assert set(found) == {name for name in PAIRS if "cylinder" not in name}
    assert all(depth.tolist() == [0] for depth in found.values())


def test_the_outline_reaches_as_far_as_things_do() -> None:
    dlo, others = outline(DOMAIN, Poses(**apart()))
    assert dlo[0, :, 0].max() == pytest.approx(0.05) and dlo[0, :, 0].min() == pytest.approx(-0.05)
    corners = np.concatenate([body.boxes()[:, :2] for body in DOMAIN.bodies])
    assert others.shape == (1, 4 * len(corners) + 4, 2)
    assert others[0, :, 1].max() == pytest.approx(0.07 + UNEQUAL.boxes()[:, 1].max() + EDGE)
