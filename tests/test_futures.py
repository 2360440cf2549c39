"""Tests re-executed futures: one state, the same commands, fresh noise; samples of what ordinary pushes lead to."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dlobench.domain import typical
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Trajectories
from dlobench.world import actions, futures, simulate, starts
from dlobench.world.simulate import Account, Simulator

A, R, T = 2, 6, 3
DOMAIN = typical(material="elastoplastic", attachment="none", length=0.10, rigid_objects=1)


@pytest.fixture(scope="module")
def some() -> tuple[Trajectories, Account]:
    """Simulates two sequences from one state, six times each."""
    return futures.futures(DOMAIN, [5, 10], sequences=A, executions=R, pushes=T)


def test_all_begin_in_one_state_and_sequences_share_their_commands(some: tuple[Trajectories, Account]) -> None:
    found, _ = some
    assert found.dlo.shape == (A * R, T + 1, 32, 3)
    for name in ("dlo", "pusher", "bodies", "cylinder"):
        begin = getattr(found, name)[:, 0]
        assert (begin == begin[0]).all()
    commands = found.commanded.reshape(A, R, T, 2)
    assert (commands == commands[:, :1]).all()
    assert (commands[0, 0] != commands[1, 0]).all()


def test_noise_is_fresh_in_every_execution_and_bounded(some: tuple[Trajectories, Account]) -> None:
    found, _ = some
    noise = (found.executed - found.commanded).reshape(-1, 2)
    assert len(np.unique(noise, axis=0)) == A * R * T
    assert np.linalg.norm(noise, axis=1).max() <= actions.NOISE_LIMIT + 1e-8
    ends = found.pusher[:, -1] - found.pusher[:, 0]
    assert ends == pytest.approx(found.executed.sum(axis=1), abs=5e-4), "the pusher does what is executed"
    spread = found.dlo[:R, -1, : DOMAIN.segments, :2].std(axis=0)
    assert spread.max() > 1e-5, "and the futures differ"


def test_a_seed_gives_the_same_futures_and_another_seed_others(some: tuple[Trajectories, Account]) -> None:
    again, account = futures.futures(DOMAIN, [5, 10], sequences=A, executions=R, pushes=T)
    assert account == some[1]
    assert all(np.array_equal(getattr(again, name), getattr(some[0], name)) for name in ("dlo", "executed", "bodies"))
    other, _ = futures.futures(DOMAIN, [5, 12], sequences=A, executions=R, pushes=T)
    assert not np.array_equal(other.dlo[:, 0], again.dlo[:, 0])


def test_more_executions_leave_the_first_ones_as_they_are(some: tuple[Trajectories, Account]) -> None:
    more, _ = futures.futures(DOMAIN, [5, 10], sequences=1, executions=R + 2, pushes=T)
    assert np.array_equal(more.dlo[:R], some[0].dlo[:R])


def test_a_restored_state_goes_on_as_if_it_had_never_been_left() -> None:
    (trajectory, account) = simulate.simulate(DOMAIN, [[1, 2]], pushes=3)
    assert account.trajectories_redrawn == 0
    one = Simulator(DOMAIN, 1)
    one.reset([starts.sample(DOMAIN, simulate.Streams.of([1, 2, 0]).start)])
    streams = simulate.Streams.of([1, 2, 0])
    exact = []
    for step in range(3):
        noise = actions.noise(streams.noise)
        exact.append(trajectory.commanded[0, step].astype(float) + noise)
    one.push(exact[0][None])
    saved = one.save()
    state = one.push(exact[1][None])
    many = Simulator(DOMAIN, 4)
    assert np.array_equal(many.restore(saved).dlo[2], one.restore(saved).dlo[0])
    assert np.array_equal(many.push(np.repeat(exact[1][None], 4, axis=0)).dlo[3], state.dlo[0]), "to the last bit"


def test_an_execution_that_fails_is_drawn_again_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    push, failed = Simulator.push, [0]

    def fail_once(self: Simulator, displacement: np.ndarray) -> object:
        state = push(self, displacement)
        if len(displacement) == R and not failed[0]:
            self.failed[[1, 4]] = True
            failed[0] = 1
        return state

    alike, _ = futures.futures(DOMAIN, [5, 10], sequences=1, executions=R, pushes=T)
    monkeypatch.setattr(Simulator, "push", fail_once)
    found, account = futures.futures(DOMAIN, [5, 10], sequences=1, executions=R, pushes=T)
    assert account.trajectories_redrawn == 2
    same = [np.array_equal(found.executed[i], alike.executed[i]) for i in range(R)]
    assert same == [True, False, True, True, False, True]
    assert (found.commanded == alike.commanded).all()


def test_a_state_that_fails_is_drawn_again_and_one_that_always_fails_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    push = Simulator.push

    def fail(self: Simulator, displacement: np.ndarray) -> object:
        state = push(self, displacement)
        self.failed[:] = bool(np.abs(displacement).max())  # every push, but not the settling
        return state

    monkeypatch.setattr(Simulator, "push", fail)
    with pytest.raises(RunError, match=r"20 states in a row failed from seed \[5, 10\]"):
        futures.futures(DOMAIN, [5, 10], sequences=1, executions=1, pushes=1)


def test_a_pusher_that_is_stuck_costs_a_state_or_a_trajectory(monkeypatch: pytest.MonkeyPatch) -> None:
    draw, drawn = actions.draw, [0]

    def stuck_once(*arguments: Any) -> Any:
        drawn[0] += 1
        if drawn[0] == 2:
            raise actions.Stuck("no feasible push")
        return draw(*arguments)

    monkeypatch.setattr(actions, "draw", stuck_once)
    _, account = futures.futures(DOMAIN, [5, 10], sequences=1, executions=2, pushes=2)
    assert account.trajectories_redrawn == 1
    drawn[0] = 0
    found, account = simulate.simulate(DOMAIN, [[1, 2], [1, 3]], pushes=2)
    assert account.trajectories_redrawn == 1
    alone, _ = simulate.simulate(DOMAIN, [[1, 2]], pushes=2)
    assert np.array_equal(found.dlo[0], alone.dlo[0]), "the other trajectory does not notice"


@pytest.mark.parametrize("wrong", [{"sequences": 0}, {"executions": 0}, {"pushes": 0}, {"pushes": 21}])
def test_numbers_that_make_no_sense_are_refused(wrong: dict[str, int]) -> None:
    (name,) = wrong
    with pytest.raises(UsageError, match=f"{name} = "):
        futures.futures(DOMAIN, [1], **{"sequences": 1, "executions": 1, "pushes": 1} | wrong)


def test_futures_spread_as_ordinary_pushes_do() -> None:
    """One push from one state: its executions scatter about the commanded place of the pusher by the noise's size."""
    found, _ = futures.futures(DOMAIN, [9], sequences=1, executions=64, pushes=1)
    off = found.pusher[:, 1] - found.pusher[:, 0] - found.commanded[:, 0]
    assert off.std() == pytest.approx(actions.NOISE, rel=0.25)
    assert np.abs(off.mean(axis=0)).max() < 4 * actions.NOISE / 8
