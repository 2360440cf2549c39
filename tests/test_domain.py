"""Tests domains: what is refused, what survives JSON, what sampling may give, and the shapes of rigid bodies."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dlobench.domain import (
    ATTACHMENTS,
    BODY_FRICTION,
    BOX_DENSITY,
    BOX_SIZE,
    DLO_DENSITY,
    LENGTHS,
    MATERIALS,
    SHAPES,
    STIFFNESS,
    SURFACE_FRICTION,
    YIELD_CURVATURE,
    Domain,
    Material,
    RigidBody,
    sample,
)
from dlobench.errors import UsageError

MIDDLE: dict[Material, float] = {"soft": 1e-6, "flexible": 1e-4, "elastoplastic": 1e-4}
UNEQUAL = RigidBody("L5", (1200.0, 8000.0, 8000.0, 1200.0, 1200.0), 0.7)


def make(**changes: Any) -> Domain:
    """Builds a domain in the middle of the ranges; the material sets its own stiffness and yield curvature."""
    material = changes.get("material", "flexible")
    fields: dict[str, Any] = {
        "surface_friction": 0.5,
        "length": 0.16,
        "density": 1000.0,
        "material": material,
        "bending_stiffness": MIDDLE.get(material, 1e-4),
        "yield_curvature": 1.0 if material == "elastoplastic" else None,
        "attachment": "none",
        "bodies": (),
    }
    return Domain(**{**fields, **changes})


REFUSED: list[tuple[dict[str, Any], str, str]] = [
    ({"surface_friction": 0.19}, "surface_friction", "0.2–0.8"),
    ({"surface_friction": 0.81}, "surface_friction", "0.2–0.8"),
    ({"surface_friction": math.nan}, "surface_friction", "0.2–0.8"),
    ({"surface_friction": -math.inf}, "surface_friction", "0.2–0.8"),
    ({"length": 0.09}, "length", "0.10 to 0.16 m"),
    ({"length": 0.17}, "length", "0.10 to 0.16 m"),
    ({"length": 0.155}, "length", "whole centimetre"),
    ({"length": math.nan}, "length", "0.10 to 0.16 m"),
    ({"density": 699.0}, "density", "700–1400 kg/m³"),
    ({"density": 1401.0}, "density", "700–1400 kg/m³"),
    ({"density": math.inf}, "density", "700–1400 kg/m³"),
    ({"material": "steel"}, "material", "soft, flexible, elastoplastic"),
    ({"material": "soft", "bending_stiffness": 2.9e-7}, "bending_stiffness of soft", "3e-07–3e-06 N m²"),
    ({"material": "soft", "bending_stiffness": 3.1e-6}, "bending_stiffness of soft", "3e-07–3e-06 N m²"),
    ({"material": "flexible", "bending_stiffness": 2.9e-5}, "bending_stiffness of flexible", "3e-05–0.0002 N m²"),
    ({"material": "flexible", "bending_stiffness": 2.1e-4}, "bending_stiffness of flexible", "3e-05–0.0002 N m²"),
    ({"material": "elastoplastic", "bending_stiffness": 4.9e-5}, "bending_stiffness of elasto", "5e-05–0.0002 N m²"),
    ({"material": "elastoplastic", "bending_stiffness": 2.1e-4}, "bending_stiffness of elasto", "5e-05–0.0002 N m²"),
    ({"material": "elastoplastic", "yield_curvature": 0.49}, "yield_curvature", "0.5–2 1/m"),
    ({"material": "elastoplastic", "yield_curvature": 2.1}, "yield_curvature", "0.5–2 1/m"),
    ({"material": "elastoplastic", "yield_curvature": None}, "yield_curvature", "material 'elastoplastic'"),
    ({"material": "soft", "yield_curvature": 1.0}, "yield_curvature", "material 'soft'"),
    ({"attachment": "glued"}, "attachment", "none, movable, fixed"),
    ({"surface_friction": "0.5"}, "surface_friction", "0.2–0.8"),
    ({"surface_friction": None}, "surface_friction", "0.2–0.8"),
    ({"surface_friction": [0.5]}, "surface_friction", "0.2–0.8"),
    ({"density": 10**5000}, "density", "700–1400 kg/m³"),
    ({"density": True}, "density", "700–1400 kg/m³"),
    ({"density": 1000j}, "density", "700–1400 kg/m³"),
    ({"length": "0.16"}, "length", "whole centimetre from 0.10 to 0.16 m"),
    ({"length": 16}, "length", "0.10 to 0.16 m"),
    ({"length": None}, "length", "0.10 to 0.16 m"),
    ({"length": True}, "length", "0.10 to 0.16 m"),
    ({"bending_stiffness": "stiff"}, "bending_stiffness of flexible", "3e-05–0.0002 N m²"),
    ({"material": "elastoplastic", "yield_curvature": "1"}, "yield_curvature", "0.5–2 1/m"),
    ({"material": None}, "material", "soft, flexible, elastoplastic"),
    ({"material": ("soft",)}, "material", "soft, flexible, elastoplastic"),
    ({"attachment": 1}, "attachment", "none, movable, fixed"),
    ({"bodies": None}, "bodies", "at most 3"),
    ({"bodies": "bar2"}, "bodies", "at most 3"),
    ({"bodies": ("bar2",)}, "bodies", "at most 3"),
]


@pytest.mark.parametrize(("changes", "field", "allowed"), REFUSED)
def test_a_domain_outside_its_ranges_is_refused(changes: dict[str, Any], field: str, allowed: str) -> None:
    with pytest.raises(UsageError) as caught:
        make(**changes)
    message = str(caught.value)
    assert field in message and allowed in message and "\n" not in message
    blamed = list(changes.values())[-1]  # the value that is to blame stands last
    assert (repr(blamed) if blamed != 10**5000 else "a huge int") in message


def test_too_many_bodies_are_refused() -> None:
    assert len(make(bodies=(UNEQUAL,) * 3).bodies) == 3
    with pytest.raises(UsageError, match=r"^bodies holds 4 rigid bodies, at most 3 .*$"):
        make(bodies=(UNEQUAL,) * 4)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        (("bar5", (2000.0,) * 5, 0.5), ["shape", "'bar5'", "bar2, bar3, bar4, L3, L4, J4, L5, T4, T5"]),
        (("bar2", (2000.0,) * 3, 0.5), ["densities", "3", "'bar2'", "2 boxes"]),
        (("bar2", (2000.0, 1199.0), 0.5), ["density", "1199.0", "1200–8000 kg/m³"]),
        (("bar2", (8001.0, 2000.0), 0.5), ["density", "8001.0", "1200–8000 kg/m³"]),
        (("bar2", (math.nan, 2000.0), 0.5), ["density", "nan", "1200–8000 kg/m³"]),
        (("bar2", (2000.0, 2000.0), 0.19), ["friction", "0.19", "0.2–0.8"]),
        (("bar2", (2000.0, 2000.0), 0.81), ["friction", "0.81", "0.2–0.8"]),
        (("bar2", (2000.0, "2000"), 0.5), ["density", "'2000'", "1200–8000 kg/m³"]),
        (("bar2", 2000.0, 0.5), ["densities", "2000.0", "2 for 'bar2'"]),
        (("bar2", None, 0.5), ["densities", "None", "2 for 'bar2'"]),
        (("bar2", "ab", 0.5), ["densities", "'ab'", "2 for 'bar2'"]),
        (("bar2", (2000.0, 2000.0), None), ["friction", "None", "0.2–0.8"]),
        ((["bar2"], (2000.0, 2000.0), 0.5), ["shape", "['bar2']", "bar2, bar3"]),
    ],
)
def test_a_body_outside_its_ranges_is_refused(fields: tuple[Any, Any, Any], expected: list[str]) -> None:
    with pytest.raises(UsageError) as caught:
        RigidBody(*fields)
    message = str(caught.value)
    assert all(part in message for part in expected) and "\n" not in message


def test_the_ends_of_the_ranges_are_inside() -> None:
    for material in MATERIALS:
        for end in (0, 1):
            kappa = YIELD_CURVATURE[end] if material == "elastoplastic" else None
            body = RigidBody("bar2", (BOX_DENSITY[end],) * 2, BODY_FRICTION[end])
            made = make(
                material=material,
                surface_friction=SURFACE_FRICTION[end],
                density=DLO_DENSITY[end],
                bending_stiffness=STIFFNESS[material][end],
                yield_curvature=kappa,
                length=LENGTHS[-end],
                bodies=(body,),
            )
            assert made.segments == (20, 32)[end]


def test_what_means_the_same_is_the_same_domain() -> None:
    plain = make(bodies=(RigidBody("bar2", (2000.0, 3000.0), 0.5),))
    body = RigidBody("bar2", [2000, np.float64(3000.0)], np.float32(0.5))  # type: ignore[arg-type]
    other = make(length=0.1 + 0.06, density=1000, surface_friction=np.float64(0.5), bodies=[body])
    assert other == plain and hash(other) == hash(plain)
    assert json.dumps(other.to_json()) == json.dumps(plain.to_json())  # so that digests are the same


def test_segments_are_half_a_centimetre() -> None:
    assert LENGTHS == (0.10, 0.11, 0.12, 0.13, 0.14, 0.15, 0.16)
    assert [make(length=length).segments for length in LENGTHS] == [20, 22, 24, 26, 28, 30, 32]


cells = st.fixed_dictionaries(
    {
        "material": st.sampled_from(MATERIALS),
        "attachment": st.sampled_from(ATTACHMENTS),
        "length": st.sampled_from(LENGTHS),
        "rigid_objects": st.integers(0, 3),
    }
)


@settings(deadline=None)
@given(cell=cells, seed=st.integers(0, 2**32 - 1))
def test_samples_stay_in_their_ranges_and_survive_json(cell: dict[str, Any], seed: int) -> None:
    domain = sample(np.random.default_rng(seed), **cell)
    assert (domain.material, domain.attachment, domain.length) == (cell["material"], cell["attachment"], cell["length"])
    assert len(domain.bodies) == cell["rigid_objects"]
    checked = [
        (domain.surface_friction, SURFACE_FRICTION),
        (domain.density, DLO_DENSITY),
        (domain.bending_stiffness, STIFFNESS[domain.material]),
        *[(body.friction, BODY_FRICTION) for body in domain.bodies],
        *[(density, BOX_DENSITY) for body in domain.bodies for density in body.densities],
    ]
    if domain.material == "elastoplastic":
        assert domain.yield_curvature is not None
        checked.append((domain.yield_curvature, YIELD_CURVATURE))
    else:
        assert domain.yield_curvature is None
    assert all(low <= value <= high for value, (low, high) in checked)
    assert all(type(value) is float for value, _ in checked)
    assert all(len(body.densities) == len(SHAPES[body.shape]) for body in domain.bodies)
    assert sample(np.random.default_rng(seed), **cell) == domain
    assert Domain.from_json(json.loads(json.dumps(domain.to_json(), allow_nan=False))) == domain
    assert hash(Domain.from_json(domain.to_json())) == hash(domain)


def test_samples_are_uniform_and_log_uniform() -> None:
    rng = np.random.default_rng(0)
    drawn = [sample(rng, material="elastoplastic", attachment="none", length=0.1, rigid_objects=1) for _ in range(2000)]
    density = [b for d in drawn for b in d.bodies[0].densities]
    uniform: list[tuple[Any, tuple[float, float]]] = [
        ([d.surface_friction for d in drawn], SURFACE_FRICTION),
        ([d.density for d in drawn], DLO_DENSITY),
        ([d.bodies[0].friction for d in drawn], BODY_FRICTION),
        (density, BOX_DENSITY),
        (np.log([d.bending_stiffness for d in drawn]), tuple(np.log(STIFFNESS["elastoplastic"]))),
        (np.log([d.yield_curvature or 0 for d in drawn]), tuple(np.log(YIELD_CURVATURE))),
    ]
    for values, (low, high) in uniform:
        # Quartiles of 2,000 uniform draws have a standard error of at most 0.011.
        quartiles = (np.quantile(values, [0.25, 0.5, 0.75]) - low) / (high - low)
        np.testing.assert_allclose(quartiles, [0.25, 0.5, 0.75], atol=0.045)
    shapes = [d.bodies[0].shape for d in drawn]
    assert min(shapes.count(shape) for shape in SHAPES) > 2000 / 9 * 0.7


@pytest.mark.parametrize(
    ("changes", "field", "allowed"),
    [
        ({"material": "steel"}, "material = 'steel'", "soft, flexible, elastoplastic"),
        ({"attachment": "glued"}, "attachment = 'glued'", "none, movable, fixed"),
        ({"length": 0.3}, "length = 0.3", "0.10 to 0.16 m"),
        ({"rigid_objects": 4}, "rigid_objects = 4", "0–3"),
        ({"rigid_objects": -1}, "rigid_objects = -1", "0–3"),
        ({"rigid_objects": 1.5}, "rigid_objects = 1.5", "0–3"),
        ({"rigid_objects": True}, "rigid_objects = True", "0–3"),
        ({"rigid_objects": "2"}, "rigid_objects = '2'", "0–3"),
        ({"rigid_objects": None}, "rigid_objects = None", "0–3"),
        ({"length": "0.1"}, "length = '0.1'", "0.10 to 0.16 m"),
        ({"length": 0.105}, "length = 0.105", "0.10 to 0.16 m"),
        ({"length": math.nan}, "length = nan", "0.10 to 0.16 m"),
    ],
)
def test_a_cell_outside_the_ranges_is_refused(changes: dict[str, Any], field: str, allowed: str) -> None:
    cell: dict[str, Any] = {"material": "soft", "attachment": "none", "length": 0.1, "rigid_objects": 0}
    with pytest.raises(UsageError) as caught:
        sample(np.random.default_rng(0), **{**cell, **changes})
    message = str(caught.value)
    assert field in message and allowed in message and "\n" not in message


def test_json_that_is_not_a_domain_is_refused() -> None:
    fields = make(material="elastoplastic", bodies=(UNEQUAL,)).to_json()
    for name in fields:
        with pytest.raises(UsageError, match=f"not a domain.*{name}"):
            Domain.from_json({key: value for key, value in fields.items() if key != name})
    with pytest.raises(UsageError, match=r"not a domain.*colour"):
        Domain.from_json({**fields, "colour": "red"})
    with pytest.raises(UsageError, match=r"not a rigid body.*colour"):
        Domain.from_json({**fields, "bodies": [{**fields["bodies"][0], "colour": "red"}]})
    with pytest.raises(UsageError, match=r"density = 1\.0 is outside"):
        Domain.from_json({**fields, "density": 1.0})


garbage = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just(10**400),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=6,
)
GOOD = make(material="elastoplastic", bodies=(UNEQUAL, UNEQUAL)).to_json()


@st.composite
def nearly_domains(draw: st.DrawFn) -> Any:
    """Draws the JSON of a good domain in which some fields, its bodies' too, are garbage, missing or new."""
    fields = {**GOOD, "bodies": [dict(body) for body in GOOD["bodies"]]}
    for place in draw(st.lists(st.sampled_from([fields, *fields["bodies"]]), min_size=1, max_size=3)):
        name = draw(st.sampled_from(sorted(place)) | st.text(max_size=5)) if place else "x"
        if draw(st.booleans()):
            place[name] = draw(garbage)
        else:
            place.pop(name, None)
    return fields


