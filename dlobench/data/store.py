"""Keeps shards on disk so that nothing half-written is ever taken for data.

A shard is one float32 array (trajectories, pushes + 1, 114) in `<set key>/<domain>/<first>.npy`. Its sealed JSON
sidecar, with the SHA-256 of the array and where it came from, is written last: without one a shard does not exist yet.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import uuid
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench.data.domain_set import DomainSet, Span, Unit
from dlobench.data.sidecar import SCHEMA, origin, seal, unseal
from dlobench.domain import MAX_BODIES, MAX_SEGMENTS
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Geometry, Trajectories, concatenate

# Columns of a shard, in order: fields of `Trajectories` flattened. The last row of the actions is 0.
COLUMNS = {"pusher": 2, "dlo": MAX_SEGMENTS * 3, "bodies": MAX_BODIES * 3, "cylinder": 3, "commanded": 2, "executed": 2}
WIDTH = sum(COLUMNS.values())

Rows = NDArray[np.float32]


class Broken(RunError):
    """Says which shard is broken and how."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(path, why)
        self.path = path
        self.why = why

    def __str__(self) -> str:
        return f"shard {self.path} is broken ({self.why}); `dlobench data repair` with its set generates it again"


def data_bytes(of: DomainSet, spans: Iterable[Span | Unit]) -> int:
    """Returns how many bytes the arrays of these spans or units take on disk, headers and sidecars aside."""
    return sum(span.count for span in spans) * (of.pushes + 1) * 4 * WIDTH


def pack(trajectories: Trajectories) -> Rows:
    """Flattens trajectories into the rows of a shard: (K, T+1, 114)."""
    K, T = len(trajectories), trajectories.pushes
    out = np.zeros((K, T + 1, WIDTH), np.float32)
    column = 0
    for name, width in COLUMNS.items():
        rows = getattr(trajectories, name)
        if rows is None:
            raise ValueError("trajectories without the cylinder are not whole")
        out[:, : rows.shape[1], column : column + width] = rows.reshape(K, rows.shape[1], width)
        column += width
    return out


def unpack(rows: Rows, geometry: Geometry) -> Trajectories:
    """Views the rows of a shard (K, T+1, 114) as trajectories of a domain with this geometry; nothing is copied."""
    K = len(rows)
    fields, column = {}, 0
    for name, width in COLUMNS.items():
        part = rows[:, :, column : column + width]
        part = part[:, :-1] if name in ("commanded", "executed") else part
        fields[name] = part.reshape(K, part.shape[1], -1, 3) if name in ("dlo", "bodies") else part
        column += width
    dlo_mask, body_mask, boxes = geometry
    return Trajectories(dlo_mask=dlo_mask, body_mask=body_mask, boxes=boxes, **fields)


@lru_cache(maxsize=64)  # the shards of a domain are looked at one after another
def _definition(of: DomainSet, index: int) -> dict[str, Any]:
    return of.definition(index)


