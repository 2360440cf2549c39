"""One domain: how the error depends on the length of the DLO, 10, 13 and 16 cm (the paper's single-domain-medium)."""

from dlobench.bench.task import Scale, Task

TASK = Task(
    name="length_sweep",
    version=1,
    set="single-domain-medium",
    apart=True,
    horizon=(1, 2, 4, 8),
    mini=Scale(trajectories=(50,), support=0, query=20, K=(0,)),
    small=Scale(trajectories=(500,), support=0, query=50, K=(0,)),
    paper=Scale(trajectories=(5_000,), support=0, query=500, K=(0,)),
)
