"""Lays records out as one tidy table, and ranks models by it: places with ties, ranks with intervals.

A row is one (task, task_version, scale, cell, model, config, seed, domain); every number of a domain is a column.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from dlobench.bench.results import DomainScore, Record
from dlobench.bench.statistics import DRAWS, LEVEL, Array, Interval, interval, resampled
from dlobench.errors import UsageError

KEY = ["task", "task_version", "scale", "cell", "model", "config", "seed", "domain"]
SWEEP = ["trajectories", "horizon", "K"]  # of the task's cell
PLACE = ["material", "attachment", "length", "objects"]  # of the domain's cell in its set, as strings
DIGESTS = ["data", "split"]
SKILL = "skill"


def scores(records: Iterable[Record]) -> pd.DataFrame:
    """Returns the tidy table of records, sorted by its key; scores that a record lacks are NaN."""
    names = [name for name in DomainScore.model_fields if name not in ("domain", "cell")]
    parts: dict[str, list[Any]] = {name: [] for name in [*KEY, *SWEEP, "of", *DIGESTS, *names]}
    cells = [(record, cell) for record in records for cell in record.cells]
    cells.sort(key=lambda pair: tuple(getattr(pair[0], name) if name != "cell" else pair[1].id for name in KEY[:-1]))
    for record, cell in cells:
        found = sorted(cell.domains, key=lambda score: score.domain)
        n = len(found)
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
    return frame


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


@dataclass(frozen=True)
class Matrix:
    """Holds what is added up of one model in one cell, NaN where a seed lacks a domain: Σ values / Σ weights."""

    values: Array  # (S, D)
    weights: Array  # (S, D)
    seeds: tuple[str, ...]
    domains: tuple[str, ...]

    def over(self, seeds: Sequence[str], domains: Sequence[str]) -> Matrix:
        """Returns these seeds and domains of it, in the order asked for."""
        rows, columns = (
            [at[name] for name in asked] for at, asked in ((_at(self.seeds), seeds), (_at(self.domains), domains))
        )
        chosen = np.ix_(rows, columns)
        return Matrix(self.values[chosen], self.weights[chosen], tuple(seeds), tuple(domains))

    def whole(self) -> list[str]:
        """Returns the domains that every seed has."""
        return [self.domains[i] for i in np.flatnonzero(np.isfinite(self.values).all(axis=0))]

    def interval(self) -> Interval:
        """Returns the mean score, or the skill, with its interval."""
        return interval(self.values, self.weights, self.seeds, self.domains)


def _at(names: Sequence[str]) -> dict[str, int]:
    return {name: i for i, name in enumerate(names)}


def grid(frame: pd.DataFrame, metric: str) -> Matrix:
    """Returns the matrix of one model in one cell, names sorted; raises `UsageError` for an unknown metric."""
    check_metric(frame, metric)
    numbers, row = np.unique(frame["seed"].to_numpy(dtype=int), return_inverse=True)
    codes, names = pd.factorize(frame["domain"], sort=True)
    score = np.full((len(numbers), len(names)), np.nan)
    score[row, codes] = frame["mse" if metric == SKILL else metric].to_numpy(dtype=float)
    seeds, domains = tuple(map(str, numbers)), tuple(map(str, names))
    if metric != SKILL:
        return Matrix(score, np.ones_like(score), seeds, domains)
    still = np.full_like(score, np.nan)
    still[row, codes] = frame["persistence_mse"].to_numpy(dtype=float)
    return Matrix(still - score, still, seeds, domains)


def matrix(frame: pd.DataFrame, metric: str) -> Matrix:
    """Returns the matrix of one model in one cell over the domains that every seed has.

    Raises `UsageError` for an unknown metric and where there is no such domain.
    """
    found = grid(frame, metric)
    if not (domains := found.whole()):
        raise UsageError(f"no domain has {metric} of every seed")
    return found.over(found.seeds, domains)


def check_metric(frame: pd.DataFrame, metric: str) -> None:
    """Raises `UsageError` for a metric that the table does not have."""
    known = [SKILL, *(name for name in metrics(frame))]
    if metric not in known:
        raise UsageError(f"metric {metric!r} is unknown: {', '.join(known)} are there")


def metrics(frame: pd.DataFrame) -> list[str]:
    """Returns the columns of the table that are scores of a model."""
    apart = {*KEY, *SWEEP, *PLACE, *DIGESTS, "of", "supports", "windows"}
    return [str(name) for name in frame.columns if name not in apart and not str(name).startswith("persistence_")]


def score(frame: pd.DataFrame, metric: str = SKILL) -> Interval:
    """Returns a model's mean score, or its skill, in one cell: the rows of one model, configuration and cell."""
    return matrix(frame, metric).interval()


