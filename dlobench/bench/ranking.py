"""Lays records out as one tidy table, and ranks models by it: places with ties, ranks with intervals.

A row is one (task, task_version, scale, cell, model, config, seed, domain); every number of a domain is a column.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from dlobench.bench.results import DomainScore, Record
from dlobench.bench.statistics import LEVEL, Array, Interval, interval, resampled
from dlobench.errors import UsageError

KEY = ["task", "task_version", "scale", "cell", "model", "config", "seed", "domain"]
SWEEP = ["trajectories", "horizon", "K"]  # of the task's cell
PLACE = ["material", "attachment", "length", "objects"]  # of the domain's cell in its set, as strings
DIGESTS = ["data", "split"]
SKILL = "skill"

Matrix = tuple[Array, Array, tuple[str, ...], tuple[str, ...]]  # values, weights (S, D), seeds, domains


def scores(records: Iterable[Record]) -> pd.DataFrame:
    """Returns the tidy table of records, sorted by its key; scores that a record lacks are NaN."""
    names = [name for name in DomainScore.model_fields if name not in ("domain", "cell")]
    parts: dict[str, list[Any]] = {name: [] for name in [*KEY, *SWEEP, "of", *DIGESTS, *names]}
    for record in records:
        for cell in record.cells:
            n, found = len(cell.domains), cell.domains
            for name in ("task", "task_version", "scale", "model", "config", "seed"):
                parts[name] += [getattr(record, name)] * n
            for name in SWEEP:
                parts[name] += [getattr(cell, name)] * n
            parts["cell"] += [cell.id] * n
            parts["data"] += [record.provenance.data_sha256] * n
            parts["split"] += [record.provenance.split_sha256] * n
            parts["domain"] += [score.domain for score in found]
            parts["of"] += [score.cell for score in found]
            for name in names:
                parts[name] += [getattr(score, name) for score in found]
    numeric = [n for n in names if all(v is None or isinstance(v, int | float) for v in parts[n])]
    numeric = [n for n in numeric if not parts[n] or any(v is not None for v in parts[n])]
    frame = pd.DataFrame({name: parts[name] for name in parts if name not in names or name in numeric})
    frame[numeric] = frame[numeric].astype(float)
    places = {of: of.rsplit("-", 3) for of in frame["of"].unique()}
    for i, name in enumerate(PLACE):
        known = {of: place[i] if len(place) == len(PLACE) else None for of, place in places.items()}
        frame[name] = frame["of"].map(known)
    return frame.sort_values(KEY, ignore_index=True, kind="stable")


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


def matrix(frame: pd.DataFrame, metric: str) -> Matrix:
    """Returns values and weights (S seeds, D domains) of one model in one cell, over domains that every seed has.

    Raises `UsageError` for an unknown metric and where there is no such domain.
    """
    column = "mse" if metric == SKILL else metric
    check_metric(frame, metric)
    values = _square(frame, column)
    if values.empty:
        raise UsageError(f"no domain has {metric} of every seed")
    seeds, domains = tuple(map(str, values.index)), tuple(map(str, values.columns))
    v = values.to_numpy(dtype=float)
    if metric != SKILL:
        return v, np.ones_like(v), seeds, domains
    w = _square(frame, "persistence_mse")[list(values.columns)].to_numpy(dtype=float)
    return w - v, w, seeds, domains


def check_metric(frame: pd.DataFrame, metric: str) -> None:
    """Raises `UsageError` for a metric that the table does not have."""
    known = [SKILL, *(name for name in metrics(frame))]
    if metric not in known:
        raise UsageError(f"metric {metric!r} is unknown: {', '.join(known)} are there")


def metrics(frame: pd.DataFrame) -> list[str]:
    """Returns the columns of the table that are scores of a model."""
    apart = {*KEY, *SWEEP, *PLACE, *DIGESTS, "of", "supports", "windows"}
    return [str(name) for name in frame.columns if name not in apart and not str(name).startswith("persistence_")]


def _square(frame: pd.DataFrame, column: str) -> pd.DataFrame:
    return frame.pivot(index="seed", columns="domain", values=column).dropna(axis="columns").sort_index(axis="columns")


def score(frame: pd.DataFrame, metric: str = SKILL) -> Interval:
    """Returns a model's mean score, or its skill, in one cell: the rows of one model, configuration and cell."""
    return interval(*matrix(frame, metric))


