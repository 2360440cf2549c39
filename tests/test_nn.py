"""Tests windows, networks and the fitting loop."""

from __future__ import annotations

import importlib.util
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from toy import error, toy_domain, toy_domains

from dlobench.bench.model import Model, Setting
from dlobench.errors import RunError, UsageError
from dlobench.nn import fit, networks, regression, windows
from dlobench.nn.budget import Budget, Log
from dlobench.trajectories import Trajectories

MODELS = Path(__file__).parents[1] / "models"
PLAN = fit.Plan(steps=300, learning_rate=1e-2, patience=100, every=50)


def load(name: str) -> Any:
    """Loads a plugin file as the app does."""
    if f"plugin_{name}" not in sys.modules:
        spec = importlib.util.spec_from_file_location(f"plugin_{name}", MODELS / f"{name}.py")
        assert spec and spec.loader
        sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[spec.name])
    return sys.modules[f"plugin_{name}"]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def with_bodies(domain: Trajectories, seed: int = 0) -> Trajectories:
    """Gives a domain two bodies that wander."""
    bodies = np.random.default_rng(seed).normal(size=domain.bodies.shape).astype(np.float32)
    bodies[:, :, 2] = 0
    return replace(domain, bodies=bodies, body_mask=np.array([True, True, False]))


def test_stacked_mlp_equals_each_network() -> None:
    rng = generator()
    nets = [networks.initial([7, 16, 16, 3], rng) for _ in range(4)]
    stack = [
        (torch.stack(w), torch.stack(b)) for w, b in (zip(*layer, strict=True) for layer in zip(*nets, strict=True))
    ]
    inputs = torch.randn(4, 5, 7, generator=rng)
    each = torch.stack([networks.mlp(net, x) for net, x in zip(nets, inputs, strict=True)])
    torch.testing.assert_close(networks.mlp(stack, inputs), each, rtol=1e-5, atol=1e-6)
    copies = networks.mlp(networks.stacked(nets[0], 4), inputs)
    torch.testing.assert_close(copies[2], networks.mlp(nets[0], inputs[2]), rtol=1e-5, atol=1e-6)


def test_mlp_equals_torch_modules() -> None:
    layers = networks.initial([7, 16, 3], generator())
    first, second = torch.nn.Linear(7, 16), torch.nn.Linear(16, 3)
    with torch.no_grad():
        for module, (weight, bias) in zip((first, second), layers, strict=True):
            module.weight.copy_(weight.T)
            module.bias.copy_(bias)
    inputs = torch.randn(9, 7, generator=generator(1))
    reference = torch.nn.Sequential(first, torch.nn.LeakyReLU(0.01), second)(inputs)
    torch.testing.assert_close(networks.mlp(layers, inputs), reference)
    assert networks.size(layers) == 7 * 16 + 16 + 16 * 3 + 3


def test_initial_layers_spread_like_those_of_torch() -> None:
    [(weight, bias)] = networks.initial([400, 300], generator())
    torch.manual_seed(0)
    reference = torch.nn.Linear(400, 300)
    assert weight.abs().max() <= 400**-0.5 and bias.abs().max() <= 400**-0.5
    assert weight.std().item() == pytest.approx(reference.weight.std().item(), rel=0.02)
    assert bias.std().item() == pytest.approx(reference.bias.std().item(), rel=0.15)


def test_initial_draws_from_its_generator_alone() -> None:
    state = torch.random.get_rng_state()
    a, b = (networks.flat(networks.initial([5, 4], generator(3))) for _ in range(2))
    assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))
    assert torch.equal(state, torch.random.get_rng_state())


