"""Tests what decides the paper's findings: known ratios are recovered, and verdicts follow from intervals alone."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import findings
import numpy as np
import pandas as pd
import pytest
import table1
from findings import Answer
from recorded import read
from test_recorded_figures import RESULTS, sweep

from dlobench.bench.record import FitReport
from dlobench.bench.results import write
from dlobench.bench.statistics import Interval
from dlobench.errors import RunError

ROOT = Path(__file__).parent.parent
TABLE, PAGE = ROOT / "paper_figures" / "tables" / "findings.md", ROOT / "docs" / "findings.md"


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    results = tmp_path_factory.mktemp("swept")
    write(sweep("horizon_sweep", "mlp", 0.05, 0.30), results)
    return results


def test_growth_with_the_horizon_and_gain_by_data_are_those_of_the_records(swept: Path) -> None:
    of = read(swept, "horizon_sweep")
    (grows,) = findings.of_horizon(of)
    assert grows.found.estimate == pytest.approx(4**0.7, rel=0.1)
    assert grows.verdict == "confirmed" and "n = 4 ÷ at n = 1" in grows.statistic
    few, many = findings.of_data(of)
    assert few.found.estimate == pytest.approx(10**0.3, rel=0.1) and few.found.domains == 18
    assert many.found.estimate == pytest.approx(10**0.3, rel=0.15) and many.found.domains == 3
    assert {few.verdict, many.verdict} == {"undecided"}, "the paper's step is from 10⁵ to 10⁶"


def test_materials_are_paired_by_attachment_and_bodies(swept: Path) -> None:
    of = read(swept, "horizon_sweep")
    frame = of.frame.copy()
    flexible = frame["material"] == "flexible"
    frame.loc[flexible, "euclidean"] *= 3
    frame.loc[flexible, "mse"] *= 9
    before, after = (list(findings.of_material(each)) for each in (of, replace(of, frame=frame)))
    for one, other in zip(before, after, strict=True):
        assert one.found.domains == 6
        assert other.found.estimate == pytest.approx(3 * one.found.estimate)
    assert ["standard deviation" in one.statistic for one in after] == [False, False, True, True]


def test_the_spread_of_errors_is_that_of_the_distances() -> None:
    missed = np.random.default_rng(0).normal(scale=0.002, size=(50, 32, 2))  # m
    distance = np.linalg.norm(missed, axis=-1)
    rows = pd.DataFrame({"mse": [(missed**2).mean()], "euclidean": [distance.mean()]})
    assert findings.spread(rows).item() == pytest.approx(distance.std())


@pytest.mark.parametrize(("minutes", "steps", "decides"), [(1.0, 100, True), (1.0, 200, False), (None, 200, True)])
def test_materials_that_the_clock_gave_unequal_steps_decide_nothing(
    minutes: float | None, steps: int, decides: bool, swept: Path
) -> None:
    of = read(swept, "horizon_sweep")
    material = of.frame.groupby("domain")["material"].first()
    fits = [
        FitReport(
            trajectories=500,
            horizon=1,
            domain=domain,
            seconds=1,
            curve=[{"step": float(steps if material[domain] == "flexible" else 100)}],
        )
        for domain in material.index
    ]
    (record,) = of.records
    about = record.provenance.model_copy(update={"budget": {"steps": None, "minutes": minutes}})
    told = replace(of, records=(record.model_copy(update={"fits": fits, "provenance": about}),))
    assert [one.decides for one in findings.of_material(told)] == [decides] * 4


@pytest.mark.parametrize(
    ("found", "unit", "verdict"),
    [
        (Interval(1.5, 1.1, 2.0, 5, 1), "×", "confirmed"),
        (Interval(1.5, 0.9, 2.0, 5, 1), "×", "undecided"),
        (Interval(0.5, 0.4, 0.6, 5, 1), "×", "contradicted"),
        (Interval(0.5, 0.4, 0.6, 5, 1), "10⁻⁴ m²", "confirmed"),
        (Interval(-0.5, -0.6, -0.4, 5, 1), "10⁻⁴ m²", "contradicted"),
        (Interval(0.5, None, None, 1, 1), "10⁻⁴ m²", "undecided"),
    ],
)
def test_a_verdict_follows_from_the_interval(found: Interval, unit: str, verdict: str) -> None:
    assert Answer("", "", found, unit).verdict == verdict
    assert Answer("", "", found, unit, decides=False).verdict == "undecided"


def test_maml_is_held_against_multitask_as_on_the_board() -> None:
    meta = read(RESULTS, "meta")
    (one,) = [a for a in findings.of_learning(meta) if "multitask" in a.statistic and "K = 10" in a.statistic]
    means = {
        name: meta.where(name=name, K=10, trajectories=meta.frame["trajectories"].max()).frame["mse"].mean()
        for name in ("maml", "multitask")
    }
    assert one.found.estimate == pytest.approx(means["multitask"] - means["maml"], rel=1e-6)


def test_a_race_is_told_apart_and_decides_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    untimed = [one for one in read(RESULTS, "meta").records if one.model in ("maml", "multitask")]
    timed = [
        one.model_copy(
            update={
                "config": one.config[::-1],
                "provenance": one.provenance.model_copy(update={"budget": {"steps": None, "minutes": 4.0}}),
            }
        )
        for one in untimed
    ]
    monkeypatch.setattr(findings, "everything", lambda results: untimed)
    assert not list(findings.of_race(RESULTS))
    monkeypatch.setattr(findings, "everything", lambda results: [*untimed, *timed])
    found = list(findings.of_race(RESULTS))
    assert found and all("fits of 4 minutes" in one.statistic and not one.decides for one in found)


def test_nothing_to_go_by_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="dlobench run --task horizon_sweep"):
        findings.answers(tmp_path)


def test_the_page_has_the_tables_of_the_committed_records(tmp_path: Path) -> None:
    findings.draw(RESULTS, tmp_path)
    table1.draw(RESULTS, tmp_path)
    for table in (TABLE, *TABLE.parent.glob("table1.*")):
        assert table.read_text() == (tmp_path / table.name).read_text(), "make leaderboard"


def test_the_page_answers_all_five() -> None:
    text = PAGE.read_text()
    titles = re.findall(r"^## ([1-5])\. .*: (confirmed|contradicted|undecided)", text, flags=re.M)
    assert [number for number, _ in titles] == list("12345")
    summary = re.findall(r"^\| ([1-5])\. [^|]*\| (confirmed|contradicted|undecided)", text, flags=re.M)
    assert summary == titles, "the table above says the same"
    verdicts: dict[str, list[str]] = {}
    for one in findings.answers(RESULTS)[0]:
        verdicts.setdefault(one.finding[0], []).extend([one.verdict] if one.decides else [])
    for number, verdict in titles:
        assert verdict in (verdicts.get(number) or ["undecided"]), f"finding {number} has another verdict in the table"
