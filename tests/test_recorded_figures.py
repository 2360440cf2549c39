"""Tests the figures that are drawn from records: what they compute, what they choose, and that all are drawn."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from itertools import combinations
from pathlib import Path

import bias
import calibration
import drawing
import length
import numpy as np
import ood
import pareto
import physics
import power_law
import pytest
import recorded
import support
import table1
from matplotlib.image import imread
from test_results import record

from dlobench.bench.record import FitReport, Record
from dlobench.bench.results import config_digest, write
from dlobench.bench.statistics import Interval
from dlobench.data.sets import domain, find
from dlobench.errors import RunError, UsageError

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "leaderboard" / "results"
SCRIPTS = [
    "bias", "calibration", "fig3", "length", "ood", "pareto", "physics", "power_law", "support", "table1",
]  # fmt: skip
HORIZONS, SIZES = (1, 4), (50, 500, 5000)


def sweep(
    task: str, model: str, level: float, exponent: float, *, sizes: Sequence[int] = SIZES, target: str = "displacement"
) -> Record:
    """Makes a record of 18 domains, of which every sixth has the largest size, with errors of a power law."""
    rng = np.random.default_rng(7)
    of = find("single-domain-large")
    height = level * np.exp(0.2 * rng.normal(size=18))
    base = record(model=model, config=config_digest(task=task, model=model, target=target))
    one = base.cells[0].domains[0]
    cells = []
    for size in sizes:
        for n in HORIZONS:
            domains = []
            for i in range(18):
                if size == SIZES[-1] and i % 6:
                    continue
                error = float(height[i] * n**0.7 * (20 * size) ** -exponent * np.exp(0.05 * rng.normal()))
                place = of.cell(i)
                cell = f"{place.material}-{place.attachment}-16cm-{place.rigid_objects}"
                spread = dict.fromkeys(("ranks", "shape_ranks"), [5] * 20) | {"coverage50": 0.4, "coverage90": 0.8}
                samples = {"energy": error, "energy_floor": error / 4, "persistence_energy": 3 * error} | spread
                domains.append(
                    one.model_copy(
                        update={"domain": f"{of.name}/{i}", "cell": cell, "euclidean": error, "mse": error**2}
                        | (samples if task == "distribution" else {})
                    )
                )
            id_ = f"{task}/trajectories{size}-h{n}"
            update = {"id": id_, "trajectories": size, "horizon": n, "K": 0, "domains": domains}
            cells.append(base.cells[0].model_copy(update=update))
    about = base.provenance.model_copy(update={"hyperparameters": {"target": target}})
    fits = [FitReport(trajectories=size, horizon=n, seconds=1, curve=[]) for size in sizes for n in HORIZONS]
    return base.model_copy(update={"task": task, "scale": "small", "cells": cells, "fits": fits, "provenance": about})


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a results folder of sweeps that are power laws, and of samples."""
    results = tmp_path_factory.mktemp("swept")
    write(sweep("horizon_sweep", "mlp", 0.05, 0.30), results)
    write(sweep("horizon_sweep", "mlp", 0.10, 0.30, target="absolute"), results)
    write(sweep("horizon_sweep", "gnn", 0.02, 0.20), results)
    write(sweep("distribution", "mlp_gaussian", 0.02, 0.0, sizes=(500,)), results)
    write(sweep("distribution", "flow", 0.01, 0.0, sizes=(500,)), results)
    return results


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Draws few pixels, which takes less time."""
    style = tmp_path_factory.mktemp("style") / "coarse.mplstyle"
    style.write_text(drawing.STYLE.read_text().replace("savefig.dpi: 200", "savefig.dpi: 40"))
    monkeypatch.setattr(drawing, "STYLE", style)


def drawn(script: str, results: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> str | None:
    """Runs a script; returns what it lacks, or None once its files are there and none is empty."""
    status = drawing.main(import_module(script).draw, ["--results", str(results), "--out", str(out)])
    said = capsys.readouterr().err
    if status:
        assert status == 1 and said.count("\n") == 1 and not list(out.glob("*"))
        return said
    suffixes = (".md", ".tex") if script == "table1" else (".pdf", ".png")
    assert all((out / f"{script}{suffix}").stat().st_size > 200 for suffix in suffixes)
    return None


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_script_draws_the_committed_records_or_says_what_to_run(
    script: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lacks = drawn(script, RESULTS, tmp_path, capsys)
    assert lacks is None or "`dlobench run --task" in lacks
    if script in ("length", "ood", "pareto", "physics", "support", "table1"):  # of these there are records
        assert lacks is None


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_script_says_what_to_run_where_nothing_is(
    script: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "`dlobench run --task" in (drawn(script, tmp_path / "none", tmp_path / "out", capsys) or "")


@pytest.mark.parametrize("script", ["bias", "calibration", "fig3", "power_law"])
def test_sweeps_and_samples_are_drawn(
    script: str, swept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert drawn(script, swept, tmp_path, capsys) is None


def test_pages_show_what_the_committed_records_draw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(drawing, "STYLE", Path(drawing.__file__).parent / "style.mplstyle")
    shown = set(re.findall(r"\(pictures/(\w+)\.png\)", (ROOT / "docs" / "findings.md").read_text()))
    assert len(shown) > 5
    for script in sorted(name for name in SCRIPTS if any(each.startswith(name) for each in shown)):
        assert drawn(script, RESULTS, tmp_path, capsys) is None
    for name in sorted(shown):
        new, old = (imread(folder / f"{name}.png")[..., :3] for folder in (tmp_path, ROOT / "docs" / "pictures"))
        assert new.shape == old.shape, f"{name}: python paper_figures --pages"
        off = (np.abs(new - old).max(axis=-1) > 0.35).sum()  # what fewer colours change stays below
        assert off < 30, f"{name}: {off} pixels are others; python paper_figures --pages"


def test_a_script_runs_on_its_own(tmp_path: Path) -> None:
    command: list[str | Path] = [sys.executable, ROOT / "paper_figures" / "table1.py", "--out", tmp_path]
    subprocess.run(command, check=True, cwd=tmp_path)
    assert "| multitask |" in (tmp_path / "table1.md").read_text()
    assert r"neural\_process" in (tmp_path / "table1.tex").read_text()


def test_table_1_has_the_numbers_of_the_board() -> None:
    of = recorded.read(RESULTS, "meta")
    found = table1.numbers(of)
    configs = set(zip(of.frame["model"], of.frame["config"], strict=True))
    with (RESULTS.parent / "leaderboard.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["task"] == "meta" and row["scale"] == of.scale]
    rows = [row for row in rows if (row["model"], row["config"]) in configs]
    assert len(rows) == len(found) > 20
    names = {(record.model, record.config): recorded.label(record) for record in of.records}
    for row in rows:
        one = found[names[row["model"], row["config"]], int(row["trajectories"]), int(row["K"])]
        expected = [float(row[column]) for column in ("mse_m2", "mse_low", "mse_high")]
        assert [one.estimate, one.low, one.high] == pytest.approx(expected, rel=1e-6)
    table = table1.rows(of)
    most = int(of.frame["trajectories"].max())
    best = f"{1e4 * found['gnn_context', most, 10].estimate:.2f} "
    assert next(row for row in table if row[0] == "gnn_context")[table[0].index("K = 10")].startswith(best)
    assert [row[2:] for row in table[-2:]] == [["1.54", "1.45", "1.17", "1.08"], ["1.85", "1.56", "1.30", "1.21"]]


def test_the_largest_scale_and_the_newest_configuration_with_most_seeds_are_chosen() -> None:
    def made(
        config: str,
        seed: int,
        day: int,
        scale: str = "small",
        target: str = "displacement",
        minutes: float | None = None,
    ) -> Record:
        one = record(config=config, seed=seed)
        about = {
            "created": f"2026-01-{day:02d}T00:00:00+00:00",
            "hyperparameters": {"target": target},
            "budget": {"steps": None, "minutes": minutes},
        }
        return one.model_copy(update={"scale": scale, "provenance": one.provenance.model_copy(update=about)})

    old = [made("aaaaaaaa", seed, 1) for seed in (0, 1)]
    new = [made("bbbbbbbb", seed, 2) for seed in (0, 1)]
    others = [made("cccccccc", 0, 3), made("dddddddd", 0, 4, target="absolute"), made("eeeeeeee", 0, 5, scale="mini")]
    found = recorded.choose([*others, *new, *old], "meta")
    assert [one.config for one in found] == ["bbbbbbbb", "bbbbbbbb", "dddddddd"]
    assert [recorded.label(one) for one in found] == ["mlp", "mlp", "mlp (absolute)"]
    assert recorded.choose(others[2:], "rollout", "meta") == others[2:]
    timed = [made("ffffffff", seed, 6, minutes=4.0) for seed in (0, 1, 2)]
    assert [one.config for one in recorded.choose([*timed, *old], "meta")] == ["aaaaaaaa", "aaaaaaaa"]
    assert recorded.choose(timed, "meta") == timed, "better than none"
    with pytest.raises(RunError, match="`dlobench run --task rollout"):
        recorded.choose(others, "rollout")


def test_models_that_are_not_known_beforehand_are_told_apart() -> None:
    looks = [recorded.look(name) for name in (*recorded.ORDER, "mine", "yours", "mlp (absolute, raw)", "maml (N = 50)")]
    assert all(one != other for one, other in combinations(looks, 2))
    assert recorded.look("mine") == recorded.look("mine")


def test_mamls_of_another_n_have_a_row_of_their_own(tmp_path: Path) -> None:
    """The paper's Table 1 has a row for N = 5 and one for N = 50."""
    five = next(one for one in recorded.everything(RESULTS) if one.task == "meta" and one.model == "maml")
    hyper = five.provenance.hyperparameters
    assert hyper["N"] == recorded.USUAL_N["maml"]
    about = five.provenance.model_copy(update={"hyperparameters": hyper | {"N": 50}})
    for one in (five, five.model_copy(update={"config": "ffffffff", "provenance": about})):
        write(one, tmp_path / "results")
    table1.draw(tmp_path / "results", tmp_path)
    text = (tmp_path / "table1.md").read_text()
    assert "| maml |" in text and "| maml (N = 50) |" in text and "N of maml is 5, unless" in text