def difference(a: pd.DataFrame, b: pd.DataFrame, metric: str = SKILL) -> Interval:
    """Returns score of a less that of b in one cell, paired over the domains and the seeds that both have.

    Raises `UsageError` where they share no domain or no seed.
    """
    return _difference(grid(a, metric), grid(b, metric))


def _difference(a: Matrix, b: Matrix) -> Interval:
    seeds = [name for name in a.seeds if name in b.seeds]
    theirs = set(b.domains)
    domains = [name for name in a.domains if name in theirs]
    for what, both in (("domain", domains), ("seed", seeds)):
        if not both:
            raise UsageError(f"the two share no {what}: run them on the same {what}s")
    a, b = a.over(seeds, domains), b.over(seeds, domains)
    theirs = set(b.whole())
    if not (domains := [name for name in a.whole() if name in theirs]):
        raise UsageError("the two share no domain that all of their seeds have: run them on the same domains")
    a, b = a.over(seeds, domains), b.over(seeds, domains)
    return replace(a, values=a.values - b.values).interval()


def places(frame: pd.DataFrame, metric: str = SKILL) -> pd.DataFrame:
    """Returns the models of one cell, best first, with their place; whoever ties with the one above shares its place.

    A tie is a paired interval of the difference between neighbours that holds 0, or no interval, or nothing shared.
    """
    grids = {key: grid(rows, metric) for key, rows in frame.groupby(["model", "config"], sort=True)}
    found = {key: one.over(one.seeds, one.whole()).interval() for key, one in grids.items()}
    sign = -1 if metric == SKILL else 1
    order = sorted(found, key=lambda key: (sign * found[key].estimate, key))
    out: list[dict[str, object]] = []
    for i, key in enumerate(order):
        tied = i > 0 and _tied(grids[order[i - 1]], grids[key])
        place = out[-1]["place"] if tied else i + 1
        one = found[key]
        names = {"model": key[0], "config": key[1], "place": place, "tie": tied}
        out.append(names | {"estimate": one.estimate, "low": one.low, "high": one.high})
    return pd.DataFrame(out, columns=["model", "config", "place", "tie", "estimate", "low", "high"])


def _tied(a: Matrix, b: Matrix) -> bool:
    try:
        return _difference(a, b).tie is not False
    except UsageError:
        return True


def ranks(frame: pd.DataFrame, metric: str = SKILL) -> pd.DataFrame:
    """Returns the rank of each model of one task and scale by its mean score over cells, with intervals at 95 %.

    Ranked are models that have every cell, over the domains of a cell that all seeds of all of these have; the other
    models are missing. All are resampled together, domains and seeds as in `resampled`, and equal means share the mean
    rank. With one seed the interval is over domains alone, and the few seeds of a bootstrap make it rather narrow.
    Raises `UsageError` where a cell was scored on several data or splits, or no domain is common to all.
    """
    from scipy.stats import rankdata

    cells = sorted(frame["cell"].unique())
    if (frame.groupby("cell")[DIGESTS].nunique() > 1).any(axis=None):
        raise UsageError("the records of a cell were scored on different data or splits: rank those of one alone")
    grids = {key: grid(rows, metric) for key, rows in frame.groupby(["model", "config", "cell"], sort=True)}
    models = sorted({key[:2] for key in grids})
    models = [key for key in models if all((*key, cell) in grids for cell in cells)]
    if not models:
        return pd.DataFrame(columns=["model", "config", "mean", "rank", "low", "high"])
    means, draws = np.zeros(len(models)), np.zeros((len(models), DRAWS))
    for cell in cells:
        parts = [grids[*key, cell] for key in models]
        common = sorted(set.intersection(*(set(part.whole()) for part in parts)))
        if not common:
            raise UsageError(f"no domain of {cell} is common to all models with every cell")
        for i, part in enumerate(parts):
            one = part.over(part.seeds, common)
            means[i] += one.values.sum() / one.weights.sum() / len(cells)
            draws[i] += resampled(one.values, one.weights, one.seeds, one.domains) / len(cells)
    sign = -1 if metric == SKILL else 1
    rank = rankdata(sign * means)
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(rankdata(sign * draws, axis=0), [tail, 1 - tail], axis=1)
    out = pd.DataFrame(models, columns=["model", "config"])
    out = out.assign(mean=means, rank=rank, low=np.minimum(low, rank), high=np.maximum(high, rank))
    return out.sort_values(["rank", "model", "config"], ignore_index=True)
