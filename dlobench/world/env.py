"""Offers a domain as a dm_control environment: an action is one push, an episode one trajectory of 20 pushes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dm_control.rl import control
from dm_env import StepType, TimeStep

from dlobench import ranges
from dlobench.domain import Domain
from dlobench.errors import UsageError
from dlobench.world.episode import Pushing, Shaping
from dlobench.world.physics import Physics
from dlobench.world.simulate import PUSHES
from dlobench.world.state import PUSH_TIME, Array


class Environment(control.Environment):  # type: ignore[misc]  # dm_control is untyped
    """Runs episodes. `copy.deepcopy` gives a twin to plan with, to the last bit.

    Where the simulation fails (MuJoCo warns, or things are pressed into each other) the push is taken back and the
    episode cut: its last step shows the state before that push, nothing executed, with a discount of 1.
    """

    _reset_next_step: bool  # dm_control's

    def step(self, action: Array) -> TimeStep:
        """Executes a push, or starts an episode when none is on; raises `UsageError` for an action outside its spec."""
        if self._reset_next_step:
            return self.reset()
        try:
            return super().step(action)
        except control.PhysicsError:
            self._task.take_back(self._physics)
            self._reset_next_step = True
            reward = self._task.get_reward(self._physics)
            return TimeStep(StepType.LAST, reward, 1.0, self._task.get_observation(self._physics))


def make(domain: Domain, seed: int | Sequence[int] = 0, noise: bool = True, goal: bool = False) -> Environment:
    """Makes the environment of a domain.

    The domain may be sampled (`dlobench.domain.sample`) or be one of a set (`dlobench.data.sets.domain`). `noise=False`
    executes just what is asked for; `goal=True` adds a goal to the observation and the reward to it.
    Raises `UsageError` for what is no domain or no seed.
    """
    if not isinstance(domain, Domain):
        by_id = "an id such as meta-learning/17 gives one by dlobench.data.sets.domain"
        raise UsageError(f"domain = {ranges.shown(domain)} is not a Domain; {by_id}")
    physics = Physics(domain)
    task = (Shaping if goal else Pushing)(ranges.seed(seed), noise)
    steps = round(PUSH_TIME / physics.timestep())
    length = (PUSHES - 0.5) * steps * physics.timestep()  # half a push less, so that no rounding adds one
    return Environment(physics, task, time_limit=length, n_sub_steps=steps)


def make_torchrl_env(domain: Domain, seed: int | Sequence[int] = 0, noise: bool = True, goal: bool = False) -> Any:
    """Makes the environment of a domain for torchrl, a `DMControlWrapper`, of what `make` takes.

    Seeds are given here: torchrl's `set_seed` begins another episode and changes no more.
    """
    from torchrl.envs import DMControlWrapper  # type: ignore[import-untyped]  # noqa: PLC0415  # heavy

    return DMControlWrapper(make(domain, seed, noise, goal))