def test_a_power_law_is_recovered_with_its_interval() -> None:
    """Checks that intervals hold the truth about as often as they say, though few domains have the largest size."""
    sizes, exponent, a = np.array([1e3, 1e4, 1e5]), 0.3, 0.03
    names = tuple(map(str, range(18)))
    held = {"exponent": 0, "pushes": 0}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        slopes, heights = exponent + 0.03 * rng.normal(size=18), a * np.exp(0.3 * rng.normal(size=18))
        heights *= 1e3 ** (slopes - exponent)  # so that domains differ most where they end, not where they begin
        errors = (heights * sizes[:, None] ** -slopes * np.exp(0.05 * rng.normal(size=(3, 18))))[:, None]
        errors[2, :, 3:] = np.nan
        law = power_law.fit(sizes, errors, ("0",), names)
        assert law.exponent.estimate == pytest.approx(exponent, abs=0.05)
        assert law.a == pytest.approx(a, rel=0.6)
        needed = (a / power_law.TARGET) ** (1 / exponent)
        for what, found, true in (("exponent", law.exponent, exponent), ("pushes", law.pushes, needed)):
            assert found.low is not None and found.high is not None
            held[what] += found.low <= true <= found.high
    assert min(held.values()) >= 34


@pytest.mark.parametrize(("last", "bends"), [(0.3, False), (0.1, True)])
def test_a_law_that_the_last_step_contradicts_bends(last: float, bends: bool) -> None:
    rng = np.random.default_rng(1)
    errors = np.array([1.0, 10**-0.3, 10 ** -(0.3 + last)])[:, None, None] * np.exp(0.01 * rng.normal(size=(3, 1, 18)))
    errors[2, :, 3:] = np.nan
    law = power_law.fit(np.array([1e3, 1e4, 1e5]), errors, ("0",), tuple(map(str, range(18))))
    assert law.bends == bends
    assert law.last.estimate == pytest.approx(last, abs=0.02) and law.last.domains == 3


