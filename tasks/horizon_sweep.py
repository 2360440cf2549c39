"""One domain: how the error grows with the horizon and falls with the number of pushes (the paper's Fig. 3)."""

from dlobench.bench.task import Scale, Task

TASK = Task(
    name="horizon_sweep",
    version=1,
    set="single-domain-large",
    apart=True,
    horizon=(1, 2, 4, 8),
    mini=Scale(trajectories=(50,), support=0, query=20, K=(0,)),
    small=Scale(trajectories=(50, 500, 5_000), support=0, query=50, K=(0,)),
    paper=Scale(trajectories=(50, 500, 5_000, 50_000), support=0, query=500, K=(0,)),
)
