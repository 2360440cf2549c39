"""Joins the shards of a span into one array that can be mapped into memory, and maps it.

A span of one shard is that shard. Any other is joined once, into `joined/<set key>/<domain>-<first>-<count>.npy`: its
rows, and after them 32 bytes, the SHA-256 of its shards' digests. A join whose last bytes are not those of the shards
that are there now is never used, and whatever is under `joined` may be deleted at any time.
"""

from __future__ import annotations

import fcntl
import hashlib
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from dlobench.data.domain_set import DomainSet, Span, Unit
from dlobench.data.store import WIDTH, Broken, Rows, Store, atomic_write, header
from dlobench.errors import RunError


def map_rows(store: Store, of: DomainSet, span: Span) -> Rows:
    """Maps the rows of a span, (K, T+1, 114), read-only; nothing is read before it is used.

    A shard's bytes are checked when it is mapped, those of several when they are joined; that a join is of the shards
    of today is checked every time. Raises `Broken` for a broken or missing shard, `RunError` when the disk refuses.
    """
    units = list(of.units([span]))
    skip = span.first - units[0].first
    if len(units) == 1:
        store.rows(of, units[0])
        return _map(store.path(of, units[0]))[skip : skip + span.count]
    path = join_path(store, of, span)
    seal = _seal(store, of, units)
    if not _is_join(path, of, span, seal):
        with _alone(path.parent):
            if not _is_join(path, of, span, seal):  # another process may have made it meanwhile
                for leftover in path.parent.glob(f".{path.name}.*.tmp"):  # of a join that was killed
                    leftover.unlink(missing_ok=True)
                atomic_write(path, _pieces(store, of, span, units, seal))
    return _map(path)


def join_path(store: Store, of: DomainSet, span: Span) -> Path:
    """Returns where the join of a span is kept."""
    return store.root / "joined" / of.key / f"{span.domain:05d}-{span.first:07d}-{span.count}.npy"


def _seal(store: Store, of: DomainSet, units: list[Unit]) -> bytes:
    """Returns the SHA-256 of the digests of shards, as their sidecars tell them."""
    digest = hashlib.sha256()
    for unit in units:
        sidecar = store.sidecar(of, unit)
        if sidecar is None:
            raise Broken(store.path(of, unit), "it has no sidecar")
        digest.update(f"{unit.first} {sidecar['sha256']}\n".encode())
    return digest.digest()


def _shape(of: DomainSet, span: Span) -> tuple[int, int, int]:
    return span.count, of.pushes + 1, WIDTH


def _is_join(path: Path, of: DomainSet, span: Span, seal: bytes) -> bool:
    """Tells whether a file is the join of shards with this seal, whole."""
    begin = header(_shape(of, span))
    try:
        with path.open("rb") as file:
            if file.read(len(begin)) != begin:
                return False
            end = file.seek(-len(seal), os.SEEK_END)
            return end == len(begin) + 4 * math.prod(_shape(of, span)) and file.read() == seal
    except (OSError, ValueError):
        return False


def _pieces(store: Store, of: DomainSet, span: Span, units: list[Unit], seal: bytes) -> Iterator[bytes | memoryview]:
    """Yields the bytes of a join, shard by shard, every byte of a shard checked against its digest."""
    yield header(_shape(of, span))
    for unit in units:
        skip = max(span.first - unit.first, 0)
        rows = store.rows(of, unit)[skip : span.first + span.count - unit.first]
        yield np.ascontiguousarray(rows).data.cast("B")
    if _seal(store, of, units) != seal:
        raise RunError(f"the shards of {of.name}/{span.domain} changed while they were joined; read them again")
    yield seal


def _map(path: Path) -> Rows:
    rows: Rows = np.load(path, mmap_mode="r", allow_pickle=False)
    return rows


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Waits until no other process joins in this folder, and keeps others waiting for as long."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise RunError(f"cannot write {folder}: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
