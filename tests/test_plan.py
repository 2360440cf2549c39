"""Tests the plans: they count just what a generation makes, and what they measure is what it costs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_cli import Call, check_failed
from test_cli import call as call  # noqa: PLC0414  # a fixture
from test_store import write

from dlobench.data import cost
from dlobench.data.cost import Cost, cost_of, measure
from dlobench.data.domain_set import SCALES, Cell, DomainSet, Unit
from dlobench.data.generate import make_unit
from dlobench.data.plan import BLOCK, estimated_hours, plan, push_seconds
from dlobench.data.sets import SETS
from dlobench.data.store import Store

META, LARGE, FUTURES = SETS["meta-learning"], SETS["single-domain-large"], SETS["distribution"]


def here(function: Callable[[Any], Any], work: Iterable[Any]) -> Iterator[Any]:
    """Executes in this process."""
    return map(function, work)


def priced(price: Callable[[Unit], float], monkeypatch: pytest.MonkeyPatch) -> list[Unit]:
    """Lets shards cost what a function says, instead of simulating them; returns those that are asked for, in time."""
    asked: list[Unit] = []

    def fake(unit: Unit, store: Store) -> Cost:
        asked.append(unit)
        return Cost(core_seconds=price(unit), wall_seconds=2 * price(unit), sidecar=1500)

    monkeypatch.setattr(cost, "cost_of", fake)
    return asked


@pytest.mark.parametrize("of", SETS.values(), ids=SETS)
@pytest.mark.parametrize("scale", SCALES)
def test_a_plan_of_known_costs_is_exact(of: DomainSet, scale: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    priced(lambda _: 3.6, monkeypatch)
    spans = of.spans(scale)
    found = plan(of, spans, here, workers=4, seconds=0, progress=lambda *_: None)
    units = list(of.units(spans))
    assert (found.shards, found.files) == (len(units), 2 * len(units))
    assert found.pushes == sum(unit.count for unit in units) * of.pushes >= of.total(spans)
    assert found.core_hours == pytest.approx(len(units) * 0.001)
    assert found.wall_hours == pytest.approx(2 * found.core_hours / 4)
    assert found.uncertainty == pytest.approx(0, abs=1e-9)
    assert found.sidecar_bytes == 1500 * len(units)


def test_few_samples_represent_all_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Costs that differ from cell to cell, as real ones do, are averaged well by any number of samples."""

    def price(unit: Unit) -> float:
        return push_seconds(META.cell(unit.domain))

    spans = META.spans("paper")
    exact = estimated_hours(META, spans) / META.total(spans) * 3600
    for samples in (8, 13, 25, 40):
        monkeypatch.setattr(cost, "SAMPLES", samples)
        asked = priced(price, monkeypatch)
        found = plan(META, spans, here, workers=1, seconds=1e9, progress=lambda *_: None)
        assert len(asked) == found.samples == samples
        assert found.core_hours * 3600 / found.shards == pytest.approx(exact, rel=0.06)
    assert 0 < found.uncertainty < 0.15


def test_measuring_ends_in_time_and_tells_how_it_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(10_000))
    monkeypatch.setattr("dlobench.data.cost.time.perf_counter", lambda: float(next(clock)))
    asked, told = priced(lambda _: 1.0, monkeypatch), list[tuple[int, int]]()
    costs = measure(list(LARGE.units(LARGE.spans("mini"))), here, 30, lambda *state: told.append(state))
    assert len(costs) == len(asked) < 60
    assert told[-1][0] <= told[-1][1] == 30
    assert [done for done, _ in told] == sorted(done for done, _ in told)


