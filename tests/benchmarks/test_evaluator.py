"""What the bench adds to a model's own work, and what starting the command line costs. Run by `make bench`."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from test_journal import Quiet
from toy import toy_domains

from dlobench.bench.fitting import Parts, fit_and_score
from dlobench.bench.model import Setting
from dlobench.bench.order import Order, order
from dlobench.bench.plugins import ModelPlugin, load_model, load_task
from dlobench.bench.sandbox import Sandbox
from dlobench.nn.budget import Budget

STEPS = 10_000  # of a fit; `mlp` takes up to 40,000. Where benchmarks are disabled, a hundredth
TOYS = toy_domains(72, trajectories=20, pushes=20, segments=32)


def ordered(plugin: ModelPlugin, steps: int) -> Order:
    """Orders meta/mini."""
    return order(load_task("meta"), "mini", plugin, None, None, budget=Budget(steps=steps), settings={"patience": 100})


def parts(wanted: Order) -> Parts:
    """Returns toy trajectories for all that the order reads."""
    toys = iter(TOYS)
    return {
        part: {f"meta-learning/{span.domain:05d}": next(toys) for span in spans} for part, spans in wanted.spans.items()
    }


def bare(steps: int) -> float:
    """Does a model's own work by hand: fit, adapt to every support, predict every query. Returns seconds."""
    wanted = ordered(load_model("mlp"), steps)
    data, scale = parts(wanted), wanted.task.mini
    begin = time.perf_counter()
    model = wanted.plugin.model(seed=0, **wanted.settings)
    model.fit([*data["train"].values()], [*data["valid"].values()], Setting(4, wanted.K, wanted.budget))
    for K in wanted.K:
        for there in data["test"].values():
            query, _ = there.take(slice(scale.support, None)).windows(4)
            for first in range(0, scale.support if K else 1, K or 1):
                model.adapt(there.take(slice(first, first + K))).predict(query, 1)
    return time.perf_counter() - begin


def benched(steps: int) -> float:
    """Has the bench do the same, with all scores, the plugin in a process of its own. Returns seconds."""
    with Sandbox() as sandbox:
        plugin = sandbox.load("mlp")
        wanted, short = ordered(plugin, steps), ordered(plugin, steps=2)
        data = parts(wanted)
        fit_and_score(short, short.fits[0], data, title="", reporter=Quiet())  # torch takes a second to wake up
        begin = time.perf_counter()
        fit_and_score(wanted, wanted.fits[0], data, title="", reporter=Quiet())
        return time.perf_counter() - begin


def paired(benchmark: BenchmarkFixture, ours: Callable[[], float], peer: Callable[[], float], rounds: int) -> None:
    """Times ours and its peer in turn, and notes the ratio of the medians."""
    pairs = []

    def one() -> None:
        pairs.append((ours(), peer()))

    benchmark.pedantic(one, rounds=rounds, warmup_rounds=1)  # type: ignore[no-untyped-call]
    mine, theirs = (sorted(each)[len(pairs) // 2] for each in zip(*pairs, strict=True))
    benchmark.extra_info |= {"ours_s": round(mine, 4), "peer_s": round(theirs, 4), "ratio": round(mine / theirs, 4)}


@contextmanager
def _shown(benchmark: BenchmarkFixture, what: str, capsys: pytest.CaptureFixture[str]) -> Iterator[None]:
    yield
    if benchmark.enabled:
        with capsys.disabled():
            print(f"\n{what}: {dict(benchmark.extra_info)}")  # noqa: T201


def test_what_the_bench_adds_to_fit_and_predict(
    benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    with _shown(benchmark, "bench ÷ fit, adapt and predict by hand", capsys):
        steps = STEPS if benchmark.enabled else STEPS // 100
        paired(benchmark, lambda: benched(steps), lambda: bare(steps), rounds=3)


def seconds(*arguments: str) -> float:
    """Returns how long a Python takes for something."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
    return time.perf_counter() - begin


def test_what_starting_the_command_line_costs(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture[str]) -> None:
    with _shown(benchmark, "import of the command line ÷ python -c pass", capsys):
        paired(benchmark, lambda: seconds("-c", "import dlobench.cli"), lambda: seconds("-c", "pass"), rounds=15)