@settings(deadline=None, max_examples=300)
@given(fields=garbage | nearly_domains())
def test_garbage_is_refused_in_one_sentence(fields: Any) -> None:
    try:
        domain = Domain.from_json(fields)
    except UsageError as error:
        assert "\n" not in str(error) and 10 < len(str(error)) < 300
    else:
        assert Domain.from_json(json.loads(json.dumps(domain.to_json(), allow_nan=False))) == domain


def grid(cells: Any) -> frozenset[tuple[int, int]]:
    """Returns cells moved into the corner."""
    cells = np.asarray(cells)
    return frozenset((int(x), int(y)) for x, y in cells - cells.min(axis=0))


def test_nine_shapes_three_bars_six_composites() -> None:
    assert len(SHAPES) == 9
    straight = {name for name, cells in SHAPES.items() if 0 in np.ptp(np.asarray(cells), axis=0)}
    assert {len(SHAPES[name]) for name in straight} == {2, 3, 4} and len(straight) == 3
    for name in set(SHAPES) - straight:
        cells = np.asarray(SHAPES[name])
        # Two arms of one box's width that share one box: an L when that box ends both, a T when it ends one.
        corners = [c for c in cells if all(((cells == c)[:, 0]) | ((cells == c)[:, 1]))]
        assert len(corners) == 1, name
        arms = [cells[cells[:, 1 - axis] == corners[0][1 - axis]][:, axis] for axis in (0, 1)]
        ends = [corner in (arm.min(), arm.max()) for arm, corner in zip(arms, corners[0], strict=True)]
        assert (name[0] in "LJ", name[0] == "T") == (all(ends), sum(ends) == 1), name