@pytest.mark.parametrize("of", [META, LARGE, FUTURES], ids=lambda of: of.name)
def test_a_shard_is_as_large_as_planned(of: DomainSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, spans = Store(tmp_path), of.spans("mini")[:1]
    for unit in of.units(spans):
        write(store, of, unit)
    paths = [path for path in (tmp_path / of.key).rglob("*") if path.is_file()]
    sizes = {kind: [p.stat().st_size for p in paths if p.suffix == kind] for kind in (".npy", ".json")}
    monkeypatch.setattr(cost, "cost_of", lambda unit, store: Cost(1.0, 1.0, sum(sizes[".json"]) // len(sizes[".json"])))
    found = plan(of, spans, here, workers=1, seconds=0, progress=lambda *_: None)
    assert found.files == len(paths)
    assert found.array_bytes == sum(sizes[".npy"])
    assert found.sidecar_bytes == pytest.approx(sum(sizes[".json"]), rel=0.01)
    assert found.allocated_bytes == sum(-(-path.stat().st_size // BLOCK) * BLOCK for path in paths)


def test_a_real_shard_costs_what_was_measured(tmp_path: Path) -> None:
    """Within a factor, that is: the beginning of a shard is not all of it, and the machine does other things too."""
    of, store = META, Store(tmp_path / "made")
    unit = Unit(of.name, 0, 0, of.block)
    measured = cost_of(unit, Store(tmp_path / "measured"))
    make_unit(unit, store=store, of=of)
    sidecar = store.sidecar(of, unit)
    assert sidecar is not None
    assert 0.4 < measured.core_seconds / sidecar["seconds"] < 2.5
    assert measured.sidecar == pytest.approx(store.path(of, unit).with_suffix(".json").stat().st_size, abs=40)


def test_the_beginning_of_futures_is_of_their_kind() -> None:
    trajectories, _ = cost.beginning(FUTURES, Unit(FUTURES.name, 0, 0, FUTURES.block), 4)
    assert trajectories.dlo.shape[:2] == (4, FUTURES.pushes + 1)
    assert all(np.array_equal(trajectories.dlo[0, 0], other[0]) for other in trajectories.dlo), "all from one state"
    assert np.array_equal(trajectories.commanded[0], trajectories.commanded[1]), "executed again"
    assert not np.array_equal(trajectories.executed[0], trajectories.executed[1])


def test_estimates_grow_with_length_and_bodies() -> None:
    seconds = {(L, b): push_seconds(Cell("soft", "none", L, b)) for L in (0.10, 0.16) for b in (0, 3)}
    assert seconds[0.10, 0] < seconds[0.10, 3] < seconds[0.16, 3]
    assert seconds[0.10, 0] < seconds[0.16, 0]
    assert 1 / seconds[0.16, 0] == pytest.approx(156, rel=0.05)
    assert 1 / seconds[0.10, 0] == pytest.approx(356, rel=0.05)
    assert estimated_hours(LARGE, LARGE.spans("mini")) < estimated_hours(LARGE, LARGE.spans("small"))


def test_the_verb_says_that_it_measures_and_prints_what_it_found(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cost, "ENOUGH", 2)
    done = call("data", "plan", "single-domain-medium", "--workers", 1, "--seconds", 0, "--json")
    assert done.code == 0, done.err
    assert "simulates beginnings of shards on 1 of" in done.err
    (row,) = json.loads(done.out)
    assert (row["set"], row["scale"], row["shards"], row["workers"]) == ("single-domain-medium", "mini", 216, 1)
    assert row["samples"] >= 2
    assert 0.005 < row["core_hours"] < 5
    assert not (tmp_path / "data").exists(), "it keeps nothing"


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("moon",), ("moon", "meta-learning")),
        (("meta-learning", "--scale", "huge"), ("huge", "mini", "small", "paper")),
        (("meta-learning", "--workers", "0"), ("0",)),
        (("meta-learning", "--seconds", "-1"), ("-1", "--seconds")),
        (("meta-learning", "--seconds", "nan"), ("nan",)),
        ((), ("SET",)),
    ],
    ids=" ".join,
)
def test_bad_usage_of_a_plan_is_told_in_one_line(
    arguments: tuple[str, ...], parts: tuple[str, ...], call: Call
) -> None:
    check_failed(call("data", "plan", *arguments), 2, *parts)
