"""Tells whether the truth looks like one more sample: ranks, coverage and rank histograms. Padding never counts.

Shapes: samples (S, B, 32, 2) m, true (M, B, 32, 2) m, mask (32,) with n valid segments. A rank counts the samples below
a truth, from 0 to S; ties are broken at random by an explicit generator. If truth and samples are drawn alike, all
S + 1 ranks are equally likely. All raise `UsageError` for other shapes, no sample, no truth, and values that are not
finite.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dlobench.bench.metrics import Array, valid_segments
from dlobench.bench.sampled import check
from dlobench.errors import UsageError
from dlobench.trajectories import Floats, Mask

SAMPLES = 99  # that the benchmark asks for: its 100 ranks hold central intervals of 50 and 90 % exactly
STILL = 1e-5  # m, a segment that is displaced by no more has not moved
PIECE = 128  # queries that are ranked at a time

Ranks = NDArray[np.int64]


def ranks(samples: Floats, true: Floats, mask: Mask, rng: np.random.Generator) -> Ranks:
    """Returns the rank of every coordinate of every truth among the samples, (M, B, n, 2) from 0 to S."""
    x, truths = _valid(samples, true, mask)
    out = np.empty(truths.shape, np.int64)
    for y, rank in zip(truths, out, strict=True):
        rank[:] = (x < y).sum(axis=0) + rng.integers(0, (x == y).sum(axis=0), endpoint=True)
    return out


def unmoved(start: Floats, samples: Floats, true: Floats, mask: Mask) -> Mask:
    """Tells which segments stay where they are, (M, B, n), by the truth and by all samples alike: start (B, 32, 2) m.

    Their ranks are those of ties, and are to be shown apart: `ranks(...)[~unmoved(...)]` are the others. Truth and
    samples have the same say, so that the ranks of a calibrated model are uniform on both sides; if the truth alone
    decided, they would not be.
    """
    x, truths = _valid(samples, true, mask)
    begin = start[:, valid_segments(mask)].astype(np.float64)

    def still(dlo: Floats) -> Mask:
        resting: Mask = np.sqrt(np.square(dlo - begin).sum(axis=-1)) <= STILL
        return resting

    resting = np.all([still(each) for each in x], axis=0)
    return np.stack([resting & still(y) for y in truths])


def coverage(found: Ranks, samples: int, level: float) -> float | None:
    """Returns the share of ranks within the central interval of `level`, which calibrated samples meet; None of none.

    The interval leaves out (S + 1)(1 − level) / 2 ranks at each end: its ends are samples, and nothing is interpolated.
    Raises `UsageError` where that is no whole number.

    Examples:
        >>> coverage(np.arange(100), samples=99, level=0.9)  # every rank once: calibrated
        0.9
        >>> coverage(np.array([0, 0, 99, 99]), samples=99, level=0.9)  # the truth is always outside
        0.0

    """
    out = (samples + 1) * (1 - level) / 2
    if not 0 < level < 1 or abs(out - round(out)) > 1e-9:
        raise UsageError(
            f"{samples} samples have no central interval of {level:g}: it leaves out {out:g} of {samples + 1} ranks "
            f"at each end, which has to be a whole number ({SAMPLES} samples have those of 0.5 and 0.9)"
        )
    return float(np.mean((found >= round(out)) & (found <= samples - round(out)))) if found.size else None


def histogram(found: Ranks, samples: int) -> Ranks:
    """Returns how often each rank occurs, (S + 1,); raises `UsageError` for ranks beyond 0 to S."""
    if found.size and not 0 <= found.min() <= found.max() <= samples:
        raise UsageError(
            f"ranks from {found.min()} to {found.max()} are not those among {samples} samples, 0 to {samples}"
        )
    return np.bincount(found.ravel(), minlength=samples + 1)


def shape_ranks(
    samples: Floats,
    true: Floats,
    mask: Mask,
    rng: np.random.Generator,
    order: Literal["average", "depth"] = "average",
) -> Ranks:
    """Returns the multivariate rank of every true shape among the sampled ones, (M, B) from 0 to S.

    S + 1 shapes, the truth among them, are ordered by a mean over coordinates of a function of the rank r = 1 … S + 1
    (mean ranks of ties) of each: "average" is r, which shows bias as a slope and a wrong spread as ∪ or ∩; "depth" is
    the band depth (S + 1 − r)(r − 1), low for outlying shapes, so that the truth ranks low among samples that are too
    narrow and high among those that are too wide (Thorarinsdottir, Scheuerer & Heinz 2016, "Assessing the calibration
    of high-dimensional ensemble forecasts using rank histograms").
    """
    if order not in ("average", "depth"):
        raise UsageError(f"order = {order} is unknown: average and depth are there")
    x, truths = _valid(samples, true, mask)
    out = np.empty(truths.shape[:2], np.int64)
    for first in range(0, x.shape[1], PIECE):
        rows = slice(first, first + PIECE)
        among = _mean_ranks(x[:, rows])
        for y, rank in zip(truths[:, rows], out[:, rows], strict=True):
            rank[:] = _shape_rank(x[:, rows], among, y, rng, order)
    return out


def _shape_rank(x: Floats, among: Array, y: Floats, rng: np.random.Generator, order: str) -> Ranks:
    """Returns the rank (b,) of each true shape y (b, n, 2) among those of x (S, b, n, 2), whose own ranks are known."""
    S = len(x)
    below, same = x < y, x == y
    true_rank = 1 + below.sum(axis=0) + same.sum(axis=0) / 2
    rank = among + ~(below | same) + same / 2
    if order == "depth":
        true_rank, rank = (S + 1 - true_rank) * (true_rank - 1), (S + 1 - rank) * (rank - 1)
    true_order, orders = (
        true_rank.sum(axis=(1, 2)),
        rank.sum(axis=(2, 3)),
    )  # sums of quarters: exact, as ties have to be
    lower: Ranks = (orders < true_order).sum(axis=0)
    lower += rng.integers(0, (orders == true_order).sum(axis=0), endpoint=True)
    return lower


def _mean_ranks(x: Floats) -> Array:
    """Returns the rank of every coordinate of every sample among the samples, 1 … S, the mean rank for ties."""
    from scipy.stats import rankdata

    found: Array = rankdata(x, axis=0)
    return found


def _valid(samples: Floats, true: Floats, mask: Mask) -> tuple[Floats, Floats]:
    """Returns the valid segments of samples (S, B, n, 2) and of the truths (M, B, n, 2), all of them finite."""
    check(samples, true, mask)
    valid = valid_segments(mask)
    x, y = samples[:, :, valid], true[:, :, valid]
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise UsageError(
            "samples or true ones that are not finite cannot be ranked: every coordinate has to be a number"
        )
    return x, y
