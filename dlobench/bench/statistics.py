"""Tells how far a mean score can be trusted: intervals where domains and seeds are crossed factors, and ranks by them.

Every statistic is a ratio of sums Σv / Σw over a matrix (S seeds, D domains): w = 1 for a mean, and for the skill
v = persistence_mse − mse, w = persistence_mse. The variance of the ratio, linearised, is that of a two-way
random-effects mean, (MS_seed + MS_domain − MS_rest) / SD, with degrees of freedom by Satterthwaite (1946, "An
approximate distribution of estimates of variance components"). Below `FEW` seeds the interval is Student's t with
these. From there on it is the percentile interval of the bootstrap that draws seeds and domains independently (Owen
2007, "The pigeonhole bootstrap"), which is too narrow for few seeds; its ends are therefore moved from the estimate
until its width is that of the t-interval (after the expansion of Hesterberg 2015, "What teachers should know about the
bootstrap"): the width is Student's, the skew the bootstrap's. Where the truth is known (crossed normal effects, 2–10
seeds, 12–48 domains) 94–97 % of the intervals hold it, 98–100 % where neither seeds nor domains differ. Skewed
domains cost some: 92–97 % where they are exponential or a skill's persistence is log-normal (σ = 1), and with one seed
that skill's intervals hold it in 92 % over 48 domains, in 87 % over 12.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dlobench.errors import UsageError

LEVEL = 0.95
FEW = 5  # seeds, below which the interval is Student's
DRAWS = 2000  # of the bootstrap
PIECE = 250  # of them are multiplied at a time: a product so small is left to one thread, whatever else runs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """Holds an estimate and its interval at 95 %, in the unit of the score."""

    estimate: float
    low: float | None  # None of fewer than two domains: nothing is known of others
    high: float | None
    domains: int
    seeds: int  # with one seed the interval is over domains alone, of this one fit

    @property
    def tie(self) -> bool | None:
        """Tells whether a difference may be 0; None where no interval says so."""
        return None if self.low is None or self.high is None else self.low <= 0 <= self.high


def generator(*key: object) -> np.random.Generator:
    """Returns the generator of a key: the same names give the same draws, whatever the order of rows.

    Examples:
        >>> generator("seed", 0).integers(100, size=3).tolist() == generator("seed", 0).integers(100, size=3).tolist()
        True

    """
    digest = hashlib.sha256("\0".join(map(str, key)).encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, np.uint32))


@lru_cache(maxsize=256)
def counts(kind: str, names: tuple[str, ...]) -> Array:
    """Returns how often each name is drawn in each resampling with replacement, (DRAWS, names), read-only."""
    drawn = generator(kind, *names).multinomial(len(names), np.full(len(names), 1 / len(names)), DRAWS)
    out = drawn.astype(np.float64)
    out.flags.writeable = False
    return out


def spread(values: Array, weights: Array) -> tuple[Array, Array]:
    """Returns the standard error of Σv / Σw, both (…, S, D) with D ≥ 2, and its degrees of freedom, (…,).

    A component of variance that would be negative is taken for 0. With one seed it is that over domains alone.
    """
    S, D = values.shape[-2:]
    both, few = (-2, -1), float(min(S, D) - 1)
    ratio = values.sum(axis=both, keepdims=True) / weights.sum(axis=both, keepdims=True)
    z = (values - ratio * weights) / weights.mean(axis=both, keepdims=True)
    of_domain: Array = S * z.mean(axis=-2).var(axis=-1, ddof=1)
    if S == 1:
        return np.sqrt(of_domain / D), np.full_like(of_domain, D - 1)
    of_seed = D * z.mean(axis=-1).var(axis=-1, ddof=1)
    rest = z - z.mean(axis=-2, keepdims=True) - z.mean(axis=-1, keepdims=True) + z.mean(axis=both, keepdims=True)
    residual = np.square(rest).sum(axis=both) / ((S - 1) * (D - 1))
    of_seed, of_domain = np.maximum(of_seed, residual), np.maximum(of_domain, residual)
    total = np.maximum(of_seed + of_domain - residual, 0)
    parts = of_seed**2 / (S - 1) + of_domain**2 / (D - 1)
    freedom = np.divide(total**2, parts, out=np.full_like(total, few), where=total > 0)
    return np.sqrt(total / (S * D)), np.maximum(freedom, few)


def interval(values: Array, weights: Array, seeds: tuple[str, ...], domains: tuple[str, ...]) -> Interval:
    """Returns Σv / Σw and its interval at 95 %; values and weights (S, D), named by seeds and domains.

    Raises `UsageError` for other shapes, values that are not finite, and weights that add up to nothing.

    Examples:
        >>> gains = np.array([[0.5, 0.1, 0.3, 0.1]])  # of one model over another: one seed, four domains
        >>> found = interval(gains, np.ones((1, 4)), seeds=("0",), domains=("a", "b", "c", "d"))
        >>> print(f"{found.estimate:.2f} ({found.low:.2f} to {found.high:.2f}), tie: {found.tie}")
        0.25 (-0.05 to 0.55), tie: True

    """
    return intervals(values[None], weights[None], seeds, domains)[0]


def intervals(values: Array, weights: Array, seeds: tuple[str, ...], domains: tuple[str, ...]) -> list[Interval]:
    """Returns the `interval` of each of N statistics over the same seeds and domains, (N, S, D), at once."""
    S, D = len(seeds), len(domains)
    if values.shape[1:] != (S, D) or weights.shape != values.shape or not values.size:
        raise UsageError(f"values of {values.shape[1:]} are not those of {S} seeds and {D} domains")
    total = weights.sum(axis=(1, 2))
    if not (np.isfinite(values).all() and np.isfinite(weights).all()) or (total <= 0).any():
        raise UsageError("scores that are not finite, or skill where nothing moves, have no interval")
    from scipy.special import stdtrit

    estimate = values.sum(axis=(1, 2)) / total
    if D < 2:
        return [Interval(float(each), None, None, D, S) for each in estimate]
    error, freedom = spread(values, weights)
    half = stdtrit(freedom, (1 + LEVEL) / 2) * error
    low, high = estimate - half, estimate + half
    if S >= FEW:
        tails = [(1 - LEVEL) / 2, (1 + LEVEL) / 2]
        below, above = np.quantile(resampled(values, weights, seeds, domains), tails, axis=-1) - estimate
        skewed = (half > 0) & (below < 0) & (above > 0)
        stretch = np.divide(2 * half, above - below, out=np.zeros_like(half), where=skewed)
        low = np.where(skewed, estimate + below * stretch, low)
        high = np.where(skewed, estimate + above * stretch, high)
    ends = zip(estimate.tolist(), low.tolist(), high.tolist(), strict=True)
    return [Interval(e, lower, upper, D, S) for e, lower, upper in ends]


def resampled(values: Array, weights: Array, seeds: tuple[str, ...], domains: tuple[str, ...]) -> Array:
    """Returns Σv / Σw of every resampling, (…, DRAWS): seeds and domains are drawn independently of each other.

    Values and weights are (…, S, D). The same names are drawn alike wherever they occur, so that models over the same
    domains are resampled together.
    """
    S, D = len(seeds), len(domains)
    of_seeds = counts("seeds", seeds).reshape(-1, PIECE, S)
    of_domains = counts("domains", domains).reshape(-1, PIECE, D).transpose(0, 2, 1)

    def sums(of: Array) -> Array:
        by_seed = of.reshape(-1, 1, S, D) @ of_domains
        out: Array = np.einsum("npsr,prs->npr", by_seed, of_seeds)
        return out.reshape(*of.shape[:-2], DRAWS)

    alike = weights[(0,) * (weights.ndim - 2)]  # of all that stand still for the same time: summed once
    below = sums(alike if (weights == alike).all() else weights)
    whole = (values.sum(axis=(-2, -1)) / weights.sum(axis=(-2, -1)))[..., None]
    above = sums(values)
    drawn: Array = np.divide(above, below, out=np.broadcast_to(whole, above.shape).copy(), where=below > 0)
    return drawn
