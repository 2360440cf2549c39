"""Writes the card of a data set: README.md for people, croissant.json for programs, and the tables they speak of."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dlobench.data import croissant, parquet, table
from dlobench.data.card_text import CITATION, LICENSE, SUMMARY, text
from dlobench.data.domain_set import DomainSet, ScaleName, Span
from dlobench.data.inventory import listed
from dlobench.data.store import Store, atomic_write
from dlobench.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa

README, CROISSANT = "README.md", "croissant.json"
SHARDS, STATES = "shards.parquet", f"{parquet.FOLDER}/*.parquet"

SHARD_COLUMNS = {
    "path": "the array, in the folder of the set",
    "domain": "the domain's number in its set",
    "part": "train, valid or test",
    "first": "number of its first trajectory in its domain",
    "trajectories": "how many it holds",
    "bytes": "its size",
    "sha256": "SHA-256 of its bytes",
    "core_seconds": "processor time that it took",
}
ABOUT = {
    table.NAME: "The domains of the set: a row a domain, with its physical parameters and what it holds",
    SHARDS: "The shards on disk: a row a shard, with the SHA-256 of its bytes",
    STATES: "The trajectories: a row a state, with the push that follows it",
}
COLUMNS = {table.NAME: table.about_columns(), SHARDS: SHARD_COLUMNS, STATES: parquet.COLUMNS}

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Shards:
    """Holds what is on disk of a scale, a value a shard, and where it comes from."""

    columns: dict[str, list[Any]]
    versions: tuple[str, ...]  # of the software that made them
    cpus: tuple[str, ...]
    wanted: int  # shards of the scale, there or not

    def __len__(self) -> int:
        return len(self.columns["path"])

    def content(self) -> bytes:
        """Returns the table of the shards as a Parquet file."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        buffer = io.BytesIO()
        pq.write_table(pa.table(self.columns, schema=_shard_schema()), buffer, compression="zstd")
        return buffer.getvalue()


def write(
    store: Store, of: DomainSet, scale: ScaleName, out: Path, progress: Progress = lambda _done, _total: None
) -> int:
    """Writes the card of a scale of a set into a folder, beside a Parquet export of the set if one is there.

    Returns the number of shards that it lists, those on disk. Raises `UsageError` for a folder that holds something
    else, `RunError` for a broken shard and when the disk refuses. A card that is there already is written anew.
    """
    _check_folder(of, out)
    shards = _shards(store, of, of.spans(scale), progress)
    tables = {table.NAME: table.content(of), SHARDS: shards.content()}
    files = {name: croissant.file_object(name, content, ABOUT[name]) for name, content in tables.items()}
    domains = _schema(tables[table.NAME])
    records = [
        croissant.record_set("domains", files[table.NAME], domains, COLUMNS[table.NAME], key=("id",)),
        croissant.record_set("shards", files[SHARDS], _shard_schema(), SHARD_COLUMNS, key=("path",)),
    ]
    if any(out.glob(STATES)):
        files[STATES] = croissant.file_set("state-files", STATES, ABOUT[STATES])
        key = ("domain", "trajectory", "step")
        records.append(croissant.record_set("states", files[STATES], parquet.schema(of), parquet.COLUMNS, key=key))
    about = {
        "name": f"dlobench-{of.name}-{scale}",
        "description": SUMMARY,
        "version": f"{of.version}.0.0",
        "datePublished": datetime.now(UTC).date().isoformat(),
        "license": LICENSE,
        "citeAs": CITATION,
        "creator": {"@type": "sc:Organization", "name": "dlobench"},
        "keywords": ["deformable linear objects", "pushing", "dynamics", "meta-learning", "simulation"],
    }
    described = croissant.dataset(about, list(files.values()), records)
    readme = text(
        of,
        scale,
        there=(len(shards), shards.wanted),
        versions=shards.versions,
        cpus=shards.cpus,
        sha256=files[SHARDS]["sha256"],
        tables={name: columns for name, columns in COLUMNS.items() if name in files},
    )
    for name, content in tables.items():
        atomic_write(out / name, content)
    atomic_write(out / README, readme.encode())
    atomic_write(out / CROISSANT, json.dumps(described, indent=1, ensure_ascii=False).encode())
    return len(shards)


def _check_folder(of: DomainSet, out: Path) -> None:
    """Raises `UsageError` unless a card may be written there."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out} is not a folder")
    if (out / README).exists() and not (out / CROISSANT).exists():
        raise UsageError(f"--out {out} holds a {README} that is not of a card; nothing is overwritten")
    if (out / table.NAME).exists():
        made = _key(out / table.NAME)
        if made != of.key:
            raise UsageError(f"--out {out} holds {made or 'something else'}, this is {of.key}")


def _key(path: Path) -> str | None:
    """Returns the key of the set that a table of domains says it is of, None for anything else."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        metadata = pq.read_schema(path).metadata or {}
    except (pa.ArrowException, OSError):
        return None
    found = metadata.get(b"set")
    return found.decode(errors="replace") if found else None


def _shards(store: Store, of: DomainSet, spans: Sequence[Span], progress: Progress) -> Shards:
    """Returns what is on disk of some spans, by their sidecars."""
    columns: dict[str, list[Any]] = {name: [] for name in SHARD_COLUMNS}
    versions, cpus, done = set[str](), set[str](), 0
    total = sum(1 for _ in of.units(spans))
    for span in sorted(spans, key=lambda span: (span.domain, span.first)):
        units = list(of.units([span]))
        here = set(listed(store.path(of, units[0]).parent))  # most may be still to be made
        progress(done := done + len(units), total)
        for unit in units:
            path = store.path(of, unit)
            sidecar = store.sidecar(of, unit) if path.with_suffix(".json").name in here else None
            if sidecar is None:
                continue
            place = (path.relative_to(store.root / of.key).as_posix(), unit.domain, span.part, unit.first, unit.count)
            about = (sidecar["bytes"], sidecar["sha256"], float(sidecar["seconds"]))
            for column, value in zip(columns.values(), (*place, *about), strict=True):
                column.append(value)
            versions.add(", ".join(f"{name} {number}" for name, number in sidecar["versions"].items()))
            cpus.add(f"{sidecar['cpu']['model']} ({sidecar['cpu']['architecture']})")
    return Shards(columns, tuple(sorted(versions)), tuple(sorted(cpus)), total)


def _schema(content: bytes) -> pa.Schema:
    import pyarrow.parquet as pq

    return pq.read_schema(io.BytesIO(content))


def _shard_schema() -> pa.Schema:
    import pyarrow as pa

    text, whole = pa.string(), pa.int32()
    types = (text, whole, text, whole, whole, pa.int64(), text, pa.float64())
    return pa.schema(list(zip(SHARD_COLUMNS, types, strict=True)))
