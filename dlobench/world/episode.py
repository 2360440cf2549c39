"""Says what happens in an episode: how it starts, what a push does, what is seen, and what is worth something."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import mujoco
import numpy as np
from dm_control.rl import control
from dm_env import specs
from numpy.typing import NDArray

from dlobench import ranges
from dlobench.domain import MAX_BODIES, MAX_SEGMENTS, WORKSPACE
from dlobench.errors import UsageError
from dlobench.world import actions, goal, starts
from dlobench.world.physics import Physics
from dlobench.world.scene import REACH
from dlobench.world.simulate import Streams
from dlobench.world.state import Array

LONGEST = actions.DISTANCE[1]  # m, the bound of each component of an action
ROUNDING = 1e-6  # m, by which an action may pass its bound: agents reckon in float32
GOAL_STREAM = 3  # the goal's own random numbers come after the three streams of a trajectory
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class Pushing(control.Task):  # type: ignore[misc]  # dm_control is untyped
    """Pushes the DLO about: an action is a displacement of the pusher, executed with noise. There is no reward.

    A displacement that would leave the pusher's reach is cut at its border, since an agent cannot be asked again.
    Episode e of seed s is the simulated trajectory of seed (s, e): its start, its noise and, if the agent commands the
    same pushes, its states.
    """

    def __init__(self, seed: Sequence[int], noise: bool) -> None:
        self._seed = tuple(seed)
        self._noise = noise
        self._episode = 0
        self._streams = Streams.of([*seed, 0, 0])
        self._executed = np.zeros(2)
        self._before = np.zeros(0)

    def initialize_episode(self, physics: Physics) -> None:
        """Samples a start from the episode's seed and lets it settle."""
        seed = [*self._seed, self._episode, 0]  # 0: a trajectory's first attempt
        self._episode += 1
        self._streams = Streams.of(seed)
        self._executed = np.zeros(2)
        start = starts.sample(physics.domain, self._streams.start)
        self._aim(physics, start, np.random.default_rng([*seed, GOAL_STREAM]))
        goal.settle(physics, start)

    def before_step(self, action: Array, physics: Physics) -> None:
        """Plans the push: the action plus execution noise, cut at the border of the reach.

        Raises `UsageError` for an action that is outside of the action spec.
        """
        asked = _checked(action)
        self._before = np.empty(mujoco.mj_stateSize(physics.model, _STATE))
        mujoco.mj_getState(physics.model, physics.data, self._before, _STATE)
        noise = actions.noise(self._streams.noise) if self._noise else np.zeros(2)
        pusher = physics.state().pusher[0]
        wanted = asked + noise
        inside = np.abs(pusher + wanted) <= REACH  # what stays inside is taken as it is, to the last bit
        self._executed = np.where(inside, wanted, np.clip(pusher + wanted, -REACH, REACH) - pusher)
        physics.plan(self._executed)

    def after_step(self, physics: Physics) -> None:
        """Raises `control.PhysicsError` when things have been pressed into each other."""
        goal.check(physics)

    def take_back(self, physics: Physics) -> None:
        """Brings back the state before the last push, as if it had not been executed."""
        mujoco.mj_setState(physics.model, physics.data, self._before, _STATE)
        mujoco.mj_kinematics(physics.model, physics.data)
        self._executed = np.zeros(2)

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Bounds each component of the displacement by the longest push, m."""
        return specs.BoundedArray((2,), np.float64, minimum=-LONGEST, maximum=LONGEST, name="displacement")

    def get_observation(self, physics: Physics) -> OrderedDict[str, NDArray[np.float64]]:
        """Returns the planar poses and the displacement that was last executed."""
        state = physics.state()
        named = {"dlo": state.dlo[0], "pusher": state.pusher[0], "bodies": state.bodies[0], "executed": self._executed}
        return OrderedDict((name, value.copy()) for name, value in named.items())

    def observation_spec(self, physics: Physics) -> OrderedDict[str, specs.Array]:
        """Describes the observation, SI, padding is 0: places are between the walls, angles from −π to π."""
        place, pose = [WORKSPACE / 2] * 2, [WORKSPACE / 2, WORKSPACE / 2, np.pi]
        executed = [LONGEST + actions.NOISE_LIMIT] * 2
        return OrderedDict(
            dlo=_within("dlo", (MAX_SEGMENTS, 3), pose),
            pusher=_within("pusher", (2,), place),
            bodies=_within("bodies", (MAX_BODIES, 3), pose),
            executed=_within("executed", (2,), executed),
        )

    def get_reward(self, physics: Physics) -> float:
        """Returns 0: the world is pushed to be predicted."""
        return 0.0

    def _aim(self, physics: Physics, start: starts.Start, rng: np.random.Generator) -> None:
        """Chooses what the episode is after: nothing."""


class Shaping(Pushing):
    """Pushes the DLO into a goal: a shape and place that pushes did bring about from the same start.

    The observation shows the goal's segment centres as `goal`; the reward is the negative mean distance to them, m. The
    goal has random numbers of its own, so that starts and noise are those of an episode without one.
    """

    def __init__(self, seed: Sequence[int], noise: bool) -> None:
        super().__init__(seed, noise)
        self._goal = np.zeros((MAX_SEGMENTS, 2))

    def get_observation(self, physics: Physics) -> OrderedDict[str, NDArray[np.float64]]:
        """Returns what `Pushing` shows, and the goal: (32, 2) segment centres x m, y m."""
        return OrderedDict(super().get_observation(physics), goal=self._goal.copy())

    def observation_spec(self, physics: Physics) -> OrderedDict[str, specs.Array]:
        """Describes the observation, the goal included."""
        shown = _within("goal", self._goal.shape, [WORKSPACE / 2] * 2)
        return OrderedDict(super().observation_spec(physics), goal=shown)

    def get_reward(self, physics: Physics) -> float:
        """Returns the negative mean distance of the segments' centres to the goal's, m."""
        return -goal.distance(goal.centres(physics), self._goal[: physics.domain.segments])

    def _aim(self, physics: Physics, start: starts.Start, rng: np.random.Generator) -> None:
        self._goal = goal.reach(physics, start, rng)


def _checked(action: Array) -> Array:
    """Returns an action as (2,) float64; raises `UsageError` when it is outside of the action spec."""
    try:
        asked = np.asarray(action, dtype=float)
    except (TypeError, ValueError):
        asked = np.zeros(0)
    if asked.shape != (2,) or not (np.abs(asked) <= LONGEST + ROUNDING).all():
        raise UsageError(f"action = {ranges.shown(action)} is not two numbers within ±{LONGEST:g} m")
    clipped: Array = np.clip(asked, -LONGEST, LONGEST)
    return clipped


def _within(name: str, shape: tuple[int, ...], bound: list[float]) -> specs.BoundedArray:
    """Describes an observation whose last axis is bounded by ± `bound`."""
    most = np.broadcast_to(np.array(bound), shape)
    return specs.BoundedArray(shape, np.float64, minimum=-most, maximum=most, name=name)
