"""Seals what is told about a shard, so that not one byte of a sidecar changes unnoticed.

A sidecar is JSON whose last field is the SHA-256 of every byte before it.
"""

from __future__ import annotations

import hashlib
import json
from functools import cache
from typing import Any

from dlobench import machine

SCHEMA = 3
_FIELDS = {"schema", "unit", "key", "domain", "seed", "sha256", "bytes", "account", "seconds", "versions", "cpu"}


def seal(about: dict[str, Any]) -> bytes:
    """Returns the content of a sidecar."""
    body = json.dumps(about, indent=1).removesuffix("\n}").encode()
    return body + _tail(body)


def unseal(content: bytes) -> dict[str, Any]:
    """Returns what a sidecar says; raises `ValueError` with the reason why it is none of ours, or was altered."""
    length = len(_tail(b""))
    if content[-length:] != _tail(content[:-length]):
        try:
            found = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"unreadable sidecar: {error}") from error
        schema = found.get("schema") if isinstance(found, dict) else None
        if isinstance(schema, int) and schema != SCHEMA:
            raise ValueError(f"its sidecar has schema {schema}, this version of dlobench reads {SCHEMA}")
        raise ValueError("its sidecar was altered, or is not one of ours")
    about: dict[str, Any] = json.loads(content)
    if not (
        about.keys() >= _FIELDS
        and about["schema"] == SCHEMA
        and type(about["bytes"]) is int
        and type(about["seconds"]) in (int, float)
    ):
        raise ValueError("its sidecar is not one of ours")
    return about


def _tail(body: bytes) -> bytes:
    return b',\n "seal": "%s"\n}\n' % hashlib.sha256(body).hexdigest().encode()


@cache
def origin() -> dict[str, Any]:
    """Returns the versions and the CPU that shards made by this process come from."""
    return {"versions": machine.versions(), "cpu": machine.cpu()}
