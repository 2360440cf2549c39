"""Keeps shards on disk so that nothing half-written is ever taken for data.

A shard is one float32 array (trajectories, pushes + 1, 114) in `<set key>/<domain>/<first>.npy`. Its JSON sidecar, with
the SHA-256 of the array and where it came from, is written last: a shard without a valid sidecar does not exist yet.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench import machine
from dlobench.data.domain_set import DomainSet, Span, Unit
from dlobench.domain import MAX_BODIES, MAX_SEGMENTS
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Geometry, Trajectories, concatenate

# Columns of a shard, in order: fields of `Trajectories` flattened. The last row of the actions is 0.
COLUMNS = {"pusher": 2, "dlo": MAX_SEGMENTS * 3, "bodies": MAX_BODIES * 3, "cylinder": 3, "commanded": 2, "executed": 2}
WIDTH = sum(COLUMNS.values())
SCHEMA = 2
_FIELDS = {"schema", "unit", "key", "domain", "seed", "sha256", "bytes", "account", "seconds", "versions", "cpu"}

Rows = NDArray[np.float32]


class Broken(RunError):
    """Says which shard is broken and how."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(path, why)
        self.path = path
        self.why = why

    def __str__(self) -> str:
        return f"shard {self.path} is broken ({self.why}); `dlobench data repair` with its set generates it again"


def data_bytes(of: DomainSet, spans: Iterable[Span]) -> int:
    """Returns how many bytes the arrays of these spans take on disk, headers and sidecars aside."""
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


def _is_sidecar(found: object) -> bool:
    """Tells whether JSON has the fields of a sidecar, of the types that are reckoned with."""
    return (
        isinstance(found, dict)
        and found.keys() >= _FIELDS
        and found["schema"] == SCHEMA
        and type(found["bytes"]) is int
        and type(found["seconds"]) in (int, float)
    )


@dataclass(frozen=True)
class Store:
    """Reads and writes the shards under one data folder."""

    root: Path

    @classmethod
    def open(cls, data: str | os.PathLike[str] | None = None) -> Store:
        """Opens a data folder, by default $DLOBENCH_DATA, else the platform's cache; raises `UsageError` for a file."""
        from platformdirs import user_cache_path  # noqa: PLC0415  # seldom needed

        root = Path(data or os.environ.get("DLOBENCH_DATA") or user_cache_path("dlobench")).expanduser().absolute()
        if root.exists() and not root.is_dir():
            raise UsageError(f"data {root} is not a folder")
        return cls(root)

    def path(self, of: DomainSet, unit: Unit) -> Path:
        """Returns where a unit's array is kept; its sidecar has the suffix .json."""
        return self.root / of.key / f"{unit.domain:05d}" / f"{unit.first:07d}.npy"

    def sidecar(self, of: DomainSet, unit: Unit) -> dict[str, Any] | None:
        """Returns a shard's sidecar, or None where the shard is still to be made.

        Raises `Broken` when sidecar and array do not belong together. Reads no array; `load` checks every byte.
        """
        path = self.path(of, unit)
        try:
            found: dict[str, Any] = json.loads(path.with_suffix(".json").read_text())
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            raise Broken(path, f"unreadable sidecar: {error}") from error
        if not _is_sidecar(found):
            raise Broken(path, "its sidecar is not one of ours")
        if (
            found["key"] != of.key
            or found["unit"] != asdict(unit)
            or found["seed"] != of.seed(unit.domain, unit.first)
            or found["domain"] != of.definition(unit.domain)
        ):
            raise Broken(path, f"it was made for another set, domain or version than {of.key}")
        try:
            size = path.stat().st_size
        except OSError as error:
            raise Broken(path, f"its array is missing: {error.strerror}") from error
        if size != found["bytes"]:
            raise Broken(path, f"{size} bytes, {found['bytes']} were written")
        return found

    def load(self, of: DomainSet, unit: Unit) -> Trajectories:
        """Loads a shard, every byte checked against its digest; raises `Broken`."""
        found = self.sidecar(of, unit)
        path = self.path(of, unit)
        if found is None:
            raise Broken(path, "it has no sidecar")
        try:
            content = path.read_bytes()
        except OSError as error:
            raise Broken(path, f"unreadable: {error.strerror}") from error
        if hashlib.sha256(content).hexdigest() != found["sha256"]:
            raise Broken(path, "its SHA-256 differs from the one in its sidecar")
        try:
            rows = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise Broken(path, f"it holds no plain array: {error}") from error
        if rows.shape != (unit.count, of.pushes + 1, WIDTH) or rows.dtype != np.float32 or not np.isfinite(rows).all():
            raise Broken(path, f"{rows.dtype} {rows.shape} is not a finite shard")
        return unpack(rows, of.geometry(unit.domain))

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
            "versions": machine.versions(),
            "cpu": machine.cpu(),
        }
        path = self.path(of, unit)
        atomic_write(path, content)
        atomic_write(path.with_suffix(".json"), json.dumps(about, indent=1).encode())

    def discard(self, of: DomainSet, unit: Unit) -> None:
        """Forgets a shard: removes its sidecar, so that it counts as still to be made."""
        self.path(of, unit).with_suffix(".json").unlink(missing_ok=True)


def atomic_write(path: Path, content: bytes) -> None:
    """Writes a file so that it is there whole or not at all; raises `RunError` when the disk refuses."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as file:
                file.write(content)
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
