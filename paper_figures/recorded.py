"""Chooses the records that a figure is drawn from, and says which run makes those that are missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from dlobench.bench.matrix import Matrix, grid, grids, intervals_of
from dlobench.bench.record import Record
from dlobench.bench.results import read_all
from dlobench.bench.scores import scores
from dlobench.bench.statistics import Interval
from dlobench.errors import RunError
from dlobench.world.simulate import PUSHES

SCALES = ("paper", "small", "mini")  # the largest that there is
MM = 1e3  # mm in a metre
USUAL_N = {"maml": 5, "maml_learn2learn": 5}  # tasks a meta step, which the paper's Table 1 tells apart
SUGGESTED = {"meta": "gnn_context", "ood": "gnn_context", "distribution": "mlp_gaussian"}  # to be run, else `mlp`

# What a model is drawn as in every figure: Okabe and Ito's colours, a marker and a line that tell without colour
_COLOURS = ("#000000", "#E69F00", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9")
_MARKERS = "osD^vPX<>*hd"
_LINES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
ORDER = (
    "persistence", "ridge", "mlp", "mlp (absolute)", "mlp (push frame)", "multitask", "gnn", "finetune", "maml",
    "neural_process", "gnn_context", "oracle_parameters", "mlp_gaussian", "gnn_noise", "flow", "cvae",
)  # fmt: skip


def place(name: str) -> tuple[int, str]:
    """Returns what models are sorted by: the known ones as in `ORDER`, then the others by name."""
    return (ORDER.index(name) if name in ORDER else len(ORDER), name)


def look(name: str) -> dict[str, Any]:
    """Returns colour, marker and line style of a model, the same in every figure, of an unknown one by its name."""
    at, _ = place(name)
    at += crc32(name.encode()) if name not in ORDER else 0
    return {
        "color": _COLOURS[at % len(_COLOURS)],
        "marker": _MARKERS[at % len(_MARKERS)],
        "linestyle": _LINES[at % len(_LINES)],
    }


def label(record: Record) -> str:
    """Returns what a model is called: its name and, where they are not the usual ones, representation and N."""
    hyper = record.provenance.hyperparameters
    apart = [str(hyper["target"])] if hyper.get("target", "displacement") != "displacement" else []
    apart += ["push frame"] if hyper.get("frame") == "push" else []
    apart += ["raw"] if hyper.get("normalise") is False else []
    usual = USUAL_N.get(record.model)
    apart += [f"N = {hyper['N']}"] if usual is not None and hyper.get("N", usual) != usual else []
    return record.model + (f" ({', '.join(apart)})" if apart else "")


@dataclass(frozen=True)
class Recorded:
    """Holds the records of one task at one scale, one configuration a name, and their scores."""

    task: str
    scale: str
    records: tuple[Record, ...]
    frame: pd.DataFrame  # `scores` with a column `name`

    @property
    def names(self) -> list[str]:
        """Returns the names of the models, in the order in which they are drawn."""
        return sorted(self.frame["name"].unique(), key=place)

    def where(self, **values: object) -> Recorded:
        """Returns what has these values in columns of the frame; a list holds any of its values."""
        frame = self.frame
        for column, value in values.items():
            frame = frame[frame[column].isin(value if isinstance(value, list) else [value])]
        return replace(self, frame=frame)

    def footnote(self) -> str:
        """Returns scale, seeds, domains and what cut fits short in a sentence."""
        seeds = self.frame.groupby("name")["seed"].nunique()
        fewest, most = int(seeds.min()), int(seeds.max())
        many = f"{most}" if fewest == most else f"{fewest} to {most}"
        over = "domains" if most == 1 else "domains and seeds"
        limits = {label(record): record.provenance.budget["steps"] or 0 for record in self.records}
        cut = [f"{limits[name]:,.0f} of {name}" for name in self.names if limits[name]]
        limited = f"; steps a fit, at most: {', '.join(cut)}" if cut else ""
        return (
            f"task {self.task}, scale {self.scale}: {self.frame['domain'].nunique()} test domains, "
            f"{many} seed{'' if most == 1 else 's'} a model; intervals (95 %) over {over}{limited}"
        )

    def intervals(self, metric: str, by: Sequence[str]) -> dict[tuple[str, ...], Interval]:
        """Returns the mean of a score by name and the values (as text) of some columns, with its interval.

        It is over the domains that every seed has, as on the board.
        """
        found = grids(self.frame, metric, ["name", *by])
        return dict(zip(found, intervals_of([one.filled() for one in found.values()]), strict=True))


def choose(records: Sequence[Record], *tasks: str) -> list[Record]:
    """Returns the records to draw: of the first task that has any, at its largest scale, over one set of data.

    Of each `label` it is a configuration whose fits no clock ended, where there is one, the one with most seeds, of
    several the newest. Raises `RunError` that says what to
    run where there is none.
    """
    task = next((task for task in tasks if any(record.task == task for record in records)), None)
    if task is None:
        raise missing(tasks[0], SUGGESTED.get(tasks[0], "mlp"))
    found = [record for record in records if record.task == task]
    scale = next(scale for scale in SCALES if any(record.scale == scale for record in found))
    found = [record for record in found if record.scale == scale]

    def alike(record: Record) -> tuple[int, str, str]:
        return record.task_version, record.provenance.data_sha256, record.provenance.split_sha256

    groups: dict[tuple[int, str, str], list[Record]] = {}
    for record in found:
        groups.setdefault(alike(record), []).append(record)
    found = groups[max(groups, key=lambda key: (key[0], len(groups[key]), key))]
    configs: dict[str, dict[str, list[Record]]] = {}
    for record in found:
        configs.setdefault(label(record), {}).setdefault(record.config, []).append(record)

    def worth(of: list[Record]) -> tuple[bool, int, str]:
        untimed = all(record.provenance.budget["minutes"] is None for record in of)
        return untimed, len(of), max(record.provenance.created for record in of)

    return [record for name in sorted(configs, key=place) for record in max(configs[name].values(), key=worth)]


def read(results: Path, *tasks: str) -> Recorded:
    """Returns what is drawn of the first of some tasks that has records; raises `RunError` as `choose` does."""
    return scored(choose(everything(results), *tasks))


def everything(results: Path) -> list[Record]:
    """Returns all records of a results folder, none where it is missing."""
    return read_all(results) if results.is_dir() else []


def scored(records: Sequence[Record]) -> Recorded:
    """Returns chosen records with their scores."""
    names = {(record.model, record.config): label(record) for record in records}
    frame = scores(records)
    frame["name"] = [names[key] for key in zip(frame["model"], frame["config"], strict=True)]
    frame["pushes"] = frame["trajectories"] * PUSHES  # a training domain
    return Recorded(records[0].task, records[0].scale, tuple(records), frame)


def adapting(of: Recorded) -> list[str]:
    """Returns the names of the models whose error changes with K: all others never adapt."""
    of_domain = of.frame.groupby(["name", "trajectories", "horizon", "seed", "domain"])["mse"]
    spread = (of_domain.max() - of_domain.min()).groupby("name").max()
    return [name for name in of.names if spread[name] > 0]


def log_errors(frame: pd.DataFrame) -> Matrix:
    """Returns the matrix of the logarithms of mean Euclidean errors (m) of one model in one cell."""
    one = grid(frame, "euclidean")
    return replace(one, values=np.log(one.values), of="log euclidean")


def missing(task: str, *models: str, what: str = "record", scale: str = "small") -> RunError:
    """Returns the error that names the run which makes what is missing."""
    runs = " and ".join(f"`dlobench run --task {task} --scale {scale} --model {model}`" for model in models)
    return RunError(f"there is no {what} of {task} to draw: run {runs}, with `--out leaderboard/results`")


def errorbar(axes: Axes, x: Sequence[float], found: Sequence[Interval], *, unit: float = MM, **how: Any) -> None:
    """Draws estimates and their intervals, times `unit`; an estimate without an interval is hollow."""
    y, low, high = (np.array([getattr(one, end) for one in found], float) * unit for end in ("estimate", "low", "high"))
    known = np.isfinite(low)
    reach = np.where(known, [y - low, high - y], 0)
    how = {"capsize": 2, "elinewidth": 0.8} | how
    if not known.any():
        how["markerfacecolor"] = "white"
    axes.errorbar(np.asarray(x, float), y, yerr=reach, **how)


def across(
    axes: Axes, at: float, found: Interval, how: dict[str, Any], *, unit: float = 1.0, zero: bool = True
) -> None:
    """Draws an estimate and its interval, times `unit`, along the abscissa; hollow if it holds 0 and `zero`."""
    low, high = (found.estimate if end is None else end for end in (found.low, found.high))
    axes.plot([unit * low, unit * high], [at, at], color=how["color"], linewidth=0.9)
    fill = "white" if zero and found.tie is not False else how["color"]
    axes.plot([unit * found.estimate], [at], how["marker"], color=how["color"], markersize=4, markerfacecolor=fill)


def log_mm(axes: Axes) -> None:
    """Makes the ordinate logarithmic, with numbers that can be read."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())


def shown(found: Interval, unit: float, digits: int = 2) -> str:
    """Returns an estimate and its interval as text, in a unit."""
    text = f"{found.estimate * unit:.{digits}f}"
    if found.low is None or found.high is None:
        return text
    return f"{text} ({found.low * unit:.{digits}f} to {found.high * unit:.{digits}f})"


def markdown(path: Path, rows: Sequence[Sequence[str]], note: str) -> None:
    """Writes a table as Markdown, its first row the header, and a note below."""
    header, *rest = ["| " + " | ".join(row) + " |" for row in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, "| " + " | ".join("---" for _ in rows[0]) + " |", *rest, "", note, ""]))
