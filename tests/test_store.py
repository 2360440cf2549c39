"""Tests the shards: what is written is read back, and nothing half-written or altered is ever taken for data."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import pickle
import subprocess
from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dlobench.data.domain_set import PUSHES, DomainSet, Span, Unit
from dlobench.data.sets import SETS
from dlobench.data.status import status
from dlobench.data.store import WIDTH, Broken, Store, atomic_write, pack, unpack
from dlobench.domain import MAX_BODIES, MAX_SEGMENTS, Domain
from dlobench.errors import RunError
from dlobench.trajectories import Trajectories, geometry

META = SETS["meta-learning"]
UNIT = Unit("meta-learning", 0, 0, 4)


def fake(domain: Domain, trajectories: int, *, seed: int = 0, pushes: int = PUSHES) -> Trajectories:
    """Makes trajectories of a domain's shapes out of random walks; they cost no simulation."""
    rng = np.random.default_rng(seed)
    K, T = trajectories, pushes
    dlo_mask, body_mask, boxes = geometry(domain)
    executed = rng.normal(scale=0.01, size=(K, T, 2)).astype(np.float32)
    pusher = np.concatenate([np.zeros((K, 1, 2)), executed.cumsum(1)], axis=1).astype(np.float32)
    dlo = rng.normal(scale=0.01, size=(K, T + 1, MAX_SEGMENTS, 3)).cumsum(1).astype(np.float32)
    bodies = rng.normal(scale=0.1, size=(K, T + 1, MAX_BODIES, 3)).astype(np.float32)
    dlo[:, :, ~dlo_mask], bodies[:, :, ~body_mask] = 0, 0
    commanded = (executed + rng.normal(scale=1e-4, size=executed.shape)).astype(np.float32)
    cylinder = rng.normal(scale=0.1, size=(K, T + 1, 3)).astype(np.float32)
    return Trajectories(dlo, dlo_mask, pusher, bodies, body_mask, boxes, commanded, executed, cylinder)


def write(store: Store, of: DomainSet, unit: Unit) -> Trajectories:
    """Writes a fake shard."""
    trajectories = fake(of.domain(unit.domain), unit.count, seed=unit.domain, pushes=of.pushes)
    store.write(of, unit, trajectories, {"commands": 1}, 0.25)
    return trajectories


