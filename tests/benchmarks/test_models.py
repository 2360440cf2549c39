"""Measures models beside their peers: a meta step beside a loop over tasks, predictions beside bare matrix products.

Two threads, float32. Where benchmarks are disabled, all run once on little, and a meta step is held against its peer.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from rates import Tables, paired
from torch import Tensor
from toy import toy_scene

from dlobench.bench.plugins import load_model
from dlobench.nn.graph import GraphNetwork
from dlobench.nn.inner import PART, Inner, RatePer, meta_loss
from dlobench.nn.networks import Layers, flat, initial, mlp, weighted_mse

STEP = "a meta step of maml, forward and backward, ms; × how many times as fast as a loop over tasks, or learn2learn"
PREDICTIONS = "predictions a second, 1 push ahead"
WINDOWS = 17  # of a trajectory at n = 4
QUERIES = 10  # trajectories of a task
RATES: dict[str, RatePer] = {"loop": "layer", "learn2learn": "network"}
ROUNDS = 25  # of a meta step and its peer, turn by turn
pytestmark = pytest.mark.usefixtures("two_threads")


def batch(N: int, trajectories: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Makes the windows of so many trajectories of N tasks: inputs, targets, weights."""
    shape = N, trajectories * WINDOWS
    inputs, targets = torch.randn(*shape, 74, generator=generator), torch.randn(*shape, 64, generator=generator)
    return inputs, targets, torch.full((N, 1, 64), 1 / 64)


def looped(layers: Layers, rates: Tensor, support: Any, query: Any) -> Tensor:
    """Returns the loss after an inner step, task by task, as `torch.autograd.grad` in a loop has it."""
    losses = []
    for task in range(len(support[0])):
        inputs, targets, weight = (each[task] for each in support)
        slopes = torch.autograd.grad(
            weighted_mse(mlp(layers, inputs), targets, weight), flat(layers), create_graph=True
        )
        pairs = zip(layers, zip(slopes[::2], slopes[1::2], strict=True), rates, strict=True)
        adapted = [(w - r * dw, b - r * db) for (w, b), (dw, db), r in pairs]
        inputs, targets, weight = (each[task] for each in query)
        losses.append(weighted_mse(mlp(adapted, inputs), targets, weight))
    return torch.stack(losses).mean()


