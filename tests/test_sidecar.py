"""Tests the seal of sidecars: not one byte changes unnoticed, and what is none of ours is told apart."""

from __future__ import annotations

import json
import random

import pytest

from dlobench.data.sidecar import SCHEMA, origin, seal, unseal

ABOUT = {
    "schema": SCHEMA, "unit": {"domain": 3}, "key": "k", "domain": {"length": 0.16}, "seed": [1, 2], "sha256": "0" * 64,
    "bytes": 7, "account": {}, "seconds": 0.25, **origin(),
}  # fmt: skip


def test_what_is_sealed_is_json_and_is_unsealed() -> None:
    content = seal(ABOUT)
    found = unseal(content)
    assert found == json.loads(content)
    assert {name: found[name] for name in ABOUT} == ABOUT


def test_every_byte_is_guarded() -> None:
    content, rng = seal(ABOUT), random.Random(0)
    for position in range(len(content)):
        changed = bytearray(content)
        changed[position] ^= rng.randrange(1, 256)
        with pytest.raises(ValueError, match=r"sidecar"):
            unseal(bytes(changed))


@pytest.mark.parametrize("change", [b"\n", b" ", b"\0"])
def test_nothing_is_added_or_cut_off(change: bytes) -> None:
    content = seal(ABOUT)
    for altered in (content + change, change + content, content[:-1], content[1:], content.replace(b"\n", b"")):
        with pytest.raises(ValueError, match=r"altered|unreadable"):
            unseal(altered)


def test_an_older_schema_is_named() -> None:
    with pytest.raises(ValueError, match=f"has schema 2, this version of dlobench reads {SCHEMA}"):
        unseal(json.dumps(ABOUT | {"schema": 2}, indent=1).encode())


@pytest.mark.parametrize("name", ABOUT)
def test_a_field_that_is_missing_is_missed_though_the_seal_fits(name: str) -> None:
    with pytest.raises(ValueError, match="not one of ours"):
        unseal(seal({key: value for key, value in ABOUT.items() if key != name}))


@pytest.mark.parametrize("change", [{"bytes": "1"}, {"bytes": True}, {"seconds": None}, {"schema": "3"}], ids=str)
def test_a_wrong_type_is_refused_though_the_seal_fits(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="not one of ours"):
        unseal(seal(ABOUT | change))
