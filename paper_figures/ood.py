"""Draws what it costs to meet domains unlike all that were trained on: the error there, beside a fit that saw some."""

from __future__ import annotations

import sys
from pathlib import Path

from drawing import main, save
from matplotlib.figure import Figure
from recorded import MM, Recorded, across, look, markdown, missing, read, shown

from dlobench.bench.matrix import grid
from dlobench.bench.plugins import load_task
from dlobench.bench.statistics import Interval, interval

MARK = "-without-"  # in the name of a cell whose fit lacked a region of domains, and which is tested in it
SAID = {
    "free": "not attached",
    "movable": "movable attachment",
    "fixed": "fixed attachment",
    "length": "10 and 16 cm",
    "density": "extreme density",
    "friction": "extreme friction",
}


def regions(of: Recorded) -> list[str]:
    """Returns the regions that are left out in what was recorded, in the order of the task."""
    there = {str(cell).partition(MARK)[2] for cell in of.frame["cell"].unique()}
    return [region.name for region in load_task(of.task).left_out if region.name in there]


def gap(of: Recorded, name: str, region: str, K: int) -> tuple[Interval, Interval] | None:
    """Returns how much worse a model is in a region that it did not train on, m and as a share; None where not run.

    It is the error of the fit without the region less that of the fit to all domains, over the region's test domains,
    paired; the share is of the latter.
    """
    rows = of.where(name=name, K=K).frame
    without = rows[rows["cell"].str.endswith(MARK + region)]
    everywhere = rows[~rows["cell"].str.contains(MARK)]
    if without.empty or everywhere.empty:
        return None
    whole = grid(everywhere, "euclidean")
    more = grid(without, "euclidean") - whole
    return more.interval(), interval(more.values, whole.over(more.seeds, more.domains).values, more.seeds, more.domains)


def draw(results: Path, out: Path) -> None:
    """Draws a panel a K, a row a region, a mark a model, and writes the gaps as a table."""
    of = read(results, "ood")
    names = [name for name in of.names if name != "persistence"]  # trains on nothing, so that nothing is left out
    if not names or not (there := regions(of)):
        raise missing("ood", "gnn_context", what="record of a model that learns")
    of = of.where(name=names, trajectories=of.frame["trajectories"].max())
    Ks = sorted(map(int, of.frame["K"].unique()))
    found = {
        (name, region, K): one
        for name in names
        for region in there
        for K in Ks
        if (one := gap(of, name, region, K)) is not None
    }
    figure = Figure(figsize=(1.8 + 2.9 * len(Ks), 1.2 + 0.45 * len(there)), layout="constrained")
    axes = figure.subplots(1, len(Ks), sharey=True, sharex=True, squeeze=False)[0]
    for panel, K in zip(axes, Ks, strict=True):
        for i, name in enumerate(names):
            for at, region in enumerate(there):
                if (name, region, K) in found:
                    y = at + 0.7 * ((i + 0.5) / len(names) - 0.5)
                    across(panel, y, found[name, region, K][0], look(name), unit=MM)
            panel.plot([], [], **look(name) | {"linestyle": "-"}, label=name)
        panel.axvline(0, color="black", linewidth=0.8)
        panel.set(title=f"K = {K}", xlabel="more error without such domains, mm")
    axes[0].set_yticks(range(len(there)), [SAID.get(region, region) for region in there])
    axes[0].set_ylim(len(there) - 0.5, -0.5)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    save(figure, "ood", out, f"{of.footnote()}; filled: the interval leaves out 0")
    table = [["left out", "K", "domains", *(f"{name}, mm and %" for name in names)]]
    for region in there:
        for K in Ks:
            cells = [found.get((name, region, K)) for name in names]
            texts = ["–" if c is None else f"{shown(c[0], MM)}, {shown(c[1], 100, 0)} %" for c in cells]
            domains = next(str(c[0].domains) for c in cells if c is not None)
            table.append([SAID.get(region, region), str(K), domains, *texts])
    note = (
        "Error of a fit without such domains less that of a fit to all, over the same test domains, paired; the latter "
        f"also has more domains to train on; {of.footnote()}."
    )
    markdown(out / "ood.md", table, note)


if __name__ == "__main__":
    sys.exit(main(draw))
