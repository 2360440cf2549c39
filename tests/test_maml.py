"""Tests the meta-learner: its gradient against a loop over tasks, its rates, its adaptation."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec
from typing import Any, get_args

import numpy as np
import pytest
import torch
from test_nn import generator, load
from torch import Tensor
from toy import error, toy_domains

from dlobench.bench.model import Setting
from dlobench.errors import RunError, UsageError
from dlobench.nn import episodes, meta, networks
from dlobench.nn.budget import Log
from dlobench.nn.inner import Adapts, Inner, RatePer, by_weight, inner_step, meta_loss
from dlobench.nn.windows import standardise

maml = load("maml")


def problem(tasks: int = 3) -> tuple[networks.Layers, Tensor, Any, Any]:
    """Returns double layers, rates, support and query; the second task has padding."""
    rng = generator()
    layers = [(w.detach().double(), b.detach().double()) for w, b in networks.initial([5, 8, 8, 64], rng)]
    layers = [(w.requires_grad_(), b.requires_grad_()) for w, b in layers]
    rates = torch.tensor([0.3, 0.5, 0.8], dtype=torch.float64, requires_grad=True)
    weight = torch.full((tasks, 1, 64), 1 / 64, dtype=torch.float64)
    weight[1] = (torch.arange(64) < 40).double() / 40

    def batch(size: int) -> tuple[Tensor, Tensor, Tensor]:
        inputs = torch.randn(tasks, size, 5, generator=rng, dtype=torch.float64)
        return inputs, torch.randn(tasks, size, 64, generator=rng, dtype=torch.float64), weight

    return layers, rates, batch(6), batch(9)


def looped_loss(layers: networks.Layers, rates: Tensor, support: Any, query: Any, order: int = 2) -> Tensor:
    """Computes the meta loss task by task, with plain autograd and without any code of the plugin.

    At `order` 1 the inner gradient is a constant, which is what first-order MAML differentiates.
    """
    losses = []
    for task in range(len(support[0])):

        def loss(weights: list[Tensor], batch: Any, task: int = task) -> Tensor:
            hidden = batch[0][task]
            for layer in range(3):
                hidden = hidden @ weights[2 * layer] + weights[2 * layer + 1]
                hidden = torch.where(hidden > 0, hidden, 0.01 * hidden) if layer < 2 else hidden
            exists = batch[2][task, 0] > 0
            squares: Tensor = (hidden - batch[1][task])[:, exists].square()
            return squares.mean()

        start = networks.flat(layers)
        slopes = torch.autograd.grad(loss(start, support), start, create_graph=order == 2)
        losses.append(loss([w - rates[i // 2] * g for i, (w, g) in enumerate(zip(start, slopes, strict=True))], query))
    return torch.stack(losses).mean()


def test_batched_meta_gradient_equals_a_loop_over_tasks() -> None:
    layers, rates, support, query = problem()
    learned = [*networks.flat(layers), rates]
    batched, looped = (f(layers, rates, support, query) for f in (meta_loss, looped_loss))
    torch.testing.assert_close(batched, looped, rtol=1e-12, atol=1e-12)
    for ours, theirs in zip(torch.autograd.grad(batched, learned), torch.autograd.grad(looped, learned), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)
        assert ours.abs().max() > 1e-6


def recorded_loss(layers: networks.Layers, rates: Tensor, support: Any, query: Any, inner: Inner) -> Tensor:
    """Computes the meta loss of any options with autograd, which records every inner step and differentiates it."""
    now, start = networks.stacked(layers, len(support[0])), networks.stacked(layers, len(support[0]))
    moving = len(layers) if inner.adapts == "all" else 1
    scales = networks.flat(by_weight(rates, layers[-moving:]))
    for _ in range(inner.inner_steps):
        loss = networks.weighted_mse(networks.mlp(now, support[0]), *support[1:]).sum()
        moved = networks.flat(now[-moving:])
        slopes = torch.autograd.grad(loss, moved, create_graph=not inner.first_order)
        tensors = [w - r * g for w, r, g in zip(moved, scales, slopes, strict=True)]
        now = start[:-moving] + list(zip(tensors[::2], tensors[1::2], strict=True))
    return networks.weighted_mse(networks.mlp(now, query[0]), *query[1:]).mean()


OPTIONS = [
    Inner(steps, first_order, rate_per, adapts)
    for steps in (1, 3)
    for first_order in (False, True)
    for rate_per in get_args(RatePer)
    for adapts in get_args(Adapts)
]


@pytest.mark.parametrize("inner", OPTIONS, ids=str)
@pytest.mark.parametrize("part", [1, 4096])
def test_the_gradient_is_that_of_autograd(inner: Inner, part: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dlobench.nn.inner.PART", part)  # tasks one by one, or all at once
    layers, _, support, query = problem()
    count = inner.rates(layers)
    rates = torch.rand(count, generator=generator(), dtype=torch.float64).add(0.2).requires_grad_()
    learned = [*networks.flat(layers), rates]
    losses = meta_loss(layers, rates, support, query, inner=inner), recorded_loss(layers, rates, support, query, inner)
    torch.testing.assert_close(*losses, rtol=1e-12, atol=1e-12)
    for ours, theirs in zip(*(torch.autograd.grad(loss, learned) for loss in losses), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-12)
        assert ours.abs().max() > 1e-6


@pytest.mark.parametrize("inner", [Inner(1, False, "network"), Inner(3, False, "network"), Inner(2, True, "network")])
def test_learn2learn_has_the_same_gradients(inner: Inner) -> None:
    if find_spec("learn2learn") is None:
        pytest.skip("learn2learn is not installed: make peers")
    layers, rates, support, query = problem()
    rates = rates[:1].detach().requires_grad_()
    learned = [*networks.flat(layers), rates]
    losses = [f(layers, rates, support, query, inner=inner) for f in (meta_loss, load("maml_learn2learn").looped_loss)]
    torch.testing.assert_close(*losses, rtol=0, atol=1e-9)
    for ours, theirs in zip(*(torch.autograd.grad(loss, learned) for loss in losses), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)
        assert ours.abs().max() > 1e-6


def test_without_learn2learn_its_model_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "learn2learn", None)
    domains = toy_domains(2, trajectories=3)
    with pytest.raises(RunError, match=r"needs learn2learn.*`make peers`"):
        load("maml_learn2learn").MamlLearn2learn().fit(domains, [], Setting(horizon=2, K=(1,)))


def test_meta_gradient_is_of_second_order() -> None:
    layers, rates, support, query = problem()
    losses = meta_loss(layers, rates, support, query), looped_loss(layers, rates, support, query, order=1)
    torch.testing.assert_close(*losses, rtol=1e-12, atol=1e-12)  # only the gradients tell the orders apart
    for ours, first in zip(*(torch.autograd.grad(loss, networks.flat(layers)) for loss in losses), strict=True):
        assert (ours - first).norm() > 0.01 * ours.norm()


def test_each_rate_moves_its_own_layer() -> None:
    layers, _, support, _ = problem()
    rates = torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64)
    adapted = inner_step(layers, rates, support)
    for number, ((weight, bias), (new_weight, new_bias)) in enumerate(zip(layers, adapted, strict=True)):
        assert torch.equal(weight.expand_as(new_weight), new_weight) == (number != 1)
        assert torch.equal(bias.expand_as(new_bias), new_bias) == (number != 1)


@pytest.mark.parametrize("options", [{}, {"inner_steps": 3}, {"adapts": "head", "inner_steps": 2}])
def test_second_order_gradient_equals_finite_differences(options: dict[str, Any]) -> None:
    layers, rates, support, query = problem()
    layers = [(0.3 * w.detach(), b.detach()) for w, b in layers]
    learned = networks.flat(layers)
    rates = (rates[-1:] if options.get("adapts") == "head" else rates).detach()
    for tensor in learned:
        tensor.requires_grad_()
    slopes = torch.autograd.grad(meta_loss(layers, rates, support, query, inner=Inner(**options)), learned)
    rng, step = generator(), 1e-6
    with torch.no_grad():
        for tensor, slope in zip(learned, slopes, strict=True):
            way = torch.randn(tensor.shape, generator=rng, dtype=torch.float64)
            ends = []
            for sign in (1, -2):
                tensor.add_(sign * step * way)
                ends.append(meta_loss(layers, rates, support, query, inner=Inner(**options)))
            tensor.add_(step * way)
            expected = (ends[0] - ends[1]) / (2 * step)
            torch.testing.assert_close((slope * way).sum(), expected, rtol=1e-5, atol=1e-9)


def test_first_order_is_the_gradient_with_constant_inner_slopes() -> None:
    layers, rates, support, query = problem()
    learned = [*networks.flat(layers), rates]
    ours = torch.autograd.grad(meta_loss(layers, rates, support, query, inner=Inner(first_order=True)), learned)
    theirs = torch.autograd.grad(looped_loss(layers, rates, support, query, order=1), learned)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


def test_several_steps_are_single_steps_repeated() -> None:
    layers, rates, support, _ = problem()
    at_once = inner_step(layers, rates, support, inner=Inner(3))
    for task in range(3):
        inputs, targets, weight = (tensor[task : task + 1] for tensor in support)
        alone = inputs, targets, weight
        now = layers
        for _ in range(3):
            now = [(w[0], b[0]) for w, b in inner_step(now, rates, alone)]
        for a, b in zip(networks.flat(at_once), networks.flat(now), strict=True):
            torch.testing.assert_close(a[task], b, rtol=1e-12, atol=1e-12)


def test_the_head_alone_adapts_and_the_body_still_learns() -> None:
    layers, rates, support, query = problem()
    adapted = inner_step(layers, rates[-1:], support, inner=Inner(adapts="head"))
    for old, new in zip(networks.flat(layers[:-1]), networks.flat(adapted[:-1]), strict=True):
        assert torch.equal(old.expand_as(new), new)
    full = inner_step(layers, rates, support)
    for new, expected in zip(adapted[-1], full[-1], strict=True):
        torch.testing.assert_close(new, expected, rtol=1e-12, atol=1e-12)
    loss = meta_loss(layers, rates[-1:], support, query, inner=Inner(adapts="head"))
    assert all(slope.abs().max() > 1e-6 for slope in torch.autograd.grad(loss, networks.flat(layers)))


def test_a_rate_a_weight_scales_each_slope_by_its_own() -> None:
    layers, rates, support, _ = problem()
    each = torch.cat([r.expand(t.numel()) for layer, r in zip(layers, rates, strict=True) for t in layer]).clone()
    same, by_layer = (inner_step(layers, r, support) for r in (each, rates))
    for a, b in zip(networks.flat(same), networks.flat(by_layer), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
    each = each.detach()
    each[7] = 0  # input 0, unit 7 of the first layer
    frozen = inner_step(layers, each, support)[0][0]
    assert torch.equal(frozen[:, 0, 7], layers[0][0][0, 7].expand(3))
    torch.testing.assert_close(frozen[:, 1:], same[0][0][:, 1:])


@pytest.mark.parametrize(("adapts", "number"), [("all", None), ("head", 8 * 64 + 64)])
def test_rates_a_weight_are_learned_and_used_to_adapt(adapts: str, number: int | None) -> None:
    model = maml.Maml(width=8, depth=2, steps=60, rate_per="weight", adapts=adapts, inner_steps=2, first_order=True)
    domains = toy_domains(4, trajectories=8)
    model.fit(domains, [], Setting(horizon=2, K=(1,)))
    assert model.rates.shape == (number or networks.size(model.network.layers),)
    assert (model.rates > 0).all() and len(set(model.rates.tolist())) > 100
    adapted = model.adapt(domains[0])
    pairs = list(zip(model.network.layers, adapted.network.layers, strict=True))
    moved = [not torch.equal(old[0], new[0]) for old, new in pairs]
    assert moved == ([True] * 3 if adapts == "all" else [False, False, True])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("inner_steps", 0, "inner_steps = 0 is not a whole number"),
        ("inner_steps", 1.5, "inner_steps = 1.5 is not a whole number"),
        ("first_order", "maybe", "first_order = 'maybe' is neither true nor false"),
        ("rate_per", "unit", "rate_per = 'unit' is none of network, layer, weight"),
        ("adapts", "body", "adapts = 'body' is none of all, head"),
    ],
)
def test_bad_options_are_refused_by_name(name: str, value: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        maml.Maml(steps=1, **{name: value}).fit(toy_domains(2, trajectories=3), [], Setting(horizon=2, K=(1,)))


@pytest.fixture(scope="module")
def fitted() -> Any:
    model = maml.Maml(width=16, depth=2, steps=600, learning_rate=3e-3, queries=4)
    domains = toy_domains(40, trajectories=12)
    model.fit(domains[:36], domains[36:], Setting(horizon=2, K=(0, 1, 5)))
    return model


def test_rates_are_learned_one_a_layer_and_positive(fitted: Any) -> None:
    assert fitted.rates.shape == (3,)
    assert (fitted.rates > 0).all() and len(set(fitted.rates.tolist())) == 3
    assert (fitted.rates != fitted.inner_rate).all() and fitted.rates.max() - fitted.rates.min() > 0.01
    assert fitted.parameters() == networks.size(fitted.network.layers) + 3


def test_adapting_helps_on_unseen_domains_and_more_trajectories_help_more(fitted: Any) -> None:
    errors: dict[int, list[float]] = {0: [], 1: [], 5: []}
    for domain in toy_domains(20, seed=1, trajectories=15):
        query, truth = domain.take(slice(5, 15)).windows(2)
        for K, values in errors.items():
            model = fitted.adapt(domain.take(slice(0, K)))
            values.append(error(model.predict(query, 1).dlo, truth.dlo, query.dlo_mask))
    mean = {K: np.mean(values) for K, values in errors.items()}
    assert mean[5] < mean[1] < mean[0] and mean[5] < 0.5 * mean[0]


def test_adapt_lowers_the_support_loss_and_leaves_self_unchanged(fitted: Any) -> None:
    [domain] = toy_domains(1, seed=2, trajectories=5)
    query, truth = domain.windows(2)
    before = fitted.predict(query, 1).dlo
    kept = [w.clone() for w in networks.flat(fitted.network.layers)]
    adapted = fitted.adapt(domain)
    np.testing.assert_array_equal(fitted.predict(query, 1).dlo, before)
    assert all(torch.equal(a, b) for a, b in zip(kept, networks.flat(fitted.network.layers), strict=True))
    assert type(adapted) is type(fitted) and adapted is not fitted and adapted.N == fitted.N
    assert error(adapted.predict(query, 1).dlo, truth.dlo, query.dlo_mask) < error(before, truth.dlo, query.dlo_mask)
    again = fitted.adapt(domain).predict(query, 1).dlo
    np.testing.assert_array_equal(again, adapted.predict(query, 1).dlo)
    assert fitted.adapt(domain.take(slice(0, 0))) is fitted
    assert not any(w.requires_grad for w in networks.flat(adapted.network.layers))


def test_adapt_takes_the_step_it_was_trained_with(fitted: Any) -> None:
    [domain] = toy_domains(1, seed=2, trajectories=5)
    made = fitted.network.scaling.windows([domain])
    layers = [(w.clone().requires_grad_(), b.clone().requires_grad_()) for w, b in fitted.network.layers]
    inputs, targets, weight = made.pick(slice(None))
    loss = networks.weighted_mse(networks.mlp(layers, inputs), targets, weight)
    slopes = torch.autograd.grad(loss, networks.flat(layers))
    for i, adapted in enumerate(networks.flat(fitted.adapt(domain).network.layers)):
        expected = networks.flat(layers)[i] - fitted.rates[i // 2] * slopes[i]
        torch.testing.assert_close(adapted, expected.detach(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("sizes", "K", "expected"), [((12, 12), 5, (5, 4)), ((6, 9), 5, (5, 1)), ((5, 9), 5, (2, 3))])
def test_support_and_query_are_disjoint_and_of_one_domain(
    sizes: tuple[int, ...], K: int, expected: tuple[int, int]
) -> None:
    domains = [toy_domains(1, seed=n, trajectories=n)[0] for n in sizes]
    made, _ = standardise(domains, horizon=2, bodies=False, target="displacement")
    tasks = torch.tensor([0, 1, 1, 0] * 25)
    support, query = drawn = episodes.rows(made.count, tasks, K, queries=4, generator=generator())
    assert (support.shape[1], query.shape[1]) == expected
    rows = torch.cat(drawn, dim=1)
    assert all(len(set(row)) == len(row) for row in rows.tolist())
    assert torch.equal(made.domain[rows], tasks[:, None].expand_as(rows))
    assert set(rows.flatten().tolist()) == set(range(sum(sizes)))  # every trajectory gets its turn


def test_a_domain_with_one_trajectory_is_refused() -> None:
    with pytest.raises(RunError, match="a domain has 1 trajectories"):
        maml.Maml(steps=1).fit(toy_domains(2, trajectories=1), [], Setting(horizon=2, K=(1,)))


@pytest.mark.parametrize(
    ("K_train", "Ks", "expected"), [(None, (0, 1, 3), {1, 3}), (2, (0, 1, 3), {2}), (None, (0,), {1})]
)
def test_support_sizes_follow_the_setting(
    K_train: int | None, Ks: tuple[int, ...], expected: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = maml.Maml(K_train=K_train, steps=20)
    drawn: set[int] = set()

    def spy(windows: Any, domains: Tensor, K: int, **how: Any) -> Any:
        drawn.add(K)
        return episodes.draw(windows, domains, K, **how)

    monkeypatch.setattr(meta, "draw", spy)
    model.fit(toy_domains(3, trajectories=6), [], Setting(horizon=2, K=Ks))
    assert drawn == expected


def test_validation_is_logged_and_ragged_domains_are_fine() -> None:
    domains = [toy_domains(1, seed=n, trajectories=n, segments=20 + n)[0] for n in (4, 6, 9, 12)]
    valid: list[float] = []
    log = Log([lambda step, total, values: valid.append(values.get("valid", np.nan))])
    model = maml.Maml(steps=200)
    model.fit(domains[:2], domains[2:], Setting(horizon=2, K=(1, 50), log=log))
    assert np.isfinite(valid).sum() == 2
    query, _ = replace(domains[3]).windows(2)
    assert np.isfinite(model.adapt(domains[3]).predict(query, 1).dlo).all()
