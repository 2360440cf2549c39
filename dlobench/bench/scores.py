"""Lays records out as one tidy table: a row a (task, task_version, scale, cell, model, config, seed, domain).

Every number of a domain is a column. Lists, such as rank histograms, are no numbers and stay in the records.
"""

from __future__ import annotations

from collections.abc import Iterable
from operator import itemgetter

import numpy as np
import pandas as pd

from dlobench.bench.record import CellScore, DomainScore, Record
from dlobench.errors import UsageError

KEY = ["task", "task_version", "scale", "cell", "model", "config", "seed", "domain"]
SWEEP = ["trajectories", "horizon", "K"]  # of the task's cell
PLACE = ["material", "attachment", "length", "objects"]  # of the domain's cell in its set, as strings
DIGESTS = ["data", "split"]
SKILL = "skill"
NUMBERS = [name for name, field in DomainScore.model_fields.items() if field.annotation not in (str, list[int] | None)]


def scores(records: Iterable[Record]) -> pd.DataFrame:
    """Returns the tidy table of records, sorted by its key; scores that a record lacks are NaN."""

    def key(pair: tuple[Record, CellScore]) -> tuple[object, ...]:
        record, cell = pair
        return (record.task, record.task_version, record.scale, cell.id, record.model, record.config, record.seed)

    pairs = sorted(((record, cell) for record in records for cell in record.cells), key=key)
    found = [sorted(cell.domains, key=lambda score: score.domain) for _, cell in pairs]
    times = [len(each) for each in found]
    columns: dict[str, object] = {}
    for i, name in enumerate(KEY[:-1]):
        columns[name] = _repeated([key(pair)[i] for pair in pairs], times)
    columns["domain"] = np.array([score.domain for each in found for score in each], dtype=object)
    for name in SWEEP:
        columns[name] = _repeated([getattr(cell, name) for _, cell in pairs], times)
    columns["of"] = np.array([score.cell for each in found for score in each], dtype=object)
    for name in DIGESTS:
        columns[name] = _repeated([getattr(record.provenance, f"{name}_sha256") for record, _ in pairs], times)
    take = itemgetter(*NUMBERS)  # all of a score at once: records are large, and a cache is small
    width = len(NUMBERS)
    numbers = [np.array([take(s.__dict__) for s in each], dtype=float).reshape(-1, width) for each in found]
    whole = np.concatenate([np.empty((0, width)), *numbers])  # None has become NaN
    columns |= {name: c for name, c in zip(NUMBERS, whole.T, strict=True) if not c.size or not np.isnan(c).all()}
    frame = pd.DataFrame(columns)
    places = {of: of.rsplit("-", 3) for of in frame["of"].unique()}
    for i, name in enumerate(PLACE):
        known = {of: place[i] if len(place) == len(PLACE) else None for of, place in places.items()}
        frame[name] = frame["of"].map(known)
    return frame


def _repeated(values: list[object], times: list[int]) -> object:
    """Returns a column in which each value stands as often as it has domains."""
    whole = all(isinstance(value, int) for value in values)
    return np.repeat(np.array(values, dtype=int if whole else object), times)


def with_all(frame: pd.DataFrame, column: str) -> pd.DataFrame:
    """Returns the rows of domains that have every value of a column, such as every size in `trajectories`.

    Models, configurations, seeds, K and horizons are kept apart: a domain stays where all of them have all sizes.
    """
    others = [name for name in ["model", "config", "seed", *SWEEP] if name != column]
    sizes = frame[column].nunique()
    have = frame.groupby([*others, "domain"])[column].nunique()
    groups = frame[others].drop_duplicates().shape[0]
    full = (have == sizes).groupby(level="domain").sum() == groups
    return frame[frame["domain"].isin(full.index[full])].reset_index(drop=True)


def check_metric(frame: pd.DataFrame, metric: str) -> None:
    """Raises `UsageError` for a metric that the table does not have."""
    known = [SKILL, *(name for name in metrics(frame))]
    if metric not in known:
        raise UsageError(f"metric {metric!r} is unknown: {', '.join(known)} are there")


def metrics(frame: pd.DataFrame) -> list[str]:
    """Returns the columns of the table that are scores of a model."""
    apart = {*KEY, *SWEEP, *PLACE, *DIGESTS, "of", "supports", "windows"}
    return [str(name) for name in frame.columns if name not in apart and not str(name).startswith("persistence_")]