def difference(a: pd.DataFrame, b: pd.DataFrame, metric: str = SKILL) -> Interval:
    """Returns score of a less that of b in one cell, paired over the domains and the seeds that both have.

    Raises `UsageError` where they share no domain or no seed.
    """
    for shared in ("domain", "seed"):
        both = sorted(set(a[shared]) & set(b[shared]))
        if not both:
            raise UsageError(f"the two share no {shared}: run them on the same {shared}s")
        a, b = a[a[shared].isin(both)], b[b[shared].isin(both)]
    values_a, weights, seeds, domains_a = matrix(a, metric)
    values_b, _, _, domains_b = matrix(b, metric)
    domains = [name for name in domains_a if name in set(domains_b)]
    if not domains:
        raise UsageError("the two share no domain that all of their seeds have: run them on the same domains")
    of_a, of_b = [domains_a.index(name) for name in domains], [domains_b.index(name) for name in domains]
    return interval(values_a[:, of_a] - values_b[:, of_b], weights[:, of_a], seeds, tuple(domains))


def places(frame: pd.DataFrame, metric: str = SKILL) -> pd.DataFrame:
    """Returns the models of one cell, best first, with their place; whoever ties with the one above shares its place.

    A tie is a paired interval of the difference between neighbours that holds 0, or no interval, or nothing shared.
    """
    groups = dict(iter(frame.groupby(["model", "config"], sort=True)))
    found = {key: score(rows, metric) for key, rows in groups.items()}
    sign = -1 if metric == SKILL else 1
    order = sorted(found, key=lambda key: (sign * found[key].estimate, key))
    out: list[dict[str, object]] = []
    for i, key in enumerate(order):
        tied = i > 0 and _tied(groups[order[i - 1]], groups[key], metric)
        place = out[-1]["place"] if tied else i + 1
        one = found[key]
        names = {"model": key[0], "config": key[1], "place": place, "tie": tied}
        out.append(names | {"estimate": one.estimate, "low": one.low, "high": one.high})
    return pd.DataFrame(out, columns=["model", "config", "place", "tie", "estimate", "low", "high"])


def _tied(a: pd.DataFrame, b: pd.DataFrame, metric: str) -> bool:
    try:
        return difference(a, b, metric).tie is not False
    except UsageError:
        return True


def ranks(frame: pd.DataFrame, metric: str = SKILL) -> pd.DataFrame:
    """Returns the rank of each model of one task and scale by its mean score over cells, with intervals at 95 %.

    Ranked are models that have every cell; the others are missing. Seeds and domains are resampled as in `resampled`,
    the domains of all models together; equal means share the mean rank.
    """
    from scipy.stats import rankdata

    cells = frame["cell"].nunique()
    names, means, draws = [], [], []
    for key, rows in frame.groupby(["model", "config"], sort=True):
        parts = [matrix(part, metric) for _, part in rows.groupby("cell", sort=True)]
        if len(parts) == cells:
            names.append(key)
            means.append(np.mean([v.sum() / w.sum() for v, w, _, _ in parts]))
            draws.append(np.mean([resampled(*part) for part in parts], axis=0))
    if not names:
        return pd.DataFrame(columns=["model", "config", "mean", "rank", "low", "high"])
    sign = -1 if metric == SKILL else 1
    rank = rankdata(sign * np.array(means))
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(rankdata(sign * np.array(draws), axis=0), [tail, 1 - tail], axis=1)
    out = pd.DataFrame(names, columns=["model", "config"])
    out = out.assign(mean=means, rank=rank, low=np.minimum(low, rank), high=np.maximum(high, rank))
    return out.sort_values(["rank", "model", "config"], ignore_index=True)
