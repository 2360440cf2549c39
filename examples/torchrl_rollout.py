"""Collects a rollout of random pushes with torchrl: `python examples/torchrl_rollout.py [pushes]`."""

import sys

from dlobench.data import sets
from dlobench.world.env import make_torchrl_env

env = make_torchrl_env(sets.domain("meta-learning/600"), seed=0)
rollout = env.rollout(max_steps=int(sys.argv[1]) if len(sys.argv) > 1 else 20)
moved = (rollout["next", "dlo"] - rollout["dlo"])[..., :2].norm(dim=-1).max(dim=-1).values
print(rollout)
print("the largest displacement of a segment in each push, mm:", [round(1000 * float(each), 1) for each in moved])
