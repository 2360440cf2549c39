"""Tests the leaderboard: a pure function of the records, one row a cell and configuration."""

from __future__ import annotations

import csv
import random
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_compare import HARD, made
from test_results import record

from dlobench.bench import leaderboard, results
from dlobench.bench.ranking import places, ranks
from dlobench.bench.record import FitReport, Record
from dlobench.bench.scores import scores as tidy
from dlobench.cli_board import show
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


def test_the_page_on_the_board_explains_every_column() -> None:
    page = (Path(__file__).parent.parent / "docs" / "leaderboard.md").read_text()
    heads = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    assert sorted(re.findall(r"`(\w+)`", " ".join(heads))) == sorted(leaderboard.COLUMNS)


def test_intervals_end_where_scores_do(tmp_path: Path) -> None:
    few = record(K=(10,))
    spread = [few.cells[0].domains[0].model_copy(update={"domain": f"meta-learning/{i:05d}", "mse": mse})
              for i, mse in enumerate((1e-6, 3e-4))]  # fmt: skip
    one = few.model_copy(update={"cells": [few.cells[0].model_copy(update={"domains": spread})]})
    (row,) = rows_of(csv_of([one], tmp_path))
    assert (float(row["mse_low"]), float(row["skill_high"])) == (0, 1)
    assert float(row["mse_high"]) > float(row["mse_m2"]) > 0


def test_configurations_of_a_model_say_in_what_they_differ(tmp_path: Path) -> None:
    def of(config: str, width: int, minutes: float | None) -> Record:
        one = record(config=config, K=(10,))
        about = {"hyperparameters": {"width": width, "depth": 6}, "budget": {"steps": None, "minutes": minutes}}
        return one.model_copy(update={"provenance": one.provenance.model_copy(update=about)})

    records = [
        of("aaaaaaaa", 32, None),
        of("bbbbbbbb", 64, None),
        of("cccccccc", 32, 4.0),
        record(model="maml", K=(10,)),
    ]
    told = {row["config"]: row["settings"] for row in rows_of(csv_of(records, tmp_path)) if row["model"] == "mlp"}
    assert told == {"aaaaaaaa": "width=32", "bbbbbbbb": "width=64", "cccccccc": "width=32, max_minutes=4.0"}
    assert [row["settings"] for row in rows_of(csv_of(records, tmp_path)) if row["model"] == "maml"] == [""]


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
    records = [
        made(model, HARD + mse * 1e4 * np.random.default_rng(seed).uniform(size=8), config=config, seed=seed, K=(0, 10))
        for model, config, seed, mse in items
    ]
    records = [one.model_copy(update={"fits": fitted(0.1 * one.seed + 1 / 3)}) for one in records]
    first = csv_of(records, folder)
    order.shuffle(records)
    assert csv_of(records, folder) == first


