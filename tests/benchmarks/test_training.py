"""Measures training beside its peers: networks as a stack beside one by one and beside bare matrix products.

Two threads, float32, all sides in turn. Where benchmarks are disabled, all run once on little.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from itertools import pairwise

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from rates import Tables
from torch.utils.data import DataLoader, TensorDataset
from toy import toy_domains

from dlobench.nn.budget import Budget, Log
from dlobench.nn.fit import Plan
from dlobench.nn.regression import Job, Regression, regress_many
from dlobench.nn.windows import Windows, standardise
from dlobench.trajectories import Trajectories

STACK = "steps of networks (4 × 128, batch 64) a second; × how many times as fast the stack is"
pytestmark = pytest.mark.usefixtures("two_threads")


def in_turn(sides: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """Returns the median of what each side tells, seconds, when all take turns; a first turn is not counted."""
    told = [{side: measure() for side, measure in sides.items()} for _ in range(1 + rounds)][-rounds:]
    return {side: statistics.median(each[side] for each in told) for side in sides}


def stack(domains: list[Trajectories], steps: int) -> float:
    """Returns the seconds of a network's step while all are trained at once, between the first report and the last."""
    times: list[tuple[int, float]] = []
    how = Regression(
        width=128, depth=4, bodies=True, target="displacement", batch=64, plan=Plan(steps, 2e-4, patience=1)
    )
    log = Log([lambda step, *_: times.append((step, time.perf_counter()))])
    jobs = [Job([each], [], seed, log if not seed else Log()) for seed, each in enumerate(domains)]
    assert len(regress_many(how, jobs, horizon=1, device="cpu", budget=Budget())) == len(jobs)
    (first, begin), (last, end) = times[0], times[-1]
    return (end - begin) / (last - first) / len(jobs)


def loop(windows: Windows, steps: int) -> float:
    """Returns the seconds of a step as a page of PyTorch has it: modules, a `DataLoader`, autograd, fused Adam."""
    sizes = [windows.inputs.shape[-1], *[128] * 4]
    hidden = [part for a, b in pairwise(sizes) for part in (torch.nn.Linear(a, b), torch.nn.LeakyReLU())]
    network = torch.nn.Sequential(*hidden, torch.nn.Linear(128, 64))
    optimizer = torch.optim.Adam(network.parameters(), lr=2e-4, fused=True)
    data = TensorDataset(windows.inputs.flatten(0, 1), windows.targets.flatten(0, 1))
    loader = DataLoader(data, batch_size=64, shuffle=True, num_workers=0)
    done, begin = 0, time.perf_counter()
    while done < steps:
        for inputs, targets in loader:
            optimizer.zero_grad()
            torch.nn.functional.mse_loss(network(inputs), targets).backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            done += 1
    return (time.perf_counter() - begin) / done


def products(M: int, features: int, steps: int) -> float:
    """Returns the seconds of a network's share in the batched matrix products of a step, forward and back."""
    sizes = [features, *[128] * 4, 64]
    values = [torch.randn(M, 64, size) for size in sizes]
    weights = [torch.randn(M, a, b) / a**0.5 for a, b in pairwise(sizes)]
    made, slopes = [torch.empty_like(each) for each in values], [torch.empty_like(each) for each in weights]
    begin = time.perf_counter()
    for _ in range(steps):
        for k, weight in enumerate(weights):
            torch.bmm(values[k], weight, out=made[k + 1])
        for k, weight in reversed(list(enumerate(weights))):
            torch.bmm(values[k].mT, values[k + 1], out=slopes[k])
            if k:
                torch.bmm(values[k + 1], weight.mT, out=made[k])
    return (time.perf_counter() - begin) / steps / M


@pytest.mark.parametrize("M", [1, 18])
def test_networks_as_a_stack(benchmark: BenchmarkFixture, tables: Tables, M: int) -> None:
    M, steps, rounds = (M, 500 // M + 50, 7) if benchmark.enabled else (2, 2, 1)
    domains = toy_domains(M, trajectories=50, pushes=20, segments=32)
    windows, _ = standardise(domains[:1], horizon=1, bodies=True, target="displacement")
    found = in_turn(
        {
            "stack": lambda: stack(domains, steps),
            "one by one, DataLoader": lambda: loop(windows, steps),
            "matrix products alone": lambda: products(M, windows.inputs.shape[-1], steps),
        },
        rounds,
    )
    benchmark.pedantic(lambda: stack(domains, steps), rounds=1)  # type: ignore[no-untyped-call]
    assert all(seconds > 0 for seconds in found.values())
    if benchmark.enabled:
        lines = [f"{side:26}{1 / seconds:10,.0f}  × {seconds / found['stack']:.2f}" for side, seconds in found.items()]
        tables.setdefault(STACK, []).extend([f"{M} at once", *lines])
