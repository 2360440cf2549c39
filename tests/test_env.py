"""Tests the environment against dm_env's own contract, torchrl's, and what its docstrings promise."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from absl.testing import absltest
from dm_env import StepType, test_utils
from numpy.typing import NDArray
from test_domain import UNEQUAL, make

from dlobench.data import sets
from dlobench.domain import ATTACHMENTS, WORKSPACE, Attachment, Domain
from dlobench.errors import UsageError
from dlobench.world import actions, env, goal
from dlobench.world.physics import Physics
from dlobench.world.scene import REACH
from dlobench.world.simulate import simulate

Array = NDArray[np.float64]

BODIES = make(material="soft", attachment="movable", bodies=(UNEQUAL,))
FIXED = make(material="elastoplastic", attachment="fixed", length=0.12)


class Contract(test_utils.EnvironmentTestMixin):  # type: ignore[misc]  # dm_env is untyped
    """Drives an episode to its end and two pushes into the next."""

    domain: Domain
    goal = False

    def make_object_under_test(self) -> Any:
        return env.make(self.domain, seed=3, goal=self.goal)

    def make_action_sequence(self) -> Iterator[Array]:
        rng = np.random.default_rng(0)
        for _ in range(22):
            yield rng.uniform(-0.024, 0.024, size=2)


class TestBodies(Contract, absltest.TestCase):
    domain = BODIES


class TestFixed(Contract, absltest.TestCase):
    domain = FIXED


class TestGoal(Contract, absltest.TestCase):
    domain = BODIES
    goal = True


class TestFixedGoal(Contract, absltest.TestCase):
    domain = FIXED
    goal = True


@pytest.mark.parametrize("goal", [False, True], ids=["plain", "goal"])
@pytest.mark.parametrize("domain", [BODIES, FIXED], ids=["bodies", "fixed"])
def test_torchrl_takes_it_as_it_is(domain: Domain, goal: bool) -> None:
    from torchrl.envs import DMControlWrapper  # type: ignore[import-untyped]
    from torchrl.envs.utils import check_env_specs  # type: ignore[import-untyped]

    wrapped = DMControlWrapper(env.make(domain, goal=goal))
    check_env_specs(wrapped)
    rollout = wrapped.rollout(25)
    assert rollout.shape == (20,)
    assert rollout["next", "dlo"].shape == (20, 32, 3)
    assert rollout["next", "done"].squeeze(-1).tolist() == [False] * 19 + [True]
    assert not rollout["next", "terminated"].any()  # it is cut, nothing ended
    assert ("goal" in set(rollout.keys())) is goal
    assert bool((rollout["next", "reward"] < 0).all()) is goal


def test_an_episode_is_twenty_pushes() -> None:
    world = env.make(FIXED)
    step = world.reset()
    assert step.step_type is StepType.FIRST
    kinds = []
    for _ in range(20):
        step = world.step(np.array([0.001, 0.0]))
        kinds.append(step.step_type)
        assert step.reward == 0.0 and step.discount == 1.0
    assert kinds == [StepType.MID] * 19 + [StepType.LAST]
    assert world.step(np.zeros(2)).step_type is StepType.FIRST
    assert world.physics.time() == pytest.approx(0.3)  # the settling


@pytest.mark.parametrize("goal", [False, True])
@pytest.mark.parametrize("domain", [BODIES, FIXED])
def test_specs_say_what_is_seen(domain: Domain, goal: bool) -> None:
    world = env.make(domain, goal=goal)
    seen, specs = world.reset().observation, world.observation_spec()
    names = ["dlo", "pusher", "bodies", "executed", *["goal"] * goal]
    assert list(seen) == list(specs) == names
    shapes = {"dlo": (32, 3), "pusher": (2,), "bodies": (3, 3), "executed": (2,), "goal": (32, 2)}
    for name, spec in specs.items():
        spec.validate(seen[name])
        assert spec.shape == shapes[name] and spec.dtype == np.float64
        bound = {"executed": 0.024 + actions.NOISE_LIMIT}.get(name, WORKSPACE / 2)
        np.testing.assert_array_equal(spec.maximum[..., :2], np.full((*spec.shape[:-1], 2), bound))
        np.testing.assert_array_equal(spec.maximum[..., 2:], np.full((*spec.shape[:-1], spec.shape[-1] - 2), np.pi))
        np.testing.assert_array_equal(spec.minimum, -spec.maximum)
    assert not seen["dlo"][domain.segments :].any() and seen["dlo"][: domain.segments, :2].all()
    assert not seen["bodies"][len(domain.bodies) :].any() and not seen["executed"].any()
    action = world.action_spec()
    np.testing.assert_array_equal(action.minimum, [-0.024, -0.024])
    np.testing.assert_array_equal(action.maximum, [0.024, 0.024])


@pytest.mark.parametrize("noise", [True, False])
def test_a_push_beyond_the_reach_is_cut_at_its_border(noise: bool) -> None:
    world = env.make(make(length=0.10), seed=1, noise=noise)
    pusher = world.reset().observation["pusher"]
    cuts = 0
    for _ in range(16):
        step = world.step(np.array([0.024, -0.01]))
        executed, after = step.observation["executed"], step.observation["pusher"]
        wanted = np.array([0.024, -0.01]) if not noise else None
        assert np.abs(pusher + executed).max() <= REACH + 1e-12
        for axis, asked in enumerate([0.024, -0.01]):
            border = np.copysign(REACH, asked)
            if abs(pusher[axis] + asked) > REACH + 0.002:
                assert executed[axis] == pytest.approx(border - pusher[axis], abs=1e-12)
                cuts += 1
            elif abs(pusher[axis] + asked) < REACH - 0.002 and wanted is not None:
                assert executed[axis] == wanted[axis]  # inside it is left alone, to the last bit
        assert np.abs(after).max() < REACH + 1e-3
        pusher = after
    assert cuts > 6


def test_noise_is_on_the_push_unless_told_otherwise() -> None:
    action = np.array([0.003, 0.004])
    noisy, exact = (env.make(FIXED, seed=5, noise=noise) for noise in (True, False))
    for world in (noisy, exact):
        world.reset()
    drawn = [noisy.step(action).observation["executed"] - action for _ in range(5)]
    assert all(0 < np.linalg.norm(noise) <= 1.5e-3 for noise in drawn)
    for _ in range(5):
        np.testing.assert_array_equal(exact.step(action).observation["executed"], action)


def episode(world: Any) -> list[dict[str, Array]]:
    """Plays four pushes and returns what was seen."""
    seen = [world.reset().observation]
    seen += [world.step(np.array([0.02, 0.004 * i])).observation for i in range(4)]
    return [dict(observation) for observation in seen]


def test_episodes_follow_seed_and_number() -> None:
    world, twin, other = env.make(BODIES, seed=8), env.make(BODIES, seed=8), env.make(BODIES, seed=9)
    first, second = episode(world), episode(world)
    for ours, theirs in zip([*first, *second], [*episode(twin), *episode(twin)], strict=True):
        for name, value in ours.items():
            np.testing.assert_array_equal(value, theirs[name])
    for different in (second, episode(other)):
        for name in ("dlo", "pusher", "bodies"):
            assert not np.array_equal(first[0][name], different[0][name])
        assert not np.array_equal(first[1]["executed"], different[1]["executed"])
    # A seed of several numbers is a seed of its own, and how an episode went does not shift the next.
    assert not np.array_equal(episode(env.make(BODIES, seed=[8, 1]))[0]["pusher"], first[0]["pusher"])
    idle = env.make(BODIES, seed=8)
    idle.reset()
    np.testing.assert_array_equal(idle.reset().observation["dlo"], second[0]["dlo"])
    assert not second[0]["executed"].any()  # nothing of the first episode is left


def test_observations_are_copies() -> None:
    world = env.make(BODIES, seed=2)
    seen = world.reset().observation
    kept = {name: value.copy() for name, value in seen.items()}
    after = world.step(np.array([0.02, 0.0])).observation
    for name, value in seen.items():
        np.testing.assert_array_equal(value, kept[name])
        assert not np.shares_memory(value, after[name])
    twin = env.make(BODIES, seed=2)
    for value in twin.reset().observation.values():
        value[:] = 7.0  # a careless agent
    for name, value in twin.step(np.array([0.02, 0.0])).observation.items():
        np.testing.assert_array_equal(value, after[name])


def test_an_episode_is_the_trajectory_of_its_seed_and_number() -> None:
    made, account = simulate(FIXED, [[11, 4, 0], [11, 4, 1]], pushes=3)
    assert account.trajectories_redrawn == 0
    noise = made.executed.astype(float) - made.commanded
    world = env.make(FIXED, seed=[11, 4])
    for i in range(2):
        start = world.reset().observation
        for name in ("dlo", "pusher"):
            np.testing.assert_array_equal(start[name].astype(np.float32), getattr(made, name)[i, 0])
        executed = [world.step(np.zeros(2)).observation["executed"] for _ in range(3)]
        np.testing.assert_allclose(executed, noise[i], atol=5e-9)


def test_a_domain_of_a_set_is_found_by_its_id() -> None:
    world = env.make(sets.domain("meta-learning/17"), seed=1)
    assert world.physics.domain == sets.find("meta-learning").domain(17)
    assert world.reset().first() and world.step(np.zeros(2)).mid()


@pytest.mark.parametrize("domain", ["meta-learning/17", 17, None])
def test_what_is_no_domain_is_refused(domain: Any) -> None:
    with pytest.raises(UsageError, match=r"^domain = .* is not a Domain; .*meta-learning/17.*sets\.domain$"):
        env.make(domain)


@pytest.mark.parametrize("seed", [-1, 1.5, True, "3", None, [3, -1], [1, "2"]])
def test_what_is_no_seed_is_refused(seed: Any) -> None:
    with pytest.raises(UsageError, match=r"^seed = .* (is not a whole number within|is outside) 0, 1, 2, …$"):
        env.make(FIXED, seed=seed)


@pytest.mark.parametrize(
    "action",
    [[0.0241, 0.0], [0.0, -1.0], [np.nan, 0.0], [0.0, np.inf], [0.0], 0.01, [[0.01, 0.0]], "up", None, [None, 0.0]],
    ids=str,
)
def test_an_action_outside_its_spec_is_refused_and_changes_nothing(action: Any) -> None:
    world, twin = (env.make(FIXED, seed=4) for _ in range(2))
    world.reset(), twin.reset()
    with pytest.raises(UsageError, match=r"^action = [^\n]+ is not two numbers within ±0\.024 m$"):
        world.step(action)
    one, two = (each.step(np.array([0.01, 0.0])).observation for each in (world, twin))
    for name, value in one.items():
        np.testing.assert_array_equal(value, two[name])


def test_single_precision_reaches_the_bounds() -> None:
    world = env.make(make(length=0.10), seed=1, noise=False)
    world.reset()
    spec = world.action_spec()
    towards = -np.sign(world.reset().observation["pusher"])
    executed = world.step((towards * spec.maximum).astype(np.float32)).observation["executed"]
    np.testing.assert_array_equal(executed, towards * spec.maximum)


def test_a_copy_is_a_twin() -> None:
    world = env.make(BODIES, seed=2, goal=True)
    world.reset()
    world.step(np.array([0.02, 0.0]))
    twin = copy.deepcopy(world)
    for i in range(20):  # into the next episode
        one, two = (each.step(np.array([0.01, 0.002 * (i % 5)])) for each in (world, twin))
        assert one.step_type is two.step_type and one.reward == two.reward
        for name, value in one.observation.items():
            np.testing.assert_array_equal(value, two.observation[name])


@pytest.mark.parametrize("goal", [False, True])
@pytest.mark.parametrize("how", ["warning", "pressed"])
def test_a_failed_simulation_cuts_the_episode(how: str, goal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    world, twin = (env.make(BODIES, seed=7, goal=goal) for _ in range(2))
    for each in (world, twin):
        each.reset()
        each.step(np.array([0.0, 0.01]))
    before = world.step(np.array([0.01, 0.0]))
    with monkeypatch.context() as patch:
        if how == "warning":
            patch.setattr(actions, "noise", lambda rng: np.full(2, 1e-3) + np.array([1e12, 0.0]))
            patch.setattr("dlobench.world.episode.REACH", 1e13)
        else:
            patch.setattr("dlobench.world.goal.impossible", lambda domain, state: np.array([True]))
        cut = world.step(np.array([0.01, 0.01]))
    assert cut.last() and cut.discount == 1.0 and cut.reward == before.reward
    for name, value in cut.observation.items():
        np.testing.assert_array_equal(value, 0 * value if name == "executed" else before.observation[name])
    again, next_one = world.step(np.zeros(2)), twin.reset()
    assert again.first()
    for name, value in again.observation.items():
        np.testing.assert_array_equal(value, next_one.observation[name])


@pytest.mark.parametrize("attachment", ATTACHMENTS)
def test_a_goal_changes_neither_start_nor_noise_nor_what_follows(attachment: Attachment) -> None:
    domain = make(material="elastoplastic", attachment=attachment, length=0.10, bodies=(UNEQUAL,))
    plain, aimed = env.make(domain, seed=6), env.make(domain, seed=6, goal=True)
    goals = []
    for _ in range(2):
        for one, two in zip(episode(plain), episode(aimed), strict=True):
            for name, value in one.items():
                np.testing.assert_array_equal(value, two[name])
        goals.append(two["goal"])
    assert not np.array_equal(goals[0], goals[1])  # every episode has its own


@pytest.mark.parametrize("attachment", ATTACHMENTS)
def test_a_goal_is_a_pose_that_pushes_lead_to(attachment: Attachment, monkeypatch: pytest.MonkeyPatch) -> None:
    trials: list[list[Array]] = []
    settle, draw = goal.settle, actions.draw

    def settled(*where: Any) -> None:
        trials.append([])
        settle(*where)

    def drawn(*where: Any) -> tuple[Array, int]:
        found = draw(*where)
        trials[-1].append(found[0])
        return found

    monkeypatch.setattr(goal, "settle", settled)
    monkeypatch.setattr(actions, "draw", drawn)
    domain = make(attachment=attachment, length=0.10, bodies=(UNEQUAL,))
    world = env.make(domain, seed=2, noise=False, goal=True)
    start = world.reset().observation
    shape, first = start["goal"], start["dlo"]
    assert shape[:20].all() and not shape[20:].any()
    np.testing.assert_allclose(np.linalg.norm(np.diff(shape[:20], axis=0), axis=1), 0.005, atol=6e-4)  # bent, not torn
    assert goal.distance(first[:20, :2], shape[:20]) >= goal.DISTANCE
    pushes = next(trial for trial in reversed(trials) if trial)
    assert 1 <= len(pushes) <= 20
    rewards = [world.step(push).reward for push in pushes]
    assert rewards[-1] == 0.0 and all(reward < 0 for reward in rewards[:-1])
    if attachment == "fixed":  # the clamped end stays where the start has it
        yaw = first[0, 2]
        end = first[0, :2] - 0.0025 * np.array([np.cos(yaw), np.sin(yaw)])
        assert np.linalg.norm(shape[0] - end) == pytest.approx(0.0025, abs=1e-6)


def test_a_goal_that_is_hard_to_find_is_the_farthest_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Array] = []
    centres = goal.centres

    def watched(physics: Physics) -> Array:
        seen.append(centres(physics))
        return seen[-1]

    monkeypatch.setattr(goal, "DISTANCE", 1.0)  # m, wider than the table
    monkeypatch.setattr(goal, "TRIALS", 2)
    monkeypatch.setattr(goal, "centres", watched)
    shape = env.make(FIXED, seed=3, goal=True).reset().observation["goal"][: FIXED.segments]
    away = [np.linalg.norm(pose - seen[0], axis=1).mean() for pose in seen]
    assert len(seen) == 1 + 2 * 20 and max(away) > 0.005
    np.testing.assert_array_equal(shape, seen[int(np.argmax(away))])


def test_a_goal_is_found_although_simulations_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = env.make(FIXED, seed=3, goal=True)
    count = iter(range(10**6))
    with monkeypatch.context() as patch:
        patch.setattr(goal, "impossible", lambda domain, state: np.array([next(count) == 2]))
        seen = expected.reset().observation
    assert goal.distance(seen["dlo"][:24, :2], seen["goal"][:24]) > 0.01
    assert next(count) > 3  # it went on after the failure


def test_the_reward_is_the_distance_end_by_end() -> None:
    world = env.make(BODIES, seed=5, goal=True)
    aim = world.reset().observation["goal"]
    for i in range(3):
        step = world.step(np.array([0.01, -0.01 * i]))
        np.testing.assert_array_equal(step.observation["goal"], aim)
        apart = [np.hypot(*(step.observation["dlo"][k, :2] - aim[k])) for k in range(BODIES.segments)]
        assert step.reward == pytest.approx(-sum(apart) / BODIES.segments, rel=1e-12)
    n = BODIES.segments
    assert goal.distance(aim[:n], aim[:n]) == 0 and goal.distance(aim[:n][::-1], aim[:n]) > 0.01  # ends are told apart


def test_a_planner_needs_nothing_more() -> None:
    """Shoots at random in copies, keeps the best sequence, and gets just what it was promised."""
    domain = make(attachment="fixed", length=0.10)
    world = env.make(domain, seed=1, noise=False, goal=True)
    start, rng = world.reset().observation, np.random.default_rng(0)
    best: tuple[float, list[Array]] = (-goal.distance(start["dlo"][:20, :2], start["goal"][:20]), [])
    for _ in range(6):
        twin, seen, pushes = copy.deepcopy(world), start, []
        for _ in range(14):
            nearest = min(seen["dlo"][:20, :2], key=lambda place: float(np.hypot(*(place - seen["pusher"]))))
            towards = nearest - seen["pusher"] + rng.normal(scale=0.01, size=2)
            pushes.append(0.02 * towards / np.hypot(*towards))
            step = twin.step(pushes[-1])
            seen = step.observation
            best = max(best, (step.reward, list(pushes)), key=lambda found: found[0])
            if step.last():
                break
    for push in best[1]:
        step = world.step(push)
    assert step.reward == best[0] > -0.7 * goal.distance(start["dlo"][:20, :2], start["goal"][:20])
