"""Tests the original layout: what others' loaders rely on, a way back without loss, and nothing taken on trust."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_cli import Call, call, check_failed  # noqa: F401  # a fixture
from test_store import fake, files, full, same
from test_store import write as write_shard

from dlobench.bench import results
from dlobench.bench.plugins import load_task
from dlobench.data import imported, original
from dlobench.data.domain_set import PUSHES, Cell, DomainSet, Part, Span
from dlobench.data.imported import find_imported, imported_sets
from dlobench.data.imported_set import ImportedDomain, ImportedSet
from dlobench.data.original import params
from dlobench.data.recorded import folders, read
from dlobench.data.sets import SETS
from dlobench.data.status import status
from dlobench.data.store import Store
from dlobench.domain import LENGTHS
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Trajectories

META = SETS["meta-learning"]
RICH = META.per_cell * META.cells.index(Cell("elastoplastic", "movable", 0.14, 3))  # a domain with three bodies
ARRAYS = ("data_pos_all.npy", "data_or_all.npy", "data_true_action_all.npy")
OURS = ("data_executed_action_all.npy", "data_segment_yaw_all.npy", "data_cylinder_all.npy")

Array = NDArray[Any]


def put(root: Path, index: int, trajectories: int = 4, seed: int = 0) -> Trajectories:
    """Writes a domain of the meta-learning set, made of random walks, in the original layout."""
    made = fake(META.domain(index), trajectories, seed=seed)
    original.write(root / f"{index:05d}", params(META, [Span(index, "train", 0, trajectories)]), made)
    return made


def silent(done: int, total: int) -> None:
    """Listens to progress."""
    assert 0 <= done <= total


def import_set(store: Store, root: Path, name: str) -> ImportedSet:
    """Imports a folder as the command does."""
    return imported.import_set(store, folders(root), name, silent)


def export(store: Store, of: DomainSet, root: Path, *, domains: int | None = None, part: Part | None = None) -> None:
    """Exports mini of a set as the command does."""
    planned = original.plan(store, of, "mini", root, domains=domains, part=part)
    original.export(store, of, planned, root, silent)


# What the layout is


@given(index=st.integers(0, len(META) - 1), K=st.integers(1, 4), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_what_is_written_is_read_back_to_the_last_bit(
    index: int, K: int, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    root = tmp_path_factory.mktemp("layout")
    made = put(root, index, K, seed)
    one = read(root / f"{index:05d}")
    assert same(one.trajectories, made)
    assert (one.id, one.cell) == (index, META.cell(index))
    shutil.rmtree(root)


def test_a_folder_is_what_the_loader_of_the_authors_reads(tmp_path: Path) -> None:
    made = put(tmp_path, RICH, 5)
    folder = tmp_path / f"{RICH:05d}"
    assert len(folder.name) == 5
    assert [path.name for path in tmp_path.iterdir()] == [folder.name], "the loader opens whatever lies beside it"
    positions, quaternions, commanded = (np.load(folder / name, allow_pickle=False) for name in ARRAYS)
    about = json.loads((folder / "params.json").read_text())
    assert about["domain_id"] == RICH
    assert about["dlo"] == {"length": 0.14, "material_type": "elastoplastic", "attachment": "movable"}
    boxes = sum(len(body.boxes()) for body in META.domain(RICH).bodies)
    n, bodies = 28, len(about["rigid_objects"])
    assert bodies == 3
    assert positions.shape == (5, 21, 1 + n + boxes + bodies, 2)
    assert np.array_equal(positions[:, :, 0], made.pusher)
    assert np.array_equal(positions[:, :, 1 : 1 + n], made.dlo[:, :, :n, :2])
    assert np.array_equal(positions[:, :, -bodies:], made.bodies[..., :2])
    # The loader of the authors takes the last rows, and fails where there are others.
    assert quaternions.shape == (5, 21, bodies, 4)
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    assert not x.any()
    assert not y.any()
    assert np.allclose(2 * np.arctan2(z, w), made.bodies[..., 2], rtol=0, atol=1e-7)
    assert np.allclose(z**2 + w**2, 1)
    assert np.array_equal(commanded, made.commanded), "not what was executed"
    first = positions[2, 7, 1 + n]  # the first box of the first body, in the world
    px, py, yaw = made.bodies[2, 7, 0]
    bx, by, *_ = made.boxes[0, 0]
    there = [px + np.cos(yaw) * bx - np.sin(yaw) * by, py + np.sin(yaw) * bx + np.cos(yaw) * by]
    assert np.allclose(first, there, rtol=0, atol=1e-7)


@pytest.mark.parametrize("length", LENGTHS)
def test_lengths_survive_the_loader_of_the_authors(length: float) -> None:
    index = META.per_cell * META.cells.index(Cell("soft", "none", length, 0))
    written = json.loads(json.dumps(params(META, [Span(index, "train", 0, 1)])))["dlo"]["length"]
    assert int(written * 200) == META.domain(index).segments == round(length / 0.005)
    assert written in (0.1, 0.11, 0.12, 0.13, 0.14, 0.15, 0.16), "the loader looks cells up by these very floats"


# A folder that others wrote: by the description of the layout, not by our exporter

PLACES = {0: [(-0.0075, 0.0), (0.0075, 0.0)], 1: [(-0.015, 0.001), (0.0, 0.001), (0.015, 0.001)]}  # in a body's frame
ORDER = [(1, 2), (0, 0), (1, 0), (0, 1), (1, 1)]  # (body, box): mixed up


def turn(yaw: Array, place: tuple[float, float]) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * place[0] - s * place[1], s * place[0] + c * place[1]], axis=-1)


def others(root: Path, number: int = 17, K: int = 3, *, all_turned: bool = False, seed: int = 1) -> dict[str, Array]:
    """Writes a domain of two bodies as others would, in float64; returns what is true of it."""
    rng = np.random.default_rng(seed)
    n, folder = 24, root / f"{number:05d}"
    pusher, bodies = rng.normal(size=(K, 21, 1, 2)), rng.normal(size=(K, 21, 2, 2))
    yaw = rng.uniform(-np.pi, np.pi, (K, 21, 2))
    along = np.cumsum(rng.normal(scale=0.02, size=(K, 21, n)), axis=2) + rng.uniform(-3, 3, (K, 21, 1))
    centres = np.cumsum(0.005 * np.stack([np.cos(along), np.sin(along)], axis=-1), axis=2)
    boxes = np.stack([bodies[:, :, b] + turn(yaw[:, :, b], PLACES[b][i]) for b, i in ORDER], axis=2)
    box_yaw = np.stack([yaw[:, :, b] + 0.5 * i for b, i in ORDER], axis=2)
    rows = np.concatenate([np.zeros((K, 21, 1)), along, box_yaw, yaw], axis=2) if all_turned else yaw
    sign = rng.choice([-1.0, 1.0], rows.shape)  # q and −q are the same rotation
    zero = np.zeros_like(rows)
    folder.mkdir(parents=True)
    np.save(folder / "data_pos_all.npy", np.concatenate([pusher, centres, boxes, bodies], axis=2))
    np.save(
        folder / "data_or_all.npy",
        np.stack([zero, zero, sign * np.sin(rows / 2), sign * np.cos(rows / 2)], axis=-1),
    )
    actions = rng.normal(scale=0.01, size=(K, 20, 2))
    np.save(folder / "data_true_action_all.npy", actions)
    about = {
        "domain_id": number,
        "dlo": {"length": 0.12, "material_type": "flexible", "attachment": "fixed", "youngs_modulus": 1e6},
        "rigid_objects": [{"anything": [1, None]}, "L"],
    }
    (folder / "params.json").write_text(json.dumps(about))
    return {"pusher": pusher, "centres": centres, "along": along, "bodies": bodies, "yaw": yaw, "actions": actions}


def apart(one: Array, other: Array) -> float:
    """Returns how far angles are apart at most, rad."""
    return float(np.abs(np.angle(np.exp(1j * (one - other)))).max())


@pytest.mark.parametrize("all_turned", [False, True])
def test_a_folder_of_others_is_understood(all_turned: bool, tmp_path: Path) -> None:
    true = others(tmp_path, all_turned=all_turned)
    one = read(tmp_path / "00017")
    t = one.trajectories
    assert one.cell == Cell("flexible", "fixed", 0.12, 2)
    assert (t.dlo_mask.sum(), t.body_mask.sum()) == (24, 2)
    assert np.allclose(t.pusher, true["pusher"][:, :, 0], atol=1e-6)
    assert np.allclose(t.dlo[:, :, :24, :2], true["centres"], atol=1e-6)
    assert not t.dlo[:, :, 24:].any()
    assert np.allclose(t.bodies[:, :, :2, :2], true["bodies"], atol=1e-6)
    assert apart(t.bodies[:, :, :2, 2], true["yaw"]) < 1e-6
    assert not t.bodies[:, :, 2].any()
    assert apart(t.dlo[:, :, :24, 2], true["along"]) < (1e-6 if all_turned else 0.1)
    assert np.allclose(t.commanded, true["actions"], atol=1e-8)
    assert np.array_equal(t.executed, t.commanded)
    # Which box belongs to which body was told by how they move, in the order of the file.
    assert [[box[:2] for box in body] for body in one.boxes] == [
        [PLACES[b][i] for b, i in ORDER if b == body] for body in (0, 1)
    ]
    yaws = [[0.5 * i if all_turned else 0.0 for b, i in ORDER if b == body] for body in (0, 1)]
    assert [[box[2] for box in body] for body in one.boxes] == yaws
    assert {box[3:] for body in one.boxes for box in body} == {(0.0075, 0.0075)}
    told = " / ".join(one.assumed)
    assert "executed" in told
    assert "15 mm" in told
    assert "cylinder" in told
    assert ("neighbours" in told) is ("as their bodies" in told) is not all_turned


def test_bodies_that_never_move_apart_cannot_be_told(tmp_path: Path) -> None:
    others(tmp_path)
    folder = tmp_path / "00017"
    for name in ARRAYS:
        rows = np.load(folder / name)
        np.save(folder / name, np.repeat(np.repeat(rows[:1, :1], 2, axis=0), rows.shape[1], axis=1))
    with pytest.raises(RunError, match="bodies 0, 1 alike"):
        read(folder)


# Bad input


def save(name: str, change: Callable[[Array], Any]) -> Callable[[Path], None]:
    """Returns what changes an array of a folder."""

    def spoil(folder: Path) -> None:
        np.save(folder / name, change(np.load(folder / name)), allow_pickle=True)

    return spoil


def text(name: str, content: bytes) -> Callable[[Path], None]:
    """Returns what writes some bytes into a file of a folder."""
    return lambda folder: void((folder / name).write_bytes(content))


def void(_: object) -> None:
    """Returns nothing."""


def about(**changes: Any) -> Callable[[Path], None]:
    """Returns what changes fields of `params.json`."""

    def spoil(folder: Path) -> None:
        path = folder / "params.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return spoil


def dlo(**changes: Any) -> Callable[[Path], None]:
    """Returns what changes fields of the DLO in `params.json`."""
    return about(dlo={"length": 0.12, "material_type": "flexible", "attachment": "fixed"} | changes)


def set_first(value: float) -> Callable[[Array], Array]:
    """Returns what changes one value of an array."""

    def change(rows: Array) -> Array:
        rows[(0,) * rows.ndim] = value
        return rows

    return change


def folder_for_file(folder: Path) -> None:
    (folder / POS).unlink()
    (folder / POS).mkdir()


def npz() -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, np.zeros(3))
    return buffer.getvalue()


HUGE = (
    np.lib.format.magic(1, 0)
    + b"\x76\x00"
    + b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999, 21, 32, 2), }"
)
POS, OR, ACT = ARRAYS
SPOILED: dict[str, tuple[Callable[[Path], None], str]] = {
    **{f"no {name}": (lambda f, name=name: (f / name).unlink(), name) for name in ("params.json", *ARRAYS)},  # type: ignore[misc]
    "folder for a file": (folder_for_file, POS),
    "empty": (text(POS, b""), POS),
    "text": (text(POS, b"1 2 3"), POS),
    "npz": (text(POS, npz()), POS),
    "pickle": (text(ACT, pickle.dumps([1])), ACT),
    "cut": (lambda f: void((f / POS).write_bytes((f / POS).read_bytes()[:-9])), POS),
    "huge": (text(POS, HUGE.ljust(128) + bytes(64)), POS),
    "objects": (save(POS, lambda rows: rows.astype(object)), POS),
    "words": (save(POS, lambda rows: rows.astype(str)), POS),
    "complex": (save(POS, lambda rows: rows.astype(complex)), POS),
    "whole numbers": (save(ACT, lambda rows: rows.astype(int)), ACT),
    "nan": (save(POS, set_first(np.nan)), POS),
    "nan action": (save(ACT, set_first(np.nan)), ACT),
    "nan quaternion": (save(OR, set_first(np.nan)), OR),
    "inf": (save(POS, set_first(-np.inf)), POS),
    "beyond float32": (save(POS, set_first(1e39)), POS),
    "a state less": (save(POS, lambda rows: rows[:, :-1]), POS),
    "no trajectories": (save(POS, lambda rows: rows[:0]), POS),
    "3D": (save(POS, lambda rows: np.concatenate([rows, rows[..., :1]], axis=-1)), POS),
    "flat": (save(POS, np.ravel), POS),
    "scalar": (save(POS, lambda rows: rows[0, 0, 0, 0]), POS),
    "a row less than the bodies": (save(OR, lambda rows: rows[:, :, 1:]), OR),
    "other trajectories": (save(OR, lambda rows: rows[1:]), OR),
    "yaws for quaternions": (save(OR, lambda rows: rows[..., 0]), OR),
    "no unit quaternions": (save(OR, lambda rows: 2 * rows), OR),
    "an action more": (save(ACT, lambda rows: np.concatenate([rows, rows[:, :1]], axis=1)), ACT),
    "too few rows": (save(POS, lambda rows: rows[:, :, :26]), POS),
    "too many rows": (save(POS, lambda rows: np.concatenate([rows, rows], axis=2)), POS),
    "a box of no body": (save(POS, lambda rows: np.insert(rows, 25, 0.0, axis=2)), POS),
    "our file of another shape": (lambda f: np.save(f / OURS[0], np.zeros((3, 19, 2))), OURS[0]),
    "our file with objects": (lambda f: np.save(f / OURS[2], np.array([None]), allow_pickle=True), OURS[2]),
    "no json": (text("params.json", b"{"), "params.json"),
    "no text": (text("params.json", b"\xff\xfe"), "params.json"),
    "deep json": (text("params.json", b"[" * 100_000), "params.json"),
    "list": (text("params.json", b"[]"), "params.json"),
    "nan in json": (about(dlo={"length": float("nan"), "material_type": "soft", "attachment": "none"}), "params.json"),
    "no dlo": (about(dlo=None), "dlo"),
    "another id": (about(domain_id=18), "domain_id"),
    "an id in words": (about(domain_id="17"), "domain_id"),
    "four bodies": (about(rigid_objects=[{}] * 4), "rigid_objects"),
    "another number of bodies": (about(rigid_objects=[{}]), POS),
    "bodies in words": (about(rigid_objects="two"), "rigid_objects"),
    "length in cm": (dlo(length=12), "length"),
    "length between": (dlo(length=0.125), "length"),
    "length in words": (dlo(length="0.12"), "length"),
    "another length": (dlo(length=0.16), POS),
    "another material": (dlo(material_type="steel"), "material_type"),
    "another attachment": (dlo(attachment=None), "attachment"),
}


@pytest.mark.parametrize("what", SPOILED)
def test_what_is_not_the_layout_is_named_and_nothing_is_written(what: str, tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    others(tmp_path / "layout", number=16, seed=2)
    others(tmp_path / "layout")
    spoil, named = SPOILED[what]
    spoil(tmp_path / "layout" / "00017")
    with pytest.raises(RunError) as refused:
        import_set(store, tmp_path / "layout", "mine")
    assert named in str(refused.value)
    assert str(tmp_path / "layout" / "00017") in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not store.root.exists()


def test_nothing_unpickles(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "sprung",))

    others(tmp_path / "layout")
    for content in (pickle.dumps(Trap()), npy(np.array([Trap()], dtype=object))):
        (tmp_path / "layout" / "00017" / POS).write_bytes(content)
        with pytest.raises(RunError):
            import_set(Store(tmp_path / "data"), tmp_path / "layout", "mine")
        assert not (tmp_path / "sprung").exists()


def npy(rows: Array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, rows, allow_pickle=True)
    return buffer.getvalue()


@pytest.mark.parametrize("entry", ["17", "0001a", "notes.txt", "000017"])
def test_what_is_no_domain_is_named(entry: str, tmp_path: Path) -> None:
    others(tmp_path / "layout")
    (tmp_path / "layout" / entry).mkdir()
    with pytest.raises(UsageError, match=entry):
        import_set(Store(tmp_path / "data"), tmp_path / "layout", "mine")


def test_an_absent_and_an_empty_folder_are_named(tmp_path: Path) -> None:
    for root in (tmp_path / "absent", tmp_path / "empty"):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(UsageError, match=root.name):
            import_set(Store(tmp_path / "data"), root, "mine")


@pytest.mark.parametrize("name", ["", "a/b", "..", ".hidden", "a b", "meta-learning", "x" * 65])
def test_a_name_that_cannot_be_is_refused(name: str, tmp_path: Path) -> None:
    others(tmp_path / "layout")
    with pytest.raises(UsageError, match="--name"):
        import_set(Store(tmp_path / "data"), tmp_path / "layout", name)


# Sets that were imported


def test_an_imported_set_is_kept_like_any_other(tmp_path: Path) -> None:
    store, layout = Store(tmp_path / "data"), tmp_path / "layout"
    made = {index: put(layout, index, K, seed=index) for index, K in ((RICH, 40), (3, 60), (612, 20))}
    of = import_set(store, layout, "mine")
    (found,) = imported_sets(store)
    assert (found.name, found.key, len(found)) == ("mine", of.key, 3)
    assert found.block == 20, "what divides all"
    spans = {span.domain: span for span in found.spans("mini")}
    for index, trajectories in made.items():
        assert same(store.load_span(found, spans[index]), trajectories)
        assert found.cell(index) == META.cell(index)
        assert "surface_friction" not in found.definition(index), "not known, so not told"
    assert found.digest(spans.values()) == of.digest(of.spans("paper"))
    assert not status(store, found, found.units(spans.values()), every_byte=True).broken
    with pytest.raises(UsageError, match="not known"):
        found.domain(RICH)
    with pytest.raises(UsageError, match="18"):
        found.cell(18)


def test_importing_again_mends_what_is_broken_and_changes_nothing_else(tmp_path: Path) -> None:
    store, layout = Store(tmp_path / "data"), tmp_path / "layout"
    put(layout, RICH, 40)
    put(layout, 3, 20)
    of = import_set(store, layout, "mine")
    before = files(store.root)
    changed = sorted(store.root.rglob("*.npy"))[:2]
    content = bytearray(changed[0].read_bytes())
    content[-1] ^= 1
    changed[0].write_bytes(content)
    changed[1].with_suffix(".json").unlink()
    assert import_set(store, layout, "mine").key == of.key
    after = files(store.root)
    arrays = {name for name in before if not name.endswith(".json")}
    assert after.keys() == before.keys()
    assert all(after[name] == before[name] for name in arrays)


def test_a_name_is_not_given_twice(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    put(tmp_path / "one", 3)
    put(tmp_path / "two", 4)
    import_set(store, tmp_path / "one", "mine")
    before = files(store.root)
    with pytest.raises(UsageError, match="mine"):
        import_set(store, tmp_path / "two", "mine")
    assert files(store.root) == before
    import_set(store, tmp_path / "two", "other")
    assert {of.name for of in imported_sets(store)} == {"mine", "other"}
    with pytest.raises(UsageError, match=r"'third'.*mine, other"):
        find_imported(store, "third")


def test_other_content_has_another_key(tmp_path: Path) -> None:
    keys = set()
    for change in range(3):
        layout = tmp_path / str(change)
        put(layout, 3, 4, seed=change > 0)
        if change == 2:
            about(rigid_objects=[], more=1)(layout / "00003")
        keys.add(import_set(Store(tmp_path / f"data{change}"), layout, "mine").key)
    assert len(keys) == 3


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{}", b'{"name": "mine", "domains": {"3": {}}}', b"\xff", b"[" * 99999]
)
def test_an_altered_definition_is_named(content: bytes, tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    put(tmp_path / "layout", 3)
    of = import_set(store, tmp_path / "layout", "mine")
    path = store.root / "imported" / f"{of.key}.json"
    path.write_bytes(content)
    with pytest.raises(RunError, match="imported"):
        imported_sets(store)


def test_a_definition_that_was_edited_no_longer_fits_its_shards(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    put(tmp_path / "layout", RICH)
    of = import_set(store, tmp_path / "layout", "mine")
    path = store.root / "imported" / f"{of.key}.json"
    path.write_text(path.read_text().replace("movable", "fixed"))
    (found,) = imported_sets(store)
    assert status(store, found, found.units(found.spans("mini"))).broken


def test_a_disk_that_refuses_leaves_no_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path / "data")
    put(tmp_path / "layout", 3)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunError, match="No space left"):
        import_set(store, tmp_path / "layout", "mine")
    monkeypatch.undo()
    assert not files(store.root)
    assert not imported_sets(store)
    import_set(store, tmp_path / "layout", "mine")


@given(sizes=st.lists(st.integers(1, 20), min_size=1, max_size=4), trajectories=st.integers(1, 700))
def test_every_cell_has_its_parts_and_no_trajectory_two(sizes: list[int], trajectories: int) -> None:
    cells = [cell for cell, size in zip(META.cells, sizes, strict=False) for _ in range(size)]
    known = ImportedDomain(META.cells[0], trajectories, (), {}, (), "0" * 64)
    of = ImportedSet.make("mine", {3 * i: replace(known, cell=cell) for i, cell in enumerate(cells)})
    assert trajectories % of.block == 0
    for cell, size in zip(META.cells, sizes, strict=False):
        count = Counter(of.part(index) for index in of.domains if of.cell(index) == cell)
        assert len(count) == min(size, 3), "three domains are one of each"
        if size >= 8:
            assert count["train"] > count["test"] >= count["valid"]
    if len(sizes) >= 3:
        assert {of.part(index) for index in of.domains} == {"train", "valid", "test"}
    for each in (of, of.parted_like(SETS["single-domain-large"])):
        spans = each.spans("mini")
        for index in of.domains:
            rows = [row for span in spans if span.domain == index for row in range(span.first, span.first + span.count)]
            assert sorted(rows) == list(range(trajectories))
    parts = Counter(span.part for span in of.parted_like(SETS["single-domain-large"]).spans("mini"))
    assert len(parts) == min(trajectories, 3)


# Export


@pytest.fixture
def generated(tmp_path: Path) -> Store:
    """Returns a data folder with mini of two sets, made of random walks, cut to a few domains."""
    store = Store(tmp_path / "data")
    for name in ("meta-learning", "single-domain-large"):
        of = SETS[name]
        for unit in of.units(span for span in of.spans("mini") if span.domain in first_domains(name, 3)):
            write_shard(store, of, unit)
    return store


def first_domains(name: str, count: int) -> list[int]:
    return list(dict.fromkeys(span.domain for span in SETS[name].spans("mini")))[:count]


def test_an_exported_set_comes_back(generated: Store, tmp_path: Path) -> None:
    of, layout = SETS["single-domain-large"], tmp_path / "layout"
    export(generated, of, layout, domains=3)
    back = import_set(generated, layout, "mine")
    assert list(back.domains) == first_domains(of.name, 3)
    for index in back.domains:
        spans = [span for span in of.spans("mini") if span.domain == index]
        assert [span.part for span in spans] == ["train", "valid", "test"]
        whole = generated.load_span(back, Span(index, "train", 0, sum(span.count for span in spans)))
        first = 0
        for span in spans:
            rows = whole.take(slice(first, first + span.count))
            assert np.array_equal(rows.dlo, generated.load_span(of, span).dlo)
            assert np.array_equal(rows.executed, generated.load_span(of, span).executed)
            first += span.count


def test_an_imported_set_can_be_exported(generated: Store, tmp_path: Path) -> None:
    others(tmp_path / "layout")
    of = import_set(generated, tmp_path / "layout", "mine")
    export(generated, of, tmp_path / "again")
    for name in ARRAYS[::2]:
        one, again = (np.load(tmp_path / where / "00017" / name) for where in ("layout", "again"))
        if name == POS:  # boxes are now in the order of their bodies
            one = np.delete(one, np.s_[25:30], axis=2)
            again = np.delete(again, np.s_[25:30], axis=2)
        assert np.allclose(one, again, rtol=0, atol=1e-6)
    about = json.loads((tmp_path / "again" / "00017" / "params.json").read_text())
    assert about["rigid_objects"] == [{"anything": [1, None]}, "L"]
    assert about["dlobench"]["domain"]["params"]["dlo"]["youngs_modulus"] == 1e6
    assert read(tmp_path / "again" / "00017").boxes == read(tmp_path / "layout" / "00017").boxes


def test_one_part_can_be_exported(generated: Store, tmp_path: Path) -> None:
    of = SETS["single-domain-large"]
    export(generated, of, tmp_path / "layout", domains=2, part="test")
    for folder in (tmp_path / "layout").iterdir():
        (span,) = [s for s in of.spans("mini") if s.domain == int(folder.name) and s.part == "test"]
        assert np.array_equal(np.load(folder / ACT), generated.load_span(of, span).commanded)


def test_what_is_there_is_left_and_never_overwritten(generated: Store, tmp_path: Path) -> None:
    of, layout = META, tmp_path / "layout"
    export(generated, of, layout, domains=2)
    before = {path: path.stat().st_mtime_ns for path in layout.rglob("*")}
    export(generated, of, layout, domains=2)
    assert {path: path.stat().st_mtime_ns for path in layout.rglob("*")} == before
    export(generated, of, layout, domains=3)
    second = layout / f"{first_domains(of.name, 2)[1]:05d}"
    content = (second / POS).read_bytes()
    (second / POS).write_bytes(content[:-1] + b"\0\0")
    with pytest.raises(UsageError, match=second.name):
        export(generated, of, layout, domains=2)
    assert (second / POS).read_bytes() == content[:-1] + b"\0\0"
    other = tmp_path / "other"
    (other / second.name).mkdir(parents=True)
    (other / second.name / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match=second.name):
        export(generated, of, other, domains=2)
    assert files(other) == {f"{second.name}/notes.txt": b"mine"}, "nothing was begun"


def test_an_export_that_fails_leaves_no_half_domain(
    generated: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = iter(range(2 * 7 + 5))  # two a file, seven files a domain: somewhere in the second
    real = os.fsync

    def fsync(number: int) -> None:
        real(number) if next(left, None) is not None else full()

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(RunError, match="No space left"):
        export(generated, META, tmp_path / "layout", domains=3)
    monkeypatch.undo()
    (whole,) = (tmp_path / "layout").iterdir()
    read(whole)
    assert not list(tmp_path.glob(".*"))
    export(generated, META, tmp_path / "layout", domains=3)
    assert len(list((tmp_path / "layout").iterdir())) == 3


# The command line

RUN = ("run", "--model", "persistence", "--scale", "mini")


def test_a_task_runs_on_an_imported_set(call: Call, tmp_path: Path) -> None:  # noqa: F811
    alone = [i for i in range(len(META)) if META.cell(i) == Cell("soft", "none", 0.16, 0)]
    for index in alone[:3]:
        put(tmp_path / "layout", index, 20, seed=index)
    done = call("data", "import", "--original", tmp_path / "layout", "--name", "mine")
    assert done.code == 0, done.err
    assert "3 domains" in done.err
    store = Store(tmp_path / "data")
    of = find_imported(store, "mine")
    done = call(*RUN, "--task", "meta", "--on", "mine", "--out", "runs")
    assert done.code == 0, done.err
    (record,) = results.read_all(Path("runs"))
    assert record.task == f"meta-on-{of.key}", "no board mixes it with the task itself, or with other data"
    assert record.provenance.set == of.key
    task = load_task("meta").on(of)
    assert record.provenance.data_sha256 == of.digest(s for spans in task.spans("mini").values() for s in spans)
    assert {cell.K for cell in record.cells} == {0, 1, 10}
    (scored,) = record.cells[0].domains
    (test,) = [span.domain for span in of.spans("mini") if span.part == "test"]
    assert scored.domain == f"mine/{test:05d}"
    t = store.load_span(of, Span(test, "test", 0, 20)).take(slice(10, 20))
    query, truth = t.windows(4)
    assert scored.mse == pytest.approx(np.mean((query.dlo[..., :2] - truth.dlo[0])[:, query.dlo_mask] ** 2), rel=1e-4)
    assert "reused the record" in call(*RUN, "--task", "meta", "--on", "mine", "--out", "runs").err
    check_failed(call(*RUN, "--task", "meta", "--on", "mine", "--K", "11"), 2, "11", "10")
    check_failed(call(*RUN, "--task", "meta", "--on", "other"), 2, "other", "mine")
    check_failed(call(*RUN, "--task", "meta", "--on", "mine", "--scale", "small"), 2, "20")
    shard = next(store.root.rglob("0000000.npy"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"\7")
    check_failed(call(*RUN, "--task", "meta", "--on", "mine", "--out", "runs"), 1, str(shard), "import")


def test_what_was_exported_by_the_command_is_imported_by_the_other(
    call: Call,  # noqa: F811
    generated: Store,
    tmp_path: Path,
) -> None:
    name, layout = "single-domain-large", tmp_path / "layout"
    done = call("data", "export", name, "--original", layout, "--domains", 3)
    assert done.code == 0, done.err
    assert call("data", "import", "--original", layout).code == 0
    assert len(find_imported(generated, "original")) == 3
    assert call("data", "export", "original", "--original", tmp_path / "again").code == 0
    for folder in layout.iterdir():
        assert same(read(folder).trajectories, read(tmp_path / "again" / folder.name).trajectories)


BAD: list[tuple[tuple[object, ...], int, tuple[str, ...]]] = [
    (("export", "distribution", "--original", "x"), 2, ("distribution", "8", "20")),
    (("export", "moon", "--original", "x"), 2, ("moon", "meta-learning")),
    (("export", "meta-learning", "--original", "x", "--scale", "big"), 2, ("big", "mini")),
    (("export", "meta-learning", "--original", "x", "--part", "most"), 2, ("most", "train, valid, test")),
    (("export", "meta-learning", "--original", "x", "--domains", "0"), 2, ("0", "1–")),
    (("export", "meta-learning", "--original", "x"), 1, ("dlobench generate meta-learning --scale mini",)),
    (("import", "--original", "absent"), 2, ("absent",)),
    (("import", "--original", "absent", "--name", "a/b"), 2, ("a/b",)),
]


@pytest.mark.parametrize(("arguments", "code", "parts"), BAD, ids=str)
def test_bad_input_ends_in_one_sentence(
    arguments: tuple[object, ...],
    code: int,
    parts: tuple[str, ...],
    call: Call,  # noqa: F811
) -> None:
    check_failed(call("data", *arguments), code, *parts)
    assert not Path("x").exists()


def test_what_executes_commands_again_and_again_is_refused_on_an_imported_set(tmp_path: Path) -> None:
    put(tmp_path / "layout", 3)
    of = import_set(Store(tmp_path / "data"), tmp_path / "layout", "mine")
    with pytest.raises(UsageError, match="64 times"):
        replace(load_task("meta"), set="distribution").on(of)
    assert of.pushes == PUSHES


def test_a_task_on_single_domains_parts_the_trajectories_of_an_imported_set(tmp_path: Path) -> None:
    for index in (3, 4):
        put(tmp_path / "layout", index, 160)
    of = import_set(Store(tmp_path / "data"), tmp_path / "layout", "mine")
    task = replace(load_task("meta"), set="single-domain-large", where={}).on(of)
    assert {part: [(s.domain, s.count) for s in spans] for part, spans in task.spans("mini").items()} == {
        "train": [(3, 20), (4, 20)],
        "valid": [(3, 20), (4, 20)],
        "test": [(3, 20), (4, 20)],
    }
    firsts = {span.part: span.first for span in task.of.spans("mini") if span.domain == 3}
    assert firsts == {"train": 0, "valid": 100, "test": 120}


def test_imported_sets_are_looked_after_but_never_generated(call: Call, tmp_path: Path) -> None:  # noqa: F811
    put(tmp_path / "layout", 3, 20)
    assert call("data", "import", "--original", tmp_path / "layout", "--name", "mine").code == 0
    assert "mine" in call("data", "status").out
    rows = json.loads(call("data", "verify", "--json").out)["sets"]
    assert [(row["shards"], row["broken"], row["strays"]) for row in rows if row["set"] == "mine"] == [(1, 0, [])]
    before = files(tmp_path / "data")
    for verb in (("generate",), ("data", "repair"), ("data", "verify", "--regenerate", "1")):
        check_failed(call(*verb, "mine"), 2, "mine", "imported", "dlobench data import")
    assert files(tmp_path / "data") == before
    shard = next((tmp_path / "data").rglob("0000000.npy"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"\7")
    done = call("data", "verify", "mine")
    check_failed(done, 1, "broken")
    assert str(shard) in done.err
    assert call("data", "import", "--original", tmp_path / "layout", "--name", "mine").code == 0
    assert call("data", "verify", "mine").code == 0
    assert files(tmp_path / "data").keys() == before.keys()