def files(folder: Path) -> dict[str, bytes]:
    """Returns every file under a folder with its content."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def same(one: Trajectories, other: Trajectories) -> bool:
    """Tells whether trajectories are the same in every bit."""
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(Trajectories) if f.name != "parameters"]
    return all(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in pairs)


@given(
    index=st.integers(0, len(META.cells) * META.per_cell - 1), K=st.integers(1, 5), pushes=st.integers(1, 6),
    seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
@settings(max_examples=50, deadline=None)
def test_what_is_packed_is_unpacked(index: int, K: int, pushes: int, seed: int) -> None:
    domain = META.domain(index)
    trajectories = fake(domain, K, seed=seed, pushes=pushes)
    rows = pack(trajectories)
    assert rows.shape == (K, pushes + 1, WIDTH)
    assert rows.dtype == np.float32
    assert same(unpack(rows, geometry(domain)), trajectories)


def test_every_column_of_a_shard_has_one_meaning() -> None:
    domain = META.domain(META.per_cell * len(META.cells) - 1)
    rows = np.arange(2 * (PUSHES + 1) * WIDTH, dtype=np.float32).reshape(2, PUSHES + 1, WIDTH)
    rows[:, -1, -4:] = 0  # no action follows the last state
    assert np.array_equal(pack(unpack(rows, geometry(domain))), rows)


def test_a_written_shard_is_read_back_whole(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.sidecar(META, UNIT) is None
    written = write(store, META, UNIT)
    assert same(store.load(META, UNIT), written)
    path = store.path(META, UNIT)
    assert sorted(p.name for p in path.parent.iterdir()) == [path.with_suffix(".json").name, path.name]
    sidecar = json.loads(path.with_suffix(".json").read_text())
    assert sidecar["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert Domain.from_json(sidecar["domain"]) == META.domain(0)


def test_a_domain_is_cut_to_the_trajectories_asked_for(tmp_path: Path) -> None:
    store, block = Store(tmp_path), META.block
    span = Span(3, "train", 0, block + 1)
    parts = [write(store, META, unit) for unit in META.units([span])]
    loaded = store.load_span(META, span)
    assert len(loaded) == block + 1
    assert np.array_equal(loaded.dlo[:block], parts[0].dlo)
    assert np.array_equal(loaded.dlo[block:], parts[1].dlo[:1])


def test_a_span_may_begin_anywhere(tmp_path: Path) -> None:
    store, of = Store(tmp_path), SETS["single-domain-large"]
    (span,) = [span for span in of.spans("mini") if (span.domain, span.part) == (4, "test")]
    assert span.first >= 1_000_000, "numbers of its own"
    parts = [write(store, of, unit) for unit in of.units([span])]
    assert len(parts) == 2
    inside = replace(span, first=span.first + 3, count=12)
    assert np.array_equal(store.load_span(of, inside).dlo[:7], parts[0].dlo[3:])
    assert np.array_equal(store.load_span(of, inside).dlo[7:], parts[1].dlo[:5])


def test_sets_have_trajectories_of_their_own_length(tmp_path: Path) -> None:
    store, of = Store(tmp_path), SETS["distribution"]
    unit = Unit(of.name, 2, 0, of.block)
    written = write(store, of, unit)
    assert written.pushes == of.pushes == 8
    assert same(store.load(of, unit), written)


def test_a_forgotten_shard_is_to_be_made_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    write(store, META, UNIT)
    store.discard(META, UNIT)
    assert store.sidecar(META, UNIT) is None
    store.discard(META, UNIT)  # twice is no error


def full(*_: object) -> NoReturn:
    """Refuses like a full disk."""
    raise OSError(errno.ENOSPC, "No space left on device")


def refuse_after(calls: int, real: Any) -> Any:
    """Returns a function that works `calls` times and then refuses."""
    left = iter(range(calls))
    return lambda *arguments: full() if next(left, None) is None else real(*arguments)


class FullFile(io.BytesIO):
    """Stands for a file on a full disk."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        path.touch()

    write = full


def check_refused(store: Store, before: dict[str, bytes]) -> None:
    """Writes a shard, sees it refused, and finds nothing that was not there before but what is no data."""
    with pytest.raises(RunError, match="No space left") as refused:
        write(store, META, UNIT)
    assert str(store.root) in str(refused.value)
    after = files(store.root)
    assert not [name for name in after if name.endswith(".tmp")], "a temporary file was left"
    assert before.items() <= after.items()
    assert not status(store, META, [UNIT]).broken


