"""Tests the tables: the domains of a set, and trajectories exported as Parquet, say what the set and its shards do."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from test_store import files, full, write

from dlobench.data import parquet, table
from dlobench.data.domain_set import PARTS, SCALES, DomainSet, Span
from dlobench.data.sets import SETS
from dlobench.data.store import Broken, Store
from dlobench.domain import Domain, RigidBody
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Trajectories

META, LARGE, FUTURES = SETS["meta-learning"], SETS["single-domain-large"], SETS["distribution"]
EVERY_SET = pytest.mark.parametrize("of", SETS.values(), ids=SETS)


def rebuilt(row: pd.Series) -> Domain:
    """Builds a domain from nothing but its row."""
    bodies = [
        RigidBody(
            row[f"body{i}_shape"],
            tuple(map(float, row[f"body{i}_densities_kg_per_m3"])),
            float(row[f"body{i}_friction"]),
        )
        for i in range(row["rigid_objects"])
    ]
    return Domain(
        surface_friction=row["surface_friction"],
        length=row["length_m"],
        density=row["density_kg_per_m3"],
        material=row["material"],
        bending_stiffness=row["bending_stiffness_N_m2"],
        yield_curvature=None if pd.isna(row["yield_curvature_per_m"]) else row["yield_curvature_per_m"],
        attachment=row["attachment"],
        bodies=tuple(bodies),
    )


def test_a_row_holds_all_of_its_domain() -> None:
    rows = pd.read_parquet(io.BytesIO(table.content(META)))
    assert len(rows) == len(META)
    for index in range(0, len(META), 97):
        assert rebuilt(rows.iloc[index]) == META.domain(index), "every bit"
        bodies = rows.iloc[index]["rigid_objects"]
        assert [rows[f"body{i}_shape"].notna()[index] for i in range(3)] == [i < bodies for i in range(3)]


@EVERY_SET
def test_the_table_counts_what_the_scales_hold(of: DomainSet) -> None:
    rows = table.domains_table(of)
    assert list(rows["domain"]) == list(range(len(of)))
    assert list(rows["id"]) == [f"{of.name}/{i}" for i in range(len(of))]
    for scale in SCALES:
        spans = of.spans(scale)
        for part in PARTS:
            column = rows[f"{scale}_{part}_trajectories"]
            assert column.sum() == sum(span.count for span in spans if span.part == part)
            assert column.astype(bool).sum() == len({s.domain for s in spans if s.part == part})
            assert (column.astype(bool) <= rows["parts"].str.contains(part)).all()


@EVERY_SET
def test_frame_and_file_say_the_same(of: DomainSet) -> None:
    frame, file = table.domains_table(of), pd.read_parquet(io.BytesIO(table.content(of)))
    assert list(frame.columns) == list(file.columns) == list(table.about_columns())
    for name in table.about_columns():
        if "_densities_" in name:
            assert [list(v) if isinstance(v, list) else None for v in frame[name]] == [
                None if v is None else list(v) for v in file[name]
            ]
        else:
            pd.testing.assert_series_equal(frame[name], file[name], check_dtype=False, check_exact=True)


def test_a_scale_takes_its_own_domains_and_columns() -> None:
    rows = table.domains_table(META, "mini")
    assert set(rows["domain"]) == {span.domain for span in META.spans("mini")}
    assert "mini_train_trajectories" in rows
    assert "paper_train_trajectories" not in rows


def test_the_file_is_the_same_bytes_in_another_process(tmp_path: Path) -> None:
    path = table.write(Store(tmp_path), META)
    assert path == tmp_path / META.key / "domains.parquet"
    code = (
        "import hashlib, sys; from dlobench.data import table; from dlobench.data.sets import SETS;"
        "sys.stdout.buffer.write(table.content(SETS['meta-learning']))"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert other.stdout == path.read_bytes()
    assert pq.read_schema(path).metadata[b"set"] == META.key.encode()


def test_thousands_of_domains_take_a_moment() -> None:
    begin = time.process_time()
    table.content(META)
    assert time.process_time() - begin < 4, "about 1 s on a quiet machine"


# Exports


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "data")


def made(store: Store, of: DomainSet, spans: list[Span]) -> dict[Span, Trajectories]:
    """Writes fake shards for some spans and returns what they hold."""
    for unit in of.units(spans):
        write(store, of, unit)
    return {span: store.load_span(of, span) for span in spans}


def check_same(of: DomainSet, span: Span, rows: pd.DataFrame, held: Trajectories) -> None:
    """Sees every number of some trajectories in the rows of an export."""
    domain, K, T = of.domain(span.domain), len(held), held.pushes
    rows = rows[(rows["part"] == span.part)].reset_index(drop=True)
    assert len(rows) == K * (T + 1)
    assert (rows["domain"] == span.domain).all()
    assert np.array_equal(rows["trajectory"], np.repeat(np.arange(span.first, span.first + K), T + 1))
    assert np.array_equal(rows["step"], np.tile(np.arange(T + 1), K))
    for axis, name in enumerate(("x_m", "y_m", "yaw_rad")):
        for field, count in (("dlo", domain.segments), ("bodies", len(domain.bodies))):
            found = np.stack(rows[f"{field}_{name}"].to_list()).reshape(K, T + 1, count)
            assert np.array_equal(found, getattr(held, field)[:, :, :count, axis])
        cylinder = rows[f"cylinder_{name}"].to_numpy()
        if domain.attachment == "none":
            assert np.isnan(cylinder).all()
        else:
            assert held.cylinder is not None
            assert np.array_equal(cylinder, held.cylinder[..., axis].reshape(-1))
    for axis, name in enumerate(("x_m", "y_m")):
        assert np.array_equal(rows[f"pusher_{name}"], held.pusher[..., axis].reshape(-1))
        for field in ("commanded", "executed"):
            pushes = rows[f"{field}_{name}"].to_numpy().reshape(K, T + 1)
            assert np.array_equal(pushes[:, :-1], getattr(held, field)[..., axis])
            assert np.isnan(pushes[:, -1]).all(), "no push follows the last state"


def cases() -> list[tuple[DomainSet, list[Span]]]:
    """Returns spans of all kinds: several parts of a domain, ends within a shard, bodies, another length."""
    large = [s for s in LARGE.spans("mini") if s.domain in (1, 9)]
    large[0] = replace(large[0], count=13)
    return [
        (LARGE, large),
        (META, [Span(25 * 27, "train", 5, 20), Span(25 * 250, "test", 0, 20)]),
        (FUTURES, FUTURES.spans("mini")[5:6]),
    ]


@pytest.mark.parametrize(("of", "spans"), cases(), ids=lambda value: getattr(value, "name", ""))
def test_an_export_holds_every_number(of: DomainSet, spans: list[Span], store: Store, tmp_path: Path) -> None:
    held, out = made(store, of, spans), tmp_path / "a" / "out"
    states = parquet.export(store, of, spans, out)
    assert sorted(files(out)) == sorted({"domains.parquet", *(f"states/{span.domain:05d}.parquet" for span in spans)})
    assert (out / "domains.parquet").read_bytes() == table.content(of)
    for span in spans:
        check_same(of, span, pd.read_parquet(out / "states" / f"{span.domain:05d}.parquet"), held[span])
    assert len(pd.read_parquet(out / "states")) == states == sum(span.count for span in spans) * (of.pushes + 1)
    assert [path.name for path in out.parent.iterdir()] == ["out"], "nothing is left beside it"


def test_columns_are_typed_and_compressed(store: Store, tmp_path: Path) -> None:
    spans = LARGE.spans("mini")[:1]
    made(store, LARGE, spans)
    parquet.export(store, LARGE, spans, tmp_path / "out")
    file = pq.ParquetFile(tmp_path / "out" / "states" / "00000.parquet")
    types = {field.name: str(field.type) for field in file.schema_arrow}
    assert list(types) == list(parquet.COLUMNS)
    assert (types["step"], types["trajectory"], types["pusher_x_m"]) == ("int16", "int32", "float")
    assert types["dlo_x_m"].startswith("list<")
    assert {file.metadata.row_group(0).column(i).compression for i in range(5)} == {"ZSTD"}


def test_an_export_is_the_same_bytes_again(store: Store, tmp_path: Path) -> None:
    spans = LARGE.spans("mini")[:3]
    made(store, LARGE, spans)
    for name in ("one", "two"):
        parquet.export(store, LARGE, spans, tmp_path / name)
    assert files(tmp_path / "one") == files(tmp_path / "two")


def test_an_export_overwrites_nothing(store: Store, tmp_path: Path) -> None:
    spans = LARGE.spans("mini")[:1]
    made(store, LARGE, spans)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("mine")
    before = files(tmp_path)
    for taken in (tmp_path / "out", tmp_path / "out" / "mine"):
        with pytest.raises(UsageError, match="exists already") as refused:
            parquet.export(store, LARGE, spans, taken)
        assert str(taken) in str(refused.value)
    assert files(tmp_path) == before
    (tmp_path / "empty").mkdir()
    parquet.export(store, LARGE, spans, tmp_path / "empty")
    assert (tmp_path / "empty" / "domains.parquet").is_file()


def test_what_is_missing_or_broken_is_not_exported(store: Store, tmp_path: Path) -> None:
    spans = LARGE.spans("mini")[:3]
    with pytest.raises(RunError, match="still to be made"):
        parquet.export(store, LARGE, spans, tmp_path / "out")
    made(store, LARGE, spans)
    path = store.path(LARGE, list(LARGE.units(spans))[-1])
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    path.write_bytes(content)
    with pytest.raises(Broken):
        parquet.export(store, LARGE, spans, tmp_path / "out")
    assert [each.name for each in tmp_path.iterdir()] == ["data"], "nothing half-written is left"


def test_a_full_disk_leaves_no_export(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spans = LARGE.spans("mini")[:1]
    made(store, LARGE, spans)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunError, match="No space left") as refused:
        parquet.export(store, LARGE, spans, tmp_path / "out")
    assert str(tmp_path / "out") in str(refused.value)
    assert [each.name for each in tmp_path.iterdir()] == ["data"]


def test_a_place_below_a_file_is_named(store: Store, tmp_path: Path) -> None:
    spans = LARGE.spans("mini")[:1]
    made(store, LARGE, spans)
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(RunError, match="Not a directory") as refused:
        parquet.export(store, LARGE, spans, tmp_path / "mine" / "out")
    assert str(tmp_path / "mine" / "out") in str(refused.value)


MEMORY = """
import resource, sys
from pathlib import Path
from dlobench.data import parquet
from dlobench.data.domain_set import Span
from dlobench.data.sets import SETS
from dlobench.data.store import Store

of, out = SETS["single-domain-large"], Path(sys.argv[1])
for number, count in enumerate((500, 500, 4000)):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    parquet.export(Store(out / "data"), of, [Span(0, "train", 0, count)], out / str(number))
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


def test_memory_is_flat_in_what_is_exported(store: Store, tmp_path: Path) -> None:
    """4000 trajectories are 38 MB in the shards; in a process of its own, whose peak nothing else has raised."""
    made(store, LARGE, [Span(0, "train", 0, 4000)])
    done = subprocess.run([sys.executable, "-c", MEMORY, str(tmp_path)], capture_output=True, text=True, check=True)
    _, again, more = map(float, done.stdout.split())
    assert more < 15, f"MB more for eight times as much, after {again} MB for the same again"
