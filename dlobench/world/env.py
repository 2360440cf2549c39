"""Offers a domain as a dm_control environment: an action is one push, an episode one trajectory of 20 pushes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
from dm_control.rl import control
from dm_env import specs
from numpy.typing import NDArray

from dlobench.domain import MAX_BODIES, MAX_SEGMENTS, Domain
from dlobench.world import actions, starts
from dlobench.world.physics import Physics
from dlobench.world.scene import REACH
from dlobench.world.simulate import PUSHES, Streams
from dlobench.world.state import PUSH_TIME, Array


class Pushing(control.Task):  # type: ignore[misc]  # dm_control is untyped
    """Pushes the DLO about: an action is a displacement of the pusher, executed with noise. There is no reward.

    A displacement that would leave the pusher's reach is cut at its border, since an agent cannot be asked again.
    Episode e of seed s starts as the simulated trajectory of seed (s, e) does.
    """

    def __init__(self, seed: Sequence[int], noise: bool = True) -> None:
        self._seed = tuple(seed)
        self._noise = noise
        self._episode = 0
        self._streams = Streams.of([*seed, 0])
        self._executed = np.zeros(2)

    def initialize_episode(self, physics: Physics) -> None:
        """Samples a start from the episode's seed and lets it settle."""
        self._streams = Streams.of([*self._seed, self._episode])
        self._episode += 1
        self._executed = np.zeros(2)
        physics.start(starts.sample(physics.domain, self._streams.start))
        physics.step(physics.plan(np.zeros(2)))

    def before_step(self, action: Array, physics: Physics) -> None:
        """Plans the push: the action plus execution noise, cut at the border of the reach."""
        noise = actions.noise(self._streams.noise) if self._noise else np.zeros(2)
        pusher = physics.state().pusher[0]
        wanted = np.asarray(action, dtype=float) + noise
        inside = np.abs(pusher + wanted) <= REACH  # what stays inside is taken as it is, to the last bit
        self._executed = np.where(inside, wanted, np.clip(pusher + wanted, -REACH, REACH) - pusher)
        physics.plan(self._executed)

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Bounds each component of the displacement by the longest push, m."""
        longest = actions.DISTANCE[1]
        return specs.BoundedArray((2,), np.float64, minimum=-longest, maximum=longest, name="displacement")

    def get_observation(self, physics: Physics) -> OrderedDict[str, NDArray[np.float64]]:
        """Returns the planar poses and the displacement that was last executed."""
        state = physics.state()
        named = {"dlo": state.dlo[0], "pusher": state.pusher[0], "bodies": state.bodies[0], "executed": self._executed}
        return OrderedDict((name, value.copy()) for name, value in named.items())

    def observation_spec(self, physics: Physics) -> OrderedDict[str, specs.Array]:
        """Describes the observation: SI units, padding is 0."""
        shapes = {"dlo": (MAX_SEGMENTS, 3), "pusher": (2,), "bodies": (MAX_BODIES, 3), "executed": (2,)}
        return OrderedDict((name, specs.Array(shape, np.float64, name=name)) for name, shape in shapes.items())

    def get_reward(self, physics: Physics) -> float:
        """Returns 0: the world is pushed to be predicted."""
        return 0.0


def make(domain: Domain, seed: int | Sequence[int] = 0, noise: bool = True) -> control.Environment:
    """Makes the environment of a domain; `noise=False` executes just what is asked for."""
    physics = Physics(domain)
    task = Pushing([seed] if isinstance(seed, int) else seed, noise)
    steps = round(PUSH_TIME / physics.timestep())
    return control.Environment(physics, task, time_limit=PUSHES * PUSH_TIME, n_sub_steps=steps)
