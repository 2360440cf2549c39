"""Tests verification and repair: what is wrong is found wherever it is looked for, and mended without touching more."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from test_faults import arrays, inline, quiet, tiny, units
from test_store import fake, files, write

from dlobench.data.domain_set import Unit
from dlobench.data.executors import find_executor
from dlobench.data.generate import generate, make_unit
from dlobench.data.store import Broken, Store
from dlobench.data.verify import PIECE, repair, verify
from dlobench.world.simulate import Account

OF = tiny(8)
UNITS = units(OF)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """Returns a folder of random walks."""
    store = Store(tmp_path)
    for unit in UNITS:
        write(store, OF, unit)
    return store


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)


def test_workers_find_what_is_found_here(store: Store) -> None:
    flip(store.path(OF, UNITS[3]))
    flip(store.path(OF, UNITS[5]).with_suffix(".json"))
    store.path(OF, UNITS[7]).unlink()
    heard: list[tuple[int, int, int]] = []
    here = verify(store, OF, inline, lambda *told: heard.append(told))
    assert verify(store, OF, find_executor("local", workers=2), quiet) == here
    assert set(here.broken) == {UNITS[3], UNITS[5], UNITS[7]}
    assert "SHA-256" in here.broken[UNITS[3]]
    assert "sidecar" in here.broken[UNITS[5]]
    assert "missing" in here.broken[UNITS[7]]
    assert heard[0] == (0, len(UNITS), 0)
    assert heard[-1] == (len(UNITS), len(UNITS), here.bytes)
    whole = len(UNITS) - 3
    assert here.bytes == whole * 3 * 114 * 4


def test_many_shards_are_checked_in_pieces(tmp_path: Path) -> None:
    count = PIECE + 3
    of = replace(OF, cells=OF.cells[:1], extents={s: (replace(e[0], train=count, valid=count, test=count, per_cell=1),)
                                                  for s, e in OF.extents.items()})  # fmt: skip
    store = Store(tmp_path)
    for unit in units(of):
        write(store, of, unit)
    flip(store.path(of, units(of)[-1]))
    found = verify(store, of, inline, quiet)
    assert (found.shards, list(found.broken)) == (count, units(of)[-1:])


def test_what_is_no_shard_is_listed_and_no_error(store: Store) -> None:
    folder = store.path(OF, UNITS[0]).parent
    (folder / ".0000000.json.0f.tmp").touch()
    (folder / "notes.txt").touch()
    store.discard(OF, UNITS[1])
    found = verify(store, OF, inline, quiet)
    assert (found.broken, found.halves) == ({}, [UNITS[1]])
    assert [path.name for path in found.temporary] == [".0000000.json.0f.tmp"]
    assert [path.name for path in found.strays] == ["notes.txt"]


def test_an_empty_folder_is_whole(tmp_path: Path) -> None:
    found = verify(Store(tmp_path), OF, find_executor("local", workers=2), quiet)
    assert (found.shards, found.bytes, found.broken) == (0, 0, {})


def test_repair_mends_what_was_there_and_no_more(tmp_path: Path) -> None:
    store = Store(tmp_path)
    generate(store, OF, UNITS[:6], inline, quiet)
    before = arrays(tmp_path)
    flip(store.path(OF, UNITS[0]))
    store.discard(OF, UNITS[1])
    store.path(OF, UNITS[2]).unlink()
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.*")}
    made = repair(store, OF, verify(store, OF, inline, quiet), inline, quiet)
    assert set(made) == set(UNITS[:3])
    assert arrays(tmp_path) == before
    for unit in UNITS[3:6]:
        path = store.path(OF, unit)
        assert all(times[each] == each.stat().st_mtime_ns for each in (path, path.with_suffix(".json")))
    assert repair(store, OF, verify(store, OF, inline, quiet), inline, quiet) == []


def test_repair_of_a_scale_adds_what_it_misses(tmp_path: Path) -> None:
    store = Store(tmp_path)
    generate(store, OF, UNITS[:6], inline, quiet)
    flip(store.path(OF, UNITS[0]))
    made = repair(store, OF, verify(store, OF, inline, quiet), inline, quiet, scale="mini")
    assert (made[0], set(made[1:])) == (UNITS[0], set(UNITS[6:]))
    found = verify(store, OF, inline, quiet)
    assert (found.shards, found.broken) == (len(UNITS), {})


def test_a_repair_that_is_stopped_loses_nothing(tmp_path: Path) -> None:
    store = Store(tmp_path)
    generate(store, OF, UNITS[:4], inline, quiet)
    before = arrays(tmp_path)
    for unit in UNITS[:4]:
        store.path(OF, unit).unlink()

    def stop(done: int, _: int) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        repair(store, OF, verify(store, OF, inline, quiet), inline, stop)
    found = verify(store, OF, inline, quiet)
    assert len(found.broken) == 3, "what is not mended yet is still known"
    repair(store, OF, found, inline, quiet)
    assert arrays(tmp_path) == before


def test_what_has_appeared_meanwhile_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, unit = Store(tmp_path), UNITS[0]
    write(store, OF, unit)
    before = files(tmp_path)
    monkeypatch.setattr("dlobench.data.generate.simulate", None)  # nothing is simulated
    make_unit(unit, store, OF)
    assert files(tmp_path) == before
    flip(store.path(OF, unit).with_suffix(".json"))
    with pytest.raises(Broken):
        make_unit(unit, store, OF)


def test_whoever_comes_first_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As when another process has written the shard while this one was still simulating."""
    from dlobench.data import generate as module

    store, unit, real = Store(tmp_path), UNITS[0], module.simulate_unit

    def late(of: object, unit: object) -> object:
        write(store, OF, UNITS[0])
        return real(OF, UNITS[0])

    monkeypatch.setattr(module, "simulate_unit", late)
    make_unit(unit, store, OF)
    first = store.load(OF, unit)
    store.discard(OF, unit)
    assert (first.dlo == write(store, OF, unit).dlo).all()


def test_two_generators_share_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whenever one simulates a shard, the other makes one at the same time; neither knows of the other."""
    from dlobench.data import generate as module

    store, made, busy = Store(tmp_path), list[Unit](), list[bool]()
    walk = fake(OF.domain(0), 1, pushes=OF.pushes)
    other: Iterator[object] = iter(())

    def simulate(of: object, unit: Unit) -> object:
        made.append(unit)
        if not busy:
            busy.append(True)
            next(other, None)
            busy.clear()
        return walk, Account(0, 0, 0)

    def step(function: Callable[[Any], Any], work: Iterable[Any]) -> Iterator[Any]:
        nonlocal other
        other = map(function, work)
        return iter(())

    monkeypatch.setattr(module, "simulate_unit", simulate)
    of = tiny(64)
    generate(store, of, units(of), step, quiet)
    generate(store, of, units(of), inline, quiet)
    assert set(made) == set(units(of))
    assert len(made) < 1.25 * len(units(of)), "twice as many, did both go the same way"
