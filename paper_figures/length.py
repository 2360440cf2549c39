"""Draws how the error depends on the length of the DLO, for each horizon, and how much longer ones are harder."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pandas as pd
from drawing import main, save
from findings import ratio
from matplotlib.figure import Figure
from recorded import Recorded, errorbar, log_mm, look, markdown, missing, read, shown

from dlobench.bench.statistics import Interval


def growth(of: Recorded) -> dict[tuple[str, int], Interval]:
    """Returns how many times the error of the shortest DLOs that of the longest is, by model and horizon.

    It is paired by material, attachment and bodies: domains of different length are alike in all else.
    """
    pair = of.frame["material"] + "-" + of.frame["attachment"] + "-" + of.frame["objects"]
    paired, lengths = replace(of, frame=of.frame.assign(domain=pair)), sorted(of.frame["length"].unique())
    return {
        (name, horizon): ratio(*(rows.where(length=length).frame for length in (lengths[-1], lengths[0])))
        for name in of.names
        for horizon in sorted(map(int, of.frame["horizon"].unique()))
        for rows in [paired.where(name=name, horizon=horizon)]
    }


def panels(figure: Figure, of: Recorded, lengths: list[str]) -> None:
    """Draws the error against the length, a panel a horizon and a line a model."""
    horizons, found = sorted(map(int, of.frame["horizon"].unique())), of.intervals("euclidean", ["horizon", "length"])
    for panel, horizon in zip(figure.subplots(1, len(horizons), sharey=True, squeeze=False)[0], horizons, strict=True):
        for i, name in enumerate(of.names):
            x = [at + 0.05 * (i - (len(of.names) - 1) / 2) for at in range(len(lengths))]  # beside each other
            errorbar(panel, x, [found[name, str(horizon), length] for length in lengths], label=name, **look(name))
        panel.set(title=f"n = {horizon}", xlabel="length, cm")
        panel.set_xticks(range(len(lengths)), [at.removesuffix("cm") for at in lengths])
    figure.axes[0].set_ylabel("mean Euclidean error, mm")
    log_mm(figure.axes[0])
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5)


def draw(results: Path, out: Path) -> None:
    """Draws the errors, and writes the growth from the shortest to the longest as a table."""
    of = read(results, "length_sweep")
    if len(lengths := sorted(pd.unique(of.frame["length"]))) < 2:
        raise missing("length_sweep", "mlp", what="record of several lengths")
    figure = Figure(figsize=(1.2 + 1.7 * of.frame["horizon"].nunique(), 3.2), layout="constrained")
    panels(figure, of, lengths)
    save(figure, "length", out, of.footnote())
    rows = [["model", "n", f"error at {lengths[-1]} ÷ at {lengths[0]}", "pairs"]]
    for (name, horizon), one in growth(of).items():
        rows.append([name, str(horizon), shown(one, 1), str(one.domains)])
    markdown(out / "length.md", rows, f"Paired by material, attachment and bodies; {of.footnote()}.")


if __name__ == "__main__":
    sys.exit(main(draw))
