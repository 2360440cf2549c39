"""Draws what a step costs and what it errs, over random pushes: the picture of docs/adr/0008.

Run as `python tests/benchmarks/step_size.py docs/pictures/step_size.png`; some five minutes on one core.
"""

from __future__ import annotations

import sys
import time

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from dlobench.validation.probe import Probe, walk
from dlobench.validation.survey import MOVED, domains, gather

STEPS = (0.002, 0.003, 0.004, 0.005, 0.006, 0.01)  # s, each a whole number of times in a push
TRAJECTORIES, PUSHES = 4, 8


def error(timestep: float) -> tuple[float, float, int]:
    """Returns mean and median error a push against a tenth of the step, m, and over how many pushes."""
    found = gather(domains("quick")[::3], TRAJECTORIES, PUSHES, timestep=timestep, workers=1)
    motion = np.concatenate([f.compared.motion for f in found])
    errors = np.concatenate([f.compared.step for f in found])[motion > MOVED]
    return float(errors.mean()), float(np.median(errors)), len(errors)


def speed(timestep: float) -> float:
    """Returns pushes per second of processor time with three rigid bodies, one thread."""
    pushes, spent = 0, 0.0
    for i, domain in enumerate(d for d in domains("quick")[::3] if len(d.bodies) == 3):
        probe = Probe(domain, 8, timestep=timestep)
        begun = time.process_time()
        pushes += sum(push.commands for push in walk(probe, [[5, i, k, 0] for k in range(8)], PUSHES))
        spent += time.process_time() - begun
    return pushes / spent


def main(out: str) -> None:
    """Measures, prints a table and draws."""
    rows = [(step, *error(step), speed(step)) for step in STEPS]
    print("step, ms | mean error, mm | median, mm | pushes compared | pushes/s, 3 bodies")  # noqa: T201
    for step, mean, median, count, rate in rows:
        print(f"{1e3 * step:g} | {1e3 * mean:.2f} | {1e3 * median:.2f} | {count} | {rate:.0f}")  # noqa: T201
    figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
    steps, means, medians, _, rates = (np.array(column) for column in zip(*rows, strict=True))
    axes.plot(rates, 1e3 * means, "o-", color="#0072b2", label="mean")
    axes.plot(rates, 1e3 * medians, "s--", color="#d55e00", label="median")
    for step, mean, rate in zip(steps, means, rates, strict=True):
        axes.annotate(f"{1e3 * step:g} ms", (rate, 1e3 * mean), xytext=(4, 4), textcoords="offset points")
    axes.axhline(0.3, color="0.6", linewidth=1)
    axes.set(xlabel="pushes per second and core, 3 rigid bodies", ylabel="step-size error a push, mm", ylim=(0, None))
    axes.legend(frameon=False)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main(sys.argv[1])
