"""Tests the leaderboard: a pure function of the records, one row a cell and configuration."""

from __future__ import annotations

import csv
import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_results import record

from dlobench.bench import leaderboard, results
from dlobench.bench.results import Record
from dlobench.errors import RunError


def csv_of(records: list[Record], folder: Path) -> bytes:
    """Returns the bytes of the table of some records."""
    path = folder / "board.csv"
    leaderboard.write(leaderboard.table(records), path)
    return path.read_bytes()


def rows_of(content: bytes) -> list[dict[str, str]]:
    """Returns the rows of a table."""
    return list(csv.DictReader(content.decode().splitlines()))


def test_a_row_says_what_its_records_say(tmp_path: Path) -> None:
    (row,) = rows_of(csv_of([record(K=(10,), mse=1e-4)], tmp_path))
    expected = {
        "task": "meta", "task_version": "1", "scale": "mini", "cell": "meta/trajectories20-h4-k10", "model": "mlp",
        "config": "0123abcd", "seeds": "1", "parameters": "100", "trajectories": "20", "horizon": "4", "K": "10",
        "domains": "2", "data": "a" * 8, "split": "b" * 8,
    }  # fmt: skip
    assert expected.items() <= row.items()
    numbers = {"skill": 0.75, "mse_m2": 1e-4, "euclidean_m": 0.01, "fit_s": 1.5, "adapt_s": 0.001, "predict_s": 1e-5}
    assert {name: float(row[name]) for name in numbers} == pytest.approx(numbers)
    assert list(row) == leaderboard.COLUMNS


def test_seeds_are_averaged(tmp_path: Path) -> None:
    records = [record(seed=seed, mse=mse, K=(10,)) for seed, mse in ((0, 1e-4), (1, 2e-4), (5, 6e-4))]
    (row,) = rows_of(csv_of(records, tmp_path))
    assert row["seeds"] == "3"
    assert float(row["mse_m2"]) == pytest.approx(3e-4)
    assert float(row["skill"]) == pytest.approx((0.75 + 0.5 - 0.5) / 3)
    assert float(row["euclidean_m"]) == pytest.approx(sum(m**0.5 for m in (1e-4, 2e-4, 6e-4)) / 3)


def test_two_configurations_are_two_rows(tmp_path: Path) -> None:
    records = [record(K=(10,)), record(config="ffffffff", K=(10,), mse=2e-4), record(model="maml", K=(10,), mse=5e-5)]
    rows = rows_of(csv_of(records, tmp_path))
    assert [(row["model"], row["config"]) for row in rows] == [  # the best first
        ("maml", "0123abcd"),
        ("mlp", "0123abcd"),
        ("mlp", "ffffffff"),
    ]


def test_cells_are_kept_apart_and_sorted_by_their_support(tmp_path: Path) -> None:
    rows = rows_of(csv_of([record(K=(0, 1, 10, 2))], tmp_path))
    assert [row["K"] for row in rows] == ["0", "1", "2", "10"]


scores = st.floats(1e-9, 1e-2)
boards = st.lists(
    st.tuples(st.sampled_from(["mlp", "maml"]), st.sampled_from(["00000000", "11111111"]), st.integers(0, 4), scores),
    min_size=1,
    max_size=8,
    unique_by=lambda item: item[:3],
)


@given(items=boards, order=st.randoms(use_true_random=False))
@settings(max_examples=40, deadline=None)
def test_the_order_of_the_records_does_not_matter(
    items: list[tuple[str, str, int, float]], order: random.Random, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.getbasetemp()
    records = [record(model=model, config=config, seed=seed, mse=mse) for model, config, seed, mse in items]
    first = csv_of(records, folder)
    order.shuffle(records)
    assert csv_of(records, folder) == first


def test_a_tie_of_means_is_broken_by_name_whatever_the_order(tmp_path: Path) -> None:
    values = (0.1, 0.2, 0.3)
    one = [record(config="00000000", seed=i, mse=m) for i, m in enumerate(values)]
    two = [record(config="11111111", seed=i, mse=m) for i, m in enumerate(values)]
    expected = csv_of(one + two, tmp_path)
    assert [row["config"] for row in rows_of(expected)][:2] == ["00000000", "11111111"]
    assert csv_of(two[::-1] + one, tmp_path) == csv_of(one[::-1] + two, tmp_path) == expected


def test_the_table_of_nothing_has_its_columns(tmp_path: Path) -> None:
    assert csv_of(results.read_all(tmp_path), tmp_path) == (",".join(leaderboard.COLUMNS) + "\n").encode()


def test_the_records_are_left_as_they_were() -> None:
    records = [record(), record(seed=1)]
    before = [each.model_copy(deep=True) for each in records]
    leaderboard.table(records)
    assert records == before


def test_a_refusing_disk_leaves_the_old_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "leaderboard.csv"
    leaderboard.write(leaderboard.table([record()]), path)
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(RunError, match="No space left"):
        leaderboard.write(leaderboard.table([record(mse=9e-4)]), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
