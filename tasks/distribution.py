"""The spread of the future: samples under execution noise, beside the same commands executed again and again."""

from dlobench.bench.task import Scale, Task

TASK = Task(
    name="distribution",
    version=1,
    set="single-domain-large",
    futures="distribution",
    apart=True,
    horizon=(1, 4),
    mini=Scale(trajectories=(50,), support=0, query=2, K=(0,)),
    small=Scale(trajectories=(500,), support=0, query=10, K=(0,)),
    paper=Scale(trajectories=(50_000,), support=0, query=1000, K=(0,)),
)
