"""Draws how many pushes buy an accuracy: power laws of the error against pushes to train on, and where they lead."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from drawing import main, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from recorded import MM, Recorded, across, look, markdown, missing, read, shown

from dlobench.bench.matrix import Matrix, grids
from dlobench.bench.statistics import LEVEL, Array, Interval, interval, resampled
from dlobench.errors import UsageError

TARGET = 1e-3  # m
BEYOND = 100.0  # times the largest size that was measured: farther a law is not asked
THIN = "hollow: few domains have that size; thin: beyond what was measured, unless the law bends"


@dataclass(frozen=True)
class PowerLaw:
    """Holds error = a n^−b of the typical domain, which has the geometric mean of the domains' errors."""

    a: float  # m, at one push
    exponent: Interval  # b
    last: Interval  # b between the two largest sizes, of the domains that have both; where fewer than two do, b
    pushes: Interval  # that bring the error down to `TARGET`; infinite where none do

    @property
    def bends(self) -> bool:
        """Tells whether the last step brings more or less than the law says, so that it leads nowhere."""
        low, high = self.last.low, self.last.high
        return low is not None and high is not None and not low <= self.exponent.estimate <= high

    def error(self, n: Array) -> Array:
        """Returns the error after n pushes, m."""
        out: Array = self.a * n**-self.exponent.estimate
        return out


def fit(sizes: Array, errors: Array, seeds: tuple[str, ...], domains: tuple[str, ...]) -> PowerLaw:
    """Returns the power law of sizes (N,) in pushes and errors (N, S, D) in m, NaN where a domain lacks a size.

    Least squares in logarithms, in which every domain has an intercept of its own and all share one exponent, so that
    domains that lack the largest sizes distort nothing. The exponent has the interval of a ratio of sums over seeds and
    domains, and the pushes the percentiles of resamplings of both. Where the truth is known (18 domains, of which 3
    have the largest of 3 sizes, exponents alike or not) 95–96 % of the former and 92–95 % of the latter hold it.
    Raises `UsageError` unless two domains have two sizes each.
    """
    x = np.where(np.isfinite(errors), np.log(sizes)[:, None, None], np.nan)
    y = np.log(errors)
    if not np.isfinite(errors).any(axis=0).all() or (np.isfinite(errors).sum(axis=0).min(axis=0) > 1).sum() < 2:
        raise UsageError("a power law needs two domains that have two sizes each")
    middle, level = np.nanmean(x, axis=0), np.nanmean(y, axis=0)  # (S, D)
    below = np.nansum((x - middle) ** 2, axis=0)
    above = -np.nansum((x - middle) * (y - level), axis=0)
    exponent = interval(above, below, seeds, domains)
    ones = np.ones_like(level)

    def pushes(b: Array, height: Array, at: Array) -> Array:
        """Returns where the line through (at, height) of slope −b meets the target."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            reached = np.exp(at + (height - np.log(TARGET)) / b)
        out: Array = np.where(b > 0, reached, np.inf)
        return out

    b, height, at = exponent.estimate, level.mean(), middle.mean()
    drawn = pushes(*(resampled(v, w, seeds, domains) for v, w in ((above, below), (level, ones), (middle, ones))))
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="inverted_cdf")
    needed = float(pushes(np.array(b), np.array(height), np.array(at)))
    found = Interval(needed, float(low), float(high), len(domains), len(seeds))
    both = np.isfinite(errors[-2:]).all(axis=(0, 1))
    step = (y[-2] - y[-1])[:, both] / np.log(sizes[-1] / sizes[-2])
    last = interval(step, np.ones_like(step), seeds, tuple(np.array(domains)[both])) if both.sum() > 1 else exponent
    return PowerLaw(float(np.exp(height + b * at)), exponent, last, found)


def stacked(cells: dict[int, Matrix]) -> tuple[Array, Array, tuple[str, ...], tuple[str, ...]]:
    """Returns sizes and errors (N, S, D) of matrices by size, over the seeds that all have, as `fit` takes them."""
    seeds = tuple(sorted(set.intersection(*(set(one.seeds) for one in cells.values()))))
    domains = tuple(sorted({name for one in cells.values() for name in one.domains}))
    out = np.full((len(cells), len(seeds), len(domains)), np.nan)
    for row, size in zip(out, sorted(cells), strict=True):
        there = [domains.index(name) for name in cells[size].domains]
        row[:, there] = cells[size].over(seeds, cells[size].domains).values
    return np.array(sorted(cells), float), out, seeds, domains


def laws(of: Recorded) -> dict[tuple[str, int], PowerLaw]:
    """Returns the power law of each model at each horizon that has enough for one."""
    cells: dict[tuple[str, int], dict[int, Matrix]] = {}
    for (name, horizon, pushes), one in grids(of.frame, "euclidean", ["name", "horizon", "pushes"]).items():
        cells.setdefault((name, int(horizon)), {})[int(pushes)] = one
    out = {}
    for key, found in cells.items():
        with suppress(UsageError):  # after failed fits, say: the others have theirs, and `draw` tells whose is missing
            out[key] = fit(*stacked(found))
    return out


def said(found: Interval, most: float) -> str:
    """Returns pushes as text, with their interval; of more than `most` only that they are more."""
    more = f"> {most:.0e}"

    def number(value: float | None) -> str:
        return f"{value:.1e}" if value is not None and value <= most else more

    if number(found.low) == more:
        return more
    return f"{number(found.estimate)} ({number(found.low)} to {number(found.high)})"


def curves(axes: Axes, of: Recorded, found: dict[tuple[str, int], PowerLaw], horizon: int) -> None:
    """Draws what was measured of each domain's typical error, the law within it and, thinner, beyond it."""
    for name in [name for name in of.names if (name, horizon) in found]:
        rows, how = of.where(name=name, horizon=horizon).frame, look(name)
        law = found[name, horizon]
        n = np.sort(rows["pushes"].unique()).astype(float)
        axes.plot(n, MM * law.error(n), color=how["color"], linestyle=how["linestyle"])
        if not law.bends:
            beyond = np.geomspace(n[-1], BEYOND * n[-1], 20)
            axes.plot(beyond, MM * law.error(beyond), color=how["color"], linestyle=how["linestyle"], linewidth=0.5)
        # A domain that lacks a size moves no point: each error is set beside the domain's own over all of its sizes
        logs = np.log(rows["euclidean"])
        apart = logs - np.log(law.error(rows["pushes"].to_numpy(float)))
        of_domain = apart.groupby(rows["domain"]).transform("mean")
        typical = np.exp((logs - of_domain).groupby(rows["pushes"]).mean())
        measured = rows.groupby("pushes")["domain"].nunique()
        for size, error in typical.items():
            fill = how["color"] if measured[size] == measured.max() else "white"
            axes.plot([size], [MM * error], **how | {"linestyle": "", "markerfacecolor": fill})
        axes.plot([], [], **how, label=name)
    axes.axhline(MM * TARGET, color="0.5", linewidth=0.8)
    axes.set(
        xscale="log",
        yscale="log",
        title=f"n = {horizon}",
        xlabel="pushes to train on",
        xlim=(7e2, 1.5 * BEYOND * of.frame["pushes"].max()),
    )
    axes.set_ylim(0.5, 60)
    axes.set_yticks([0.5, 1, 2, 5, 10, 20, 50], ["0.5", "1", "2", "5", "10", "20", "50"])
    axes.minorticks_off()


