"""Draws Fig. 3: the error against pushes to train on and against the horizon, beside the paper's medians."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from drawing import main, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from recorded import MM, Recorded, errorbar, read

from dlobench.bench.matrix import grids, intervals_of
from dlobench.bench.scores import with_all
from dlobench.domain import MATERIALS

# Medians read from the paper's figure: mean Euclidean error a segment, m
PAPER = {
    1: {1e3: 0.70e-2, 1e4: 0.37e-2, 1e5: 0.21e-2, 1e6: 0.14e-2},
    2: {1e3: 1.02e-2, 1e4: 0.59e-2, 1e5: 0.32e-2, 1e6: 0.215e-2},
    4: {1e3: 1.58e-2, 1e4: 0.84e-2, 1e5: 0.47e-2, 1e6: 0.337e-2},
    8: {1e3: 2.35e-2, 1e4: 1.25e-2, 1e5: 0.76e-2, 1e6: 0.548e-2},
}
PAPER_MATERIALS = {  # after 10⁶ pushes, m
    "soft": {1: 0.13e-2, 2: 0.20e-2, 4: 0.31e-2, 8: 0.51e-2},
    "flexible": {1: 0.28e-2, 2: 0.43e-2, 4: 0.66e-2, 8: 0.93e-2},
    "elastoplastic": {1: 0.155e-2, 2: 0.23e-2, 4: 0.33e-2, 8: 0.44e-2},
}
HORIZONS: dict[int, dict[str, Any]] = {
    1: {"color": "#000000", "marker": "o", "linestyle": "-"},
    2: {"color": "#0072B2", "marker": "s", "linestyle": "--"},
    4: {"color": "#D55E00", "marker": "^", "linestyle": "-."},
    8: {"color": "#009E73", "marker": "D", "linestyle": ":"},
}
OF_MATERIALS: dict[str, dict[str, Any]] = {
    "soft": {"color": "#0072B2", "marker": "o", "linestyle": "-"},
    "flexible": {"color": "#D55E00", "marker": "^", "linestyle": "--"},
    "elastoplastic": {"color": "#009E73", "marker": "s", "linestyle": "-."},
}
GREY: dict[str, Any] = {"color": "0.65", "markerfacecolor": "white", "linewidth": 0.8, "zorder": 1}


def common(of: Recorded) -> int:
    """Returns the largest number of trajectories that every domain has."""
    sizes = of.frame.groupby("trajectories")["domain"].nunique()
    return int(sizes.index[sizes == sizes.max()].max())


def by_size(axes: Axes, of: Recorded, name: str) -> None:
    """Draws the error against pushes, a line a horizon, and goes on, hollow, over the domains with every size."""
    frame = of.where(name=name).frame
    whole = frame[frame["trajectories"] <= common(of)]
    few = with_all(frame, "trajectories")
    few = few[few["trajectories"] >= common(of)]
    for n, look in HORIZONS.items():
        if n in PAPER:
            axes.plot(list(PAPER[n]), [MM * e for e in PAPER[n].values()], **GREY | {k: look[k] for k in ("marker",)})
        for part, more in ((few, {"markerfacecolor": "white"}), (whole, {})):
            if part is few and few["domain"].nunique() == whole["domain"].nunique():
                continue
            cells = grids(part[part["horizon"] == n], "euclidean", ["pushes"])
            found = dict(zip(cells, intervals_of([one.filled() for one in cells.values()]), strict=True))
            sizes = sorted(found, key=lambda key: int(key[0]))
            errorbar(axes, [float(x) for (x,) in sizes], [found[x] for x in sizes], **look | more)
    axes.set(xscale="log", yscale="log", title=name, xlabel="pushes to train on")
    axes.set_xticks([1e3, 1e4, 1e5, 1e6])


def by_material(axes: Axes, of: Recorded, name: str) -> None:
    """Draws the error against the horizon, a line a material, at the largest size that every domain has."""
    found = of.where(name=name, trajectories=common(of)).intervals("euclidean", ["material", "horizon"])
    for material in MATERIALS:
        look = OF_MATERIALS[material]
        paper = PAPER_MATERIALS[material]
        axes.plot(list(paper), [MM * e for e in paper.values()], **GREY | {"marker": look["marker"]})
        ahead = sorted(int(key[2]) for key in found if key[:2] == (name, material))
        errorbar(axes, ahead, [found[name, material, str(n)] for n in ahead], **look)
    axes.set(xscale="log", yscale="log", xlabel="horizon n, pushes ahead")
    axes.set_xticks(list(HORIZONS), [str(n) for n in HORIZONS])


def draw(results: Path, out: Path) -> None:
    """Draws both rows, a column a model."""
    of = read(results, "horizon_sweep", "single_domain")
    figure = Figure(figsize=(1.2 + 1.7 * len(of.names), 5.4), layout="constrained")
    axes = figure.subplots(2, len(of.names), sharey=True, squeeze=False)
    for column, name in zip(axes.T, of.names, strict=True):
        by_size(column[0], of, name)
        by_material(column[1], of, name)
        for each in column:
            each.minorticks_off()
    for row in axes:
        row[0].set_ylabel("mean Euclidean error, mm")
    axes[0, 0].set_yticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    paper = Line2D([], [], marker="o", **GREY)
    horizons = [Line2D([], [], **look) for look in HORIZONS.values()]
    materials = [Line2D([], [], **look) for look in OF_MATERIALS.values()]
    axes[0, -1].legend(
        [*horizons, paper], [*(f"n = {n}" for n in HORIZONS), "the paper's medians"],
        loc="upper left", bbox_to_anchor=(1, 1),
    )  # fmt: skip
    axes[1, -1].legend(
        [*materials, paper], [*MATERIALS, "the paper's medians,\n10⁶ pushes"], loc="upper left", bbox_to_anchor=(1, 1)
    )
    few = {with_all(of.where(name=name).frame, "trajectories")["domain"].nunique() for name in of.names}
    few -= {0, of.frame["domain"].nunique()}  # which are not drawn hollow
    hollow = f"; hollow: the {' or '.join(map(str, sorted(few)))} domains that have every size" if few else ""
    pushes = int(of.where(trajectories=common(of)).frame["pushes"].iloc[0])
    save(
        figure,
        "fig3",
        out,
        f"{of.footnote()}{hollow}; below after {pushes:,} pushes; means of domains, the "
        "paper's are medians of another simulator's",
    )


if __name__ == "__main__":
    sys.exit(main(draw))
