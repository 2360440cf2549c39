"""Tests the records: what is written is read back, and whatever else lies there is refused and left alone."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

import dlobench
from dlobench.bench.record import CellScore, DomainScore, FitReport, Provenance, Record
from dlobench.bench.results import checkout, read, read_all, write
from dlobench.errors import RunError


def record(
    *, model: str = "mlp", config: str = "0123abcd", seed: int = 0, mse: float = 1e-4, K: tuple[int, ...] = (0, 10)
) -> Record:
    """Makes a record of one fit, scored at each K on two domains."""
    domains = [
        DomainScore(
            domain=f"meta-learning/{i:05d}",
            cell="soft-none-16cm-0",
            supports=1,
            windows=170,
            moving=100,
            mse=mse,
            euclidean=mse**0.5,
            shape=mse**0.5,
            euclidean_moving=2 * mse**0.5,
            body_position=None,
            body_yaw=None,
            persistence_mse=4e-4,
            persistence_euclidean=0.02,
            adapt_seconds=0.001,
            predict_seconds=1e-5,
        )
        for i in (3, 7)
    ]
    cells = [
        CellScore(
            id=f"meta/trajectories20-h4-k{k}",
            trajectories=20,
            horizon=4,
            K=k,
            mse=mse,
            euclidean=mse**0.5,
            skill=1 - mse / 4e-4,
            domains=domains,
        )
        for k in K
    ]
    return Record(
        task="meta",
        task_version=1,
        scale="mini",
        model=model,
        config=config,
        seed=seed,
        parameters=100,
        seconds=2.5,
        fits=[FitReport(trajectories=20, horizon=4, seconds=1.5, curve=[{"step": 1.0, "train": 0.1}])],
        cells=cells,
        provenance=Provenance(
            command="dlobench run",
            created="2026-01-01T00:00:00+00:00",
            commit=None,
            dirty=None,
            versions={"numpy": "2.0"},
            cpu={"model": "x", "simd": ["avx"]},
            device="cpu",
            set="meta-learning-v1",
            data_sha256="a" * 64,
            split_sha256="b" * 64,
            plugin_sha256="c" * 64,
            hyperparameters={"width": 32, "K_train": None},
            K=list(K),
            budget={"steps": None, "minutes": 0.5},
        ),
    )


def check_refused(results: Path, path: Path, *messages: str) -> None:
    """Sees a results folder refused because of one file, which is named and left as it was."""
    before = path.read_bytes()
    with pytest.raises(RunError) as error:
        read_all(results)
    assert all(message in str(error.value) for message in (str(path), *messages))
    assert path.read_bytes() == before


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    one, two = record(), record(seed=12, mse=1 / 3)
    paths = [write(each, tmp_path) for each in (one, two)]
    assert [str(path.relative_to(tmp_path)) for path in paths] == [
        "meta/mini/mlp@0123abcd/seed0.json",
        "meta/mini/mlp@0123abcd/seed12.json",
    ]
    assert read(paths[1], tmp_path) == two
    assert read_all(tmp_path) == [one, two]
    assert not list(tmp_path.rglob("*.tmp"))


def test_configurations_and_seeds_never_share_a_place(tmp_path: Path) -> None:
    others = [record(), record(seed=1), record(config="0123abce"), record(model="maml")]
    assert len({each.path(tmp_path) for each in others}) == len(others)


def test_a_record_in_the_wrong_place_is_refused(tmp_path: Path) -> None:
    path = write(record(), tmp_path)
    for name in ("mini/mlp@0123abcd/seed1.json", "mini/mlp@ffffffff/seed0.json", "small/mlp@0123abcd/seed0.json"):
        wrong = tmp_path / "meta" / name
        wrong.parent.mkdir(parents=True, exist_ok=True)
        path.rename(wrong)
        check_refused(tmp_path, wrong, "belongs to", str(path))
        wrong.rename(path)
    assert len(read_all(tmp_path)) == 1


@pytest.mark.parametrize(
    "name", ["notes.txt", "meta/mini/mlp@0123abcd/seed0.json.bak", "meta/mini/mlp@0123abcd/model.pt", "other.json",
             "meta/table.csv", "seedx.json"],
)  # fmt: skip
def test_a_foreign_file_is_refused(name: str, tmp_path: Path) -> None:
    write(record(), tmp_path)
    path = tmp_path / name
    path.write_text("mine")
    check_refused(tmp_path, path, "not a record of ours", "move it away")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_half_written_record_is_refused(share: float, tmp_path: Path) -> None:
    path = write(record(), tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    check_refused(tmp_path, path, "not a record of ours")


@pytest.mark.parametrize("content", [b"[]", b"null", b"{}", b"\xff\xfe\x00", b"{" * 5000])
def test_what_is_no_record_is_refused(content: bytes, tmp_path: Path) -> None:
    path = write(record(), tmp_path)
    path.write_bytes(content)
    check_refused(tmp_path, path, "not a record of ours")


def test_hidden_files_and_tables_are_no_records(tmp_path: Path) -> None:
    written = record()
    path = write(written, tmp_path)
    path.with_name(".seed0.json.77.tmp").write_text("{")  # a killed run leaves this
    (tmp_path / "leaderboard.csv").write_text("x")
    assert read_all(tmp_path) == [written]


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"no results folder at .*absent"):
        read_all(tmp_path / "absent")


def test_an_empty_folder_holds_no_records(tmp_path: Path) -> None:
    assert read_all(tmp_path) == []


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["mse", "euclidean", "skill"])
def test_a_score_that_is_not_finite_makes_no_record(name: str, value: float) -> None:
    fields = record().cells[0].model_dump() | {name: value}
    with pytest.raises(ValidationError, match=name):
        CellScore(**fields)


def edit(path: Path, change: Any) -> None:
    """Changes the JSON of a record."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e999", '"low"', "null"])
