"""Tests the status: what is on disk is counted, and told by a digest; what is not there costs nothing."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from test_store import write

from dlobench.data.domain_set import DomainSet, Extent, Unit
from dlobench.data.inventory import other_versions
from dlobench.data.sets import SETS
from dlobench.data.status import Census, census, status
from dlobench.data.store import Store
from dlobench.errors import RunError

META = SETS["meta-learning"]
OF = replace(
    META,
    cells=META.cells[:2],
    per_cell=8,
    block=2,
    extents={
        "mini": (Extent(train=2, valid=2, test=2),),
        "small": (Extent(train=3, valid=3, test=3, per_cell=2),),
        "paper": (Extent(train=6, valid=6, test=6, per_cell=8),),
    },
)  # 2 shards, 8 and 48
UNITS = list(OF.units(OF.spans("paper")))
MINI = list(OF.units(OF.spans("mini")))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """Returns a folder that holds all of mini and one shard more."""
    store = Store(tmp_path)
    for unit in (*MINI, Unit(OF.name, 7, 4, 2)):
        write(store, OF, unit)
    return store


def counted(found: Census) -> list[tuple[int, int, int]]:
    return [(tally.done, tally.pending, tally.broken) for tally in found.scales.values()]


def test_every_scale_is_counted(store: Store) -> None:
    found = census(store, OF)
    assert counted(found) == [(2, 0, 0), (2, 6, 0), (3, 45, 0)]
    assert (found.broken, found.halves, found.temporary, found.strays) == ({}, 0, [], [])
    paper = found.scales["paper"]
    assert paper.pushes == 3 * 2 * 20
    assert paper.bytes == sum(path.stat().st_size for path in store.root.rglob("*.npy"))
    assert paper.seconds == 3 * 0.25
    assert paper.rate == pytest.approx(120 / 0.75)


def test_an_empty_folder_and_none_hold_nothing(tmp_path: Path) -> None:
    for root in (tmp_path, tmp_path / "absent"):
        found = census(Store(root), OF)
        assert counted(found) == [(0, 2, 0), (0, 8, 0), (0, 48, 0)]
        assert {tally.digest for tally in found.scales.values()} == {None}
        assert {tally.rate for tally in found.scales.values()} == {None}


def test_the_digest_tells_folders_apart_and_nothing_else(
    store: Store, tmp_path_factory: pytest.TempPathFactory
) -> None:
    other = Store(tmp_path_factory.mktemp("other"))
    for unit in (Unit(OF.name, 7, 4, 2), *reversed(MINI)):
        write(other, OF, unit)
    digests = [census(each, OF).scales["paper"].digest for each in (store, other)]
    assert digests[0] == digests[1]
    lines = [
        f"{path.parent.name}/{path.stem} {hashlib.sha256(path.read_bytes()).hexdigest()}"
        for path in sorted(store.root.rglob("*.npy"))
    ]
    assert digests[0] == hashlib.sha256("\n".join([OF.key, *lines]).encode()).hexdigest()
    assert census(store, OF).scales["mini"].digest != digests[0]
    other.discard(OF, MINI[0])
    assert census(other, OF).scales["paper"].digest != digests[0]


def test_what_is_no_whole_shard_is_told_apart(store: Store) -> None:
    folder = store.path(OF, MINI[0]).parent
    store.path(OF, MINI[0]).write_bytes(b"short")
    store.discard(OF, MINI[1])
    half, stray = folder / ".0000002.npy.abc.tmp", folder / "notes.txt"
    misplaced, foreign = folder / "0000001.npy", folder.parent / "00099"
    for path in (half, stray, misplaced):
        path.touch()
    foreign.mkdir()
    for name in ("domains.parquet", "README.md"):  # what may lie beside the domains
        (folder.parent / name).touch()
    found = census(store, OF)
    assert counted(found) == [(0, 1, 1), (0, 7, 1), (1, 46, 1)]
    assert list(found.broken) == [MINI[0]]
    assert found.halves == 1
    assert found.temporary == [half]
    assert sorted(found.strays) == sorted([stray, misplaced, foreign])


def test_only_what_is_there_is_opened(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, real = list[Unit](), Store.sidecar

    def look(self: Store, of: DomainSet, unit: Unit) -> Any:
        opened.append(unit)
        return real(self, of, unit)

    monkeypatch.setattr(Store, "sidecar", look)
    big = replace(OF, extents=OF.extents | {"paper": (Extent(train=10**6, valid=10**6, test=10**6, per_cell=8),)})
    assert census(store, big).scales["paper"].pending == 8 * 10**6 - 3
    assert len(opened) == 3
    assert status(store, OF, UNITS).done == [unit for unit in UNITS if unit in opened]
    assert len(opened) == 6


def test_units_are_sorted_in_the_order_they_were_asked_for(store: Store) -> None:
    found = status(store, OF, reversed(UNITS))
    assert found.pending == [unit for unit in reversed(UNITS) if unit not in found.done]
    assert set(found.done) == {*MINI, Unit(OF.name, 7, 4, 2)}


def test_folders_of_other_versions_are_named(store: Store) -> None:
    newer = replace(OF, version=OF.version + 1)
    write(store, newer, MINI[0])
    (store.root / "meta-learning-of-mine").mkdir()
    assert other_versions(store, OF) == [newer.key]
    assert other_versions(store, newer) == [OF.key]
    assert counted(census(store, OF)) == [(2, 0, 0), (2, 6, 0), (3, 45, 0)]


def test_a_shard_of_another_engine_is_said_in_one_sentence(store: Store) -> None:
    engine = replace(OF)
    vars(engine)["key"] = OF.key + ".1"  # as another version of MuJoCo would make it
    store.path(OF, MINI[0]).parents[1].rename(store.root / engine.key)
    whys = set(census(store, engine).broken.values())
    assert whys == {f"it was made as {OF.key}, this is {OF.key}.1"}


def test_a_folder_that_cannot_be_read_is_named(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: Any) -> Any:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.scandir", refuse)
    with pytest.raises(RunError, match=r"cannot read .*: Permission denied"):
        census(store, OF)
