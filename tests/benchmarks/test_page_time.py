"""Measures how long the page of a thousand records takes on top of their table, beside `json.dumps` of the records.

Nothing is asserted about time: machines differ. Where benchmarks are disabled, all run once on a few records.
"""

from __future__ import annotations

import json
import time

import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from rates import Tables
from test_board import SHAPES, records  # type: ignore[import-not-found]

from dlobench.bench import leaderboard

pytest.importorskip("itables", reason="itables is not installed: pip install 'dlobench[page]'")
pytest.importorskip("vl_convert", reason="vl-convert is not installed: pip install 'dlobench[page]'")

TITLE = "seconds for the page of 1,000 records, each of 3 cells of 48 domains"


@pytest.mark.parametrize("name", SHAPES)
def test_page(benchmark: BenchmarkFixture, tables: Tables, name: str) -> None:
    from dlobench.bench.page import build
    from dlobench.bench.page.libraries import libraries

    made = records(*(SHAPES[name] if benchmark.enabled else (1, 3, 2)))
    frame = leaderboard.table(made)
    page = benchmark.pedantic(lambda: build(made, frame), rounds=3)  # type: ignore[no-untyped-call]
    begin = time.perf_counter()
    libraries()
    bundled = time.perf_counter() - begin
    begin = time.perf_counter()
    written = json.dumps([record.model_dump(mode="json") for record in made]).encode()
    peer = time.perf_counter() - begin
    assert b"<table" in page
    if benchmark.enabled:
        seconds = benchmark.stats.stats.min  # type: ignore[union-attr]
        line = f"{name:32}{seconds:6.2f} ({bundled:.2f} bundling the libraries), {len(page) / 1e6:.2f} MB; "
        line += f"json.dumps of the records {peer:.2f}, {len(written) / 1e6:.1f} MB, × {seconds / peer:.2f}"
        tables.setdefault(TITLE, []).append(line)
