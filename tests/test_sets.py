"""Tests the sets: what they hold, how they are parted, that scales nest, and how a domain is found by its id."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dlobench.data import sets
from dlobench.data.domain_set import PARTS, SCALES, DomainSet, ScaleName, Span
from dlobench.data.sets import SETS
from dlobench.domain import typical
from dlobench.errors import UsageError

META = SETS["meta-learning"]
EVERY = pytest.mark.parametrize("of", SETS.values(), ids=SETS)
PARTED = [of for of in SETS.values() if of.name != "distribution"]


def counted(of: DomainSet, scale: ScaleName, **where: object) -> dict[str, int]:
    """Counts the pushes of each part in the cells that have these fields."""
    spans = [span for span in of.spans(scale) if of.cell(span.domain).within(where)]
    return {part: of.total(span for span in spans if span.part == part) for part in PARTS}


def test_the_sets_are_those_of_the_paper() -> None:
    large, medium, meta, future = (SETS[name] for name in SETS)
    assert {span.domain for span in large.spans("paper")} == set(range(18))
    assert {of.count * large.pushes for of in large.spans("paper") if of.part == "train"} == {10**6}
    assert {span.domain for span in medium.spans("paper")} == set(range(27))
    assert {of.count * medium.pushes for of in medium.spans("paper") if of.part == "train"} == {10**5}
    assert {span.domain for span in meta.spans("paper")} == set(range(6300))
    assert {span.count * meta.pushes for span in meta.spans("paper")} == {10**4}
    assert len({str(meta.cell(span.domain)) for span in meta.spans("paper")}) == 252
    assert {str(future.cell(i)) for i in range(18)} == {str(large.cell(i)) for i in range(18)}
    assert [future.domain(i) for i in range(18)] == [large.domain(i) for i in range(18)]
    assert future.executions >= 64
    assert {span.part for span in future.spans("paper")} == {"test"}


def test_small_is_what_a_night_needs() -> None:
    for name, domains in (("single-domain-large", 18), ("single-domain-medium", 27)):
        of = SETS[name]
        pushes = Counter(span.count * of.pushes for span in of.spans("small") if span.part == "train")
        expected = {10**4: domains - 3, 10**5: 3} if name.endswith("large") else {10**4: domains}
        assert pushes == expected
    alone = [s for s in META.spans("small") if META.cell(s.domain).within({"length": 0.16, "rigid_objects": 0})]
    assert len(alone) >= 192
    assert sum(span.part == "test" for span in alone) >= 48
    assert len({str(META.cell(span.domain)) for span in META.spans("small")}) == 252


@EVERY
def test_scales_nest(of: DomainSet) -> None:
    for smaller, larger in pairwise(SCALES):
        whole = {(span.domain, span.part): span for span in of.spans(larger)}
        assert all(whole[s.domain, s.part].head(s.count) == s for s in of.spans(smaller))
        assert set(of.units(of.spans(smaller))) <= set(of.units(of.spans(larger)))


@EVERY
@pytest.mark.parametrize("scale", SCALES)
def test_no_trajectory_and_no_shard_has_two_parts(of: DomainSet, scale: ScaleName) -> None:
    spans = of.spans(scale)
    units = list(of.units(spans))
    assert len(units) == len(set(units)) == sum(span.count for span in spans) / of.block, "shards are full"
    if of.parted == "domains":
        assert Counter(span.domain for span in spans).most_common(1)[0][1] == 1


@pytest.mark.parametrize("of", PARTED, ids=lambda of: of.name)
@pytest.mark.parametrize("scale", SCALES)
def test_every_scale_has_every_part_in_every_kind_of_cell(of: DomainSet, scale: ScaleName) -> None:
    for material in ("soft", "flexible", "elastoplastic"):
        assert min(counted(of, scale, material=material).values()) > 0


@given(salt=st.text(max_size=8), cell=st.integers(0, len(META.cells) - 1), per_cell=st.integers(1, 30))
@settings(deadline=None, max_examples=60)
def test_of_eight_neighbours_two_are_tested_and_one_validates(salt: str, cell: int, per_cell: int) -> None:
    of = replace(META, salt=salt, per_cell=per_cell)
    first = cell * per_cell
    parts = [of.part(index) for index in range(first, first + per_cell)]
    for start in range(0, per_cell - 7, 8):
        assert Counter(parts[start : start + 8]) == {"test": 2, "valid": 1, "train": 5}
    rest = Counter(parts[per_cell - per_cell % 8 :])
    assert rest["test"] <= 2 and rest["valid"] <= 1


def test_another_salt_parts_otherwise() -> None:
    other = replace(META, salt="another")
    assert [META.part(i) for i in range(200)] != [other.part(i) for i in range(200)]


def test_seeds_of_different_parts_and_sets_never_meet() -> None:
    seeds = [
        tuple(of.seed(span.domain, trajectory))
        for of in SETS.values()
        for span in of.spans("mini")
        for trajectory in range(span.first, span.first + span.count)
    ]
    assert len(seeds) == len(set(seeds))


# Definitions, not outputs: on every machine they must be these. A change here is another set: raise its version.
DIGESTS = {
    ("single-domain-large", "mini"): "50ee67e2e2371edd",
    ("single-domain-large", "small"): "801ab22327bc9ae5",
    ("single-domain-large", "paper"): "825195173f9f7367",
    ("single-domain-medium", "mini"): "ee540c57b1c1abe2",
    ("single-domain-medium", "small"): "8348357ff2fb89fa",
    ("single-domain-medium", "paper"): "4dd5acf8a17e496c",
    ("meta-learning", "mini"): "ccf9f9f46ac88a14",
    ("meta-learning", "small"): "895f2ebc16a986cf",
    ("meta-learning", "paper"): "0273c4e8b1ef6da9",
    ("distribution", "mini"): "e94e4d0a8ca818b7",
    ("distribution", "small"): "a212a10771929fdb",
    ("distribution", "paper"): "fb9c60e636458e83",
}


@EVERY
@pytest.mark.parametrize("scale", SCALES)
def test_the_definitions_are_the_published_ones(of: DomainSet, scale: ScaleName) -> None:
    spans = of.spans(scale)
    assert of.digest(spans)[:16] == DIGESTS[of.name, scale]
    assert of.digest(reversed(spans)) == of.digest(spans), "the order says nothing"
    if scale == "mini":
        assert of.digest(spans[1:]) != of.digest(spans)
        shorter = [span.head(span.count - 1) if i == 0 else span for i, span in enumerate(spans)]
        assert of.digest(shorter) != of.digest(spans)


def test_a_span_has_no_more_than_it_has() -> None:
    span = Span(3, "valid", 40, 20)
    assert span.head(5) == Span(3, "valid", 40, 5)
    with pytest.raises(UsageError, match="21 trajectories are asked for, domain 3 has 20 to valid"):
        span.head(21)


def test_typical_domains_lie_in_the_middle_and_differ_only_by_their_cells() -> None:
    of = SETS["single-domain-medium"]
    domains = [of.domain(i) for i in range(len(of))]
    assert len({domain.surface_friction for domain in domains}) == len({domain.density for domain in domains}) == 1
    assert len({domain.bending_stiffness for domain in domains}) == 3, "one a material"
    assert len(set(domains)) == 27
    one = typical(material="elastoplastic", attachment="none", length=0.16, rigid_objects=3)
    assert (one.surface_friction, one.density, one.yield_curvature) == (0.5, 1050.0, 1.0)
    assert one.bending_stiffness == pytest.approx(1e-4)
    with pytest.raises(UsageError, match="rigid_objects = 4"):
        typical(material="soft", attachment="none", length=0.16, rigid_objects=4)


def test_an_id_is_the_set_and_the_number() -> None:
    of = sets.find("meta-learning")
    assert sets.domain("meta-learning/17") == of.domain(17)
    assert sets.domain("meta-learning/00017") == of.domain(17)  # as records write it
    assert sets.locate("meta-learning/6299") == (of, 6299)
    assert len({sets.domain(f"meta-learning/{i}") for i in range(0, len(of), 700)}) == 9


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("meta-learning/6300", ["domain of meta-learning = 6300", "0–6299"]),
        ("metalearning/3", ["unknown set 'metalearning'", "meta-learning"]),
        ("meta-learning", ["'meta-learning'", "<set>/<number>", "meta-learning/0–6299"]),
        ("meta-learning/-1", ["'meta-learning/-1'", "meta-learning/0–6299"]),
        ("meta-learning/1/2", ["'meta-learning/1/2'", "meta-learning/0–6299"]),
        ("meta-learning/²", ["'meta-learning/²'", "meta-learning/0–6299"]),
        ("meta-learning/" + "9" * 5000, ["meta-learning/0–6299"]),
        ("/3", ["'/3'", "meta-learning/0–6299"]),
        ("", ["''", "meta-learning/0–6299"]),
    ],
)
def test_what_is_no_id_is_refused(given: str, expected: list[str]) -> None:
    with pytest.raises(UsageError) as caught:
        sets.domain(given)
    message = str(caught.value)
    assert all(part in message for part in expected) and "\n" not in message and len(message) < 200


def test_a_set_has_no_domain_before_its_first() -> None:
    with pytest.raises(UsageError, match=r"^domain of meta-learning = -1 is outside 0–6299$"):
        sets.find("meta-learning").domain(-1)
