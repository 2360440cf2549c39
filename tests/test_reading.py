"""Tests `dlobench.load`: what is read is what was written, mapped and not copied, and a stale join is never used."""

from __future__ import annotations

import doctest
import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import fields
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_store import fake, same

import dlobench
from dlobench.data import joined, reading
from dlobench.data.domain_set import DomainSet, Span
from dlobench.data.joined import join_path, map_rows
from dlobench.data.sets import SETS
from dlobench.data.store import Broken, Store, pack
from dlobench.errors import RunError, UsageError

META, LARGE, FUTURES = SETS["meta-learning"], SETS["single-domain-large"], SETS["distribution"]
SPAN = next(span for span in LARGE.spans("mini") if (span.domain, span.part) == (4, "train"))  # five shards


def fill(store: Store, of: DomainSet, part: str, scale: Any = "mini") -> None:
    """Writes the fake shards of a part, each with a content of its own."""
    for unit in of.units(span for span in of.spans(scale) if span.part == part):
        rewrite(store, of, unit, seed=1000 * unit.domain + unit.first)


def rewrite(store: Store, of: DomainSet, unit: Any, seed: int) -> None:
    """Writes a fake shard."""
    store.write(of, unit, fake(of.domain(unit.domain), unit.count, seed=seed, pushes=of.pushes), {}, 0.0)


