"""Builds the leaderboard: records in, one table out. The same records give the same bytes."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

import pandas as pd

from dlobench.bench.results import Record
from dlobench.data.store import atomic_write

KEY = ["task", "task_version", "scale", "cell", "model", "config"]
MEANS = ["skill", "mse_m2", "euclidean_m", "fit_s", "adapt_s", "predict_s"]
COLUMNS = [*KEY, "seeds", *MEANS, "parameters", "trajectories", "horizon", "K", "domains", "data", "split"]


def table(records: list[Record]) -> pd.DataFrame:
    """Returns one row a cell and configuration: means over seeds, best first within a cell."""
    rows = [
        {
            "task": record.task,
            "task_version": record.task_version,
            "scale": record.scale,
            "cell": cell.id,
            "model": record.model,
            "config": record.config,
            "seeds": record.seed,
            "skill": cell.skill,
            "mse_m2": cell.mse,
            "euclidean_m": cell.euclidean,
            "fit_s": sum(
                f.seconds for f in record.fits if (f.trajectories, f.horizon) == (cell.trajectories, cell.horizon)
            ),
            "adapt_s": fmean(score.adapt_seconds for score in cell.domains),
            "predict_s": fmean(score.predict_seconds for score in cell.domains),
            "parameters": record.parameters,
            "trajectories": cell.trajectories,
            "horizon": cell.horizon,
            "K": cell.K,
            "domains": len(cell.domains),
            "data": record.provenance.data_sha256[:8],
            "split": record.provenance.split_sha256[:8],
        }
        for record in records
        for cell in record.cells
    ]
    frame = pd.DataFrame(rows, columns=COLUMNS)
    how = {column: "mean" if column in MEANS else "first" for column in COLUMNS if column not in KEY} | {
        "seeds": "nunique"
    }
    grouped = frame.groupby(KEY, as_index=False, sort=True).agg(how)[COLUMNS]
    order = ["task", "task_version", "scale", "trajectories", "horizon", "K", "cell", "mse_m2", "model", "config"]
    return grouped.sort_values(order, ignore_index=True, kind="stable")


def write(frame: pd.DataFrame, path: Path) -> None:
    """Writes the table as CSV, whole or not at all."""
    atomic_write(path, frame.to_csv(index=False, float_format="%.9g", lineterminator="\n").encode())
