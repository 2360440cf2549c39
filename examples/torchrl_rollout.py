"""Collects a rollout with torchrl under a policy that pushes towards the DLO; takes the number of pushes."""

import sys

from tensordict import TensorDictBase

from dlobench.data import sets
from dlobench.world.env import make_torchrl_env

env = make_torchrl_env(sets.domain("meta-learning/600"), seed=0)
longest = float(env.action_spec.space.high.max())  # m, of a push


def towards(state: TensorDictBase) -> TensorDictBase:
    """Pushes from the pusher towards a segment in the middle, as far as a push may go."""
    way = state["dlo"][state["dlo"].shape[0] // 4, :2] - state["pusher"]
    return state.set("action", longest * way / way.norm())


rollout = env.rollout(max_steps=int(sys.argv[1]) if len(sys.argv) > 1 else 20, policy=towards)
moved = (rollout["next", "dlo"] - rollout["dlo"])[..., :2].norm(dim=-1).max(dim=-1).values
print(rollout)
print("the largest displacement of a segment in each push, mm:", [round(1000 * float(each), 1) for each in moved])
