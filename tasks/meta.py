"""Unseen domains: adapt on K trajectories, predict 4 pushes ahead (the paper's Table 1)."""

from dlobench.bench.task import Scale, Task

TASK = Task(
    name="meta",
    version=1,
    set="meta-learning",
    where={"length": 0.16, "rigid_objects": 0},
    horizon=(4,),
    mini=Scale(trajectories=(20,), support=10, query=10, K=(0, 1, 10)),
    small=Scale(trajectories=(60,), support=50, query=10, K=(0, 1, 10, 50)),
    paper=Scale(trajectories=(100, 500), support=50, query=450, K=(0, 1, 10, 50)),
)
