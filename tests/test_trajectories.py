"""Tests trajectories: windows against a naive loop, geometry and padding, taking and joining."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_domain import UNEQUAL, make

from dlobench.domain import ATTACHMENTS, BOX_SIZE, MATERIALS, SHAPES, RigidBody, sample, typical
from dlobench.trajectories import Query, Trajectories, concatenate, geometry, parameters

ROWS = ("dlo", "pusher", "bodies", "commanded", "executed", "cylinder")
SHARED = ("dlo_mask", "body_mask", "boxes", "parameters")
DOMAIN = make(length=0.12, bodies=(UNEQUAL, RigidBody("bar2", (2000.0, 3000.0), 0.4)))


def noise(K: int, T: int, seed: int = 0) -> Trajectories:
    """Makes trajectories of which no two numbers are equal, in the geometry of `DOMAIN`."""
    rng = np.random.default_rng(seed)
    shapes = {"dlo": (K, T + 1, 32, 3), "pusher": (K, T + 1, 2), "bodies": (K, T + 1, 3, 3)}
    shapes |= {"commanded": (K, T, 2), "executed": (K, T, 2), "cylinder": (K, T + 1, 3)}
    rows = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    dlo_mask, body_mask, boxes = geometry(DOMAIN)
    return Trajectories(dlo_mask=dlo_mask, body_mask=body_mask, boxes=boxes, parameters=parameters(DOMAIN), **rows)


@settings(deadline=None)
@given(K=st.integers(0, 4), T=st.integers(1, 6), data=st.data())
def test_windows_equal_a_naive_loop(K: int, T: int, data: st.DataObject) -> None:
    n = data.draw(st.integers(1, T), label="n")
    made = noise(K, T)
    query, truth = made.windows(n)
    assert len(query) == K * (T - n + 1) and query.horizon == n
    assert truth.bodies is not None
    assert truth.dlo.shape == (1, len(query), 32, 2) and truth.bodies.shape == (1, len(query), 3, 3)
    row = 0
    for k in range(K):
        for t in range(T - n + 1):
            np.testing.assert_array_equal(query.dlo[row], made.dlo[k, t])
            np.testing.assert_array_equal(query.pusher[row], made.pusher[k, t])
            np.testing.assert_array_equal(query.bodies[row], made.bodies[k, t])
            for ahead in range(n):
                np.testing.assert_array_equal(query.actions[row, ahead], made.executed[k, t + ahead])
            np.testing.assert_array_equal(truth.dlo[0, row], made.dlo[k, t + n, :, :2])
            np.testing.assert_array_equal(truth.bodies[0, row], made.bodies[k, t + n])
            row += 1
    for name in SHARED:
        np.testing.assert_array_equal(getattr(query, name), getattr(made, name))
    floats = [query.dlo, query.pusher, query.bodies, query.boxes, query.actions, truth.dlo, truth.bodies]
    assert all(values.dtype == np.float32 for values in floats)


@pytest.mark.parametrize("n", [-1, 0, 4])
def test_a_horizon_that_does_not_fit_is_refused(n: int) -> None:
    with pytest.raises(ValueError, match=f"horizon = {n} does not fit into trajectories of 3 pushes"):
        noise(2, 3).windows(n)


def test_geometry_is_padded_with_nothing() -> None:
    dlo_mask, body_mask, boxes = geometry(DOMAIN)
    assert dlo_mask.tolist() == [True] * 24 + [False] * 8
    assert body_mask.tolist() == [True, True, False]
    assert boxes.shape == (3, 5, 5) and boxes.dtype == np.float32
    np.testing.assert_allclose(boxes[0], UNEQUAL.boxes(), atol=1e-9)
    half = BOX_SIZE / 2
    np.testing.assert_allclose(boxes[1, :2], [[-half, 0, 0, half, half], [half, 0, 0, half, half]], atol=1e-9)
    assert not boxes[1, 2:].any() and not boxes[2].any()


def test_geometry_does_not_tell_what_is_unobserved() -> None:
    other = make(
        length=0.12,
        material="elastoplastic",
        surface_friction=0.3,
        density=800.0,
        attachment="fixed",
        bodies=tuple(replace(body, friction=0.2, densities=(8000.0,) * len(body.densities)) for body in DOMAIN.bodies),
    )
    for one, two in zip(geometry(DOMAIN), geometry(other), strict=True):
        np.testing.assert_array_equal(one, two)
    taller = geometry(make(length=0.13, bodies=(RigidBody("T5", (2000.0,) * len(SHAPES["T5"]), 0.5),)))
    assert taller[0].sum() == 26 and taller[1].sum() == 1 and taller[2][0].any()


def test_trajectories_are_taken_in_order() -> None:
    made = noise(5, 3)
    for index in (np.array([3, 0, 3]), slice(1, 4)):
        taken = made.take(index)
        assert len(taken) == 3 and taken.pushes == 3
        for name in ROWS:
            np.testing.assert_array_equal(getattr(taken, name), getattr(made, name)[index])
        for name in SHARED:
            np.testing.assert_array_equal(getattr(taken, name), getattr(made, name))


def test_queries_are_taken_in_order() -> None:
    query, _ = noise(3, 4).windows(2)
    index = np.array([5, 1])
    taken = query.take(index)
    assert len(taken) == 2 and taken.horizon == 2
    for field in fields(Query):
        whole = getattr(query, field.name)
        np.testing.assert_array_equal(getattr(taken, field.name), whole if field.name in SHARED else whole[index])


def test_parameters_tell_domains_apart() -> None:
    middle = typical(material="soft", attachment="none", length=0.16, rigid_objects=0)
    # stiffness is at 1e-6, of ranges that reach from 3e-7 to 2e-4 in all
    stiffness = 2 * np.log(math.sqrt(3e-7 * 3e-6) / 3e-7) / np.log(2e-4 / 3e-7) - 1
    np.testing.assert_allclose(parameters(middle), [0, 0, 1, stiffness, 1, 1, 0, 0, 1, 0, 0], atol=1e-6)
    rng = np.random.default_rng(0)
    drawn = [sample(rng, material=m, attachment=a, length=0.1, rigid_objects=0) for m in MATERIALS for a in ATTACHMENTS]
    found = np.array([parameters(one) for one in drawn])
    assert np.abs(found).max() <= 1
    assert len({tuple(row[5:]) for row in found}) == 9


def test_parts_join_to_the_whole() -> None:
    made = noise(5, 3)
    joined = concatenate([made.take(slice(0, 2)), made.take(slice(2, 2)), made.take(slice(2, 5))])
    for field in fields(Trajectories):
        np.testing.assert_array_equal(getattr(joined, field.name), getattr(made, field.name))
        assert getattr(joined, field.name).dtype == getattr(made, field.name).dtype


@pytest.mark.parametrize("name", SHARED)
def test_parts_of_different_geometry_are_not_joined(name: str) -> None:
    made = noise(2, 3)
    values = getattr(made, name).copy()
    values[-1] = 1 - values[-1]
    other = replace(made, **{name: values})
    for parts in ([made, other], [made, made, other], [other, made]):
        with pytest.raises(ValueError, match="different domains"):
            concatenate(parts)


def test_a_model_sees_everything_but_the_cylinder() -> None:
    made = noise(2, 3)
    shown = made.observed()
    assert shown.cylinder is None and made.cylinder is not None
    for name in (*ROWS[:-1], *SHARED):
        assert getattr(shown, name) is getattr(made, name)
    assert concatenate([shown, shown]).cylinder is None and shown.take(slice(1)).cylinder is None
