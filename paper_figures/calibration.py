"""Draws whether samples are spread as the futures are: coverage, ranks of the truth, and the energy score."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from drawing import main, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from recorded import Recorded, across, label, look, markdown, missing, read, shown

from dlobench.bench.matrix import grid
from dlobench.bench.record import DomainScore
from dlobench.bench.statistics import Array, Interval, interval

LEVELS = {"coverage50": 50, "coverage90": 90}  # %, of the central intervals
RANKS = {"ranks": "rank of a coordinate", "shape_ranks": "depth rank of a shape"}
BASE = "mlp_gaussian"  # what a generative model has to beat


def histogram(of: Recorded, name: str, horizon: int, which: str) -> Array:
    """Returns how much more often than 1 in all bins the truth is in each bin of ranks, the mean over domains."""

    def shares(score: DomainScore) -> Array | None:
        counts = getattr(score, which)
        return np.array(counts) / sum(counts) * len(counts) if counts and sum(counts) else None

    cells = [cell for record in of.records if label(record) == name for cell in record.cells if cell.horizon == horizon]
    found = [each for cell in cells for score in cell.domains if (each := shares(score)) is not None]
    out: Array = np.mean(found, axis=0)
    return out


def normalised(of: Recorded, name: str, base: str | None) -> Interval:
    """Returns (energy score − floor) / (that of the base − floor) in the mean; without a base, persistence is it.

    0 is as good as executions of the same commands, 1 as good as the base.
    """
    frame = of.frame.assign(
        above=of.frame["energy"] - of.frame["energy_floor"],
        still=of.frame["persistence_energy"] - of.frame["energy_floor"],
    )
    rows = frame[frame["name"] == name]
    above = grid(rows, "above").filled()
    below = grid(rows, "still") if base is None else grid(frame[frame["name"] == base], "above")
    seeds = tuple(seed for seed in above.seeds if seed in below.seeds)
    domains = tuple(each for each in above.domains if each in below.whole)
    above, below = above.over(seeds, domains), below.over(seeds, domains)
    return interval(above.values, below.values, seeds, domains)


def coverage(axes: Axes, found: dict[str, dict[str, Interval]], names: list[str]) -> None:
    """Draws a row a model: the share of truths in the central interval of each level, and dashed what it should be."""
    for i, (metric, level) in enumerate(LEVELS.items()):
        for at, name in enumerate(names):
            across(axes, at + 0.3 * (i - 0.5), found[metric][name], look(name), unit=100, zero=False)
        axes.axvline(level, color="black", linewidth=0.8, linestyle="--")
    rows(axes, names)


def rows(axes: Axes, names: list[str]) -> None:
    """Names the rows."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)


def draw(results: Path, out: Path) -> None:
    """Draws a row a horizon, and writes coverage and scores as a table."""
    of = read(results, "distribution")
    sampling = []
    if "coverage50" in of.frame:
        sampling = [name for name in of.names if of.where(name=name).frame["coverage50"].notna().any()]
    if not sampling:
        raise missing("distribution", BASE, "flow", what="record of a model that samples")
    base = BASE if BASE in sampling else None
    # Horizons that every model which samples has
    horizons = sorted(set.intersection(*(set(of.where(name=name).frame["horizon"].astype(int)) for name in sampling)))
    if not horizons:
        raise missing("distribution", *sampling, what="horizon that all sampling models share")
    of = of.where(horizon=horizons)
    figure = Figure(figsize=(10, 0.9 + len(horizons) * (1.2 + 0.22 * len(of.names))), layout="constrained")
    axes = figure.subplots(len(horizons), 4, squeeze=False, sharex="col", width_ratios=(1.2, 1, 1, 1))
    table = [["model", "n", *(f"coverage of {level} %" for level in LEVELS.values()), "energy score, normalised"]]
    for row, horizon in zip(axes, horizons, strict=True):
        here = of.where(horizon=horizon)
        covered = {
            metric: {
                name: here.where(name=name).intervals(metric, ["horizon"])[name, str(horizon)] for name in sampling
            }
            for metric in LEVELS
        }
        coverage(row[0], covered, sampling)
        for panel, (which, said) in zip(row[1:3], RANKS.items(), strict=True):
            for name in sampling:
                shares = histogram(of, name, horizon, which)
                x = 100 * (np.arange(len(shares)) + 0.5) / len(shares)
                panel.plot(x, shares, **look(name) | {"markersize": 2.5, "linewidth": 0.9}, label=name)
            panel.axhline(1, color="black", linewidth=0.8, linestyle="--")
            panel.set_ylabel("frequency / uniform")
            panel.set_xlabel(f"{said}, %" if horizon == horizons[-1] else "")
            panel.set_ylim(0, None)
        scores = {name: normalised(here, name, base) for name in of.names}
        for at, one in enumerate(scores.values()):
            across(row[3], at, one, look(of.names[at]), zero=False)
        rows(row[3], of.names)
        row[3].axvline(1, color="black", linewidth=0.8, linestyle="--")
        row[3].axvline(0, color="black", linewidth=0.8)
        row[0].set_ylabel(f"n = {horizon}")
        for name in of.names:
            cells = [shown(covered[metric][name], 100, 1) if name in sampling else "–" for metric in LEVELS]
            table.append([name, str(horizon), *cells, shown(scores[name], 1)])
    axes[-1, 0].set_xlabel("truth in the central 50 % (upper)\nand 90 % (lower), %")
    axes[-1, 3].set_xlabel(f"(energy score − floor) /\nthat of {base or 'persistence'}")
    figure.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside upper center", ncols=len(sampling))
    save(figure, "calibration", out, f"{of.footnote()}; dashed: calibrated, and as good as {base or 'persistence'}")
    note = (
        f"Energy score: 0 is as good as executions of the same commands, 1 as good as {base or 'persistence'}; "
        f"{of.footnote()}."
    )
    markdown(out / "calibration.md", table, note)


if __name__ == "__main__":
    sys.exit(main(draw))
