"""Measures how long a board of a thousand records takes, beside a table of means by pandas of the same files.

The peer reads the same JSON with the standard library and averages it with pandas by cell and configuration, whose keys
are categories: no check, no interval, no place, no rank. Nothing is asserted about time: machines differ. Where
benchmarks are disabled, all run once on a few records.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from rates import Tables
from test_results import record

from dlobench.bench import leaderboard, results
from dlobench.bench.record import Record
from dlobench.bench.results import read_all

TITLE = "seconds of processor time for a board of 1,000 records, each of 3 cells of 48 domains"
DOMAINS, CELLS = 48, 3
KEYS = ["task", "scale", "cell", "model", "config"]
SHAPES = {"4 tasks × 50 models × 5 seeds": (4, 50, 5), "1 task × 1,000 models × 1 seed": (1, 1000, 1)}

pytestmark = pytest.mark.benchmark(timer=time.process_time)  # other processes may want the core


def records(tasks: int, models: int, seeds: int) -> list[Record]:
    """Makes records of models that differ a little, on domains of which some are hard."""
    rng = np.random.default_rng(0)
    hard, out = 4e-4 * np.exp(rng.normal(size=DOMAINS)), []
    for task in range(tasks):
        for model in range(models):
            share = rng.uniform(0.2, 0.8)
            for seed in range(seeds):
                base = record(model=f"m{model}", seed=seed, K=tuple(range(CELLS)))
                like = base.cells[0].domains[0]
                cells = []
                for cell in base.cells:
                    errors = hard * share * np.exp(0.1 * rng.normal(size=DOMAINS))
                    domains = [
                        like.model_copy(
                            update={
                                "domain": f"meta-learning/{i:05d}",
                                "mse": float(e),
                                "persistence_mse": float(hard[i]),
                            }
                        )
                        for i, e in enumerate(errors)
                    ]
                    cells.append(cell.model_copy(update={"domains": domains}))
                out.append(base.model_copy(update={"task": f"task{task}", "cells": cells}))
    return out


def means(folder: Path) -> pd.DataFrame:
    """Returns the means of every score by cell and configuration, with nothing checked: the peer."""
    read = [json.loads(path.read_bytes()) for path in sorted(folder.rglob("seed*.json"))]
    cells = [(one, cell) for one in read for cell in one["cells"]]
    names = [name for name, column in cells[0][1]["domains"].items() if not isinstance(column[0], str)]
    frame = pd.DataFrame({name: np.concatenate([cell["domains"][name] for _, cell in cells]) for name in names})
    sizes = [len(cell["domains"]["domain"]) for _, cell in cells]
    for name in KEYS:
        values = [cell["id"] if name == "cell" else one[name] for one, cell in cells]
        frame[name] = pd.Categorical.from_codes(*_codes(values, sizes))
    return frame.groupby(KEYS, observed=True)[names].mean().reset_index()


def _codes(values: list[str], sizes: list[int]) -> tuple[Any, Any]:
    codes, names = pd.factorize(np.array(values))
    return np.repeat(codes, sizes), names


@pytest.fixture(scope="module", params=SHAPES)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Returns a folder of records, few where benchmarks are disabled."""
    shape = SHAPES[request.param] if request.config.getoption("benchmark_enable") else (1, 3, 2)
    out = tmp_path_factory.mktemp("runs")
    for one in records(*shape):
        results.write(one, out)
    return request.param, out


def measure(benchmark: BenchmarkFixture, work: Any) -> tuple[Any, float]:
    """Returns what work returns and the seconds that its fastest round took."""
    out = benchmark.pedantic(work, rounds=3, warmup_rounds=1)  # type: ignore[no-untyped-call]
    return out, benchmark.stats.stats.min if benchmark.enabled else 0.0  # type: ignore[union-attr]


def test_board(benchmark: BenchmarkFixture, tables: Tables, folder: tuple[str, Path]) -> None:
    name, runs = folder
    board, seconds = measure(benchmark, lambda: leaderboard.table(read_all(runs)))
    of_peer, peer = [], []
    for _ in range(3 if benchmark.enabled else 1):
        begin = time.process_time()
        of_peer.append(means(runs))
        peer.append(time.process_time() - begin)
    there = read_all(runs)
    begin = time.process_time()
    leaderboard.table(there)
    of_table = time.process_time() - begin
    assert len(board) == len(of_peer[0])
    merged = board.merge(of_peer[0], on=KEYS)
    assert merged["mse_m2"].to_numpy() == pytest.approx(merged["mse"].to_numpy()), "both average the same"
    if benchmark.enabled:
        line = f"{name:32}{seconds:6.2f} ({seconds - of_table:.2f} read and checked, {of_table:.2f} table)"
        tables.setdefault(TITLE, []).append(f"{line}; means by pandas {min(peer):.2f}, × {seconds / min(peer):.2f}")