@pytest.fixture(autouse=True)
def unsynced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves syncing out, which takes most of the time and which other tests look at."""
    monkeypatch.setattr(os, "fsync", lambda _: None)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    out = Store(tmp_path)
    for unit in LARGE.units([SPAN]):
        rewrite(out, LARGE, unit, seed=unit.first)
    return out


@pytest.mark.parametrize(
    ("of", "part"),
    [(META, "train"), (META, "valid"), (META, "test"), (FUTURES, "test"), (LARGE, "valid")],
    ids=lambda value: str(getattr(value, "name", value)),
)
def test_what_is_loaded_is_what_was_written(of: DomainSet, part: str, tmp_path: Path) -> None:
    store = Store(tmp_path)
    fill(store, of, part)
    domains, trajectories = dlobench.load(of.name, "mini", part=part, data=tmp_path)
    spans = {span.domain: span for span in of.spans("mini") if span.part == part}
    assert list(domains.index) == list(trajectories) == sorted(spans)
    assert len(trajectories) == len(spans)
    assert domains.index.name == "domain"
    for index, span in spans.items():
        domain, row = of.domain(index), domains.loc[index]
        assert same(trajectories[index], store.load_span(of, span))
        assert (row["material"], row["attachment"], row["length_m"]) == (
            domain.material,
            domain.attachment,
            domain.length,
        )
        assert row["bending_stiffness_N_m2"] == domain.bending_stiffness
        assert row["density_kg_per_m3"] == domain.density and row["surface_friction"] == domain.surface_friction
        assert row["rigid_objects"] == len(domain.bodies)
        assert row["part"] == part and row["trajectories"] == span.count == len(trajectories[index])


def test_a_set_may_be_used_by_its_cells(tmp_path: Path) -> None:
    fill(Store(tmp_path), META, "test")
    domains, trajectories = dlobench.load("meta-learning", part="test", data=tmp_path)
    soft = domains.query("material == 'soft' and rigid_objects == 0")
    assert len(soft) and set(soft.index) == {d for d in trajectories if str(META.cell(d)).startswith("soft") and
                                             META.cell(d).rigid_objects == 0}  # fmt: skip


def test_the_example_in_the_documentation_is_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(Store(tmp_path), META, "train")
    monkeypatch.setenv("DLOBENCH_DATA", str(tmp_path))
    [test] = doctest.DocTestFinder(recurse=False).find(dlobench.load, "load", globs={"load": dlobench.load})
    assert len(test.examples) == 6
    told: list[str] = []
    assert doctest.DocTestRunner().run(test, out=told.append).failed == 0, "".join(told)


def test_arrays_are_mapped_and_not_to_be_written(store: Store) -> None:
    _, trajectories = loaded(store)
    one = trajectories[4]
    assert one.parameters is None, "what is unobserved is not shown"
    for field in (each for each in fields(one) if each.name != "parameters"):
        value = getattr(one, field.name)
        if field.name not in ("dlo_mask", "body_mask", "boxes"):
            assert isinstance(value, np.memmap) and value.dtype == np.float32, field.name
            assert not value.flags.writeable
            assert np.shares_memory(value, trajectories.rows(4)), "a copy"
    with pytest.raises(ValueError, match="read-only"):
        one.dlo[0] = 0
    assert np.array_equal(trajectories.rows(4), pack(store.load_span(LARGE, SPAN)))


def loaded(store: Store) -> tuple[None, reading.Reading]:
    """Returns one domain of a set of which nothing else is there."""
    return None, reading.Reading(store, LARGE, [SPAN])


def test_domains_are_opened_when_asked_for(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[int] = []

    def spy(store: Store, of: DomainSet, span: Span) -> Any:
        opened.append(span.domain)
        return map_rows(store, of, span)

    monkeypatch.setattr(reading, "map_rows", spy)
    missing = Span(5, "train", 0, 50)
    trajectories = reading.Reading(store, LARGE, [missing, SPAN])
    assert list(trajectories) == [5, 4] and 5 in trajectories and 6 not in trajectories and not opened
    assert len(trajectories[4]) == len(trajectories[4]) == 50 and opened == [4]
    with pytest.raises(KeyError, match=r"domain 6 of single-domain-large"):
        trajectories[6]


def test_what_is_missing_is_named_with_its_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    fill(store, META, "test")
    dlobench.load("meta-learning", part="test", data=tmp_path)
    store.discard(META, next(META.units(span for span in META.spans("mini") if span.part == "test")))
    with pytest.raises(
        RunError, match=r"^1 of 27 domains .*`dlobench generate meta-learning --scale mini --data .*` makes them$"
    ):
        dlobench.load("meta-learning", part="test", data=tmp_path)
    monkeypatch.setenv("DLOBENCH_DATA", str(tmp_path / "none"))
    with pytest.raises(RunError, match=r"none; `dlobench generate distribution --scale small` makes them$"):
        dlobench.load("distribution", "small", "test")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("meta",), "unknown set 'meta'; there are: single-domain-large, .*"),
        (("meta-learning", "tiny"), "unknown scale 'tiny'; there are: mini, small, paper"),
        (("meta-learning", "mini", "all"), "part = 'all' is not one of train, valid, test"),
        (("distribution", "mini", "train"), "distribution has no part 'train' at scale mini; there are: test"),
    ],
)
def test_what_does_not_exist_is_refused_with_the_choices(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(UsageError, match=f"^{message}$"):
        dlobench.load(*arguments)


def test_a_file_in_the_place_of_the_data_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(UsageError, match=r"mine is not a folder$"):
        dlobench.load("meta-learning", data=tmp_path / "mine")


def test_importing_dlobench_imports_nothing_heavy() -> None:
    code = "import sys, dlobench; print(sorted({'numpy', 'pandas', 'torch', 'torchrl', 'mujoco'} & {*sys.modules}))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
    with pytest.raises(AttributeError, match="loads"):
        dlobench.loads  # noqa: B018


def test_one_shard_is_mapped_itself_and_several_are_joined_once(store: Store, tmp_path: Path) -> None:
    one = Span(4, "train", 3, 5)
    assert np.array_equal(map_rows(store, LARGE, one), map_rows(store, LARGE, SPAN)[3:8])
    path = join_path(store, LARGE, SPAN)
    assert [path] == [p for p in (tmp_path / "joined").rglob("*") if p.is_file()]
    before = path.stat().st_mtime_ns
    map_rows(store, LARGE, SPAN)
    assert path.stat().st_mtime_ns == before
    path.unlink()
    assert np.array_equal(map_rows(store, LARGE, SPAN), pack(store.load_span(LARGE, SPAN)))


def test_a_span_that_begins_and_ends_within_shards_is_joined(store: Store) -> None:
    inside = Span(4, "train", 7, 29)
    assert np.array_equal(map_rows(store, LARGE, inside), pack(store.load_span(LARGE, inside)))


def test_a_stale_join_is_made_again(store: Store) -> None:
    map_rows(store, LARGE, SPAN)
    unit = list(LARGE.units([SPAN]))[3]
    rewrite(store, LARGE, unit, seed=99)
    found = map_rows(store, LARGE, SPAN)
    assert np.array_equal(found, pack(store.load_span(LARGE, SPAN)))
    assert np.array_equal(found[30:40], pack(store.load(LARGE, unit)))


@pytest.mark.parametrize("kept", [0, 10, 128, 5000, -1, -32, -33])
def test_a_truncated_join_is_made_again(kept: int, store: Store) -> None:
    map_rows(store, LARGE, SPAN)
    path = join_path(store, LARGE, SPAN)
    content = path.read_bytes()
    path.write_bytes(content[:kept])
    assert np.array_equal(map_rows(store, LARGE, SPAN), pack(store.load_span(LARGE, SPAN)))
    assert path.read_bytes() == content
    path.write_bytes(content[:kept] + content[-32:])  # what is sealed may be too short all the same
    assert np.array_equal(map_rows(store, LARGE, SPAN), pack(store.load_span(LARGE, SPAN)))


def test_a_broken_shard_is_neither_joined_nor_mapped(store: Store) -> None:
    unit = list(LARGE.units([SPAN]))[2]
    path = store.path(LARGE, unit)
    content = bytearray(path.read_bytes())
    content[5000] ^= 1
    path.write_bytes(content)
    for span in (SPAN, Span(4, "train", unit.first, 10)):
        with pytest.raises(Broken, match="SHA-256") as broken:
            map_rows(store, LARGE, span)
        assert str(path) in str(broken.value)
    assert not [p for p in (store.root / "joined").rglob("*") if p.is_file()]
    store.discard(LARGE, unit)
    with pytest.raises(Broken, match="no sidecar"):
        map_rows(store, LARGE, SPAN)


def test_shards_that_change_while_they_are_joined_are_not_sealed(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    units = list(LARGE.units([SPAN]))
    real: Callable[..., Any] = Store.rows

    def changing(self: Store, of: DomainSet, unit: Any) -> Any:
        if unit == units[-1]:
            rewrite(store, LARGE, units[0], seed=77)
        return real(self, of, unit)

    monkeypatch.setattr(Store, "rows", changing)
    with pytest.raises(RunError, match="changed while they were joined"):
        map_rows(store, LARGE, SPAN)
    monkeypatch.undo()
    assert not join_path(store, LARGE, SPAN).exists()
    assert np.array_equal(map_rows(store, LARGE, SPAN), pack(store.load_span(LARGE, SPAN)))


def stop_midway(root: Path) -> None:
    """Joins, and waits for ever after the third shard."""
    real: Callable[..., Any] = Store.rows

    def slow(self: Store, of: DomainSet, unit: Any) -> Any:
        if unit.first == 30:
            (root / "midway").touch()
            signal.pause()
        return real(self, of, unit)

    Store.rows = slow  # type: ignore[method-assign]
    joined.map_rows(Store(root), LARGE, SPAN)


def test_a_join_that_was_killed_leaves_nothing_behind(store: Store) -> None:
    process = get_context("spawn").Process(target=stop_midway, args=(store.root,))
    process.start()
    end = time.monotonic() + 60
    while not (store.root / "midway").exists() and process.is_alive() and time.monotonic() < end:
        process.join(0.01)
    process.kill()
    process.join()
    folder = join_path(store, LARGE, SPAN).parent
    [leftover] = folder.iterdir()
    assert leftover.name.endswith(".tmp")
    assert np.array_equal(map_rows(store, LARGE, SPAN), pack(store.load_span(LARGE, SPAN)))
    assert list(folder.iterdir()) == [join_path(store, LARGE, SPAN)]


def join_and_tell(root: Path, results: Any) -> None:
    """Joins, and tells the digest of the rows and the file."""
    rows = joined.map_rows(Store(root), LARGE, SPAN)
    results.put((hashlib.sha256(rows.tobytes()).hexdigest(), join_path(Store(root), LARGE, SPAN).stat().st_ino))


def test_several_processes_join_once(store: Store) -> None:
    context = get_context("spawn")
    results = context.Queue()
    processes = [context.Process(target=join_and_tell, args=(store.root, results)) for _ in range(2)]
    for process in processes:
        process.start()
    told = {results.get(timeout=60) for _ in processes}
    for process in processes:
        process.join()
    assert len(told) == 1
    assert next(iter(told))[0] == hashlib.sha256(pack(store.load_span(LARGE, SPAN)).tobytes()).hexdigest()


def test_a_place_that_cannot_be_written_is_named(store: Store) -> None:
    (store.root / "joined").write_text("mine")
    with pytest.raises(RunError, match=r"cannot write .*joined.*: (Not a directory|File exists)"):
        map_rows(store, LARGE, SPAN)


def test_joins_are_nothing_to_the_store(store: Store) -> None:
    from dlobench.data.status import status

    units = list(LARGE.units([SPAN]))
    map_rows(store, LARGE, SPAN)
    assert status(store, LARGE, units, every_byte=True).done == units
