"""Puts the scores of a model in a cell into a matrix, seeds by domains, and subtracts one model from another."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dlobench.bench.scores import SKILL, check_metric
from dlobench.bench.statistics import Array, Interval, interval, intervals
from dlobench.errors import UsageError

Key = tuple[str, ...]


@dataclass(frozen=True)
class Matrix:
    """Holds what is added up of one model in one cell, NaN where a seed lacks a domain: Σ values / Σ weights."""

    values: Array  # (S, D)
    weights: Array  # (S, D)
    seeds: tuple[str, ...]
    domains: tuple[str, ...]
    of: str = ""  # the score: no other is ever subtracted

    def over(self, seeds: Sequence[str], domains: Sequence[str]) -> Matrix:
        """Returns these seeds and domains of it, in the order asked for."""
        if (*seeds,) == self.seeds and (*domains,) == self.domains:
            return self
        rows, columns = (
            [at[name] for name in asked] for at, asked in ((_at(self.seeds), seeds), (_at(self.domains), domains))
        )
        chosen = np.ix_(rows, columns)
        return replace(
            self,
            values=self.values[chosen],
            weights=self.weights[chosen],
            seeds=tuple(seeds),
            domains=tuple(domains),
        )

    @cached_property
    def whole(self) -> tuple[str, ...]:
        """Holds the domains that every seed has."""
        full = np.isfinite(self.values).all(axis=0)
        return self.domains if full.all() else tuple(self.domains[i] for i in np.flatnonzero(full))

    def filled(self) -> Matrix:
        """Returns it over the domains that every seed has; raises `UsageError` where there is none."""
        if not self.whole:
            raise UsageError(f"no domain has {self.of} of every seed")
        return self.over(self.seeds, self.whole)

    def interval(self) -> Interval:
        """Returns the mean score, or the skill, with its interval."""
        return interval(self.values, self.weights, self.seeds, self.domains)

    def __sub__(self, other: Matrix) -> Matrix:
        """Returns the difference, paired over the domains and the seeds that both have.

        Raises `UsageError` where they share no domain or no seed, or hold different scores.
        """
        if self.of != other.of:
            raise UsageError(f"{self.of} and {other.of} are different scores: score both models alike")
        seeds = [name for name in self.seeds if name in other.seeds]
        domains = self.domains if self.domains == other.domains else sorted({*self.domains} & {*other.domains})
        for what, both in (("domain", domains), ("seed", seeds)):
            if not both:
                raise UsageError(f"the two share no {what}: run them on the same {what}s")
        a, b = self.over(seeds, domains), other.over(seeds, domains)
        common = a.whole if a.whole == b.whole else sorted({*a.whole} & {*b.whole})
        if not common:
            raise UsageError("the two share no domain that all of their seeds have: run them on the same domains")
        a, b = a.over(seeds, common), b.over(seeds, common)
        return replace(a, values=a.values - b.values)


def _at(names: Sequence[str]) -> dict[str, int]:
    return {name: i for i, name in enumerate(names)}


def grid(frame: pd.DataFrame, metric: str) -> Matrix:
    """Returns the matrix of one model in one cell, names sorted; raises `UsageError` for an unknown metric."""
    return grids(frame, metric, [])[()]


def grids(frame: pd.DataFrame, metric: str, by: list[str]) -> dict[Key, Matrix]:
    """Returns the matrices of a table by the values of some columns, which together tell models and cells apart.

    The skill is of the energy score where samples are scored, else of the mean squared error. Raises `UsageError` for
    an unknown metric, a skill of both at once, and a domain that is there twice.
    """
    check_metric(frame, metric)
    numbers, domains = frame["seed"].to_numpy(dtype=int), pd.factorize(frame["domain"], sort=True)
    names = [str(name) for name in domains[1]]
    score, still, sampled = _columns(frame, metric)
    known: dict[bytes, tuple[str, ...]] = {}  # the names are the same objects in all matrices: compared at once
    out = {}
    for key, at in _members(frame, by):
        seeds, row = np.unique(numbers[at], return_inverse=True)
        codes, column = np.unique(domains[0][at], return_inverse=True)
        if len(at) > len(seeds) * len(codes) or len(np.unique(row * len(codes) + column)) < len(at):
            raise UsageError(f"a domain is there twice of one seed{' of ' if key else ''}{' '.join(key)}")
        values, weights = np.full((2, len(seeds), len(codes)), np.nan)
        values[row, column] = score[at] if still is None else still[at] - score[at]
        weights[row, column] = 1 if still is None else still[at]
        of = metric
        if metric == SKILL:
            kinds = np.unique(sampled[at])
            if len(kinds) > 1:
                raise UsageError(f"samples are scored in some domains alone{' of ' if key else ''}{' '.join(key)}")
            of = "skill of samples" if kinds.any() else "skill"
        found = known.setdefault(codes.tobytes(), tuple(names[code] for code in codes))
        out[key] = Matrix(values, weights, tuple(map(str, seeds)), found, of)
    return out


def _members(frame: pd.DataFrame, by: list[str]) -> Iterable[tuple[Key, NDArray[np.intp]]]:
    """Yields the numbers of the rows of each group, by its values."""
    if not by:
        yield (), np.arange(len(frame))
    elif len(frame):
        number = frame.groupby(by, sort=True).ngroup().to_numpy()
        order = np.argsort(number, kind="stable")
        starts = np.flatnonzero(np.diff(number[order], prepend=-1))
        keys = frame[by].iloc[order[starts]].astype(str).itertuples(index=False, name=None)
        yield from zip(keys, np.split(order, starts[1:]), strict=True)


def _columns(frame: pd.DataFrame, metric: str) -> tuple[Array, Array | None, NDArray[np.bool_]]:
    """Returns the score of each row, what standing still scores where a skill is asked for, and whether of samples."""
    none = np.zeros(len(frame), bool)
    if metric != SKILL:
        return frame[metric].to_numpy(dtype=float), None, none
    score, still = (frame[name].to_numpy(dtype=float) for name in ("mse", "persistence_mse"))
    if "energy" not in frame:
        return score, still, none
    sampled = frame["energy"].notna().to_numpy()
    pairs = ((frame["energy"], score), (frame["persistence_energy"], still))
    score, still = (np.where(sampled, column.to_numpy(dtype=float), other) for column, other in pairs)
    return score, still, sampled


def intervals_of(matrices: Sequence[Matrix]) -> list[Interval]:
    """Returns the interval of each matrix, those over the same seeds and domains at once."""
    groups: dict[tuple[tuple[str, ...], tuple[str, ...]], list[int]] = {}
    for i, one in enumerate(matrices):
        groups.setdefault((one.seeds, one.domains), []).append(i)
    out: dict[int, Interval] = {}
    for (seeds, domains), members in groups.items():
        values, weights = (np.stack([getattr(matrices[i], name) for i in members]) for name in ("values", "weights"))
        out.update(zip(members, intervals(values, weights, seeds, domains), strict=True))
    return [out[i] for i in range(len(matrices))]


def ties(pairs: Sequence[tuple[Matrix, Matrix]]) -> list[bool]:
    """Tells of each pair whether nothing tells them apart: the interval of their difference holds 0, or there is none.

    Models that share no domain tie as well. Those that share no seed are paired by the order of theirs: it is by number
    alone that seeds of two models belong together.
    """
    differences: dict[int, Matrix] = {}
    for i, (a, b) in enumerate(pairs):
        try:
            differences[i] = a - (_renamed(b, a.seeds) if set(a.seeds).isdisjoint(b.seeds) else b)
        except UsageError:
            continue
    found = dict(zip(differences, intervals_of(list(differences.values())), strict=True))
    return [i not in found or found[i].tie is not False for i in range(len(pairs))]


def _renamed(one: Matrix, seeds: tuple[str, ...]) -> Matrix:
    """Returns a matrix with other names for its first seeds, as many as there are of both."""
    count = min(len(one.seeds), len(seeds))
    return replace(one.over(one.seeds[:count], one.domains), seeds=seeds[:count])


def score(frame: pd.DataFrame, metric: str = SKILL) -> Interval:
    """Returns a model's mean score, or its skill, in one cell: the rows of one model, configuration and cell.

    Raises `UsageError` for an unknown metric and where no domain has the score of every seed.
    """
    return grid(frame, metric).filled().interval()


def difference(a: pd.DataFrame, b: pd.DataFrame, metric: str = SKILL) -> Interval:
    """Returns score of a less that of b in one cell, paired over the domains and the seeds that both have.

    Raises `UsageError` where they share no domain or no seed.
    """
    return (grid(a, metric) - grid(b, metric)).interval()
