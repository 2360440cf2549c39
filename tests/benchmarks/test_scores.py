"""Measures how many predictions a second each score takes on one core.

Nothing is asserted about time: machines differ. A prediction is what a model says of one query: one shape for the
scores of points, 99 samples for those of samples.
Where benchmarks are disabled, every score runs once on few predictions.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from rates import Tables

from dlobench.bench import calibration, metrics, sampled, validity
from dlobench.trajectories import Floats

MASK = np.ones(32, bool)  # the longest DLOs
POINTS, QUERIES, SAMPLES = 1_000_000, 100, 99
TITLE = "predictions scored per second of processor time"

pytestmark = pytest.mark.benchmark(timer=time.process_time)  # other processes may want the core


def shapes(rng: np.random.Generator, *sizes: int) -> Floats:
    """Returns straight DLOs with noise, float32."""
    line = np.zeros((32, 2), np.float32)
    line[:, 0] = 0.005 * np.arange(32)
    out = rng.standard_normal((*sizes, 32, 2), dtype=np.float32)
    out *= 0.001
    out += line
    return out


def measure(benchmark: BenchmarkFixture, tables: Tables, name: str, count: int, score: Callable[[], Any]) -> None:
    """Runs a score, and puts its rate into the table that is printed at the end."""
    out = np.asarray(benchmark.pedantic(score, rounds=3, warmup_rounds=1))  # type: ignore[no-untyped-call]
    assert np.isfinite(out).all()
    if benchmark.enabled:
        seconds = benchmark.stats.stats.min  # type: ignore[union-attr]
        tables.setdefault(TITLE, []).append(f"{name:32}{count / seconds:16,.0f}")


@lru_cache(maxsize=1)
def points(count: int) -> tuple[Floats, Floats]:
    """Returns predictions and truths, float32: a gigabyte for two million."""
    true = shapes(np.random.default_rng(0), count)
    return true + np.float32(0.001), true


@pytest.mark.parametrize("score", [metrics.mse, metrics.euclidean, metrics.shape_error], ids=lambda each: each.__name__)
def test_points(benchmark: BenchmarkFixture, tables: Tables, score: metrics.Score) -> None:
    predicted, true = points(POINTS if benchmark.enabled else 2000)
    measure(benchmark, tables, score.__name__, len(true), lambda: score(predicted, true, MASK))


@pytest.mark.parametrize("score", [validity.spacing_error, validity.self_overlap], ids=lambda each: each.__name__)
def test_validity(benchmark: BenchmarkFixture, tables: Tables, score: Callable[..., float]) -> None:
    dlo = points(POINTS if benchmark.enabled else 2000)[1][:50_000]
    measure(benchmark, tables, score.__name__, len(dlo), lambda: score(dlo, MASK))


SAMPLED = [sampled.energy, sampled.segment_energy, sampled.variogram, sampled.crps, sampled.mmd2]


@pytest.mark.parametrize("truths", [1, 64])
@pytest.mark.parametrize("score", SAMPLED, ids=lambda each: each.__name__)
def test_samples(benchmark: BenchmarkFixture, tables: Tables, score: metrics.Score, truths: int) -> None:
    rng = np.random.default_rng(0)
    queries = QUERIES if benchmark.enabled else 2
    M = max(truths, 2) if score is sampled.mmd2 else truths
    samples, true = shapes(rng, SAMPLES, queries), shapes(rng, M, queries)
    name = f"{score.__name__}, S = {SAMPLES}, M = {M}"
    measure(benchmark, tables, name, queries, lambda: score(samples, true, MASK))


@pytest.mark.parametrize("ranking", [calibration.ranks, calibration.shape_ranks], ids=lambda each: each.__name__)
def test_ranks(benchmark: BenchmarkFixture, tables: Tables, ranking: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    queries = QUERIES if benchmark.enabled else 2
    samples, true = shapes(rng, SAMPLES, queries), shapes(rng, 1, queries)
    name = f"{ranking.__name__}, S = {SAMPLES}, M = 1"
    measure(benchmark, tables, name, queries, lambda: ranking(samples, true, MASK, rng))
