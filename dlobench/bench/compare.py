"""Compares two models cell by cell: the paired difference of their scores, its interval, and what it says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from dlobench.bench.matrix import difference
from dlobench.bench.scores import DIGESTS, SKILL, check_metric
from dlobench.bench.statistics import Interval
from dlobench.errors import RunError, UsageError


@dataclass(frozen=True)
class Comparison:
    """Holds the paired difference of two models in one cell, A − B, in the unit of the score."""

    cell: str
    difference: Interval
    verdict: str  # of A against B: better, worse, tie, or unknown where there is no interval


def choose(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """Returns the rows of a model, or of model@config; raises `UsageError` for none, and for several configurations."""
    model, _, config = name.partition("@")
    rows = frame[frame["model"] == model]
    if config:
        rows = rows[rows["config"] == config]
    found = sorted({f"{m}@{c}" for m, c in zip(rows["model"], rows["config"], strict=True)})
    if not found:
        there = sorted({f"{m}@{c}" for m, c in zip(frame["model"], frame["config"], strict=True)})
        raise UsageError(f"no model {name!r} among the records: {', '.join(there) or 'none'} are there")
    if len(found) > 1:
        raise UsageError(f"{name!r} has several configurations: say which of {', '.join(found)}")
    return rows


def compare(frame: pd.DataFrame, a: str, b: str, *, task: str, scale: str, metric: str = SKILL) -> list[Comparison]:
    """Returns A − B in every cell of a task that both have.

    Of several versions of a task the newest that is there counts. Raises `UsageError` where nothing can be compared:
    no such model, cell, domain or seed in common, or other data or another split.
    """
    there = frame[(frame["task"] == task) & (frame["scale"] == scale)]
    if there.empty:
        known = sorted(set(zip(frame["task"], frame["scale"], strict=True)))
        found_there = ", ".join(" at ".join(each) for each in known) or "none"
        raise UsageError(f"no record of {task} at scale {scale}: there are {found_there}")
    there = there[there["task_version"] == there["task_version"].max()]
    check_metric(there, metric)
    of_a, of_b = choose(there, a), choose(there, b)
    cells = of_a[of_a["cell"].isin(of_b["cell"])].sort_values(["trajectories", "horizon", "K"], kind="stable")
    if cells.empty:
        raise UsageError(f"{a} and {b} share no cell of {task} at scale {scale}")
    out = []
    for cell in cells["cell"].unique():
        one, other = of_a[of_a["cell"] == cell], of_b[of_b["cell"] == cell]
        for digest in DIGESTS:
            if len(found := sorted({*one[digest], *other[digest]})) > 1:
                raise UsageError(f"{a} and {b} were scored on different {digest}: {' and '.join(d[:8] for d in found)}")
        try:
            found_difference = difference(one, other, metric)
        except UsageError as error:
            raise UsageError(f"{a} and {b} in {cell}: {error}") from error
        out.append(Comparison(str(cell), found_difference, verdict(found_difference, higher=metric == SKILL)))
    return out


def verdict(found: Interval, *, higher: bool) -> str:
    """Says what a difference A − B means for A, where a higher score is the better one, or a lower one."""
    if found.tie is None:
        return "unknown"
    if found.tie:
        return "tie"
    return "better" if (found.estimate > 0) == higher else "worse"


def draw(found: Sequence[Comparison], path: Path, *, title: str, label: str) -> None:
    """Draws a forest plot: a row a cell, the difference and its interval, a line at 0; the same bytes each time.

    Raises `UsageError` for another kind of file than .png, .svg and .pdf, and without matplotlib; `RunError` where
    nothing can be written.
    """
    if path.suffix not in (".png", ".svg", ".pdf"):
        raise UsageError(f"--out {str(path)!r} is no picture: .png, .svg and .pdf are")
    try:
        import matplotlib as mpl
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UsageError("drawing needs matplotlib: pip install 'dlobench[figures]'") from error
    figure = Figure(figsize=(8, 1.4 + 0.35 * len(found)), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    colours = {"better": "tab:blue", "worse": "tab:red", "tie": "tab:gray", "unknown": "tab:gray"}
    for row, one in enumerate(found):
        d, colour = one.difference, colours[one.verdict]
        if d.low is not None and d.high is not None:
            axes.plot([d.low, d.high], [row, row], color=colour, linewidth=2)
        axes.plot([d.estimate], [row], "o", color=colour, fillstyle="none" if d.low is None else "full")
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(range(len(found)), [f"{one.cell}  {one.verdict}" for one in found])
    axes.set_ylim(len(found) - 0.5, -0.5)
    axes.set_xlabel(label)
    axes.set_title(title)
    dates = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    try:
        with mpl.rc_context({"svg.hashsalt": "dlobench"}):
            figure.savefig(path, metadata=dates.get(path.suffix))
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}") from error
