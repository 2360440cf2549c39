"""Unseen domains of every length, with up to 3 rigid bodies, which the paper left out; bodies count where predicted."""

from dlobench.bench.task import Scale, Task

TASK = Task(
    name="meta_objects",
    version=1,
    set="meta-learning",
    horizon=(4,),
    mini=Scale(trajectories=(20,), support=10, query=10, K=(0, 1, 10)),
    small=Scale(trajectories=(20,), support=10, query=10, K=(0, 1, 10)),
    paper=Scale(trajectories=(100, 500), support=50, query=450, K=(0, 1, 10, 50)),
)
