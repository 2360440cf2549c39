"""Draws how many trajectories buy adaptation: the error against K, and what K brings over none."""

from __future__ import annotations

import sys
from pathlib import Path

from drawing import main, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from recorded import MM, Recorded, adapting, errorbar, log_mm, look, markdown, missing, read, shown

from dlobench.bench.matrix import difference
from dlobench.bench.statistics import Interval


def gains(of: Recorded) -> dict[tuple[str, int], Interval]:
    """Returns the error without adaptation less that at K, m, paired, by model and K: positive where K helps."""
    out = {}
    for name in adapting(of):
        rows = of.where(name=name).frame
        without = rows[rows["K"] == 0]
        for K in sorted(set(rows["K"]) - {0}):
            out[name, int(K)] = difference(without, rows[rows["K"] == K], "euclidean")
    return out


def errors(axes: Axes, of: Recorded, Ks: list[int]) -> None:
    """Draws the error against K of what adapts, and a level of what does not."""
    found, adapt = of.intervals("euclidean", ["K"]), adapting(of)
    for at, name in enumerate(of.names):
        how = look(name)
        if name in adapt:
            x = [i + 0.05 * (at % 5 - 2) for i in range(len(Ks))]
            errorbar(axes, x, [found[name, str(K)] for K in Ks], label=name, **how)
        else:
            level, how = MM * found[name, "0"].estimate, how | {"linewidth": 0.8, "markerfacecolor": "white"}
            axes.axhline(level, color=how["color"], linestyle=how["linestyle"], linewidth=0.8)
            axes.plot([len(Ks) - 0.6], [level], label=f"{name} (never adapts)", **how)
    axes.set(ylabel="mean Euclidean error, mm", xlabel="K, trajectories to adapt on")
    log_mm(axes)
    axes.set_xticks(range(len(Ks)), [str(K) for K in Ks])


def draw(results: Path, out: Path) -> None:
    """Draws both, and writes the gains as a table."""
    of = read(results, "meta")
    of = of.where(trajectories=of.frame["trajectories"].max())
    if not (adapt := adapting(of)):
        raise missing("meta", "maml", what="record of a model that adapts")
    Ks = sorted(map(int, of.frame["K"].unique()))
    found = gains(of)
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    errors(left, of, Ks)
    for at, name in enumerate(adapt):
        there = [K for K in Ks if (name, K) in found]
        x = [Ks.index(K) + 0.08 * (at - (len(adapt) - 1) / 2) for K in there]
        errorbar(right, x, [found[name, K] for K in there], **look(name))
    right.axhline(0, color="black", linewidth=0.8)
    right.set_xticks(range(1, len(Ks)), [str(K) for K in Ks[1:]])
    right.set(xlabel="K, trajectories to adapt on", ylabel="gain over K = 0, mm (paired)", xlim=(0.6, len(Ks) - 0.4))
    figure.legend(loc="outside right upper")
    save(figure, "support", out, of.footnote())
    rows = [["model", *(f"K = {K}" for K in Ks[1:]), "fewest that help"]]
    for name in adapt:
        helps = [K for K in Ks[1:] if (one := found[name, K]).low is not None and one.low > 0]
        gained = [shown(found[name, K], MM) for K in Ks[1:]]
        rows.append([name, *gained, str(helps[0]) if helps else "none of these"])
    note = f"Gain over K = 0 in mm of mean Euclidean error, paired; {of.footnote()}."
    markdown(out / "support.md", rows, note)


if __name__ == "__main__":
    sys.exit(main(draw))
