"""Ranks models: places in a cell with ties, and ranks over cells with intervals."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import pandas as pd

from dlobench.bench.matrix import Key, Matrix, grids, intervals_of, ties
from dlobench.bench.scores import DIGESTS, SKILL
from dlobench.bench.statistics import DRAWS, LEVEL, Array, resampled
from dlobench.errors import UsageError

AHEAD = 16  # models that are held against the first of a place at a time


def places(frame: pd.DataFrame, metric: str = SKILL) -> pd.DataFrame:
    """Returns the models of one cell, best first, with their place and with whom of their neighbours they tie.

    Two tie where the paired interval of their difference holds 0, or there is none. A model shares the place above
    it where it ties with the model above it and with the first of that place. `tie` is "above", "below", "both" or "".
    Raises `UsageError` where models are scored differently.
    """
    return placed(grids(frame, metric, ["model", "config"]), lower=metric != SKILL)


def placed(of: Mapping[Key, Matrix], *, lower: bool = False) -> pd.DataFrame:
    """Returns the `places` of matrices by model and configuration; `lower` is better, or higher."""
    check_alike(of)
    keys = sorted(of)
    found = dict(zip(keys, intervals_of([of[key].filled() for key in keys]), strict=True))
    sign = 1 if lower else -1
    keys.sort(key=lambda key: (sign * found[key].estimate, key))
    best_first = [of[key] for key in keys]
    tied = [False, *ties(list(pairwise(best_first))), False]  # each with the one above it
    place = _places(best_first, tied)
    word = {(False, False): "", (True, False): "above", (False, True): "below", (True, True): "both"}
    rows = [
        {"model": key[0], "config": key[1], "place": place[i], "tie": word[tied[i], tied[i + 1]]}
        | {"estimate": found[key].estimate, "low": found[key].low, "high": found[key].high}
        for i, key in enumerate(keys)
    ]
    out = pd.DataFrame(rows, columns=["model", "config", "place", "tie", "estimate", "low", "high"])
    return out.astype({"estimate": float, "low": float, "high": float})


def _places(best_first: list[Matrix], tied: list[bool]) -> list[int]:
    """Returns the place of each: the first of a place, and those that tie with it and with their neighbour above."""
    out: list[int] = []
    first, known = 0, list[bool]()  # the number of the first, and whether those after it tie with it
    for i in range(len(best_first)):
        if tied[i] and i - first > len(known):
            others = best_first[first + 1 + len(known) : i + AHEAD]
            known += ties([(best_first[first], other) for other in others])
        if not (tied[i] and known[i - first - 1]):
            first, known = i, []
        out.append(first + 1)
    return out


def check_alike(of: Mapping[Key, Matrix]) -> None:
    """Raises `UsageError` where matrices hold different scores."""
    if len(kinds := sorted({one.of for one in of.values()})) > 1:
        raise UsageError(f"models were scored differently, by {' and by '.join(kinds)}: they cannot be ranked together")


def ranks(frame: pd.DataFrame, metric: str = SKILL) -> pd.DataFrame:
    """Returns the rank of each model of one task and scale by its mean score over cells, with intervals at 95 %.

    The cells that count are those of the models that have most of them, so that a model run elsewhere puts no one else
    out; a model that lacks one of them is missing. A cell counts over the domains that all seeds of all models have.
    All are resampled together, domains and seeds as in `resampled`, and equal means share the mean rank. With one seed
    the interval is over domains alone, and the few seeds of a bootstrap make it rather narrow; one domain says nothing
    of others, and the interval is NaN. Raises `UsageError` where a cell was scored on several data or splits or
    differently, or no domain is common to all.
    """
    if (frame.groupby("cell")[DIGESTS].nunique() > 1).any(axis=None):
        raise UsageError("the records of a cell were scored on different data or splits: rank those of one alone")
    return ranked(grids(frame, metric, ["model", "config", "cell"]), lower=metric != SKILL)


def ranked(of: Mapping[Key, Matrix], *, lower: bool = False) -> pd.DataFrame:
    """Returns the `ranks` of matrices by model, configuration and cell; `lower` is better, or higher."""
    have: dict[Key, set[str]] = {}
    for model, config, cell in of:
        have.setdefault((model, config), set()).add(cell)
    most = max(map(len, have.values()), default=0)
    cells = sorted(set().union(*(found for found in have.values() if len(found) == most)))
    models = sorted(key for key, found in have.items() if found.issuperset(cells))
    if not models:
        return pd.DataFrame(columns=["model", "config", "mean", "rank", "low", "high"])
    means, draws, known = np.zeros(len(models)), np.zeros((DRAWS, len(models))), True
    for cell in cells:
        parts = {key: of[*key, cell] for key in models}
        check_alike(parts)
        common = sorted(set.intersection(*(set(whole) for whole in {part.whole for part in parts.values()})))
        if not common:
            raise UsageError(f"no domain of {cell} is common to all models with every cell")
        known = known and len(common) > 1
        alike: dict[tuple[str, ...], list[int]] = {}  # by their seeds
        for i, part in enumerate(parts.values()):
            alike.setdefault(part.seeds, []).append(i)
        for seeds, members in alike.items():
            chosen = [parts[models[i]].over(seeds, common) for i in members]
            values, weights = (np.stack([getattr(one, name) for one in chosen]) for name in ("values", "weights"))
            means[members] += values.sum(axis=(1, 2)) / weights.sum(axis=(1, 2)) / len(cells)
            draws[:, members] += resampled(values, weights, seeds, tuple(common)).T / len(cells)
    sign = 1 if lower else -1
    rank = mean_ranks(sign * means[None])[0]
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(mean_ranks(sign * draws), [tail, 1 - tail], axis=0)
    low, high = (np.minimum(low, rank), np.maximum(high, rank)) if known else np.full((2, len(models)), np.nan)
    out = pd.DataFrame(models, columns=["model", "config"]).assign(mean=means, rank=rank, low=low, high=high)
    return out.sort_values(["rank", "model", "config"], ignore_index=True)


def mean_ranks(values: Array) -> Array:
    """Returns the rank of each value (N, M) in its row, 1 for the lowest; equal ones share their mean rank.

    As `scipy.stats.rankdata` along the last axis, whose import takes longer than the whole ranking.

    Examples:
        >>> mean_ranks(np.array([[0.3, 0.1, 0.3]]))
        array([[2.5, 1. , 2.5]])

    """
    out = np.empty_like(values)
    for row, rank in zip(values, out, strict=True):
        ordered = np.sort(row)
        rank[:] = (np.searchsorted(ordered, row, "left") + np.searchsorted(ordered, row, "right") + 1) / 2
    return out