@pytest.mark.parametrize("what", ["fsync", "replace", "write"])
def test_a_disk_that_refuses_leaves_no_shard(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, other = Store(tmp_path), Unit("meta-learning", 1, 0, 2)
    write(store, META, other)
    before = files(tmp_path)
    if what == "fsync":
        monkeypatch.setattr(os, "fsync", full)
    elif what == "replace":
        monkeypatch.setattr(os, "replace", full)
        monkeypatch.setattr(Path, "replace", full)
        monkeypatch.setattr(os, "rename", full)
        monkeypatch.setattr(Path, "rename", full)
    else:
        real = Path.open
        monkeypatch.setattr(
            Path, "open", lambda path, mode="r", **k: FullFile(path) if "w" in mode else real(path, mode)
        )
    check_refused(store, before)
    monkeypatch.undo()
    assert store.sidecar(META, UNIT) is None
    assert files(tmp_path) == before
    written = write(store, META, UNIT)
    assert same(store.load(META, UNIT), written)


@pytest.mark.parametrize(("what", "calls"), [("fsync", 1), ("fsync", 2), ("fsync", 3), ("replace", 1)])
def test_a_disk_that_refuses_later_leaves_no_broken_shard(
    what: str, calls: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if what == "fsync":
        monkeypatch.setattr(os, "fsync", refuse_after(calls, os.fsync))
    else:
        monkeypatch.setattr(Path, "replace", refuse_after(calls, Path.replace))
    check_refused(Store(tmp_path), {})


def test_an_interrupt_in_the_middle_of_a_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    (tmp_path / "kept").write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        atomic_write(tmp_path / "kept", b"new")
    assert files(tmp_path) == {"kept": b"old"}


def mounted(folder: Path, *options: str) -> Iterator[Path]:
    """Mounts a small disk for the time of a test; skips where that is not permitted."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"cannot mount a small disk: {error}")
    if done.returncode:
        pytest.skip(f"cannot mount a small disk: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    yield from mounted(tmp_path / "small", "size=128k")


@pytest.fixture
def read_only_disk(tmp_path: Path) -> Iterator[Path]:
    yield from mounted(tmp_path / "readonly", "size=128k", "ro")


def test_a_full_disk_leaves_whole_shards_only(small_disk: Path) -> None:
    store, units = Store(small_disk), [Unit("meta-learning", i, 0, 4) for i in range(9)]
    with pytest.raises(RunError, match="No space left") as refused:
        for unit in units:
            write(store, META, unit)
    assert str(small_disk) in str(refused.value)
    found = status(store, META, units, every_byte=True)
    assert found.done, "the disk holds at least one shard"
    assert found.pending
    assert not found.broken
    assert not list(small_disk.rglob("*.tmp"))


def test_a_read_only_disk_is_named(read_only_disk: Path) -> None:
    with pytest.raises(RunError, match="Read-only file system") as refused:
        write(Store(read_only_disk), META, UNIT)
    assert str(read_only_disk) in str(refused.value)


def test_a_file_in_the_place_of_the_folder_is_named_and_kept(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("mine")
    with pytest.raises(RunError, match=r"data.*: Not a directory"):
        write(Store(tmp_path / "data"), META, UNIT)
    assert files(tmp_path) == {"data": b"mine"}


def check_broken(store: Store, of: DomainSet = META, unit: Unit = UNIT) -> None:
    """Sees a shard called broken by its path, and nothing on disk changed."""
    before = files(store.root)
    with pytest.raises(Broken) as broken:
        store.load(of, unit)
    assert str(store.path(of, unit)) in str(broken.value)
    assert list(status(store, of, [unit], every_byte=True).broken) == [unit]
    assert files(store.root) == before


@pytest.fixture
def written(tmp_path: Path) -> Store:
    store = Store(tmp_path)
    write(store, META, UNIT)
    return store


@pytest.mark.parametrize("kept", [0, 1, 127, 128, 5000, -1])
def test_a_truncated_shard_is_broken(written: Store, kept: int) -> None:
    path = written.path(META, UNIT)
    path.write_bytes(path.read_bytes()[:kept])
    assert list(status(written, META, [UNIT]).broken) == [UNIT], "the size alone must tell"
    check_broken(written)


def test_a_lengthened_shard_is_broken(written: Store) -> None:
    path = written.path(META, UNIT)
    path.write_bytes(path.read_bytes() + b"\0")
    check_broken(written)


def test_a_flipped_bit_anywhere_is_broken(written: Store) -> None:
    path = written.path(META, UNIT)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    for position in [0, 8, 127, len(content) - 1, *rng.integers(len(content), size=60)]:
        changed = bytearray(content)
        changed[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        with pytest.raises(Broken, match="SHA-256") as broken:
            written.load(META, UNIT)
        assert str(path) in str(broken.value)


def edit(store: Store, **changes: Any) -> None:
    """Changes fields of a sidecar."""
    path = store.path(META, UNIT).with_suffix(".json")
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"schema": 99},
        {"key": META.key + "1"},
        {"unit": asdict(replace(UNIT, first=20))},
        {"unit": None},
        {"domain": META.domain(1).to_json()},
        {"domain": {}},
        {"sha256": "0" * 64},
        {"sha256": None},
        {"bytes": 1},
        {"bytes": "1"},
        {"seconds": "long"},
        {"seconds": None},
    ],
    ids=str,
)
def test_an_edited_sidecar_is_broken(written: Store, changes: dict[str, Any]) -> None:
    edit(written, **changes)
    check_broken(written)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b"{}", b"\xff\xfe", b"\0" * 100, b"[" * 100_000])
def test_what_is_no_sidecar_is_broken(written: Store, content: bytes) -> None:
    written.path(META, UNIT).with_suffix(".json").write_bytes(content)
    check_broken(written)


@pytest.mark.parametrize("name", ["schema", "unit", "key", "domain", "sha256", "bytes"])
def test_a_sidecar_without_a_field_is_broken(written: Store, name: str) -> None:
    path = written.path(META, UNIT).with_suffix(".json")
    about = json.loads(path.read_text())
    del about[name]
    path.write_text(json.dumps(about))
    check_broken(written)


def test_a_missing_array_is_broken(written: Store) -> None:
    written.path(META, UNIT).unlink()
    check_broken(written)


def test_an_array_without_a_sidecar_is_still_to_be_made(written: Store) -> None:
    written.path(META, UNIT).with_suffix(".json").unlink()
    assert status(written, META, [UNIT]).pending == [UNIT]
    with pytest.raises(Broken, match="no sidecar"):
        written.load(META, UNIT)


def test_a_shard_of_another_version_is_broken(written: Store) -> None:
    newer = replace(META, version=META.version + 1)
    other = written.path(newer, UNIT)
    other.parent.parent.mkdir()
    written.path(META, UNIT).parent.rename(other.parent)
    check_broken(written, of=newer)


def test_a_shard_in_the_place_of_another_domain_is_broken(written: Store) -> None:
    moved = replace(UNIT, domain=5)
    written.path(META, UNIT).parent.rename(written.path(META, moved).parent)
    check_broken(written, unit=moved)


def smuggle(store: Store, content: bytes) -> None:
    """Puts content in the place of an array, with a sidecar to match."""
    store.path(META, UNIT).write_bytes(content)
    edit(store, sha256=hashlib.sha256(content).hexdigest(), bytes=len(content))


def npy(array: Any) -> bytes:
    """Returns the bytes of an array file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def npz() -> bytes:
    """Returns the bytes of an archive of arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, np.zeros(3))
    return buffer.getvalue()


SHAPE = (UNIT.count, PUSHES + 1, WIDTH)
SMUGGLED = {
    "nan": npy(np.full(SHAPE, np.nan, np.float32)),
    "inf": npy(np.full(SHAPE, -np.inf, np.float32)),
    "float64": npy(np.zeros(SHAPE)),
    "shape": npy(np.zeros((3, *SHAPE[1:]), np.float32)),
    "objects": npy(np.array([{"a": 1}, None], dtype=object)),
    "pickle": pickle.dumps([1, 2]),
    "npz": npz(),
    "text": b"not an array",
    "empty": b"",
}


@pytest.mark.parametrize("what", SMUGGLED)
def test_what_is_no_finite_array_is_broken_though_its_digest_fits(written: Store, what: str) -> None:
    smuggle(written, SMUGGLED[what])
    check_broken(written)


def test_nothing_unpickles(written: Store, tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "sprung",))

    for content in (npy(np.array([Trap()], dtype=object)), pickle.dumps(Trap())):
        smuggle(written, content)
        with pytest.raises((Broken, ValueError)):
            written.load(META, UNIT)
        assert not (tmp_path / "sprung").exists()
