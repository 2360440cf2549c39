"""Domains unlike all that were trained on: one material, one attachment or the extremes of a parameter are left out."""

from dlobench.bench.regions import Region
from dlobench.bench.task import Scale, Task

TASK = Task(
    name="ood",
    version=1,
    set="meta-learning",
    horizon=(4,),
    left_out=(
        Region("soft", "material", ("soft",)),
        Region("flexible", "material", ("flexible",)),
        Region("elastoplastic", "material", ("elastoplastic",)),
        Region("free", "attachment", ("none",)),
        Region("movable", "attachment", ("movable",)),
        Region("fixed", "attachment", ("fixed",)),
        Region("length", "length", (0.10, 0.16)),
        Region("density", "density", outside=(820.0, 1280.0)),  # kg/m³: a third of the domains
        Region("friction", "surface_friction", outside=(0.3, 0.7)),
    ),
    mini=Scale(trajectories=(20,), support=10, query=10, K=(0, 10)),
    small=Scale(trajectories=(20,), support=10, query=10, K=(0, 10)),
    paper=Scale(trajectories=(100,), support=50, query=450, K=(0, 10, 50)),
)
