"""Tests the cards: mlcroissant takes them without a word and loads from them what the set, and its shards, hold."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import mlcroissant
import numpy as np
import pandas as pd
import pytest
from test_cli import Call, check_failed
from test_cli import call as call  # noqa: PLC0414  # a fixture
from test_store import edit, files, write

from dlobench.data import card, parquet, table
from dlobench.data.domain_set import Span, Unit
from dlobench.data.sets import SETS
from dlobench.data.store import Broken, Store
from dlobench.errors import RunError, UsageError

# mlcroissant and rdflib call what pandas and rdflib are about to drop.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

META, LARGE = SETS["meta-learning"], SETS["single-domain-large"]
SPANS = LARGE.spans("mini")[3:6]  # all parts of one domain, with bodies


def loaded(out: Path) -> mlcroissant.Dataset:
    """Loads a card as a user does, and sees that nothing is wrong with it."""
    dataset = mlcroissant.Dataset(out / "croissant.json")
    issues = dataset.metadata.ctx.issues
    assert not issues.errors
    assert not issues.warnings
    return dataset


def records(dataset: mlcroissant.Dataset, name: str) -> list[dict[str, Any]]:
    """Returns the records of a set of them, texts as texts and columns by their own names."""
    return [
        {
            key.removeprefix(f"{name}/"): value.decode() if isinstance(value, bytes) else value
            for key, value in row.items()
        }
        for row in dataset.records(name)
    ]


def made(store: Store, spans: list[Span]) -> list[Unit]:
    """Writes fake shards for some spans of the large domains."""
    units = list(LARGE.units(spans))
    for unit in units:
        write(store, LARGE, unit)
    return units


def test_the_domains_are_loaded_from_the_card(tmp_path: Path) -> None:
    card.write(Store(tmp_path), LARGE, "mini", tmp_path / "card")
    rows = records(loaded(tmp_path / "card"), "domains")
    frame = table.domains_table(LARGE)
    assert len(rows) == len(frame) == 18
    for (_, held), row in zip(frame.iterrows(), rows, strict=True):
        assert list(row) == list(frame.columns)
        for name, value in row.items():
            if "_densities_" in name:
                assert value == (held[name] if isinstance(held[name], list) else None)
            else:
                assert value == (None if pd.isna(held[name]) else held[name]), name


def test_the_shards_on_disk_are_listed_with_their_digests(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    units = made(store, SPANS)
    count = card.write(store, LARGE, "mini", tmp_path / "card")
    rows = records(loaded(tmp_path / "card"), "shards")
    assert len(rows) == count == len(units)
    for unit, row in zip(units, rows, strict=True):
        path = store.root / LARGE.key / row["path"]
        assert path == store.path(LARGE, unit)
        assert row["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert row["bytes"] == path.stat().st_size
        assert (row["domain"], row["first"], row["trajectories"]) == (unit.domain, unit.first, unit.count)
    parts = {span.part: {u.first for u in LARGE.units([span])} for span in SPANS}
    assert all(row["first"] in parts[row["part"]] for row in rows)


def test_exported_trajectories_are_loaded_from_the_card(tmp_path: Path) -> None:
    store, spans = Store(tmp_path / "data"), [SPANS[1], LARGE.spans("mini")[1]]
    made(store, spans)
    held = [store.load_span(LARGE, span) for span in sorted(spans, key=lambda span: span.domain)]
    out = tmp_path / "out"
    parquet.export(store, LARGE, spans, out)
    exported = files(out)
    card.write(store, LARGE, "mini", out)
    assert exported.items() <= files(out).items(), "the export is as it was"
    rows = records(loaded(out), "states")
    assert len(rows) == sum(len(each) * (each.pushes + 1) for each in held)
    assert np.array_equal([row["pusher_x_m"] for row in rows], np.concatenate([e.pusher[..., 0].ravel() for e in held]))
    bodies = held[1].bodies[:, :, :3, 2].reshape(-1, 3)
    assert np.array_equal([row["bodies_yaw_rad"] for row in rows[-len(bodies) :]], bodies)
    assert [row["step"] for row in rows[:21]] == list(range(21))
    assert rows[20]["executed_x_m"] is None


def test_a_card_of_many_domains_is_valid(tmp_path: Path) -> None:
    card.write(Store(tmp_path), META, "small", tmp_path / "card")
    dataset = loaded(tmp_path / "card")
    assert [each.id for each in dataset.metadata.record_sets] == ["domains", "shards"]
    described = json.loads((tmp_path / "card" / "croissant.json").read_text())
    for file in described["distribution"]:
        content = (tmp_path / "card" / file["contentUrl"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == file["sha256"]


def test_an_altered_table_is_not_loaded(tmp_path: Path) -> None:
    card.write(Store(tmp_path), LARGE, "mini", tmp_path / "card")
    path = tmp_path / "card" / "domains.parquet"
    path.write_bytes(path.read_bytes() + b" ")
    with pytest.raises(Exception, match=r"domains\.parquet"):
        records(loaded(tmp_path / "card"), "domains")


def test_people_read_what_it_is_and_how_it_is_made_again(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    made(store, SPANS)
    card.write(store, LARGE, "mini", tmp_path / "card")
    text = (tmp_path / "card" / "README.md").read_text()
    expected = [
        "# single-domain-large, scale mini",
        f"{len(list(LARGE.units(SPANS)))} of its 144 shards",
        "(10, 21, 114)",
        "| paper | train | 18 | 900,000 | 18,000,000 | 8,618,400,000 |",
        "dlobench generate single-domain-large --scale mini",
        LARGE.key,
        LARGE.digest(LARGE.spans("mini")),
        hashlib.sha256((tmp_path / "card" / "shards.parquet").read_bytes()).hexdigest(),
        "mujoco 4",
        "Apache",
        "DLO@Scale",
        "`bending_stiffness_N_m2`",
    ]
    assert not [part for part in expected if part not in text]
    assert "{" not in text, "every place of the template is filled"
    columns = [line for line in text.splitlines() if line.startswith("| 107–109 ")]
    assert columns == [
        "| 107–109 | `cylinder` | what an attached DLO ends in: x m, y m, yaw rad; not for models to see |"
    ]


def test_a_card_is_written_anew_and_grows_with_the_data(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    assert card.write(store, LARGE, "mini", tmp_path / "card") == 0
    made(store, SPANS[:1])
    assert card.write(store, LARGE, "mini", tmp_path / "card") == len(list(LARGE.units(SPANS[:1])))
    assert len(records(loaded(tmp_path / "card"), "shards")) == len(list(LARGE.units(SPANS[:1])))


def test_nothing_of_others_is_overwritten(tmp_path: Path) -> None:
    store, out = Store(tmp_path / "data"), tmp_path / "out"
    out.mkdir()
    (out / "README.md").write_text("mine")
    with pytest.raises(UsageError, match=r"README\.md that is not of a card"):
        card.write(store, LARGE, "mini", out)
    assert files(out) == {"README.md": b"mine"}
    card.write(store, META, "mini", tmp_path / "meta")
    before = files(tmp_path / "meta")
    with pytest.raises(UsageError, match=META.key):
        card.write(store, LARGE, "mini", tmp_path / "meta")
    assert files(tmp_path / "meta") == before
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "domains.parquet").write_bytes(b"PAR1 but not really")
    with pytest.raises(UsageError, match="something else"):
        card.write(store, LARGE, "mini", tmp_path / "foreign")


def test_a_broken_shard_is_named(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    write(store, META, Unit(META.name, 0, 0, 4))
    edit(store, bytes=1)
    path = store.path(META, Unit(META.name, 0, 0, 4))
    with pytest.raises(Broken, match=path.name):
        card.write(store, META, "paper", tmp_path / "card")
    assert not (tmp_path / "card").exists()


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(UsageError, match="not a folder"):
        card.write(Store(tmp_path), LARGE, "mini", tmp_path / "mine")
    with pytest.raises(RunError, match="Not a directory"):
        card.write(Store(tmp_path), LARGE, "mini", tmp_path / "mine" / "card")
    assert files(tmp_path) == {"mine": b"mine"}


def test_the_verbs_export_and_describe(call: Call, tmp_path: Path) -> None:
    store, out = Store(tmp_path / "data"), tmp_path / "out"
    made(store, LARGE.spans("mini")[:3])
    done = call("data", "export", LARGE.name, "--parquet", out, "--domains", 1)
    assert (done.code, done.out) == (0, ""), done.err
    assert "1,680 states" in done.err
    done = call("data", "card", LARGE.name, "--out", out)
    assert done.code == 0, done.err
    assert "8 shards" in done.err
    assert [each.id for each in loaded(out).metadata.record_sets] == ["domains", "shards", "states"]


BAD: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
    (("card", "moon", "--out", "x"), ("moon", "meta-learning")),
    (("card", "meta-learning", "--scale", "huge", "--out", "x"), ("huge", "mini")),
    (("card", "meta-learning"), ("--out",)),
    (("export", "meta-learning"), ("--original", "--parquet")),
    (("export", "meta-learning", "--original", "x", "--parquet", "y"), ("--original", "--parquet")),
    (("export", "meta-learning", "--parquet", "x", "--domains", "0"), ("0", "1–90")),
    (("export", "distribution", "--parquet", "x", "--part", "train"), ("distribution", "train")),
    (("export", "moon", "--parquet", "x"), ("moon",)),
]


@pytest.mark.parametrize(("arguments", "parts"), BAD, ids=" ".join)
def test_bad_usage_is_told_in_one_line(
    arguments: tuple[str, ...], parts: tuple[str, ...], call: Call, tmp_path: Path
) -> None:
    before = files(tmp_path)
    check_failed(call("data", *arguments), 2, *parts)
    assert files(tmp_path) == before


def test_what_is_not_generated_is_not_exported(call: Call, tmp_path: Path) -> None:
    check_failed(call("data", "export", LARGE.name, "--parquet", tmp_path / "out"), 1, "dlobench generate", LARGE.name)
    assert not (tmp_path / "out").exists()
