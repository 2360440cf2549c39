"""Tests comparisons of models: pairs are of the same domains and seeds, verdicts follow intervals, ties are ties."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import rankdata
from test_results import record

from dlobench.bench.compare import compare, draw
from dlobench.bench.matrix import difference, score
from dlobench.bench.ranking import mean_ranks, places, ranks
from dlobench.bench.record import DomainScore, Record
from dlobench.bench.results import write
from dlobench.bench.scores import scores, with_all
from dlobench.cli import main
from dlobench.errors import UsageError

HARD = np.array([1.0, 5.0, 2.0, 9.0, 3.0, 7.0, 4.0, 8.0])  # how hard each domain is


def made(
    model: str, errors: np.ndarray, *, seed: int = 0, config: str = "0123abcd", K: tuple[int, ...] = (10,)
) -> Record:
    """Makes a record of domains with these MSEs, 1e-4 m²; standing still has 20 in each."""
    base = record(model=model, seed=seed, config=config, K=K)
    like = base.cells[0].domains[0].model_dump()
    domains = [
        DomainScore(**like | {"domain": f"meta-learning/{i:05d}", "mse": e * 1e-4, "persistence_mse": 20e-4})
        for i, e in enumerate(errors)
    ]
    return base.model_copy(update={"cells": [cell.model_copy(update={"domains": domains}) for cell in base.cells]})


def test_a_small_difference_on_the_same_domains_is_seen() -> None:
    rng = np.random.default_rng(0)
    better = HARD - 0.3 + 0.1 * rng.normal(size=8)
    frame = scores([made("a", better), made("b", HARD)])
    (found,) = compare(frame, "a", "b", task="meta", scale="mini", metric="mse")
    assert found.verdict == "better" and not found.difference.tie
    assert found.difference.estimate == pytest.approx(1e-4 * (better - HARD).mean())
    one, other = score(frame[frame["model"] == "a"], "mse"), score(frame[frame["model"] == "b"], "mse")
    assert one.high is not None and other.low is not None and found.difference.high is not None
    assert one.high > other.low, "alone their intervals overlap"
    (turned,) = compare(frame, "b", "a", task="meta", scale="mini", metric="mse")
    assert turned.verdict == "worse"
    (skill,) = compare(frame, "a", "b", task="meta", scale="mini")
    assert skill.verdict == "better", "a higher skill is the better one"
    assert skill.difference.estimate == pytest.approx((HARD - better).sum() / (20 * 8))


def test_what_differs_by_chance_is_a_tie_and_one_domain_says_nothing() -> None:
    noise = np.array([1, -1, 1, -1, 1, -1, 1, -1.0])
    frame = scores([made("a", HARD + 0.5 * noise), made("b", HARD)])
    assert compare(frame, "a", "b", task="meta", scale="mini")[0].verdict == "tie"
    frame = scores([made("a", HARD[:1]), made("b", HARD[:1] + 1)])
    assert compare(frame, "a", "b", task="meta", scale="mini")[0].verdict == "unknown"


def test_only_shared_domains_and_seeds_count_whatever_the_order_of_records() -> None:
    a = [made("a", HARD[:6] - 1, seed=k) for k in range(3)]
    b = [made("b", HARD, seed=k) for k in (1, 2, 7)]
    found = difference(scores(a), scores(b))
    assert (found.domains, found.seeds) == (6, 2)
    frame, turned = scores([*a, *b]), scores([*b[::-1], *a[::-1]])
    pd.testing.assert_frame_equal(frame, turned)
    assert compare(frame, "a", "b", task="meta", scale="mini") == compare(turned, "a", "b", task="meta", scale="mini")


def test_places_share_ties_and_ranks_have_intervals() -> None:
    rng = np.random.default_rng(1)
    alike = HARD + 0.4 * rng.normal(size=8)
    frame = scores([made("good", HARD), made("alike", alike), made("bad", HARD + 5)])
    table = places(frame)
    assert list(table["place"]) == [1, 1, 3] and list(table["tie"]) == ["below", "above", ""]
    assert table["model"].iloc[2] == "bad"
    ranked = ranks(frame).set_index("model")
    low, rank, high = (ranked[name].to_numpy(dtype=float) for name in ("low", "rank", "high"))
    assert list(ranked.index)[-1] == "bad" and low[-1] == rank[-1] == high[-1] == 3
    assert (low <= rank).all() and (rank <= high).all()
    pd.testing.assert_frame_equal(ranks(frame), ranks(frame))


def test_mean_ranks_are_those_of_scipy() -> None:
    values = np.random.default_rng(0).integers(0, 5, size=(50, 7)).astype(float)
    assert np.array_equal(mean_ranks(values), rankdata(values, axis=1))


def test_models_that_lack_a_cell_are_not_ranked() -> None:
    frame = scores([made("all", HARD, K=(1, 10)), made("half", HARD - 1, K=(10,))])
    assert list(ranks(frame)["model"]) == ["all"]


def test_sizes_are_compared_over_domains_that_have_all_of_them() -> None:
    frame = scores([made("a", HARD)])
    larger = frame[frame["domain"] < "meta-learning/00003"].assign(trajectories=500)
    kept = with_all(pd.concat([frame, larger]), "trajectories")
    assert set(kept["domain"]) == {f"meta-learning/{i:05d}" for i in range(3)} and len(kept) == 6


@pytest.mark.parametrize(
    ("a", "b", "how", "named"),
    [
        ("c", "b", {}, "no model 'c' among the records: a@0123abcd, a@fedcba98, b@0123abcd are there"),
        ("a", "b", {}, "'a' has several configurations: say which of a@0123abcd, a@fedcba98"),
        ("a@0123abcd", "b", {"task": "moon"}, "no record of moon at scale mini: there are meta at mini"),
        ("a@0123abcd", "b", {"metric": "moon"}, "metric 'moon' is unknown: skill, "),
    ],
)
def test_what_cannot_be_compared_is_refused(a: str, b: str, how: dict[str, str], named: str) -> None:
    frame = scores([made("a", HARD), made("a", HARD, config="fedcba98"), made("b", HARD)])
    with pytest.raises(UsageError, match=named):
        compare(frame, a, b, **{"task": "meta", "scale": "mini"} | how)


def test_other_data_is_never_compared() -> None:
    b = made("b", HARD)
    other = b.model_copy(update={"provenance": b.provenance.model_copy(update={"data_sha256": "d" * 64})})
    with pytest.raises(UsageError, match="a and b were scored on different data: aaaaaaaa and dddddddd"):
        compare(scores([made("a", HARD), other]), "a", "b", task="meta", scale="mini")


def test_another_split_and_nothing_in_common_are_refused() -> None:
    b = made("b", HARD)
    other = b.model_copy(update={"provenance": b.provenance.model_copy(update={"split_sha256": "d" * 64})})
    with pytest.raises(UsageError, match="different split"):
        compare(scores([made("a", HARD), other]), "a", "b", task="meta", scale="mini")
    with pytest.raises(UsageError, match="different data or splits"):
        ranks(scores([made("a", HARD), other]))
    frame = scores([made("a", HARD), b])
    apart = frame.assign(domain=frame["domain"] + frame["model"])
    with pytest.raises(UsageError, match="share no domain"):
        compare(apart, "a", "b", task="meta", scale="mini")
    with pytest.raises(UsageError, match="share no seed"):
        compare(scores([made("a", HARD, seed=1), b]), "a", "b", task="meta", scale="mini")
    with pytest.raises(UsageError, match="share no cell"):
        compare(scores([made("a", HARD, K=(1,)), b]), "a", "b", task="meta", scale="mini")


@pytest.mark.parametrize("seeds", [1, 3, 6])
def test_pairs_are_narrower_than_strangers(seeds: int) -> None:
    rng = np.random.default_rng(2)
    records = [
        made(model, HARD + shift + 0.1 * rng.normal(size=8), seed=seed)
        for seed in range(seeds)
        for model, shift in (("a", 0.0), ("b", 0.5))
    ]
    frame = scores(records)
    one, other = frame[frame["model"] == "a"], frame[frame["model"] == "b"]
    paired, alone = difference(other, one, "mse"), score(one, "mse")
    assert paired.low is not None and paired.high is not None and alone.low is not None and alone.high is not None
    assert 0 < paired.low < paired.high
    assert paired.high - paired.low < (alone.high - alone.low) / 5
    back = difference(one, other, "mse")
    assert (back.low, back.high) == pytest.approx((-paired.high, -paired.low))


def test_models_are_ranked_over_the_domains_that_all_have() -> None:
    easy = HARD.argsort()[:4]
    whole, lucky = scores([made("whole", HARD)]), scores([made("lucky", HARD + 0.5)])
    lucky = lucky[lucky["domain"].isin([f"meta-learning/{i:05d}" for i in easy])]  # it never met the hard ones
    assert lucky["mse"].mean() < whole["mse"].mean()
    assert list(ranks(pd.concat([whole, lucky]), "mse")["model"]) == ["whole", "lucky"]


@pytest.mark.parametrize("suffix", ["svg", "pdf"])
def test_pictures_of_vectors_are_the_same_bytes_twice(tmp_path: Path, suffix: str) -> None:
    found = compare(scores([made("a", HARD - 1), made("b", HARD)]), "a", "b", task="meta", scale="mini")
    paths = [tmp_path / f"{name}.{suffix}" for name in ("one", "two")]
    for path in paths:
        draw(found, path, title="meta", label="skill")
    assert paths[0].read_bytes() == paths[1].read_bytes()


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["dlobench", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_the_command_prints_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for each in (made("a", HARD - 1 + 0.1 * np.arange(8)), made("b", HARD)):
        write(each, tmp_path / "runs")
    asked = ("compare", "a", "b", "--task", "meta", "--results", tmp_path / "runs")
    pictures = [tmp_path / f"{name}.png" for name in ("one", "two")]
    for picture in pictures:
        assert run(monkeypatch, *asked, "--out", picture) == 0
    out = capsys.readouterr().out
    assert "meta/trajectories20-h4-k10" in out and "better" in out and "one seed" in out
    assert pictures[0].read_bytes() == pictures[1].read_bytes()
    assert pictures[0].read_bytes().startswith(b"\x89PNG")
    assert run(monkeypatch, *asked, "--out", tmp_path / "x.doc") == 2
    assert run(monkeypatch, "compare", "a", "b", "--task", "meta", "--results", tmp_path / "absent") == 1
    errors = capsys.readouterr().err.splitlines()
    assert [line.startswith("dlobench: ") for line in errors] == [True, True]
