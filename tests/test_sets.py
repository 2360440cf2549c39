"""Tests how a domain is found by its id."""

from __future__ import annotations

import pytest

from dlobench.data import sets
from dlobench.errors import UsageError


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
