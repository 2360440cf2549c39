"""Tests the graph network: its symmetries, walls and bodies included, padding, rollouts, contexts, what it learns."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from test_nn import load
from torch import Tensor
from toy import toy_domains

from dlobench.bench.model import Setting
from dlobench.domain import sample
from dlobench.errors import RunError, UsageError
from dlobench.nn import geometry
from dlobench.nn.context import PushEncoder
from dlobench.nn.geometry import Scene
from dlobench.nn.graph import GraphNetwork
from dlobench.nn.rollout import unroll
from dlobench.nn.scenes import record
from dlobench.trajectories import Trajectories, parameters
from dlobench.world.simulate import simulate

gnn, gnn_context, oracle = load("gnn"), load("gnn_context"), load("oracle_parameters")

B, N, M = 5, 24, 2


def scene(seed: int = 0) -> Scene:
    """Returns random states with walls, segments, bodies and pusher near each other."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    dlo = torch.stack([torch.linspace(-0.05, 0.065, N).expand(B, N), 0.01 * uniform(B, N)], -1)
    bodies = torch.cat([0.08 * uniform(B, M, 2) - 0.02, 6 * uniform(B, M, 1)], -1)
    boxes = torch.zeros(B, M, 5, 5, dtype=torch.float64)
    boxes[..., :2, 0], boxes[..., 1, 1], boxes[..., :2, 3:] = 0.0075 * torch.tensor([-1.0, 1.0]), 0.015, 0.0075
    ones = torch.ones(B, N, dtype=torch.float64)
    return Scene(dlo, ones, 0.02 * uniform(B, 2) - 0.02, bodies, ones[:, :M], boxes, torch.zeros(B, 3).double())


def network(context: int = 0) -> GraphNetwork:
    torch.manual_seed(0)
    return GraphNetwork(16, 0.01, context).double()


def actions(n: int = 1) -> Tensor:
    return torch.tensor([0.012, 0.01], dtype=torch.float64) + 0.01 * torch.rand(B, n, 2, dtype=torch.float64)


def test_a_turned_and_shifted_world_gives_turned_predictions() -> None:
    given, angle, shift = scene(), torch.full((B,), 0.7).double(), torch.tensor([[0.3, -0.2]] * B).double()
    other = given.turned(angle, shift)
    assert (given.table - other.table).abs().max() > 0.1, "the walls turn along"
    done, net = actions(3), network()
    *_, one = unroll(net, given, done)
    *_, two = unroll(net, other, geometry.rotated(done, -angle[:, None]))
    expected = one.turned(angle, shift)
    for name in ("dlo", "pusher", "bodies"):
        torch.testing.assert_close(getattr(two, name), getattr(expected, name))
    *_, unfelt = unroll(net, replace(other, table=given.table), geometry.rotated(done, -angle[:, None]))
    assert (unfelt.dlo - two.dlo).abs().max() > 1e-7, "and are felt"


def test_a_quarter_turn_is_one_of_the_table_alone() -> None:
    given, net = scene(), network()
    turned = replace(given, table=given.table + torch.tensor([0, 0, math.pi / 2]).double())
    action = actions()[:, 0]
    torch.testing.assert_close(net(turned, action).dlo, net(given, action).dlo)
    torch.testing.assert_close(net(turned, action).bodies, net(given, action).bodies)


def test_a_mirrored_world_seen_in_the_mirror_gives_mirrored_predictions() -> None:
    given, action, net = scene(), actions()[:, 0], network()
    one = net(given, action).mirrored()
    two = net(given.mirrored(), action * torch.tensor([1.0, -1.0]).double(), mirror=True)
    torch.testing.assert_close(two.dlo, one.dlo)
    torch.testing.assert_close(two.bodies, one.bodies)


def test_padding_changes_nothing() -> None:
    given, action, net = scene(), actions()[:, 0], network()
    dlo = torch.cat([given.dlo, torch.full((B, 3, 2), 0.01).double()], 1)
    body = torch.cat([given.bodies, torch.full((B, 1, 3), 0.02).double()], 1)
    padded = replace(
        given,
        dlo=dlo,
        exists=torch.cat([given.exists, torch.zeros(B, 3).double()], 1),
        bodies=body,
        present=torch.cat([given.present, torch.zeros(B, 1).double()], 1),
        boxes=torch.cat([given.boxes, torch.zeros(B, 1, 5, 5).double()], 1),
    )
    whole, cut = net(padded, action), net(given, action)
    torch.testing.assert_close(whole.dlo[:, :N], cut.dlo)
    torch.testing.assert_close(whole.bodies[:, :M], cut.bodies)
    assert torch.equal(whole.dlo[:, N:], dlo[:, N:]), "what is not there does not move"