def test_seeds_from_several_machines_make_one_row_whatever_the_order() -> None:
    records = [with_provenance(made("mlp", HARD + k, seed=k), device=d) for k, d in enumerate(("cpu", "cuda", "cpu"))]
    records = [one.model_copy(update={"fits": fitted(0.1 + 0.2 * one.seed)}) for one in records]
    records.append(made("mlp", HARD + 9, config="fedcba98").model_copy(update={"fits": fitted(100)}))
    first = leaderboard.table(records)
    for order in ([1, 0, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        pd.testing.assert_frame_equal(leaderboard.table([records[i] for i in order]), first, check_exact=True)


def test_a_tie_of_means_is_broken_by_name_whatever_the_order(tmp_path: Path) -> None:
    values = (0.1, 0.2, 0.3)
    one = [record(config="00000000", seed=i, mse=m) for i, m in enumerate(values)]
    two = [record(config="11111111", seed=i, mse=m) for i, m in enumerate(values)]
    expected = csv_of(one + two, tmp_path)
    assert [row["config"] for row in rows_of(expected)][:2] == ["00000000", "11111111"]
    assert csv_of(two[::-1] + one, tmp_path) == csv_of(one[::-1] + two, tmp_path) == expected


def test_the_table_of_nothing_has_its_columns(tmp_path: Path) -> None:
    assert csv_of(results.read_all(tmp_path), tmp_path) == (",".join(leaderboard.COLUMNS) + "\n").encode()


# Places, intervals and ranks


def board(records: list[Record]) -> pd.DataFrame:
    """Returns the table by model, of one cell and no two configurations of a model."""
    return leaderboard.table(records).set_index("model")


def with_provenance(one: Record, **fields: object) -> Record:
    """Returns a record that comes from elsewhere."""
    return one.model_copy(update={"provenance": one.provenance.model_copy(update=fields)})


def test_places_and_intervals_are_those_of_the_statistics() -> None:
    rng = np.random.default_rng(1)
    records = [
        made(model, HARD + shift + rng.uniform(0, 0.9, size=8), seed=seed)
        for model, shift in (("good", 0), ("alike", 0.01), ("bad", 5))
        for seed in range(6)
    ]
    found, expected = board(records), places(tidy(records)).set_index("model")
    assert list(found.index) == list(expected.index)
    assert list(found["place"]) == list(expected["place"]) == [1, 1, 3]
    assert list(found["tie"]) == ["below", "above", ""]
    for name, of in (("skill", "estimate"), ("skill_low", "low"), ("skill_high", "high")):
        assert list(found[name]) == pytest.approx(list(expected[of]))
    assert (found["skill_low"] < found["skill"]).all() and (found["skill"] < found["skill_high"]).all()
    assert (found["mse_low"] < found["mse_m2"]).all() and (found["mse_m2"] < found["mse_high"]).all()
    ranked = ranks(tidy(records)).set_index("model").loc[found.index]
    for name, of in (("rank", "rank"), ("rank_low", "low"), ("rank_high", "high")):
        assert list(found[name]) == list(ranked[of])
    assert list(found["rank"])[-1] == list(found["rank_low"])[-1] == 3


boards_of_models = st.lists(st.integers(0, 10**6), min_size=2, max_size=6, unique=True)


def models_of(draws: list[int], seeds: int) -> list[Record]:
    """Makes models of which some are alike and some are not."""
    out = []
    for number, draw in enumerate(draws):
        rng = np.random.default_rng(draw)
        shift, noise = rng.choice([0, 0.2, 3]), rng.choice([0.05, 0.5])
        errors = HARD + shift + noise * rng.uniform(-1, 1, size=(seeds, 8))
        out += [made(f"m{number}", each, seed=seed) for seed, each in enumerate(errors)]
    return out


@given(draws=boards_of_models, seeds=st.sampled_from([1, 2, 5]))
@settings(max_examples=25, deadline=None)
def test_who_ties_with_a_neighbour_is_told_so_by_both(draws: list[int], seeds: int) -> None:
    found = board(models_of(draws, seeds))
    ties = ["", *found["tie"], ""]
    for above, below in pairwise(ties):
        assert (above in ("below", "both")) == (below in ("above", "both"))
    place = list(found["place"])
    assert place[0] == 1
    for i in range(1, len(place)):
        assert place[i] in (place[i - 1], i + 1)
        assert place[i] == i + 1 or found["tie"].iloc[i] in ("above", "both")


@given(draws=boards_of_models, seeds=st.sampled_from([1, 2, 5]))
@settings(max_examples=15, deadline=None)
def test_a_worse_model_changes_nobodys_place(draws: list[int], seeds: int) -> None:
    records = models_of(draws, seeds)
    before = board(records)
    after = board([*records, *(made("worst", HARD + 8 + k, seed=k) for k in range(seeds))])
    assert after.index[-1] == "worst"
    unchanged = ["place", "skill", "skill_low", "skill_high", "rank", "rank_low", "rank_high"]
    pd.testing.assert_frame_equal(after[unchanged].iloc[:-1], before[unchanged])


def test_models_between_do_not_lift_one_to_the_first_place() -> None:
    """Whoever ties with its neighbour need not tie with the first: a chain of steps is no way up."""
    wave = np.array([1, -1, 1, -1, 1, -1, 1, -1])
    steps = [made(f"m{i}", HARD + 0.2 * i + 0.5 * wave * (i % 2)) for i in range(6)]
    found = board(steps)
    assert set(found["tie"]) <= {"above", "below", "both"}, "each ties with its neighbours"
    assert dict(found["place"])["m5"] > 1
    assert dict(board([steps[0], steps[5]])["place"])["m5"] == 2


def test_a_seed_that_nobody_shares_is_no_way_to_tie() -> None:
    found = board([made("good", HARD), made("bad", HARD + 5, seed=77)])
    assert list(found["place"]) == [1, 2]


def test_what_was_scored_on_other_data_is_never_placed_or_ranked_together() -> None:
    here = [made("a", HARD), made("b", HARD + 5)]
    for name in ("data_sha256", "split_sha256"):
        there = with_provenance(made("c", HARD + 1), **{name: "0" * 64})
        found = board([*here, there])
        assert dict(found["place"]) == {"a": 1, "b": 2, "c": 1}
        assert dict(found["rank"]) == {"a": 1, "b": 2, "c": 1}
        columns = ["skill", "place", "tie", "rank", "rank_low", "rank_high"]
        pd.testing.assert_frame_equal(found.loc[["a", "b"], columns], board(here)[columns])


def test_a_model_that_lacks_cells_has_no_rank_and_takes_none_away() -> None:
    records = [made("all", HARD, K=(0, 10)), made("worse", HARD + 5, K=(0, 10)), made("elsewhere", HARD - 1, K=(3,))]
    found = leaderboard.table(records)
    rank = found.groupby("model")["rank"].agg(lambda column: column.iloc[0])
    assert rank["all"] == 1 and rank["worse"] == 2 and np.isnan(rank["elsewhere"])
    assert found[found["model"] == "elsewhere"][["rank_low", "rank_high"]].isna().all(axis=None)
    assert list(found[found["K"] == 3]["place"]) == [1]


def test_one_domain_has_no_interval_on_the_board() -> None:
    found = board([made("a", HARD[:1]), made("b", HARD[:1] + 1)])
    ends = [f"{name}_{end}" for name in ("skill", "mse", "rank") for end in ("low", "high")]
    assert found[ends].isna().all(axis=None)
    assert list(found["place"]) == [1, 1], "nothing tells them apart"


# Scores of samples, and what a task leaves out


def sampled(model: str, energy: float, *, still: float = 0.01) -> Record:
    """Makes a record whose samples are scored, with one energy score in every domain."""
    one = made(model, HARD)
    lists = {"ranks": [1, 2], "shape_ranks": [3]}
    more = {"energy": energy, "persistence_energy": still, "coverage90": 0.8, "overlap": 0.25} | lists
    cells = [
        cell.model_copy(update={"domains": [score.model_copy(update=more) for score in cell.domains]})
        for cell in one.cells
    ]
    return one.model_copy(update={"cells": cells})


def test_skill_is_of_the_energy_score_where_samples_are_scored(tmp_path: Path) -> None:
    rows = rows_of(csv_of([sampled("a", 0.004), sampled("b", 0.002)], tmp_path))
    assert [row["model"] for row in rows] == ["b", "a"]
    assert [float(row["skill"]) for row in rows] == pytest.approx([0.8, 0.6])
    assert [float(row["energy_m"]) for row in rows] == pytest.approx([0.002, 0.004])
    assert {float(row["coverage90"]) for row in rows} == {0.8} and {float(row["overlap"]) for row in rows} == {0.25}
    (row,) = rows_of(csv_of([made("a", HARD)], tmp_path))
    assert row["energy_m"] == row["coverage90"] == row["spacing"] == row["without"] == ""


def test_models_that_are_scored_differently_are_not_placed_together() -> None:
    with pytest.raises(RunError, match=r"meta 1 mini: models were scored differently"):
        leaderboard.table([sampled("a", 0.004), made("b", HARD)])


def test_two_records_of_a_seed_are_refused_by_their_path() -> None:
    with pytest.raises(RunError, match=r"meta/mini/mlp@0123abcd/seed3\.json"):
        leaderboard.table([record(seed=3), record(seed=4), record(seed=3, mse=2e-4)])


def test_a_cell_without_domains_is_refused_by_its_path() -> None:
    with pytest.raises(RunError, match=r"meta/mini/a@0123abcd/seed0\.json has no domain in meta/trajectories20-h4-k10"):
        leaderboard.table([made("a", HARD[:0])])


def fitted(*seconds: float, horizon: int = 4, trajectories: int = 20, without: str | None = None) -> list[FitReport]:
    """Makes the reports of fits that took so long."""
    return [
        FitReport(trajectories=trajectories, horizon=horizon, domain=f"x/{i}", seconds=s, curve=[], without=without)
        for i, s in enumerate(seconds)
    ]


def test_the_time_of_fits_apart_adds_up(tmp_path: Path) -> None:
    others = fitted(100, horizon=8) + fitted(1000, trajectories=60) + fitted(10_000, without="soft")
    one = record(K=(0,)).model_copy(update={"fits": others + fitted(1, 2, 4)})
    other = record(seed=1, K=(0,)).model_copy(update={"fits": fitted(1, 2, 6)})
    (row,) = rows_of(csv_of([one, other], tmp_path))
    assert float(row["fit_s"]) == 8, "the mean of 7 and 9"


def test_a_fit_serves_a_cell_that_looks_farther_ahead(tmp_path: Path) -> None:
    one = record(K=(0,)).model_copy(update={"fits": fitted(3, horizon=1) + fitted(50, horizon=1, without="soft")})
    (row,) = rows_of(csv_of([one], tmp_path))
    assert float(row["fit_s"]) == 3
    cells = [cell.model_copy(update={"without": "soft"}) for cell in one.cells]
    (row,) = rows_of(csv_of([one.model_copy(update={"cells": cells})], tmp_path))
    assert (float(row["fit_s"]), row["without"]) == (50, "soft")


# Equal time


def trained(config: str, seconds: float, shift: float, **about: object) -> Record:
    """Makes a record of a configuration that was trained so long and errs by so much."""
    one = made("mlp", HARD + shift, config=config).model_copy(update={"fits": fitted(seconds, seconds / 2)})
    return with_provenance(one, **about)


def test_at_equal_time_counts_who_trained_longest_and_not_who_scored_best(tmp_path: Path) -> None:
    records = [trained("00000000", 10, 0), trained("11111111", 20, 2), trained("22222222", 500, -0.5)]
    rows = {row["config"]: row for row in rows_of(csv_of(records, tmp_path))}
    assert rows["00000000"]["skill"] > rows["11111111"]["skill"]
    assert {row["skill_equal_time"] for row in rows.values()} == {rows["11111111"]["skill"]}
    assert {row["skill_equal_time"] for row in rows_of(csv_of(records[2:], tmp_path))} == {""}


@pytest.mark.parametrize(
    "about", [{"hyperparameters": {"width": 512}}, {"plugin_sha256": "d" * 64}, {"K": [1]}, {"device": "cuda"}]
)
def test_at_equal_time_another_model_does_not_count(tmp_path: Path, about: dict[str, object]) -> None:
    records = [trained("00000000", 10, 0, **about), trained("11111111", 500, 2)]
    rows = {row["config"]: row for row in rows_of(csv_of(records, tmp_path))}
    assert rows["00000000"]["skill_equal_time"] == rows["00000000"]["skill"]
    assert rows["11111111"]["skill_equal_time"] == ""


def test_at_equal_time_the_limit_is_a_fits_and_a_little_late_is_in_time(tmp_path: Path) -> None:
    limit = leaderboard.EQUAL_SECONDS["mini"]
    for seconds, counts in ((1.05 * limit, True), (1.2 * limit, False)):  # 1.5 times as long, both fits together
        (row,) = rows_of(csv_of([trained("00000000", seconds, 0)], tmp_path))
        assert (row["skill_equal_time"] == row["skill"]) is counts
    one_is_late = [trained("00000000", 1, 0), trained("00000000", 2 * limit, 0).model_copy(update={"seed": 1})]
    assert {row["skill_equal_time"] for row in rows_of(csv_of(one_is_late, tmp_path))} == {""}


def test_what_a_run_prints_fits_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    alike = HARD + 0.01 * (-1.0) ** np.arange(8)
    show(leaderboard.table([made("persistence", HARD), made("mlp", alike), made("bad", 2 * HARD)]))
    out = capsys.readouterr().out
    assert out.count("1≈") == 2 and "95 %" in out and "ties with a neighbour" in out
    assert max(len(line.rstrip()) for line in out.splitlines()) <= 120
    show(leaderboard.table([made("mlp", HARD[:1])]))
    assert " –" in capsys.readouterr().out, "there is no interval"


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