def products_of_step(layers: Layers, support: Tensor, query: Tensor) -> Callable[[], None]:
    """Returns a function that multiplies as a meta step of second order has to, and does nothing else.

    Of a layer and the windows that it sees there are three products: forward, back to what went in (not of the first
    layer), and to the weights. Queries take each once, the support three times: its gradient, and that of its gradient,
    in which each factor changes in turn (what went into the first layer does not).
    """
    each, factors = max(1, PART // support.shape[1]), []
    for k, (weight, _) in enumerate(layers):
        w = weight.detach().expand(len(support), *weight.shape).contiguous()
        for batch, times in ((query, 1), (support, 3 if k else 2)):
            x, y = (torch.ones(*batch.shape[:2], size) for size in weight.shape)
            factors += [
                (k, times, *some) for some in zip(*(torch.split(part, each) for part in (x, y, w)), strict=True)
            ]

    def run() -> None:
        for k, times, x, y, w in factors:
            for _ in range(times):
                torch.bmm(x, w)
                torch.bmm(x.mT, y)
                if k:
                    torch.bmm(y, w.mT)

    return run


def peer_of(name: str) -> Callable[..., Tensor]:
    """Returns the meta loss of a peer; what takes time once, such as loading the plugin, is done here."""
    if name == "loop":
        return looped
    if find_spec("learn2learn") is None:
        pytest.skip("learn2learn is not installed: make peers")
    loss = load_model("maml_learn2learn").model.fit.__globals__["looped_loss"]
    return partial(loss, inner=Inner(rate_per=RATES[name]))


@pytest.mark.parametrize("peer", ["loop", "learn2learn"])
@pytest.mark.parametrize(("N", "K"), [(5, 1), (5, 10), (5, 50), (50, 1), (50, 10), (50, 50)])
def test_meta_step(benchmark: BenchmarkFixture, tables: Tables, N: int, K: int, peer: str) -> None:
    theirs_loss = peer_of(peer)
    generator = torch.Generator().manual_seed(0)
    layers = initial([74, *[32] * 6, 64], generator)
    rates = torch.full((7 if peer == "loop" else 1,), 0.1, requires_grad=True)
    tasks, trajectories = (N, K) if benchmark.enabled else (2, 1)
    support, query = batch(tasks, trajectories, generator), batch(tasks, QUERIES, generator)

    def step(loss: Callable[..., Tensor]) -> list[Tensor]:
        return list(torch.autograd.grad(loss(layers, rates, support, query), [*flat(layers), rates]))

    stacked = partial(meta_loss, inner=Inner(rate_per=RATES[peer]))
    for one, other in zip(step(stacked), step(theirs_loss), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-6)
    ours, theirs = paired(lambda: step(stacked), lambda: step(theirs_loss), ROUNDS if benchmark.enabled else 1)
    benchmark.pedantic(lambda: step(stacked), rounds=1)  # type: ignore[no-untyped-call]
    if benchmark.enabled:
        bare, _ = paired(products_of_step(layers, support[0], query[0]), lambda: None, ROUNDS)
        line = f"N = {N:<3} K = {K:<3}{1e3 * ours:8.1f}, {peer} {1e3 * theirs:8.1f}  × {theirs / ours:.1f}"
        line += f", products alone {1e3 * bare:.1f}"
        tables.setdefault(STEP, []).append(line)


def products(sizes: list[int], rows: int) -> Callable[[], None]:
    """Returns a function that multiplies as a network of these sizes does, and does nothing else."""
    inputs = [torch.randn(rows, size) for size in sizes[:-1]]
    weights = [torch.randn(a, b) for a, b in pairwise(sizes)]

    def run() -> None:
        for x, w in zip(inputs, weights, strict=True):
            x @ w

    return run


def test_predictions_of_an_mlp(benchmark: BenchmarkFixture, tables: Tables) -> None:
    sizes, rows = [80, 128, 128, 128, 128, 64], 8192 if benchmark.enabled else 64
    layers, inputs = initial(sizes, torch.Generator().manual_seed(0)), torch.randn(rows, 80)

    def predict() -> Tensor:
        with torch.no_grad():
            return mlp(layers, inputs)

    ours, bare = paired(predict, products(sizes, rows), 15 if benchmark.enabled else 1)
    out = benchmark.pedantic(predict, rounds=1)  # type: ignore[no-untyped-call]
    assert out.shape == (rows, 64)
    if benchmark.enabled:
        line = f"{'mlp 4 × 128':28}{rows / ours:14,.0f}, {bare / ours:.2f} of bare matrix products"
        tables.setdefault(PREDICTIONS, []).append(line)


@pytest.mark.parametrize("bodies", [0, 3])
def test_predictions_of_a_gnn(benchmark: BenchmarkFixture, tables: Tables, bodies: int) -> None:
    B = 256 if benchmark.enabled else 4
    scene = toy_scene(B, bodies)
    network, action = GraphNetwork(32, 0.004).requires_grad_(False), 0.01 * torch.randn(B, 2)

    def predict() -> Tensor:  # both sights, as `rollout.predict` does
        one, other = network(scene, action), network(scene, action, mirror=True)
        mean: Tensor = (one.dlo + other.dlo) / 2
        return mean

    ours, _ = paired(predict, lambda: None, 9 if benchmark.enabled else 1)
    out = benchmark.pedantic(predict, rounds=1)  # type: ignore[no-untyped-call]
    assert out.isfinite().all()
    if benchmark.enabled:
        tables.setdefault(PREDICTIONS, []).append(f"{f'gnn, {bodies} bodies':28}{B / ours:14,.0f}")