def test_bodies_and_segments_feel_each_other() -> None:
    given, action, net = scene(), actions()[:, 0], network()
    away = replace(given, bodies=given.bodies + torch.tensor([0.5, 0.5, 0.0]).double())
    assert (net(away, action).dlo - net(given, action).dlo).abs().max() > 1e-7
    bent = replace(given, dlo=given.dlo + 0.004)
    moved = [net(each, action).bodies - given.bodies for each in (given, bent)]
    assert (moved[0] - moved[1]).abs().max() > 1e-7


def test_nearest_points_of_boxes() -> None:
    bodies = torch.tensor([[[0.1, 0.0, math.pi / 2]]])
    boxes = torch.zeros(1, 1, 5, 5)
    boxes[0, 0, 0] = torch.tensor([0.0, 0.0, 0.0, 0.02, 0.01])  # turned: from x 0.09 to 0.11, y −0.02 to 0.02
    points = torch.tensor([[[0.0, 0.0], [0.1, 0.05], [0.13, 0.06], [0.1, 0.01]]])
    vector, gap = geometry.nearest(points, bodies, boxes)
    expected = torch.tensor([[0.09, 0.0], [0.0, -0.03], [-0.02, -0.04], [0.0, 0.0]])
    torch.testing.assert_close(vector[0, :, 0], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(gap[0, :, 0], expected.norm(dim=-1), atol=2e-6, rtol=0)
    none, far = geometry.nearest(points, bodies, 0 * boxes)
    assert (far == geometry.FAR).all()
    assert none.isfinite().all()


def test_walls_push_inward_and_the_nearest_most() -> None:
    table = torch.zeros(1, 3)
    points = torch.tensor([[[0.12, 0.0], [0.0, -0.12], [0.0, 0.0], [0.12, 0.12]]])
    felt = geometry.walls(points, table, 0.005)[0]
    e = math.exp(-1)
    expected = torch.tensor([[e, -e, 0.0], [e, 0.0, e], [0.0, 0.0, 0.0], [2 * e, -e, -e]])
    torch.testing.assert_close(felt, expected, atol=1e-6, rtol=1e-5)


def test_the_sweep_of_a_push_is_a_segment() -> None:
    vector, distance = geometry.sweep(torch.tensor([[[-0.01, 0.0], [0.01, 0.02], [0.05, 0.0]]]), torch.tensor([[0.02]]))
    torch.testing.assert_close(vector[0], torch.tensor([[-0.01, 0.0], [0.0, 0.02], [0.03, 0.0]]))
    torch.testing.assert_close(distance[0, :, 0], torch.tensor([0.01, 0.02, 0.03]))


def pushed(trajectories: int = 6, bodies: int = 2, seed: int = 0) -> Trajectories:
    of = sample(np.random.default_rng(seed), material="flexible", attachment="none", length=0.12, rigid_objects=bodies)
    made = simulate(of, [[7, seed, k] for k in range(trajectories)], pushes=8)[0]
    return replace(made, parameters=parameters(of))


@pytest.fixture(scope="module")
def data() -> list[Trajectories]:
    """Returns three domains that were really simulated."""
    return [pushed(), pushed(seed=1), pushed(bodies=0, seed=2)]


def error(one: np.ndarray, other: np.ndarray) -> float:
    """Returns the mean squared error."""
    return float(np.square(one - other).mean())


def test_it_learns_segments_and_bodies_and_predicts_any_horizon() -> None:
    made = pushed(trajectories=30)
    model = gnn.Gnn(steps=400, width=16, body_weight=1.0)
    model.fit([made.take(slice(24))], [], Setting(horizon=2, K=(0,)))
    for n in (1, 2, 4):
        query, truth = made.take(slice(24, 30)).windows(n)
        out, exists = model.predict(query, 1), query.dlo_mask
        still = error(query.dlo[None, ..., :2][:, :, exists], truth.dlo[:, :, exists])
        assert error(out.dlo[:, :, exists], truth.dlo[:, :, exists]) < still
        assert not out.dlo[:, :, ~exists].any()
        assert out.bodies is not None and truth.bodies is not None
        found, real, before = (
            each[..., :2][:, :, query.body_mask] for each in (out.bodies, truth.bodies, query.bodies[None])
        )
        assert error(found, real) < error(before, real)


def test_a_plugin_turns_with_a_world_turned_by_a_quarter(data: list[Trajectories]) -> None:
    model = gnn.Gnn(steps=5, width=16)
    model.fit(data[:1], [], Setting(horizon=2, K=(0,)))
    query, _ = data[0].windows(2)
    quarter = np.array([[0, 1], [-1, 0]], np.float32)  # rows are points
    yaw = np.float32(math.pi / 2)
    turned = replace(
        query,
        dlo=np.concatenate([query.dlo[..., :2] @ quarter, query.dlo[..., 2:] + yaw], -1),
        pusher=query.pusher @ quarter,
        bodies=np.concatenate([query.bodies[..., :2] @ quarter, query.bodies[..., 2:] + yaw], -1),
        actions=query.actions @ quarter,
    )
    one, two = model.predict(query, 1), model.predict(turned, 1)
    assert one.bodies is not None and two.bodies is not None
    np.testing.assert_allclose(two.dlo, one.dlo @ quarter, atol=2e-6)
    np.testing.assert_allclose(two.bodies[..., :2], one.bodies[..., :2] @ quarter, atol=2e-6)


def test_the_order_of_support_says_nothing_and_no_support_is_zero(data: list[Trajectories]) -> None:
    torch.manual_seed(0)
    encoder = PushEncoder(16, 4, 0.01)
    seen = encoder.domain(record([data[0]], 1))
    again = encoder.domain(record([data[0].take(np.array([3, 1, 5, 0, 2, 4]))], 1))
    torch.testing.assert_close(seen, again)
    assert seen.shape == (5,)
    assert float(seen[-1]) == pytest.approx(math.log1p(48) / 7)
    fewer = encoder.domain(record([data[0].take(slice(1))], 1))
    assert fewer[-1] < seen[-1]


def test_contexts_tell_domains_apart(data: list[Trajectories]) -> None:
    model: Any = gnn_context.GnnContext(steps=20, width=16, tasks=2)
    model.fit(data, [], Setting(horizon=2, K=(0, 2)))
    query, _ = data[0].windows(2)
    adapted = [model.adapt(each.take(slice(2))) for each in data[:2]]
    assert not np.array_equal(adapted[0].predict(query, 1).dlo, adapted[1].predict(query, 1).dlo)
    assert not np.array_equal(adapted[0].predict(query, 1).dlo, model.predict(query, 1).dlo)
    assert not model.known.any()
    assert model.adapt(data[0].take(slice(0))) is model


def test_a_validation_looks_at_every_support_size(data: list[Trajectories], monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[int] = []
    whole = gnn_context.Seen.draw

    def spy(self: Any, of: Any, *args: Any, **named: Any) -> Any:
        found = whole(self, of, *args, **named)
        if len(of.count) == 1:  # the validation domain
            drawn.append(round(math.expm1(7 * float(found[2][0, -1])) / of.pushes))
        return found

    monkeypatch.setattr(gnn_context.Seen, "draw", spy)
    model = gnn_context.GnnContext(steps=1, width=8, tasks=2)
    model.fit(data[1:], data[:1], Setting(horizon=2, K=(0, 1, 3)))
    assert set(drawn) == {0, 1, 3}


def test_an_oracle_goes_by_the_parameters_and_wants_them(data: list[Trajectories]) -> None:
    model: Any = oracle.OracleParameters(steps=20, width=16)
    model.fit(data, data[:1], Setting(horizon=2, K=(0,)))
    query, _ = data[0].windows(2)
    other = replace(query, parameters=data[1].parameters)
    assert not np.array_equal(model.predict(query, 1).dlo, model.predict(other, 1).dlo)
    with pytest.raises(RunError, match="parameters of the domain are not told"):
        model.predict(replace(query, parameters=None), 1)
    with pytest.raises(RunError, match="parameters of domains are not told"):
        model.fit([replace(each, parameters=None) for each in data], [], Setting(horizon=2, K=(0,)))


@pytest.mark.parametrize("of", [gnn.Gnn, gnn_context.GnnContext])
def test_what_cannot_be_learnt_from_is_refused(of: Any, data: list[Trajectories]) -> None:
    with pytest.raises(RunError, match="no trajectories to learn from in 1 domains"):
        of(steps=2).fit([data[0].take(slice(0))], [], Setting(horizon=2, K=(0,)))
    with pytest.raises(RunError, match="horizon = 9 does not fit"):
        of(steps=2).fit(data, [], Setting(horizon=9, K=(0,)))
    with pytest.raises(RunError, match="horizon = 0 does not fit"):
        of(steps=2).fit(data, [], Setting(horizon=0, K=(0,)))
    model = of(steps=2)
    model.fit(data, [], Setting(horizon=2, K=(0,)))
    query = data[0].windows(2)[0]
    with pytest.raises(RunError, match="0 pushes ahead"):
        model.predict(replace(query, actions=query.actions[:, :0]), 1)
    bare = replace(data[0], dlo_mask=np.zeros(32, bool))
    with pytest.raises(RunError, match="domain 0 of 1 has no segment"):
        of(steps=2).fit([bare], [], Setting(horizon=2, K=(0,)))
    wrong = replace(data[0], executed=np.full_like(data[0].executed, np.nan))
    with pytest.raises(RunError, match="not finite"):
        of(steps=2).fit([data[1], wrong], [], Setting(horizon=2, K=(0,)))
    for name, value in (("width", 0), ("batch", -1), ("unrolled", 2.0), ("body_weight", -0.1), ("learning_rate", 0)):
        with pytest.raises(UsageError, match=f"{name} = "):
            of(steps=2, **{name: value}).fit(data, [], Setting(horizon=2, K=(0,)))


def test_finetune_takes_the_steps_that_serve_on_validation_domains_and_else_none() -> None:
    finetune = load("finetune")
    domains = toy_domains(8, trajectories=8)
    model = finetune.Finetune(steps=400, patience=2)
    model.fit(domains[:5], domains[5:7], Setting(horizon=2, K=(0, 1, 5)))
    assert set(model.chosen) == {1, 5}
    support = domains[7].take(slice(5))
    model.chosen = {5: (0.01, 3)}
    adapted, layers = model.adapt(support), model.network.layers
    inputs, targets, weight = model.network.scaling.windows([support]).pick(slice(None))
    for _ in range(3):
        leaves = [each.clone().requires_grad_() for pair in layers for each in pair]
        pairs = list(zip(leaves[::2], leaves[1::2], strict=True))
        slopes = torch.autograd.grad(finetune.weighted_mse(finetune.mlp(pairs, inputs), targets, weight), leaves)
        moved = [leaf.detach() - 0.01 * slope for leaf, slope in zip(leaves, slopes, strict=True)]
        layers = list(zip(moved[::2], moved[1::2], strict=True))
    for one, other in zip(adapted.network.layers, layers, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    model.chosen = {5: (1e4, 3)}
    assert model.adapt(support) is model, "steps that run away are not taken"
    assert model.adapt(support.take(slice(0))) is model
    never = finetune.Finetune(steps=20)
    never.fit(domains[:5], [], Setting(horizon=2, K=(1,)))
    assert never.adapt(domains[7]) is never


@pytest.mark.parametrize("penalty", [None, 1e-3])
def test_ridge_solves_its_normal_equations(penalty: float | None) -> None:
    ridge = load("ridge")
    domains = toy_domains(5, trajectories=12)
    model = ridge.Ridge(penalty=penalty)
    model.fit(domains[:4], domains[4:], Setting(horizon=2, K=(0,)))
    windows = model.scaling.windows(domains[:4])
    x, y, weight = windows.pick(slice(None))
    columns = weight[0] > 0
    chosen = [penalty] if penalty else ridge.PENALTIES
    x = torch.cat([x, torch.ones_like(x[:, :1])], 1).double()
    off = x @ model.coefficients.double() - y.double()
    slopes = [
        (x.T @ off / len(x) + p * torch.cat([model.coefficients[:-1], 0 * model.coefficients[-1:]]).double())[
            :, columns
        ]
        for p in chosen
    ]
    assert min(float(slope.abs().max()) for slope in slopes) < 1e-5, "the gradient of the loss is 0"
    query, truth = domains[0].windows(2)
    exists = query.dlo_mask
    still = error(query.dlo[None, ..., :2][:, :, exists], truth.dlo[:, :, exists])
    assert error(model.predict(query, 1).dlo[:, :, exists], truth.dlo[:, :, exists]) < still


def test_a_neural_process_depends_on_what_a_support_holds_not_on_its_order() -> None:
    process = load("neural_process")
    domains = toy_domains(6, trajectories=8)
    model = process.NeuralProcess(steps=150, width=32)
    model.fit(domains[:4], domains[4:5], Setting(horizon=2, K=(0, 3)))
    query, _ = domains[5].windows(2)
    one = model.adapt(domains[5].take(np.array([0, 1, 2]))).predict(query, 1).dlo
    two = model.adapt(domains[5].take(np.array([2, 0, 1]))).predict(query, 1).dlo
    np.testing.assert_allclose(one, two, atol=1e-6)
    assert np.abs(one - model.adapt(domains[0].take(slice(3))).predict(query, 1).dlo).max() > 1e-5
    assert np.abs(one - model.predict(query, 1).dlo).max() > 1e-5
    assert model.adapt(domains[5].take(slice(0))) is model