def test_shapes_are_connected_and_distinct_under_rotation() -> None:
    turned: set[frozenset[tuple[int, int]]] = set()
    for cells in SHAPES.values():
        reached, todo = set(), [cells[0]]
        while todo:
            x, y = todo.pop()
            if (x, y) in cells and (x, y) not in reached:
                reached.add((x, y))
                todo += [(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]
        assert len(reached) == len(cells) == len(set(cells))
        rotations = {
            grid([(x * c - y * s, x * s + y * c) for x, y in cells]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))
        }
        assert not rotations & turned
        turned |= rotations


@pytest.mark.parametrize("shape", SHAPES)
def test_boxes_are_centred_and_touch(shape: str) -> None:
    boxes = RigidBody(shape, (2000.0,) * len(SHAPES[shape]), 0.5).boxes()
    assert boxes.shape == (len(SHAPES[shape]), 5)
    np.testing.assert_allclose(boxes[:, :2].mean(axis=0), 0, atol=1e-12)
    np.testing.assert_array_equal(boxes[:, 2], 0)
    np.testing.assert_allclose(boxes[:, 3:], BOX_SIZE / 2)
    apart = np.linalg.norm(boxes[:, None, :2] - boxes[:, :2], axis=-1)
    np.testing.assert_allclose(np.sort(apart, axis=1)[:, 1], BOX_SIZE)  # the nearest shares an edge, none overlaps
    assert grid(np.round(boxes[:, :2] / BOX_SIZE - boxes[0, :2] / BOX_SIZE)) == grid(SHAPES[shape])