@lru_cache(maxsize=64)
def header(shape: tuple[int, ...]) -> bytes:
    """Returns what the file of a float32 array of some shape begins with."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return buffer.getvalue()


def _array(content: NDArray[np.uint8], shape: tuple[int, ...]) -> Rows | None:
    """Views the bytes of a file as a float32 array of some shape; None for all that is not just that."""
    begin = header(shape)
    if content[: len(begin)].tobytes() == begin:
        body = content[len(begin) :]
        return body.view(np.float32).reshape(shape) if body.size == 4 * math.prod(shape) else None
    try:  # another version of NumPy may have padded the header otherwise
        rows = np.lib.format.read_array(io.BytesIO(content.tobytes()), allow_pickle=False)
    except (ValueError, EOFError):
        return None
    return rows if rows.shape == shape and rows.dtype == np.float32 else None


@dataclass(frozen=True)
class Store:
    """Reads and writes the shards under one data folder."""

    root: Path

    @classmethod
    def open(cls, data: str | os.PathLike[str] | None = None) -> Store:
        """Opens a data folder, by default $DLOBENCH_DATA, else the platform's cache; raises `UsageError` for a file."""
        from platformdirs import user_cache_path  # seldom needed

        root = Path(data or os.environ.get("DLOBENCH_DATA") or user_cache_path("dlobench")).expanduser().absolute()
        if root.exists() and not root.is_dir():
            raise UsageError(f"data {root} is not a folder")
        return cls(root)

    def path(self, of: DomainSet, unit: Unit) -> Path:
        """Returns where a unit's array is kept; its sidecar has the suffix .json."""
        return self.root / f"{of.key}/{unit.domain:05d}/{unit.first:07d}.npy"

    def sidecar(self, of: DomainSet, unit: Unit) -> dict[str, Any] | None:
        """Returns a shard's sidecar, or None where the shard is still to be made.

        Raises `Broken` when sidecar and array do not belong together. Reads no array; `rows` checks every byte.
        """
        path = self.path(of, unit)
        try:
            found = unseal(path.with_suffix(".json").read_bytes())
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise Broken(path, f"unreadable sidecar: {error.strerror}") from error
        except ValueError as error:
            raise Broken(path, str(error)) from error
        if found["key"] != of.key:
            raise Broken(path, f"it was made as {found['key']}, this is {of.key}")
        if (
            found["unit"] != vars(unit)
            or found["seed"] != of.seed(unit.domain, unit.first)
            or found["domain"] != _definition(of, unit.domain)
        ):
            raise Broken(path, "it was made of other trajectories or another domain")
        try:
            size = path.stat().st_size
        except OSError as error:
            raise Broken(path, f"its array is missing: {error.strerror}") from error
        if size != found["bytes"]:
            raise Broken(path, f"{size} bytes, {found['bytes']} were written")
        return found

    def load(self, of: DomainSet, unit: Unit) -> Trajectories:
        """Loads a shard, every byte checked against its digest; raises `Broken`."""
        return unpack(self.rows(of, unit), of.geometry(unit.domain))

    def rows(self, of: DomainSet, unit: Unit) -> Rows:
        """Reads the rows of a shard (K, T+1, 114), every byte checked against its digest; raises `Broken`."""
        found, path = self.sidecar(of, unit), self.path(of, unit)
        if found is None:
            raise Broken(path, "it has no sidecar")
        try:
            content = np.fromfile(path, np.uint8)
        except OSError as error:
            raise Broken(path, f"unreadable: {error.strerror}") from error
        if hashlib.sha256(content.data).hexdigest() != found["sha256"]:
            raise Broken(path, "its SHA-256 differs from the one in its sidecar")
        shape = (unit.count, of.pushes + 1, WIDTH)
        rows = _array(content, shape)
        if rows is None or not np.isfinite(rows).all():
            raise Broken(path, f"it holds no finite float32 array {shape}")
        return rows

    def load_span(self, of: DomainSet, span: Span) -> Trajectories:
        """Loads consecutive trajectories of a domain into memory, every byte checked; raises `Broken`."""
        parts = [self.load(of, unit) for unit in of.units([span])]
        return concatenate(parts).take(slice(span.first % of.block, span.first % of.block + span.count))

    def write(
        self, of: DomainSet, unit: Unit, trajectories: Trajectories, account: dict[str, int], seconds: float
    ) -> None:
        """Writes a shard: array first, sidecar last, each under a temporary name, synced, renamed.

        Raises `RunError` when the disk refuses; then nothing half-written remains.
        """
        buffer = io.BytesIO()
        np.save(buffer, pack(trajectories), allow_pickle=False)
        content = buffer.getvalue()
        about = {
            "schema": SCHEMA,
            "unit": asdict(unit),
            "key": of.key,
            "domain": of.definition(unit.domain),
            "seed": of.seed(unit.domain, unit.first),
            "sha256": hashlib.sha256(content).hexdigest(),
            "bytes": len(content),
            "account": account,
            "seconds": round(seconds, 3),
            **origin(),
        }
        path = self.path(of, unit)
        atomic_write(path, content)
        atomic_write(path.with_suffix(".json"), seal(about))

    def discard(self, of: DomainSet, unit: Unit) -> None:
        """Forgets a shard: removes its sidecar, so that it counts as still to be made."""
        self.path(of, unit).with_suffix(".json").unlink(missing_ok=True)


def atomic_write(path: Path, content: bytes | Iterable[bytes | memoryview]) -> None:
    """Writes a file, given whole or in pieces, so that it is there whole or not at all; raises `RunError` otherwise."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")  # another host may have a process of this number
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as file:
                for piece in (content,) if isinstance(content, bytes) else content:
                    file.write(piece)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}") from error
