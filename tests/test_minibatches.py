"""Tests the minibatches: every window is what `Trajectories.windows` says, and an epoch has each of them once."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_store import fake

from dlobench.data.minibatches import CHUNK, Minibatch, Minibatches
from dlobench.data.sets import SETS
from dlobench.data.store import Rows, pack
from dlobench.errors import UsageError
from dlobench.trajectories import Trajectories

META = SETS["meta-learning"]
COUNTS = {600: 7, 17: 1, 3075: 12}  # trajectories by domain, in an order that is not that of their numbers
WORLDS = {domain: fake(META.domain(domain), K, seed=domain, pushes=8) for domain, K in COUNTS.items()}
ROWS = {domain: pack(trajectories) for domain, trajectories in WORLDS.items()}


def check(batch: Minibatch, trajectories: dict[int, Trajectories], numbers: Any, horizon: int) -> None:
    """Compares a minibatch with the windows of these numbers."""
    pairs = [(domain, *each.windows(horizon)) for domain, each in trajectories.items()]
    for name in ("dlo", "pusher", "bodies", "actions"):
        wanted = np.concatenate([getattr(query, name) for _, query, _ in pairs])[numbers]
        assert np.array_equal(getattr(batch, name), wanted), name
    after = np.concatenate([truth.dlo[0] for *_, truth in pairs])[numbers]
    assert np.array_equal(batch.dlo_after[..., :2], after)
    assert truth_bodies(pairs, numbers).tobytes() == np.ascontiguousarray(batch.bodies_after).tobytes()
    pusher = np.concatenate([each.pusher[:, horizon:].reshape(-1, 2) for each in trajectories.values()])[numbers]
    assert np.array_equal(batch.pusher_after, pusher)
    yaw = np.concatenate([each.dlo[:, horizon:, :, 2].reshape(-1, 32) for each in trajectories.values()])[numbers]
    assert np.array_equal(batch.dlo_after[..., 2], yaw)
    assert np.array_equal(batch.domain, np.repeat([d for d, *_ in pairs], [len(q) for _, q, _ in pairs])[numbers])


def truth_bodies(pairs: Any, numbers: Any) -> Any:
    """Returns the bodies after these windows."""
    return np.concatenate([truth.bodies[0] for *_, truth in pairs])[numbers]


@pytest.mark.parametrize("horizon", range(1, 9))
@pytest.mark.parametrize("domains", [(600,), (600, 17, 3075)], ids=["one", "several"])
def test_windows_are_those_of_the_trajectories(domains: tuple[int, ...], horizon: int) -> None:
    chosen = {domain: WORLDS[domain] for domain in domains}
    batches = Minibatches({domain: ROWS[domain] for domain in domains}, horizon=horizon)
    assert len(batches) == sum(COUNTS[domain] for domain in domains) * (8 - horizon + 1)
    numbers = np.random.default_rng(horizon).integers(len(batches), size=200)
    check(batches.take(numbers), chosen, numbers, horizon)
    check(batches.take(np.arange(len(batches))), chosen, slice(None), horizon)
    assert len(batches.take(np.arange(0))) == 0


def numbered(domains: dict[int, int], pushes: int = 8) -> dict[int, Rows]:
    """Returns rows whose pusher tells which row it is."""
    first, out = 0, {}
    for domain, K in domains.items():
        rows = np.zeros((K, pushes + 1, 114), np.float32)
        rows[:, :, 0] = np.arange(first, first + rows[:, :, 0].size).reshape(K, pushes + 1)
        out[domain], first = rows, first + rows[:, :, 0].size
    return out


@pytest.mark.parametrize("size", [1, 7, 64, CHUNK, CHUNK + 1, 10_000])
@pytest.mark.parametrize("domains", [{3: 1}, {3: 150}, {3: 100, 9: 1, 4: 50}], ids=str)
def test_an_epoch_has_every_window_once(domains: dict[int, int], size: int) -> None:
    rows = numbered(domains)
    batches = Minibatches(rows, horizon=3)
    found = list(batches.epoch(size, np.random.default_rng(0)))
    assert [len(batch) for batch in found[:-1]] == [size] * (len(found) - 1) and 0 < len(found[-1]) <= size
    seen = np.concatenate([batch.pusher[:, 0] for batch in found]).astype(int)
    wanted = np.concatenate([each[:, :6, 0].ravel() for each in rows.values()]).astype(int)
    assert np.array_equal(np.sort(seen), wanted)
    assert all(np.array_equal(batch.pusher_after[:, 0], batch.pusher[:, 0] + 3) for batch in found)


def test_an_epoch_is_shuffled_and_follows_its_generator() -> None:
    batches = Minibatches(numbered({3: 150}), horizon=1)
    one, again, other = (
        np.concatenate([batch.pusher[:, 0] for batch in batches.epoch(64, np.random.default_rng(seed))])
        for seed in (0, 0, 1)
    )
    assert np.array_equal(one, again) and not np.array_equal(one, other)
    for batch in list(batches.epoch(64, np.random.default_rng(0)))[:2]:
        trajectory, start = np.divmod(batch.pusher[:, 0].astype(int), 9)
        assert len({*trajectory}) == 64, "of different trajectories"
        assert len({*start}) == 8, "at all moments"
    rank = np.corrcoef(one, np.arange(len(one)))[0, 1]
    assert abs(rank) < 0.1


def test_drawing_reaches_all_windows_alike() -> None:
    batches = Minibatches(numbered({3: 4, 5: 6}), horizon=8)  # a window a trajectory
    rng = np.random.default_rng(0)
    counts = np.bincount((batches.draw(10_000, rng).pusher[:, 0] / 9).astype(int), minlength=10)
    assert len(counts) == 10 and counts.min() > 850 and counts.max() < 1150
    assert len(batches.draw(64, rng)) == 64


def test_minibatches_are_copies() -> None:
    rows = {domain: each.copy() for domain, each in ROWS.items()}
    batches = Minibatches(rows, horizon=2)
    kept = [(batch, batch.state.copy()) for batch in batches.epoch(5, np.random.default_rng(0))]
    for batch, state in kept:
        assert np.array_equal(batch.state, state), "a later minibatch has overwritten it"
        batch.state[:] = batch.actions[:] = batch.after[:] = 7
    for domain, each in rows.items():
        assert np.array_equal(each, ROWS[domain])


def test_tensors_share_the_arrays() -> None:
    import torch

    batch = Minibatches(ROWS, horizon=2).draw(9, np.random.default_rng(0))
    tensors = batch.torch()
    assert tensors.dlo.shape == (9, 32, 3) and tensors.actions.dtype == torch.float32
    assert tensors.domain.dtype == torch.int64
    for name in ("dlo", "pusher", "bodies", "actions", "dlo_after", "pusher_after", "bodies_after", "domain"):
        assert np.array_equal(getattr(tensors, name).numpy(), getattr(batch, name)), name
    tensors.state[0, 0] = 7
    assert batch.state[0, 0] == 7


@pytest.mark.parametrize("horizon", [0, 9, -1, 1.5, True, None])
def test_a_horizon_that_does_not_fit_is_refused(horizon: Any) -> None:
    with pytest.raises(UsageError, match=r"^horizon = .* (is outside|is not a whole number within) 1–8$"):
        Minibatches(ROWS, horizon=horizon)


@pytest.mark.parametrize("size", [0, -3, 2.0])
def test_a_size_that_is_none_is_refused(size: Any) -> None:
    batches, rng = Minibatches(ROWS, horizon=1), np.random.default_rng(0)
    with pytest.raises(UsageError, match=r"^size = "):
        batches.draw(size, rng)
    with pytest.raises(UsageError, match=r"^size = "):
        next(batches.epoch(size, rng))


@pytest.mark.parametrize("numbers", [[-1], [0, 160]])
def test_windows_that_do_not_exist_are_refused(numbers: list[int]) -> None:
    batches = Minibatches(ROWS, horizon=1)
    assert len(batches) == 160
    with pytest.raises(UsageError, match=r"are not all within 0 to 159$"):
        batches.take(np.array(numbers))


@pytest.mark.parametrize(
    "rows",
    [
        {},
        {1: ROWS[600], 2: ROWS[600][:, :5]},
        {1: ROWS[600].astype(np.float64)},
        {1: ROWS[600][:, :, :100]},
        {1: ROWS[600][::2]},
        {1: ROWS[600][:0]},
    ],
    ids=["none", "lengths", "float64", "columns", "strided", "empty"],
)
def test_what_are_no_rows_is_refused(rows: dict[int, Any]) -> None:
    with pytest.raises(UsageError):
        Minibatches(rows, horizon=1)
