"""One domain, far ahead: models apply themselves to what they predicted, up to 16 pushes."""

from dlobench.bench.task import Scale, Task

TASK = Task(
    name="rollout",
    version=1,
    set="single-domain-large",
    apart=True,
    rolled=True,
    horizon=(1, 2, 4, 8, 16),
    mini=Scale(trajectories=(50,), support=0, query=20, K=(0,)),
    small=Scale(trajectories=(500,), support=0, query=50, K=(0,)),
    paper=Scale(trajectories=(50_000,), support=0, query=500, K=(0,)),
)
