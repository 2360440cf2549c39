"""Tests the environment against dm_env's own contract, torchrl's, and what its docstrings promise."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from absl.testing import absltest
from dm_env import StepType, test_utils
from numpy.typing import NDArray
from test_domain import UNEQUAL, make

from dlobench.domain import Domain
from dlobench.world import env
from dlobench.world.scene import REACH

Array = NDArray[np.float64]

BODIES = make(material="soft", attachment="movable", bodies=(UNEQUAL,))
FIXED = make(material="elastoplastic", attachment="fixed", length=0.12)


class Contract(test_utils.EnvironmentTestMixin):  # type: ignore[misc]  # dm_env is untyped
    """Drives an episode to its end and two pushes into the next."""

    domain: Domain

    def make_object_under_test(self) -> Any:
        return env.make(self.domain, seed=3)

    def make_action_sequence(self) -> Iterator[Array]:
        rng = np.random.default_rng(0)
        for _ in range(22):
            yield rng.uniform(-0.024, 0.024, size=2)


class TestBodies(Contract, absltest.TestCase):
    domain = BODIES


class TestFixed(Contract, absltest.TestCase):
    domain = FIXED


@pytest.mark.parametrize("domain", [BODIES, FIXED], ids=["bodies", "fixed"])
def test_torchrl_takes_it_as_it_is(domain: Domain) -> None:
    from torchrl.envs import DMControlWrapper  # type: ignore[import-untyped]
    from torchrl.envs.utils import check_env_specs  # type: ignore[import-untyped]

    wrapped = DMControlWrapper(env.make(domain))
    check_env_specs(wrapped)
    rollout = wrapped.rollout(25)
    assert rollout.shape == (20,)
    assert rollout["next", "dlo"].shape == (20, 32, 3)
    assert rollout["next", "done"].squeeze(-1).tolist() == [False] * 19 + [True]
    assert not rollout["next", "terminated"].any()  # it is cut, nothing ended


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


def test_specs_say_what_is_seen() -> None:
    for domain in (BODIES, FIXED):
        world = env.make(domain)
        seen, specs = world.reset().observation, world.observation_spec()
        assert list(seen) == list(specs) == ["dlo", "pusher", "bodies", "executed"]
        for name, spec in specs.items():
            spec.validate(seen[name])
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
