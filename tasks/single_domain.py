"""One domain: fit on its pushes, predict 1 push ahead, the more data the better (the paper's Fig. 3, first column)."""

from dlobench.bench.task import Scale, Task

TASK = Task(
    name="single_domain",
    version=1,
    set="single-domain-large",
    apart=True,
    horizon=(1,),
    mini=Scale(trajectories=(50,), support=0, query=20, K=(0,)),
    small=Scale(trajectories=(50, 500, 5_000), support=0, query=50, K=(0,)),
    paper=Scale(trajectories=(50, 500, 5_000, 50_000), support=0, query=500, K=(0,)),
)
