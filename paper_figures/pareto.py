"""Draws the error against what it costs: parameters, the time of a fit and of a prediction."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from drawing import main, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from recorded import MM, Recorded, errorbar, label, log_mm, look, markdown, read, shown

from dlobench.bench.statistics import Interval

COSTS = {"parameters": "parameters", "seconds": "time of a fit, s", "prediction": "time of a prediction, ms"}


def costs(of: Recorded) -> dict[str, dict[str, float]]:
    """Returns the mean costs of each model over its seeds: parameters, seconds of a fit, ms of one prediction."""
    out = {}
    for name in of.names:
        mine = [record for record in of.records if label(record) == name]
        out[name] = {
            "parameters": float(np.mean([record.parameters for record in mine])),
            "seconds": float(np.mean([fit.seconds for record in mine for fit in record.fits])),
            "prediction": float(1e3 * of.where(name=name).frame["predict_seconds"].mean()),
        }
    return out


def front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Returns the names of (cost, error) that no other is at most as dear and better than, the cheapest first."""
    out, best = list[str](), float("inf")
    for name in sorted(points, key=lambda name: points[name]):
        if points[name][1] < best:
            out.append(name)
            best = points[name][1]
    return out


def panel(axes: Axes, found: Mapping[str, Interval], cost: Mapping[str, float], what: str, honest: list[str]) -> None:
    """Draws one cost: marks with intervals, and the front of what needs no privilege as a step."""
    for name, one in found.items():
        errorbar(axes, [cost[name]], [one], **look(name) | {"linestyle": ""}, label=name)
    best = front({name: (cost[name], found[name].estimate) for name in honest})
    steps = [cost[name] for name in best], [MM * found[name].estimate for name in best]
    axes.step(*steps, where="post", color="0.6", linewidth=0.8, zorder=0, label="the front")
    if min(cost.values()) <= 0:
        axes.set_xscale("symlog", linthresh=min(value for value in cost.values() if value > 0) / 3)
    else:
        axes.set_xscale("log")
    axes.set_xlabel(COSTS[what])


def draw(results: Path, out: Path) -> None:
    """Draws a panel a cost, at the largest K, and writes all as a table."""
    of = read(results, "meta")
    of = of.where(trajectories=of.frame["trajectories"].max(), K=of.frame["K"].max())
    K = str(of.frame["K"].iloc[0])
    found = {name: one for (name, _), one in of.intervals("euclidean", ["K"]).items()}
    found, cost = {name: found[name] for name in of.names}, costs(of)
    privileged = {label(record) for record in of.records if record.privileged}
    honest = [name for name in of.names if name not in privileged]
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    axes = figure.subplots(1, len(COSTS), sharey=True)
    for each, what in zip(axes, COSTS, strict=True):
        panel(each, found, {name: one[what] for name, one in cost.items()}, what, honest)
    axes[0].set_ylabel("mean Euclidean error, mm")
    log_mm(axes[0])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper")
    told = f"; {', '.join(privileged)} is told the parameters" if privileged else ""
    save(
        figure,
        "pareto",
        out,
        f"{of.footnote()}; K = {K}; times as recorded, by the code of then, on one of two busy cores{told}",
    )
    rows = [["model", "error, mm", *COSTS.values()]]
    for name in of.names:
        one = cost[name]
        numbers = [f"{one['parameters']:,.0f}", f"{one['seconds']:.1f}", f"{one['prediction']:.3f}"]
        rows.append([name, shown(found[name], MM), *numbers])
    markdown(out / "pareto.md", rows, f"K = {K}; {of.footnote()}{told}.")


if __name__ == "__main__":
    sys.exit(main(draw))
