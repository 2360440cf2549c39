"""Tells Weights & Biases how a run goes: its configuration, the curves of its fits, its scores and some predictions.

W&B is imported when it is asked for. Its files lie in a hidden folder of the results; `wandb sync` sends those of
offline runs later. Curves are told as each fit ends, wherever it ran.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from dlobench.bench.kept import Kept
from dlobench.bench.record import FitReport, Record
from dlobench.errors import RunError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

Mode = Literal["disabled", "offline", "online"]
MODES: tuple[Mode, ...] = get_args(Mode)
PICTURES = 4  # windows that are drawn of a cell
FOLDER = ".wandb"


class Tracker:
    """Is told how a run goes, and tells nobody. A context manager; `tracker` makes the one that was asked for."""

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def begin(self, name: str, seed: int, config: Mapping[str, Any]) -> None:
        """Begins the run of one seed; `name` tells task, scale, model and configuration."""

    def fitted(self, name: str, report: FitReport) -> None:
        """Takes the curve of a fit."""

    def recorded(self, record: Record, predictions: Sequence[Kept]) -> None:
        """Takes the final scores and what was kept of the predictions, and ends the run."""

    def close(self) -> None:
        """Ends a run that was not recorded."""


def tracker(mode: str, results: Path) -> Tracker:
    """Returns the tracker of a mode, which works in a folder of results.

    Raises `UsageError` for another mode and where a package is missing.
    """
    for known in MODES:
        if mode == known:
            return Tracker() if known == "disabled" else Wandb(known, results)
    raise UsageError(f"--wandb {mode!r} is unknown; there are: {', '.join(MODES)}")


class Wandb(Tracker):
    """Tells W&B, one of its runs a record."""

    def __init__(self, mode: Mode, results: Path) -> None:
        try:
            import matplotlib as mpl  # noqa: F401
            import wandb
        except ImportError as error:
            raise UsageError(f"--wandb {mode} needs {error.name}: pip install 'dlobench[figures]'") from error
        self._wandb, self._mode, self._folder = wandb, mode, results / FOLDER
        self._run: Any = None

    def begin(self, name: str, seed: int, config: Mapping[str, Any]) -> None:
        """Begins a run with an id that follows from name and seed: online, a run that was stopped goes on in it."""
        try:
            settings = self._wandb.Settings(
                silent=True,
                console="off",
                disable_git=True,
                save_code=False,
                x_disable_stats=True,
                x_disable_meta=True,
                init_timeout=60,
            )
            self._folder.mkdir(parents=True, exist_ok=True)
            self._run = self._wandb.init(
                project="dlobench",
                id=re.sub(r"[^\w.-]", "-", f"{name}-seed{seed}"),
                name=f"{name} seed {seed}",
                group=name,
                dir=self._folder,
                mode=self._mode,
                resume="allow" if self._mode == "online" else None,
                config=dict(config),
                settings=settings,
            )
        except (self._wandb.Error, OSError, ValueError) as error:
            raise RunError(f"W&B does not begin a run: {' '.join(str(error).split())}; --wandb offline may") from error

    def fitted(self, name: str, report: FitReport) -> None:
        """Logs the curve of a fit over its own steps."""
        self._run.define_metric(f"{name}/step", hidden=True)
        self._run.define_metric(f"{name}/*", step_metric=f"{name}/step")
        for point in report.curve:
            self._run.log({f"{name}/{what}": value for what, value in point.items()})

    def recorded(self, record: Record, predictions: Sequence[Kept]) -> None:
        """Puts scores into the summary and a table, draws predictions over truths, and ends the run."""
        names = ("trajectories", "horizon", "K", "without", "skill", "mse", "euclidean", "energy")
        table = self._wandb.Table(columns=["cell", *names])
        for cell in record.cells:
            values = [getattr(cell, name) for name in names]
            table.add_data(cell.id, *values)
            for name, value in zip(names[4:], values[4:], strict=True):
                if value is not None:
                    self._run.summary[f"{cell.id}/{name}"] = value
            mine = [one for one in predictions if one.cell == cell.id]
            if mine:
                picture = self._wandb.Image(draw(mine), caption="grey: before; black: after; dashed: predicted")
                self._run.log({f"predictions/{cell.id}": picture})
        self._run.log({"cells": table})
        self._run.summary["parameters"] = record.parameters
        self._run.summary["seconds"] = record.seconds
        self._finish(0)

    def close(self) -> None:
        """Ends a run that was not recorded, as one that failed."""
        self._finish(1)

    def _finish(self, code: int) -> None:
        run, self._run = self._run, None
        if run is not None:
            with suppress(self._wandb.Error, OSError):  # what was recorded is in the record; W&B is a copy
                run.finish(exit_code=code)


def draw(kept: Sequence[Kept]) -> NDArray[np.uint8]:
    """Draws the windows that move most, prediction over truth, and returns the pixels (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    windows = [(one, w) for one in kept for w in range(len(one.windows))]
    windows.sort(key=lambda pair: -float(np.abs(pair[0].true[0, pair[1]] - pair[0].start[pair[1]]).sum()))
    shown = windows[:PICTURES]
    figure = Figure(figsize=(3 * len(shown), 3), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for place, (one, w) in enumerate(shown, 1):
        axes = figure.add_subplot(1, len(shown), place, aspect="equal")
        axes.plot(*one.start[w][one.mask].T * 100, color="0.75", linewidth=3)
        for true in one.true[:, w]:
            axes.plot(*true[one.mask].T * 100, color="black", linewidth=2 if len(one.true) == 1 else 0.6)
        for dlo in one.dlo[:, w]:
            axes.plot(*dlo[one.mask].T * 100, "--", color="tab:orange", linewidth=2 if len(one.dlo) == 1 else 0.6)
        axes.set_title(one.domain, fontsize=8)
        axes.set_xlabel("x / cm", fontsize=8)
        axes.set_ylabel("y / cm", fontsize=8)
        axes.tick_params(labelsize=7)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels: Any = canvas.buffer_rgba()  # type: ignore[no-untyped-call]
    return np.asarray(pixels)[..., :3].copy()