def forest(axes: Axes, of: Recorded, found: dict[tuple[str, int], PowerLaw], horizon: int) -> None:
    """Draws the exponent of each model with its interval."""
    for row, name in enumerate(of.names):
        if (name, horizon) in found:
            across(axes, row, found[name, horizon].exponent, look(name))
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(range(len(of.names)), of.names)
    axes.set(ylim=(len(of.names) - 0.5, -0.5), xlabel="exponent b")


def draw(results: Path, out: Path) -> None:
    """Draws the laws and their exponents, a column a horizon, and writes both with the pushes as a table."""
    of = read(results, "horizon_sweep", "single_domain")
    sizes = of.frame.groupby("name")["trajectories"].nunique()
    names = [name for name in of.names if sizes[name] > 1 and name != "persistence"]  # which has nothing to learn
    if not names:
        raise missing(of.task, "mlp", what="record with several train sizes")
    of = of.where(name=names)
    found, horizons = laws(of), sorted(map(int, of.frame["horizon"].unique()))
    lacking = [f"{name} at n = {n}" for name in names for n in horizons if (name, n) not in found]
    told = f"; too few sizes and domains for a law: {', '.join(lacking)}" if lacking else ""
    figure = Figure(figsize=(1.5 + 1.9 * len(horizons), 4.6), layout="constrained")
    axes = figure.subplots(2, len(horizons), squeeze=False, sharey="row", height_ratios=(3, 0.3 + 0.25 * len(of.names)))
    for (top, bottom), horizon in zip(axes.T, horizons, strict=True):
        curves(top, of, found, horizon)
        forest(bottom, of, found, horizon)
    axes[0, 0].set_ylabel("Euclidean error of the typical domain, mm")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=len(of.names))
    save(figure, "power_law", out, f"{of.footnote()}; {THIN}; grey: {MM * TARGET:g} mm{told}")
    most = BEYOND * int(of.frame["pushes"].max())
    rows = [["model", "n", "exponent b", "b of the last step", f"pushes for {MM * TARGET:g} mm"]]
    rows += [
        [
            name,
            str(n),
            *(shown(each, 1, 3) for each in (one.exponent, one.last)),
            "it bends" if one.bends else said(one.pushes, most),
        ]
        for (name, n), one in sorted(found.items())
    ]
    fitted = ", ".join(f"{size:,}" for size in sorted(of.frame["pushes"].unique()))
    note = (
        f"error = a·n^−b of the typical domain, fitted to {fitted} pushes and extrapolated, at most "
        f"{BEYOND:g} times as far, unless the interval of the last step leaves out b; {of.footnote()}{told}."
    )
    markdown(out / "power_law.md", rows, note)


if __name__ == "__main__":
    sys.exit(main(draw))
