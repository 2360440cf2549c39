"""Chooses the predictions that the page shows: of each task its leading models at the farthest horizon."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from dlobench.bench import kept
from dlobench.bench.kept import Kept
from dlobench.bench.page.rollout import MOST, Windows
from dlobench.bench.record import Record

LEADING = 2  # models of each task


def shown(records: Sequence[Record], frame: pd.DataFrame, folder: Path) -> dict[str, Windows]:
    """Returns windows to draw by the name to show them under, out of the predictions beside the records of a folder.

    Of samples, the first is drawn with the first of the truths. What has no predictions beside it is not shown.
    """
    found = {}
    first = {(r.task, r.scale, r.model, r.config): r for r in sorted(records, key=lambda record: -record.seed)}
    for _, rows in frame[frame["without"] == ""].groupby(["task", "task_version", "scale"], sort=True):
        last = rows.sort_values(["horizon", "trajectories", "K"], kind="stable").iloc[-1]["cell"]
        leading = rows[(rows["cell"] == last) & rows["place"].notna()]
        leading = leading.sort_values(["place", "model", "config"], kind="stable").head(LEADING)
        for row in leading.itertuples():
            record = first[row.task, row.scale, row.model, row.config]
            path = record.path(folder).with_suffix(".safetensors")
            windows = _windows([one for one in kept.read(path) if one.cell == last]) if path.is_file() else None
            if windows is not None:
                found[f"{last}, {row.scale}, place {row.place:.0f}: {row.model}@{row.config}"] = windows
    return found


def _windows(some: Sequence[Kept]) -> Windows | None:
    """Returns the windows that move most, of DLOs of one length: of the most frequent one."""
    counts = [int(one.mask.sum()) for one in some]
    if not counts:
        return None
    usual = max(sorted(set(counts)), key=counts.count)
    pairs = [(one, w) for one, n in zip(some, counts, strict=True) if n == usual for w in range(len(one.windows))]
    pairs.sort(key=lambda pair: -float(np.abs(pair[0].true[0, pair[1]] - pair[0].start[pair[1]]).sum()))
    pairs = pairs[:MOST]
    return Windows(
        start=np.stack([one.start[w][one.mask] for one, w in pairs]),
        true=np.stack([one.true[0, w][one.mask] for one, w in pairs]),
        predicted=np.stack([one.dlo[0, w][one.mask] for one, w in pairs]),
    )
