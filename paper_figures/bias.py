"""Draws which inductive bias and which representation help where: each model's error beside that of the plain `mlp`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from drawing import main, save
from fig3 import common
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from recorded import Recorded, across, everything, look, markdown, missing, read, shown

from dlobench.bench.matrix import grid
from dlobench.bench.statistics import Interval, interval
from dlobench.domain import ATTACHMENTS, MATERIALS

BASE = "mlp"  # displacements of a flat vector: what the others change one thing of


def groups(of: Recorded) -> Iterator[tuple[str, Recorded]]:
    """Yields the kinds of domains and what is of them."""
    yield "all domains", of
    for material in MATERIALS:
        yield material, of.where(material=material)
    for attachment in ATTACHMENTS:
        yield {"none": "not attached"}.get(attachment, f"{attachment} attachment"), of.where(attachment=attachment)
    for column, unit in (("objects", "rigid bodies"), ("length", "cm")):
        if len(values := sorted(of.frame[column].unique())) > 1:
            yield from ((f"{value.removesuffix('cm')} {unit}", of.where(**{column: value})) for value in values)


def change(of: Recorded, name: str) -> Interval:
    """Returns (error of `name` − error of the base) / error of the base, in the mean, paired over domains and seeds."""
    base = grid(of.where(name=BASE).frame, "euclidean")
    less = grid(of.where(name=name).frame, "euclidean") - base
    return interval(less.values, base.over(less.seeds, less.domains).values, less.seeds, less.domains)


def changes(of: Recorded) -> dict[tuple[int, int, str, str], Interval]:
    """Returns the `change` by pushes, horizon, kind of domain and model, at the sizes that every domain has."""
    out = {}
    frame = of.frame[of.frame["trajectories"] <= common(of)]
    for pushes in sorted(map(int, frame["pushes"].unique())):
        for horizon in sorted(map(int, frame["horizon"].unique())):
            for kind, some in groups(of.where(pushes=pushes, horizon=horizon)):
                for name in of.names:
                    if name != BASE and {name, BASE} <= set(some.names):
                        out[pushes, horizon, kind, name] = change(some, name)
    return out


def panel(axes: Axes, found: dict[tuple[str, str], Interval], kinds: list[str], names: list[str]) -> None:
    """Draws the changes of one size and horizon, in percent: a row a kind of domain, a mark a model."""
    for i, name in enumerate(names):
        for at, kind in enumerate(kinds):
            if (kind, name) in found:
                y = at + 0.7 * ((i + 0.5) / len(names) - 0.5)
                across(axes, y, found[kind, name], look(name), unit=100)
        axes.plot([], [], **look(name) | {"linestyle": "-"}, label=name)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_ylim(len(kinds) - 0.5, -0.5)


def draw(results: Path, out: Path) -> None:
    """Draws the sweep over horizons and, where it is recorded, that over lengths."""
    panels(read(results, "horizon_sweep", "single_domain"), "bias", out)
    if any(record.task == "length_sweep" and record.model == BASE for record in everything(results)):
        panels(read(results, "length_sweep"), "bias_length", out)


def panels(of: Recorded, called: str, out: Path) -> None:
    """Draws a column a horizon, a row a train size, and writes the changes as a table."""
    of = of.where(name=[name for name in of.names if name != "persistence"])  # no bias at all
    if BASE not in of.names or len(of.names) < 2:
        raise missing(of.task, "mlp", "gnn", what="pair of mlp and another model")
    found = changes(of)
    sizes, horizons, kinds = (list(dict.fromkeys(key[i] for key in found)) for i in range(3))
    names = [name for name in of.names if name != BASE]
    figure = Figure(figsize=(1.8 + 1.7 * len(horizons), 0.7 + 3.2 * len(sizes)), layout="constrained")
    axes = figure.subplots(len(sizes), len(horizons), squeeze=False, sharey=True, sharex=True)
    for row, pushes in zip(axes, sizes, strict=True):
        for each, horizon in zip(row, horizons, strict=True):
            here = {key[2:]: one for key, one in found.items() if key[:2] == (pushes, horizon)}
            panel(each, here, [str(kind) for kind in kinds], names)
            each.set_title(f"n = {horizon}, {pushes:,} pushes")
    for each in axes[-1]:
        each.set_xlabel(f"error against {BASE}, %")
    axes[0, 0].set_yticks(range(len(kinds)), [str(kind) for kind in kinds])
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=len(names))
    save(figure, called, out, f"{of.footnote()}; left of 0: better than {BASE}; filled: the interval leaves out 0")
    table = [["pushes", "n", "domains", *names]]
    for pushes, horizon, kind in dict.fromkeys(key[:3] for key in found):
        cells = [found.get((pushes, horizon, kind, name)) for name in names]
        table.append([f"{pushes:,}", str(horizon), kind, *("–" if c is None else shown(c, 100, 0) for c in cells)])
    note = f"Error less that of {BASE} in percent of it, paired: below 0 is better; {of.footnote()}."
    markdown(out / f"{called}.md", table, note)


if __name__ == "__main__":
    sys.exit(main(draw))