def test_a_score_that_is_no_finite_number_is_refused(value: str, tmp_path: Path) -> None:
    path = write(record(), tmp_path)
    edit(path, lambda content: content["cells"][1].update(skill="HERE"))
    path.write_text(path.read_text().replace('"HERE"', value))
    check_refused(tmp_path, path, "cells.1.skill")


CHANGES: dict[str, tuple[str, Any]] = {
    "extra": ("note", lambda c: c.update(note="best")),
    "extra inside": ("cells.0.rank", lambda c: c["cells"][0].update(rank=1)),
    "missing": ("seed", lambda c: c.pop("seed")),
    "other schema": ("schema_version", lambda c: c.update(schema_version=2)),
    "negative seed": ("seed", lambda c: c.update(seed=-1)),
    "odd scale": ("scale", lambda c: c.update(scale="huge")),
    "path in name": ("model", lambda c: c.update(model="../../mlp")),
    "odd config": ("config", lambda c: c.update(config="XYZ")),
    "odd digest": ("provenance.data_sha256", lambda c: c["provenance"].update(data_sha256="a")),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_record_with_an_odd_field_is_refused(what: str, tmp_path: Path) -> None:
    where, change = CHANGES[what]
    path = write(record(), tmp_path)
    edit(path, change)
    check_refused(tmp_path, path, where)


def test_a_score_without_its_fit_is_refused(tmp_path: Path) -> None:
    path = write(record(), tmp_path)
    edit(path, lambda content: content.update(fits=[]))
    check_refused(tmp_path, path, "fit")


def test_records_are_no_change_of_a_checkout_and_all_else_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*arguments: str) -> None:
        who = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
        subprocess.run(["git", "-C", str(tmp_path), *who, *arguments], check=True, capture_output=True)

    package, results = tmp_path / "dlobench" / "__init__.py", tmp_path / "leaderboard" / "results"
    package.parent.mkdir()
    results.mkdir(parents=True)
    package.write_text("")
    git("init")
    git("add", ".")
    git("commit", "-m", "first")
    monkeypatch.setattr(dlobench, "__file__", str(package))
    assert checkout()[1] is False
    (results / "seed0.json").write_text("{}")
    assert checkout()[1] is False
    (package.parent / "new.py").write_text("")
    assert checkout()[1] is True
    (package.parent / "new.py").unlink()
    package.write_text("x = 1")
    assert checkout()[1] is True
