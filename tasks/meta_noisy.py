"""Unseen domains under imperfect measurements: `meta`, of which a model sees noisy poses and is scored on true ones."""

from dlobench.bench.task import Noise, Scale, Task

TASK = Task(
    name="meta_noisy",
    version=1,
    set="meta-learning",
    where={"length": 0.16, "rigid_objects": 0},
    horizon=(4,),
    noise=Noise(position=0.002, yaw=0.1),
    mini=Scale(trajectories=(20,), support=10, query=10, K=(0, 1, 10)),
    small=Scale(trajectories=(60,), support=50, query=10, K=(0, 1, 10, 50)),
    paper=Scale(trajectories=(100, 500), support=50, query=450, K=(0, 1, 10, 50)),
)
