"""Exports trajectories as Parquet: a row a state with the push that follows it, a file a domain."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dlobench.data import table
from dlobench.data.domain_set import DomainSet, Span
from dlobench.data.status import status
from dlobench.data.store import Store
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Trajectories

if TYPE_CHECKING:
    import pyarrow as pa

FOLDER = "states"  # one file a domain, states/00017.parquet
GROUP = 8192  # rows that are held in memory and make a row group

# What the columns hold, in their order; lists have an entry a segment of the DLO, or a rigid body of the domain.
COLUMNS = {
    "domain": "the domain's number in its set",
    "part": "train, valid or test",
    "trajectory": "the trajectory's number in its domain",
    "step": "pushes before this state, 0 to T",
    "pusher_x_m": "pusher, m",
    "pusher_y_m": "pusher, m",
    "dlo_x_m": "centres of the DLO's segments, m",
    "dlo_y_m": "centres of the DLO's segments, m",
    "dlo_yaw_rad": "yaw of the DLO's segments, rad",
    "bodies_x_m": "rigid bodies, m",
    "bodies_y_m": "rigid bodies, m",
    "bodies_yaw_rad": "rigid bodies, rad",
    "cylinder_x_m": "cylinder that the DLO ends in, m; absent where it is free",
    "cylinder_y_m": "cylinder that the DLO ends in, m; absent where it is free",
    "cylinder_yaw_rad": "cylinder that the DLO ends in, rad; absent where it is free",
    "commanded_x_m": "next displacement of the pusher as asked for, m; absent after the last push",
    "commanded_y_m": "next displacement of the pusher as asked for, m; absent after the last push",
    "executed_x_m": "the same plus execution noise, m; absent after the last push",
    "executed_y_m": "the same plus execution noise, m; absent after the last push",
}
_AXES = ("x_m", "y_m", "yaw_rad")


def check_free(out: Path) -> None:
    """Raises `UsageError` unless a folder can be made at `out`: there is nothing yet, or an empty folder."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise UsageError(f"{out} exists already; an export overwrites nothing")


def export(
    store: Store,
    of: DomainSet,
    spans: Iterable[Span],
    out: Path,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> int:
    """Writes `out/domains.parquet` and `out/states/<domain>.parquet`, and returns the number of states.

    Streams shard by shard, every byte checked, so that memory is flat. All is made in a hidden folder beside `out` and
    renamed at the end. Raises `UsageError` where `out` holds something and `RunError` where shards are missing or
    broken, or the disk refuses; then nothing is left.
    """
    out = out.resolve()
    check_free(out)
    spans = sorted(spans, key=lambda span: (span.domain, span.first))
    total = len({span.domain for span in spans})
    pending = status(store, of, of.units(spans)).pending
    if pending:
        where = store.path(of, pending[0])
        raise RunError(
            f"{len(pending)} shards are still to be made by `dlobench generate {of.name}`, the first {where}"
        )
    hidden = out.with_name(f".{out.name}.{uuid.uuid4().hex[:12]}.tmp")
    try:
        try:
            (hidden / FOLDER).mkdir(parents=True)
            (hidden / table.NAME).write_bytes(table.content(of))
            states = done = 0
            for domain, group in groupby(spans, key=lambda span: span.domain):
                progress(done := done + 1, total)
                states += _write_domain(store, of, list(group), hidden / FOLDER / f"{domain:05d}.parquet")
            for path in (*hidden.rglob("*"), hidden):
                _sync(path)
            hidden.replace(out)
        except BaseException:
            shutil.rmtree(hidden, ignore_errors=True)
            raise
        _sync(out.parent)
    except OSError as error:
        raise RunError(f"cannot write {out}: {error.strerror or error}") from error
    return states


def schema(of: DomainSet) -> pa.Schema:
    """Returns the types of the columns."""
    import pyarrow as pa

    kinds = {"domain": pa.int32(), "part": pa.dictionary(pa.int8(), pa.string()), "trajectory": pa.int32()}
    kinds |= {"step": pa.int16()}
    lists = ("dlo_", "bodies_")
    found = [
        (name, kinds.get(name) or (pa.list_(pa.float32()) if name.startswith(lists) else pa.float32()))
        for name in COLUMNS
    ]
    return pa.schema(found, {"set": of.key})


def _write_domain(store: Store, of: DomainSet, spans: list[Span], path: Path) -> int:
    """Writes the file of one domain, all spans of which are given, and returns its number of states."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    states, waiting = 0, list[pa.Table]()
    with pq.ParquetWriter(path, schema(of), compression="zstd") as writer:
        for rows in _tables(store, of, spans):
            states += len(rows)
            waiting.append(rows)
            if sum(map(len, waiting)) >= GROUP:
                writer.write_table(pa.concat_tables(waiting))
                waiting.clear()
        if waiting:
            writer.write_table(pa.concat_tables(waiting))
    return states


def _tables(store: Store, of: DomainSet, spans: list[Span]) -> Iterator[pa.Table]:
    """Yields the rows of some spans of a domain, shard by shard."""
    for span in spans:
        for unit in of.units([span]):
            first, end = max(unit.first, span.first), min(unit.first + unit.count, span.first + span.count)
            inside = store.load(of, unit).take(slice(first - unit.first, end - unit.first))
            yield _table(of, span, first, inside)


def _table(of: DomainSet, span: Span, first: int, trajectories: Trajectories) -> pa.Table:
    """Returns the rows of some trajectories of a domain, the first of which has the number `first`."""
    import pyarrow as pa

    K, T = len(trajectories), trajectories.pushes
    rows, types = K * (T + 1), schema(of)
    last = np.tile(np.arange(T + 1) == T, K)
    columns: dict[str, pa.Array] = {
        "domain": pa.array(np.full(rows, span.domain, np.int32)),
        "part": pa.DictionaryArray.from_arrays(np.zeros(rows, np.int8), [span.part]),
        "trajectory": pa.array(np.repeat(np.arange(first, first + K, dtype=np.int32), T + 1)),
        "step": pa.array(np.tile(np.arange(T + 1, dtype=np.int16), K)),
    }
    for name, count in (("dlo", trajectories.dlo_mask.sum()), ("bodies", trajectories.body_mask.sum())):
        poses = getattr(trajectories, name)[:, :, :count]
        offsets = np.arange(rows + 1, dtype=np.int32) * count
        for axis, unit in enumerate(_AXES):
            columns[f"{name}_{unit}"] = pa.ListArray.from_arrays(offsets, poses[..., axis].reshape(-1))
    for name in ("pusher", "cylinder", "commanded", "executed"):
        values = getattr(trajectories, name)
        missing = np.full(rows, name == "cylinder" and of.cell(span.domain).attachment == "none")
        if values.shape[1] == T:  # no push follows the last state
            values, missing = np.concatenate([values, np.zeros_like(values[:, :1])], axis=1), last
        for axis, unit in enumerate(_AXES[: values.shape[-1]]):
            columns[f"{name}_{unit}"] = pa.array(values[..., axis].reshape(-1), mask=missing)
    return pa.table([columns[name] for name in types.names], schema=types)


def _sync(path: Path) -> None:
    """Waits until a file or folder is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
