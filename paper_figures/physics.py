"""Draws how physical parameters change the error: each domain's log error, regressed on what the domain is made of."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from drawing import main, save
from matplotlib.figure import Figure
from recorded import Recorded, across, choose, everything, log_errors, look, markdown, missing, scored, shown

from dlobench.bench.statistics import LEVEL, Array, Interval, counts
from dlobench.data.sets import domain
from dlobench.domain import Domain
from dlobench.errors import UsageError

COLUMNS = 5  # of panels
# Pairs by which questions are answered: where the ratio of their errors keeps still, the answer holds everywhere
ANSWERS = ("maml", "multitask"), ("gnn", "mlp"), ("gnn_context", "gnn"), ("gnn_context", "maml")
RATIO = {"color": "0.35", "marker": "o"}  # how a ratio looks, as no model does
TASKS = ("meta", "meta_objects")  # the first has DLOs of one length and no rigid bodies


@dataclass(frozen=True)
class Regression:
    """Holds the effect of each parameter on the log error, the others held, and the share of variance they explain."""

    effects: dict[str, Interval]
    explained: float  # R²


def design(domains: Sequence[Domain]) -> dict[str, Array]:
    """Returns the columns (D,) of a regression: numbers in standard deviations, kinds as 0 or 1.

    Stiffness and yield curvature are logarithms. What never yields has the mean yield curvature, so that its effect is
    one among those that yield. What is the same in all domains has no column.
    """

    def standard(values: Sequence[float]) -> Array:
        x = np.array(values, float)
        there = x[np.isfinite(x)]
        spread = there.std() if there.size else 0.0
        return np.nan_to_num((x - there.mean()) / spread) if spread > 1e-12 else np.zeros_like(x)

    def kind(flags: Sequence[bool]) -> Array:
        return np.array(flags, float)

    columns = {
        "friction": standard([d.surface_friction for d in domains]),
        "density": standard([d.density for d in domains]),
        "length": standard([d.length for d in domains]),
        "log stiffness": standard([np.log(d.bending_stiffness) for d in domains]),
        "it yields": kind([d.yield_curvature is not None for d in domains]),
        "log yield curvature": standard([np.log(d.yield_curvature or np.nan) for d in domains]),
        "movable attachment": kind([d.attachment == "movable" for d in domains]),
        "fixed attachment": kind([d.attachment == "fixed" for d in domains]),
        "rigid bodies": standard([len(d.bodies) for d in domains]),
    }
    return {name: column for name, column in columns.items() if np.ptp(column) > 0}


def regress(columns: dict[str, Array], y: Array, seeds: tuple[str, ...], names: tuple[str, ...]) -> Regression:
    """Returns least-squares effects of columns (D,) on y (S, D), with percentile intervals over domains and seeds.

    Where the truth is known (54 of the domains of `meta`, normal errors, one seed) 95 % of the intervals hold it; of 18
    domains, too wide, 99 %. Raises `UsageError` for fewer than two domains more than columns, and for columns that say
    the same.
    """
    X = np.column_stack([np.ones(len(names)), *columns.values()])
    if len(names) < X.shape[1] + 2 or np.linalg.matrix_rank(X) < X.shape[1]:
        raise UsageError(f"{len(names)} domains do not tell {len(columns)} parameters apart")
    mean = y.mean(axis=0)
    beta, *_ = np.linalg.lstsq(X, mean, rcond=None)
    of_domains = counts("domains", names)
    drawn = counts("seeds", seeds) @ y / len(seeds)
    squares = np.einsum("rd,di,dj->rij", of_domains, X, X, optimize=True)
    moments = np.einsum("rd,di,rd->ri", of_domains, X, drawn, optimize=True)
    betas = (np.linalg.pinv(squares, hermitian=True) @ moments[..., None])[..., 0]
    low, high = np.quantile(betas, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    effects = {
        name: Interval(float(beta[i]), float(low[i]), float(high[i]), len(names), len(seeds))
        for i, name in enumerate(columns, start=1)
    }
    explained = 1 - np.square(mean - X @ beta).sum() / max(np.square(mean - mean.mean()).sum(), 1e-300)
    return Regression(effects, float(explained))


def regressions(of: Recorded) -> dict[str, Regression]:
    """Returns the regression of each model, and of the pairs of `ANSWERS`, over the domains that all seeds have."""
    logs = {name: log_errors(of.where(name=name).frame).filled() for name in of.names}
    logs |= {f"{a} ÷ {b}": logs[a] - logs[b] for a, b in ANSWERS if {a, b} <= set(logs)}
    return {
        name: regress(design([domain(each) for each in one.domains]), one.values, one.seeds, one.domains)
        for name, one in logs.items()
    }


def percent(effect: Interval) -> Interval:
    """Returns the change of an error in percent that a change of its logarithm is."""
    low, high = (None if end is None else 100 * float(np.expm1(end)) for end in (effect.low, effect.high))
    return replace(effect, estimate=100 * float(np.expm1(effect.estimate)), low=low, high=high)


def draw(results: Path, out: Path) -> None:
    """Draws the effects on each task of `TASKS` that has records."""
    records = everything(results)
    there = [task for task in TASKS if any(record.task == task for record in records)]
    if not there:
        raise missing(TASKS[0], "gnn_context")
    for task in there:
        panels(scored(choose(records, task)), "physics" if task == TASKS[0] else f"physics_{task}", out)


def panels(of: Recorded, called: str, out: Path) -> None:
    """Draws a panel of effects for each model and pair, at the largest K, and writes them as a table."""
    of = of.where(trajectories=of.frame["trajectories"].max(), K=of.frame["K"].max())
    found = regressions(of)
    effects = list(dict.fromkeys(name for one in found.values() for name in one.effects))
    rows = -(-len(found) // COLUMNS)
    figure = Figure(figsize=(1.6 + 1.5 * min(COLUMNS, len(found)), 0.6 + 2.2 * rows), layout="constrained")
    axes = figure.subplots(rows, min(COLUMNS, len(found)), squeeze=False, sharex=True, sharey=True)
    for panel, (name, one) in zip(axes.flat, found.items(), strict=False):
        for effect, interval in one.effects.items():
            across(panel, effects.index(effect), percent(interval), RATIO if "÷" in name else look(name))
        panel.axvline(0, color="black", linewidth=0.8)
        panel.set_title(f"{name}\nR² = {one.explained:.2f}", fontsize=7)
    for panel in axes.flat[len(found) :]:
        panel.set_axis_off()
    for column in range(axes.shape[1]):
        axes.flat[max(range(column, len(found), axes.shape[1]))].tick_params(labelbottom=True)
    axes[0, 0].set_yticks(range(len(effects)), effects)
    axes[0, 0].set_ylim(len(effects) - 0.5, -0.5)
    figure.suptitle("change of the error, %, by one standard deviation more, or by what is there", fontsize=8)
    K = int(of.frame["K"].iloc[0])
    save(figure, called, out, f"{of.footnote()}; K = {K}; filled: the interval leaves out 0")
    table = [["model", *effects, "R²"]]
    for name, one in found.items():
        cells = [one.effects.get(effect) for effect in effects]
        texts = ["–" if cell is None else shown(percent(cell), 1, 0) for cell in cells]
        table.append([name, *texts, f"{one.explained:.2f}"])
    lacking = sorted({"length", "rigid bodies"} - set(effects))
    same = f" The same in all domains: {', '.join(lacking)}." if lacking else ""
    note = (
        "Change of the error in percent by one standard deviation more of a parameter, the others held, or by what is "
        f"there; bootstrap over domains; K = {K}; {of.footnote()}.{same}"
    )
    markdown(out / f"{called}.md", table, note)


if __name__ == "__main__":
    sys.exit(main(draw))