@pytest.mark.parametrize("target", ["displacement", "absolute"])
@pytest.mark.parametrize("frame", ["world", "push"])
def test_scaling_inverts(target: windows.Target, frame: windows.Frame) -> None:
    train = [with_bodies(d, seed) for seed, d in enumerate(toy_domains(3, trajectories=4, segments=20))]
    made, scaling = windows.standardise(train, horizon=2, bodies=True, target=target, frame=frame)
    query, truth = train[1].windows(2)
    outputs = made.targets[made.domain == 1].flatten(0, 1)
    np.testing.assert_allclose(scaling.positions(outputs, query), truth.dlo[0], atol=1e-7)
    torch.testing.assert_close(scaling.inputs(query), made.inputs[made.domain == 1].flatten(0, 1))
    np.testing.assert_array_equal(train[1].windows(2)[0].dlo, query.dlo)  # the query was not written to


@pytest.mark.parametrize("target", ["displacement", "absolute"])
def test_in_the_frame_of_a_push_only_pusher_and_heading_tell_where_the_world_is(target: windows.Target) -> None:
    domain = with_bodies(toy_domains(1, trajectories=4)[0])
    by, (c, s) = np.array([0.02, -0.03], np.float32), np.cos([0.7, 0.7 - np.pi / 2])
    turn = np.array([[c, s], [-s, c]], np.float32)  # of rows, by 0.7 rad
    moved = replace(
        domain,
        dlo=np.concatenate([domain.dlo[..., :2] @ turn + by, domain.dlo[..., 2:] + 0.7], -1, dtype=np.float32),
        bodies=np.concatenate([domain.bodies[..., :2] @ turn + by, domain.bodies[..., 2:] + 0.7], -1, dtype=np.float32),
        pusher=domain.pusher @ turn + by,
        commanded=domain.commanded @ turn,
        executed=domain.executed @ turn,
    )
    made, other = (
        windows.standardise([d], horizon=2, bodies=True, target=target, frame="push", normalise=False)[0]
        for d in (domain, moved)
    )
    torch.testing.assert_close(made.inputs[..., 4:], other.inputs[..., 4:], atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(made.targets, other.targets, atol=1e-6, rtol=1e-5)
    query = moved.windows(2)[0]
    np.testing.assert_array_equal(other.inputs[..., :2].flatten(0, 1), query.pusher)
    ahead = query.actions[:, 0] / np.linalg.norm(query.actions[:, 0], axis=1, keepdims=True)
    np.testing.assert_allclose(other.inputs[..., 2:4].flatten(0, 1), ahead, atol=1e-6)
    first = other.inputs[..., -4:-2].flatten(0, 1).numpy()  # straight ahead, as far as it goes
    np.testing.assert_allclose(first[:, 0], np.linalg.norm(query.actions[:, 0], axis=1), atol=1e-7)
    np.testing.assert_allclose(first[:, 1], 0, atol=1e-7)


@pytest.mark.parametrize(("name", "value"), [("target", "absolut"), ("frame", "pusher")])
def test_an_unknown_representation_is_told(name: str, value: str) -> None:
    options: dict[str, Any] = {"target": "displacement", "frame": "world", name: value}
    with pytest.raises(UsageError, match=value):
        windows.standardise(toy_domains(1, trajectories=2), horizon=1, bodies=False, **options)


@pytest.mark.parametrize("limits", [{"steps": 0}, {"steps": -3}, {"minutes": -1.0}, {"minutes": float("nan")}])
def test_a_budget_of_nothing_is_told(limits: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=str(*limits.values())):
        Budget(**limits)


def test_a_pusher_that_keeps_still_has_a_frame() -> None:
    domain = toy_domains(1, trajectories=2)[0]
    still = replace(domain, executed=np.zeros_like(domain.executed))
    made, scaling = windows.standardise([still], horizon=1, bodies=False, target="displacement", frame="push")
    assert made.inputs.isfinite().all()
    query, truth = still.windows(1)
    np.testing.assert_allclose(scaling.positions(made.targets.flatten(0, 1), query), truth.dlo[0], atol=1e-7)


def test_targets_have_one_scale() -> None:
    train = toy_domains(3, trajectories=4)
    made, scaling = windows.standardise(train, horizon=1, bodies=False, target="displacement")
    moved = np.concatenate([(d.dlo[:, 1:, :20, :2] - d.dlo[:, :-1, :20, :2]).reshape(-1, 40) for d in train])
    assert scaling.target_std == pytest.approx(moved.std(axis=0).astype(float).__pow__(2).mean() ** 0.5, rel=1e-4)
    np.testing.assert_allclose(made.targets.flatten(0, 1)[:, :40] * scaling.target_std, moved, atol=1e-8)


def test_inputs_are_standardised_and_constants_stay_finite() -> None:
    train = [with_bodies(d, seed) for seed, d in enumerate(toy_domains(3, trajectories=4))]
    still = [replace(d, pusher=np.full_like(d.pusher, 0.123)) for d in train]
    made, scaling = windows.standardise(still, horizon=2, bodies=True, target="displacement")
    inputs = made.inputs.flatten(0, 1)
    assert inputs.shape[1] == 2 + 64 + 12 + 4
    assert inputs[:, :2].abs().max() < 1e-3 and torch.equal(scaling.std[:2], torch.ones(2))
    existing = made.exists[0].clone()
    existing[:2] = False
    torch.testing.assert_close(inputs[:, existing].std(0, correction=0), torch.ones(int(existing.sum())))
    assert inputs[:, existing].mean(0).abs().max() < 1e-5
    assert inputs.isfinite().all()
    assert not inputs[:, 66 + 8 : 66 + 12].any()  # the body that does not exist


def test_what_is_not_normalised_stays_in_si() -> None:
    domains = toy_domains(2, trajectories=4)
    made, scaling = windows.standardise(domains, horizon=2, bodies=False, target="absolute", normalise=False)
    query, truth = domains[1].windows(2)
    inputs, targets, _ = made.pick(slice(len(made) - len(query), len(made)))
    assert np.array_equal(inputs[:, :2].numpy(), query.pusher)
    assert np.array_equal(targets.numpy().reshape(-1, 32, 2)[:, query.dlo_mask], truth.dlo[0][:, query.dlo_mask])
    assert scaling.target_std == 1


def test_a_plan_by_epochs_validates_once_an_epoch() -> None:
    plan = fit.Plan(1000, 1e-3, 20)
    how = regression.Regression(width=4, depth=1, bodies=False, target="absolute", batch=10, plan=plan)
    assert how.plan_of(105) == plan
    by_epochs = replace(how, epochs=7).plan_of(105)
    assert (by_epochs.every, by_epochs.patience, by_epochs.steps) == (10, 7, 1000)
    assert replace(how, epochs=7).plan_of(3).every == 1
    with pytest.raises(UsageError, match="epochs = 0"):
        replace(how, epochs=0)


def test_body_features_are_sine_and_cosine() -> None:
    domain = with_bodies(toy_domains(1, trajectories=2)[0])
    query, _ = domain.windows(1)
    features = windows._features(query, bodies=True)
    expected = np.stack([*query.bodies[:, 1, :2].T, np.cos(query.bodies[:, 1, 2]), np.sin(query.bodies[:, 1, 2])], 1)
    np.testing.assert_allclose(features[:, 70:74], expected, atol=1e-6)


def test_padding_counts_neither_in_inputs_nor_in_loss_nor_in_output() -> None:
    rng = np.random.default_rng(0)
    train = [toy_domain(rng, trajectories=3, segments=n) for n in (20, 32)]
    junk = train[0].dlo.copy()
    junk[:, :, 20:] = 7 + rng.normal(size=junk[:, :, 20:].shape)
    spoiled = [replace(train[0], dlo=junk), train[1]]
    layers = networks.initial([2 + 64 + 4, 8, 64], generator())
    losses, scalings = [], []
    for domains in (train, spoiled):
        made, scaling = windows.standardise(domains, horizon=2, bodies=False, target="displacement")
        inputs, targets, weight = made.pick(slice(None))
        assert (
            not made.targets[made.domain == 0][..., 40:].any() and not made.inputs[made.domain == 0][..., 42:66].any()
        )
        targets = targets + 100 * (weight == 0)  # even a wrong target in the padding is free
        losses.append(networks.weighted_mse(networks.mlp(layers, inputs), targets, weight))
        scalings.append(scaling)
    assert torch.equal(losses[0], losses[1])
    assert torch.equal(scalings[0].mean, scalings[1].mean) and scalings[0].target_std == scalings[1].target_std
    query, _ = spoiled[0].windows(2)
    predicted = fit.Network(networks.detached(layers), scalings[1]).predict(query).dlo
    assert not predicted[:, :, 20:].any() and predicted[:, :, :20].all()


def test_padding_does_not_shift_the_moments() -> None:
    rng = np.random.default_rng(0)
    short, long = (toy_domain(rng, trajectories=3, segments=n) for n in (20, 32))
    _, both = windows.standardise([short, long], horizon=1, bodies=False, target="displacement")
    _, alone = windows.standardise([long], horizon=1, bodies=False, target="displacement")
    torch.testing.assert_close(both.mean[2 + 40 : 2 + 64], alone.mean[2 + 40 : 2 + 64])
    torch.testing.assert_close(both.std[2 + 40 : 2 + 64], alone.std[2 + 40 : 2 + 64])


def test_weighted_mse_is_the_mse_over_what_exists() -> None:
    outputs, targets = torch.randn(2, 6, 64, generator=generator())
    weight = (torch.arange(64) < 40).float().expand(6, 64) / 40
    expected = (outputs - targets)[:, :40].square().mean()
    torch.testing.assert_close(networks.weighted_mse(outputs, targets, weight), expected)


def test_windows_are_found_by_number_and_by_trajectory() -> None:
    train = [*toy_domains(1, trajectories=2, segments=32), *toy_domains(1, seed=1, trajectories=5)]
    made, _ = windows.standardise(train, horizon=3, bodies=False, target="displacement")
    assert made.count.tolist() == [2, 5] and len(made) == 7 * 4
    inputs, targets, weight = made.pick_trajectories(torch.tensor([[1, 0], [6, 2]]))
    assert inputs.shape == (2, 8, 72) and targets.shape == (2, 8, 64) and weight.shape == (2, 1, 64)
    flat = made.pick(torch.tensor([6 * 4, 2 * 4 + 3]))
    assert torch.equal(inputs[1, [0, 7]], flat[0]) and torch.equal(targets[1, [0, 7]], flat[1])
    assert torch.equal(flat[2], weight[1].expand(2, 64)) and weight[0].count_nonzero() == 64
    torch.testing.assert_close(weight.sum(-1), torch.ones(2, 1))


def test_a_domain_without_segments_is_refused() -> None:
    bare = replace(toy_domains(2, trajectories=3)[1], dlo_mask=np.zeros(32, bool))
    with pytest.raises(RunError, match="domain 1 of 2 has no segment"):
        windows.standardise([toy_domains(1, trajectories=3)[0], bare], horizon=2, bodies=False, target="absolute")


def test_what_cannot_be_learnt_from_is_refused() -> None:
    [domain] = toy_domains(1, trajectories=2)
    options: dict[str, Any] = {"horizon": 2, "bodies": False, "target": "displacement"}
    for nothing in ([], [domain.take(slice(0, 0))]):
        with pytest.raises(RunError, match="no trajectories"):
            windows.standardise(nothing, **options)
    broken = domain.executed.copy()
    broken[0, 1] = np.nan
    with pytest.raises(RunError, match=r"domain 1 of 2 .* not finite"):
        windows.standardise([domain, replace(domain, executed=broken)], **options)
    with pytest.raises(RunError, match=r"differ in pushes: \[4, 6\]"):
        windows.standardise([domain, *toy_domains(1, trajectories=2, pushes=4)], **options)
    with pytest.raises(RunError, match=r"horizon = 9 does not fit .* 6 pushes"):
        windows.standardise([domain], **{**options, "horizon": 9})
    _, scaling = windows.standardise([domain], **options)
    with pytest.raises(RunError, match=r"3 pushes ahead.* fitted for 2"):
        scaling.inputs(domain.windows(3)[0])


def quadratic() -> tuple[torch.Tensor, Any]:
    weight = torch.tensor([3.0], requires_grad=True)
    return weight, lambda: weight.square().sum()


def test_descend_keeps_the_best_validated_weights_and_stops() -> None:
    weight, loss = quadratic()
    seen: list[tuple[int, float]] = []
    valid = iter([5.0, 1.0, 2.0, 3.0, 4.0])

    def validate() -> float:
        seen.append((len(seen), weight.item()))
        return next(valid)

    plan = fit.Plan(steps=1000, learning_rate=0.01, patience=2, every=10)
    curve: list[int] = []
    log = Log([lambda step, total, values: curve.append(step)])
    fit.descend([weight], loss, validate, plan=plan, budget=Budget(), log=log)
    assert len(seen) == 4 and curve[-1] == 40
    assert weight.item() == seen[1][1]


def test_descend_without_validation_keeps_the_last() -> None:
    weight, loss = quadratic()
    plan = fit.Plan(steps=2000, learning_rate=0.01, patience=2)
    fit.descend([weight], loss, None, plan=plan, budget=Budget(), log=Log())
    assert abs(weight.item()) < 0.01


def test_descend_logs_often() -> None:
    weight, loss = quadratic()
    entries: list[tuple[int, int, dict[str, float]]] = []
    log = Log([lambda *entry: entries.append(entry)])
    fit.descend([weight], loss, lambda: loss().item(), plan=replace(PLAN, steps=110), budget=Budget(), log=log)
    assert [step for step, _, _ in entries] == [1, 25, 50, 75, 100, 110]
    assert [step for step, _, values in entries if "valid" in values] == [50, 100, 110]
    assert {total for _, total, _ in entries} == {110} and all("loss" in values for _, _, values in entries)
    assert entries[0][2]["loss"] == pytest.approx(9.0) and entries[-1][2]["loss"] < entries[1][2]["loss"] < 9


@pytest.mark.parametrize("budget", [Budget(steps=1), Budget(minutes=0)])
def test_descend_keeps_to_its_budget(budget: Budget) -> None:
    weight, loss = quadratic()
    steps: list[int] = []
    fit.descend([weight], loss, None, plan=PLAN, budget=budget, log=Log([lambda step, *_: steps.append(step)]))
    assert steps == [1]


def test_descend_names_step_and_loss_when_it_diverges() -> None:
    weight, _ = quadratic()
    counter = iter(range(1, 1000))
    with pytest.raises(RunError, match="diverged at step 25 of 300: loss nan, at first 3"):
        fit.descend(
            [weight],
            lambda: weight.sum() * (float("nan") if next(counter) == 13 else 1.0),
            None, plan=PLAN, budget=Budget(), log=Log(),
        )  # fmt: skip
    weight, _ = quadratic()
    growing = iter(range(1000))
    with pytest.raises(RunError, match=r"diverged at step 50 of 300: loss \d+.*, at first \d+"):
        fit.descend(
            [weight], lambda: 0 * weight.sum() + 3.0 ** next(growing), None, plan=PLAN, budget=Budget(), log=Log()
        )


def test_a_first_batch_of_things_that_rest_is_no_measure_of_divergence() -> None:
    weight, _ = quadratic()
    losses, steps = iter([1e-9] + [1.0] * 299), list[int]()
    log = Log([lambda step, *_: steps.append(step)])
    fit.descend([weight], lambda: 0 * weight.sum() + next(losses), None, plan=PLAN, budget=Budget(), log=log)
    assert steps[-1] == 300


@pytest.mark.parametrize("name", ["mlp", "multitask"])
@pytest.mark.parametrize("target", ["displacement", "absolute"])
def test_regressors_beat_persistence_on_what_they_know(name: str, target: str) -> None:
    domain = toy_domain(np.random.default_rng(0), trajectories=60)
    train, test = domain.take(slice(0, 40)), domain.take(slice(40, 60))
    model = make(name, width=32, depth=2, learning_rate=3e-3, steps=1500, target=target)
    model.fit([train], [domain.take(slice(30, 40))], Setting(horizon=2, K=(0,)))
    still = make("persistence")
    still.fit([train], [], Setting(horizon=2, K=(0,)))
    query, truth = test.windows(2)
    errors = [error(m.predict(query, 1).dlo, truth.dlo, query.dlo_mask) for m in (model, still)]
    assert errors[0] < (0.1 if target == "displacement" else 0.4) * errors[1]
    assert model.parameters() > 1000 and still.parameters() == 0


def make(name: str, **settings: Any) -> Model:
    """Builds the model of a plugin file."""
    module = load(name)
    [cls] = [
        c
        for c in vars(module).values()
        if isinstance(c, type) and issubclass(c, Model) and c.__module__ == module.__name__
    ]
    model = cls(**settings)
    assert isinstance(model, Model)
    return model


def test_persistence_predicts_where_things_are() -> None:
    domain = with_bodies(toy_domains(1, trajectories=2)[0])
    query, _ = domain.windows(2)
    prediction = make("persistence").predict(query, 5)
    np.testing.assert_array_equal(prediction.dlo[0], query.dlo[..., :2])
    assert prediction.bodies is not None
    np.testing.assert_array_equal(prediction.bodies[0], query.bodies)
    assert not np.shares_memory(prediction.bodies, query.bodies) and not np.shares_memory(prediction.dlo, query.dlo)


@pytest.mark.parametrize("name", ["mlp", "multitask", "finetune", "maml", "neural_process", "gnn", "gnn_context"])
def test_models_are_the_same_at_a_seed_and_leave_the_global_one_alone(name: str) -> None:
    train = toy_domains(3, trajectories=4)
    query, _ = train[0].windows(2)
    state = torch.random.get_rng_state()
    predictions = []
    for seed in (1, 1, 2):
        model = make(name, seed=seed, steps=5)
        model.fit(train[:2], train[2:], Setting(horizon=2, K=(0, 2)))
        predictions.append(model.predict(query, 3).dlo)
    assert predictions[0].shape == (1, len(query), 32, 2) and predictions[0].dtype == np.float32
    np.testing.assert_array_equal(predictions[0], predictions[1])
    assert not np.array_equal(predictions[0], predictions[2])
    assert torch.equal(state, torch.random.get_rng_state())


@pytest.mark.parametrize("name", ["mlp", "multitask", "finetune", "maml", "neural_process", "gnn", "gnn_context"])
def test_models_keep_to_their_budget(name: str) -> None:
    train = toy_domains(2, trajectories=4)
    for budget in (Budget(steps=1), Budget(minutes=0)):
        steps: list[int] = []
        start = time.monotonic()
        model = make(name, steps=10**9)
        model.fit(train, [], Setting(2, (0, 1), budget, Log([lambda step, *_, seen=steps: seen.append(step)])))
        assert steps == [1] and time.monotonic() - start < 5


@pytest.mark.parametrize("name", ["mlp", "multitask", "finetune", "maml"])
def test_models_refuse_to_diverge(name: str) -> None:
    train = toy_domains(2, trajectories=4)
    with pytest.raises(RunError, match="diverged at step"):
        make(name, learning_rate=1e4, steps=500).fit(train, [], Setting(2, (0, 1)))


def test_prediction_does_not_depend_on_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    train = toy_domains(2, trajectories=4)
    model = make("multitask", steps=5)
    model.fit(train, [], Setting(2, (0,)))
    query, _ = train[0].windows(2)
    whole = model.predict(query, 1).dlo
    monkeypatch.setattr(fit, "CHUNK", 7)
    np.testing.assert_allclose(model.predict(query, 1).dlo, whole, atol=1e-7)
    one = model.predict(query.take(np.array([3])), 1).dlo
    np.testing.assert_allclose(one[:, 0], whole[:, 3], atol=1e-7)
    assert model.predict(query.take(np.arange(0)), 1).dlo.shape == (1, 0, 32, 2)
