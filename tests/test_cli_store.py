"""Tests the verbs that look after data, as a user calls them."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from test_faults import arrays, inline, quiet, tiny, units
from test_store import files, write

from dlobench.cli import main
from dlobench.data.domain_set import DomainSet
from dlobench.data.generate import generate
from dlobench.data.sets import SETS
from dlobench.data.store import Store


class Done(NamedTuple):
    """Holds how a command ended."""

    code: int
    out: str
    err: str


Call = Callable[..., Done]


@pytest.fixture
def of(monkeypatch: pytest.MonkeyPatch) -> DomainSet:
    """Puts a tiny set in the place of meta-learning."""
    of = tiny(8)
    monkeypatch.setitem(SETS, of.name, of)
    return of


@pytest.fixture
def store(of: DomainSet, tmp_path: Path) -> Store:
    """Returns a folder that holds six of sixteen shards."""
    store = Store(tmp_path / "data")
    generate(store, of, units(of)[:6], inline, quiet)
    return store


@pytest.fixture
def call(store: Store, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Call:
    """Returns what calls `dlobench data` in this process on that folder."""
    monkeypatch.setenv("DLOBENCH_DATA", str(store.root))

    def run(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["dlobench", "data", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            main()
        out, err = capsys.readouterr()
        assert isinstance(exit_.value.code, int)
        return Done(exit_.value.code, out, err)

    return run


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)


def rows(done: Done, of: DomainSet) -> list[dict[str, Any]]:
    found = json.loads(done.out)
    return [row for row in found if row["set"] == of.name]


def test_status_tells_all_sets_or_one(call: Call, of: DomainSet) -> None:
    assert {row["set"] for row in json.loads(call("status", "--json").out)} == set(SETS)
    done = call("status", of.name, "--json")
    row = rows(done, of)[0]
    assert {row["set"] for row in json.loads(done.out)} == {of.name}
    assert (row["done"], row["pending"], row["broken"], row["pushes"]) == (6, 10, 0, 12)
    assert row["pushes_per_second"] == pytest.approx(12 / row["seconds"])
    assert row["bytes"] == 6 * (128 + 3 * 114 * 4)
    assert done.err == ""
    assert row["digest"][:12] in call("status").out


def test_status_names_what_is_odd_and_goes_on(call: Call, of: DomainSet, store: Store) -> None:
    spoilt, half = units(of)[:2]
    store.path(of, spoilt).write_bytes(b"")
    store.discard(of, half)
    folder = store.path(of, spoilt).parent
    (folder / "notes.txt").touch()
    (folder / ".x.tmp").touch()
    newer = replace(of, version=of.version + 1)
    write(store, newer, half)
    done = call("status", "--json")
    row = rows(done, of)[0]
    assert done.code == 0
    assert (row["done"], row["pending"], row["broken"]) == (4, 11, 1)
    assert row["other_versions"] == [newer.key]
    for part in (
        f"broken: {store.path(of, spoilt)}: 0 bytes",
        "1 arrays without a sidecar",
        "1 temporary files",
        f"stray: {folder / 'notes.txt'}",
        f"other versions of meta-learning, which are left alone: {newer.key}",
    ):
        assert part in done.err


def test_verify_fails_by_what_is_broken_and_names_what_mends_it(call: Call, of: DomainSet, store: Store) -> None:
    assert call("verify", "--workers", 1).code == 0
    before = arrays(store.root)
    flip(store.path(of, units(of)[2]))
    for arguments, mend in (((), ""), (("--data", store.root), f" --data {store.root}")):
        done = call("verify", of.name, "--workers", 1, *arguments)
        assert done.code == 1
        said = done.err.splitlines()[-1]
        assert said == f"dlobench: 1 shard is broken; `dlobench data repair meta-learning{mend}` brings it back"
    assert json.loads(call("verify", "--json", "--workers", 1).out)["sets"][2]["broken"] == 1
    assert call("verify", "distribution").code == 0
    assert call("repair", of.name, "--workers", 1).code == 0
    assert call("verify", "--workers", 1).code == 0
    assert arrays(store.root) == before


def test_verify_regenerates_and_compares(call: Call, of: DomainSet, store: Store) -> None:
    done = call("verify", "--regenerate", 2, "--json", "--workers", 1)
    assert done.code == 0
    again = json.loads(done.out)["regenerated"]
    assert [(row["agrees"], row["max_m"]) for row in again] == [(True, 0)] * 2
    unit = units(of)[1]
    write(store, of, unit)  # a random walk, sealed as well as can be
    assert call("verify", "--workers", 1).code == 0
    done = call("verify", of.name, "--regenerate", 6, "--workers", 1)
    assert done.code == 1
    assert (
        f"1 of 6 shards that were simulated again differ from what is on disk, the first {store.path(of, unit)}"
        in (done.err.splitlines()[-1])
    )


def test_repair_of_a_scale_completes_it(call: Call, of: DomainSet, store: Store) -> None:
    flip(store.path(of, units(of)[0]))
    store.discard(of, units(of)[1])
    done = call("repair", of.name, "--scale", "mini", "--workers", 1)
    assert done.code == 0
    said = "1 broken shards of meta-learning generated again, 1 without a sidecar, 10 missing ones"
    assert said in done.err
    assert rows(call("status", "--json"), of)[0]["done"] == 16


@pytest.mark.parametrize(
    ("arguments", "code", "part"),
    [
        (("status", "moon"), 2, "moon"),
        (("verify", "moon"), 2, "moon"),
        (("verify", "--workers", "0"), 2, "--workers 0"),
        (("verify", "--regenerate", "-1"), 2, "--regenerate = -1"),
        (("verify", "meta-learning", "--regenerate", "7"), 1, "--regenerate 7 is more than the 6 whole shards"),
        (("verify", "distribution", "--regenerate", "1"), 1, "more than the 0 whole shards of distribution"),
        (("repair", "meta-learning", "--scale", "huge"), 2, "huge"),
        (("repair", "meta-learning", "--workers", "0"), 2, "--workers 0"),
    ],
)
def test_bad_input_is_one_sentence(call: Call, store: Store, arguments: tuple[str, ...], code: int, part: str) -> None:
    before = files(store.root)
    done = call(*arguments)
    assert done.code == code
    assert part in done.err.splitlines()[-1]
    assert done.err.splitlines()[-1].startswith("dlobench: ")
    assert "Traceback" not in done.err
    assert files(store.root) == before