def test_a_model_without_sizes_at_a_horizon_keeps_no_other_from_its_law(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gnn = sweep("horizon_sweep", "gnn", 0.02, 0.2)
    cells = [cell for cell in gnn.cells if cell.horizon == 1 or cell.trajectories == SIZES[0]]
    for one in (sweep("horizon_sweep", "mlp", 0.05, 0.3), gnn.model_copy(update={"cells": cells})):
        write(one, tmp_path / "results")
    assert drawn("power_law", tmp_path / "results", tmp_path / "out", capsys) is None
    text = (tmp_path / "out" / "power_law.md").read_text()
    assert [f"| {model} | {n} |" in text for model in ("mlp", "gnn") for n in HORIZONS] == [True, True, True, False]
    assert "too few sizes and domains for a law: gnn at n = 4" in text


def test_what_does_not_fall_never_reaches_the_target() -> None:
    sizes, names = np.array([1e3, 1e4]), tuple("abcdef")
    flat = 0.01 * np.exp(1e-3 * np.random.default_rng(0).normal(size=(2, 1, 6)))
    assert power_law.said(power_law.fit(sizes, flat, ("0",), names).pushes, 1e7) == "> 1e+07"
    assert power_law.said(Interval(2e4, 1e4, np.inf, 6, 1), 1e7) == "2.0e+04 (1.0e+04 to > 1e+07)"
    with pytest.raises(UsageError, match="two domains that have two sizes"):
        power_law.fit(sizes[:1], flat[:1], ("0",), names)


def test_laws_and_changes_are_those_of_the_records(swept: Path) -> None:
    of = recorded.read(swept, "horizon_sweep")
    laws = power_law.laws(of)
    for name, exponent in (("mlp", 0.3), ("mlp (absolute)", 0.3), ("gnn", 0.2)):
        one = laws[name, 4].exponent
        assert one.low is not None and one.high is not None and one.low - 0.01 <= exponent <= one.high + 0.01
    changes = bias.changes(of)
    assert {pushes for pushes, *_ in changes} == {1000, 10_000}  # few domains have more
    doubled = changes[1000, 1, "all domains", "mlp (absolute)"]
    assert doubled.estimate == pytest.approx(1.0) and doubled.domains == 18
    assert changes[1000, 1, "flexible", "gnn"].domains == 6


def test_scores_of_samples_are_set_beside_the_floor_and_the_gaussian(swept: Path) -> None:
    of = recorded.read(swept, "distribution").where(horizon=4)
    assert calibration.normalised(of, "flow", "mlp_gaussian").estimate == pytest.approx(0.5)  # half of its errors
    assert calibration.normalised(of, "flow", None).estimate == pytest.approx(0.75 / 2.75)  # of persistence's
    assert calibration.histogram(of, "flow", 4, "ranks") == pytest.approx(np.ones(20))


def test_a_known_effect_is_recovered_and_none_is_found_where_none_is() -> None:
    names = tuple(f"meta-learning/{i}" for i in range(0, 6300, 45))
    columns = physics.design([domain(name) for name in names])
    assert list(columns) == [
        "friction", "density", "length", "log stiffness", "it yields", "log yield curvature", "movable attachment",
        "fixed attachment", "rigid bodies",
    ]  # fmt: skip
    assert not columns["log yield curvature"][columns["it yields"] == 0].any()
    rng = np.random.default_rng(0)
    y = 0.2 * columns["log stiffness"] - 0.5 * columns["fixed attachment"] + 0.1 * rng.normal(size=(2, len(names)))
    found = physics.regress(columns, y, ("0", "1"), names)
    for name, one in found.effects.items():
        true = {"log stiffness": 0.2, "fixed attachment": -0.5}.get(name, 0.0)
        assert one.estimate == pytest.approx(true, abs=0.05)
        assert one.tie is (true == 0) or name not in ("log stiffness", "fixed attachment")
    assert found.explained > 0.9
    with pytest.raises(UsageError, match="do not tell"):
        physics.regress({name: one[:8] for name, one in columns.items()}, y[:, :8], ("0", "1"), names[:8])


def test_the_ratio_of_two_models_has_the_difference_of_their_effects() -> None:
    of = recorded.read(RESULTS, "meta").where(K=10)
    of = of.where(name=["maml", "multitask"], trajectories=of.frame["trajectories"].max())
    found = physics.regressions(of)
    assert list(found) == ["multitask", "maml", "maml ÷ multitask"]
    for name, one in found["maml ÷ multitask"].effects.items():
        apart = found["maml"].effects[name].estimate - found["multitask"].effects[name].estimate
        assert one.estimate == pytest.approx(apart)


def test_lengths_are_paired_by_what_else_tells_domains_apart() -> None:
    of = recorded.read(RESULTS, "length_sweep")
    before = length.growth(of)
    frame = of.frame.copy()
    frame.loc[frame["length"] == "16cm", "euclidean"] *= 3
    after = length.growth(replace(of, frame=frame))
    assert list(before) == [(name, n) for name in of.names for n in (1, 2, 4, 8)]
    for key, one in before.items():
        assert one.domains == 9 and after[key].estimate == pytest.approx(3 * one.estimate)


def test_what_is_the_same_everywhere_has_no_effect() -> None:
    names = [f"meta-learning/{i}" for i in range(6300) if find("meta-learning").cell(i).length == 0.16][:40]
    assert "length" not in physics.design([domain(name) for name in names])


def test_only_what_adapts_gains() -> None:
    of = recorded.read(RESULTS, "meta")
    assert {"gnn_context", "neural_process"} <= set(recorded.adapting(of)).difference(("mlp", "gnn", "persistence"))
    gain = support.gains(of)["gnn_context", 10]
    by_K = of.where(name="gnn_context").frame.groupby("K")["euclidean"].mean()
    assert gain.estimate == pytest.approx(by_K[0] - by_K[10])


def test_a_gap_is_over_the_domains_of_its_region() -> None:
    of = recorded.read(RESULTS, "ood")
    found = ood.gap(of, "multitask", "soft", 0)
    assert found is not None
    frame = of.where(name="multitask", K=0, material="soft").frame.pivot_table(
        index="domain", columns="cell", values="euclidean"
    )
    pair = frame[["ood/trajectories20-h4-k0-without-soft", "ood/trajectories20-h4-k0"]].dropna()
    assert found[0].domains == len(pair) == len(frame)
    assert found[0].estimate == pytest.approx(float((pair.iloc[:, 0] - pair.iloc[:, 1]).mean()))
    assert ood.gap(of, "multitask", "nowhere", 0) is None


def test_the_front_holds_what_nothing_cheaper_beats() -> None:
    points = {"cheap": (0.0, 9.0), "bad": (1.0, 9.5), "good": (2.0, 3.0), "dear": (5.0, 3.0), "best": (9.0, 1.0)}
    assert pareto.front(points) == ["cheap", "good", "best"]
