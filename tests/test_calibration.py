"""Tests ranks, coverage and rank histograms: by hand, beside a plain implementation, on samples known to be right."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chisquare, rankdata

from dlobench.bench.calibration import PIECE, SAMPLES, STILL, coverage, histogram, ranks, shape_ranks, unmoved
from dlobench.errors import UsageError
from dlobench.trajectories import Mask

Array = NDArray[np.float64]
Ranks = NDArray[np.int64]
Order = Literal["average", "depth"]

ORDERS = pytest.mark.parametrize("order", ["average", "depth"])
UNLIKELY = 1e-3  # chance at which counts of equally likely ranks are taken for others; seeds are fixed


def padded(shapes: Array) -> tuple[Any, Mask]:
    """Returns shapes (S, B, n, 2) among padding that is no number, and their mask."""
    n = shapes.shape[2]
    out = np.full((*shapes.shape[:2], 32, 2), np.nan)
    out[:, :, :n] = shapes
    return out, np.arange(32) < n


def draw(rng: np.random.Generator, *sizes: int, n: int = 3, spread: float = 1.0) -> Array:
    """Draws Gaussian shapes (…, n, 2) whose segments correlate by a half."""
    shapes: Array = rng.normal(size=(*sizes, 1, 2)) + rng.normal(size=(*sizes, n, 2))
    shapes *= spread / np.sqrt(2)
    return shapes


def found(samples: Array, true: Array, seed: int = 0) -> Ranks:
    """Returns the ranks of true shapes (M, B, n, 2) among samples (S, B, n, 2)."""
    x, mask = padded(samples)
    return ranks(x, padded(true)[0], mask, np.random.default_rng(seed))


def of_shapes(samples: Array, true: Array, order: Order, seed: int = 0) -> Ranks:
    """Returns the ranks of whole shapes."""
    x, mask = padded(samples)
    return shape_ranks(x, padded(true)[0], mask, np.random.default_rng(seed), order)


def chance(counts: Ranks) -> float:
    """Returns the chance of such counts or more uneven ones if all ranks are equally likely."""
    return float(chisquare(counts).pvalue)


def line(*values: float) -> Array:
    """Returns a sample of one query and one segment a value; y is minus x."""
    return np.array([[[[value, -value]]] for value in values])


def test_a_rank_counts_the_samples_below() -> None:
    assert found(line(1, 2, 3), line(0, 2.5, 9))[:, 0, 0].tolist() == [[0, 3], [2, 1], [3, 0]]


def test_ties_are_broken_at_random() -> None:
    seen = {tuple(found(line(1, 2, 2, 3), line(2), seed)[0, 0, 0].tolist()) for seed in range(200)}
    assert seen == {(x, y) for x in (1, 2, 3) for y in (1, 2, 3)}


def test_what_ties_with_all_samples_has_every_rank_alike() -> None:
    still = np.zeros((9, 2000, 3, 2))
    assert chance(histogram(found(still, still[:1]), 9)) > UNLIKELY
    assert chance(histogram(of_shapes(still, still[:1], "depth"), 9)) > UNLIKELY


def test_the_same_generator_draws_the_same_ranks() -> None:
    still = np.zeros((9, 50, 3, 2))
    assert np.array_equal(found(still, still[:1], 1), found(still, still[:1], 1))
    assert not np.array_equal(found(still, still[:1], 1), found(still, still[:1], 2))


def test_calibrated_samples_have_uniform_ranks_and_the_coverage_they_claim() -> None:
    """Of one segment a query: those of a shape are no independent draws."""
    rng = np.random.default_rng(0)
    one = found(draw(rng, SAMPLES, 4000, n=1), draw(rng, 1, 4000, n=1))
    assert chance(histogram(one, SAMPLES)) > UNLIKELY
    for level in (0.5, 0.9):
        assert coverage(one, SAMPLES, level) == pytest.approx(level, abs=4 * np.sqrt(level * (1 - level) / one.size))


@pytest.mark.parametrize(("spread", "sign"), [(0.5, -1), (2.0, 1)])
def test_samples_too_narrow_or_wide_cover_too_little_or_much(spread: float, sign: int) -> None:
    rng = np.random.default_rng(0)
    wrong = found(draw(rng, SAMPLES, 1000, spread=spread), draw(rng, 1, 1000))
    for level in (0.5, 0.9):
        share = coverage(wrong, SAMPLES, level)
        assert share is not None and sign * (share - level) > 0.05
    assert chance(histogram(wrong, SAMPLES)) < 1e-12


def test_coverage_counts_the_ranks_between_the_ends_of_an_interval() -> None:
    every = np.arange(SAMPLES + 1)
    assert coverage(every, SAMPLES, 0.5) == 0.5 and coverage(every, SAMPLES, 0.9) == 0.9
    assert [coverage(np.array([rank]), SAMPLES, 0.9) for rank in (0, 4, 5, 94, 95, 99)] == [0, 0, 1, 1, 0, 0]
    assert [coverage(np.array([rank]), 19, 0.9) for rank in (0, 1, 18, 19)] == [0, 1, 1, 0]
    assert coverage(np.array([], int), SAMPLES, 0.9) is None


@pytest.mark.parametrize(("samples", "level"), [(98, 0.5), (99, 0.95), (1, 0.9), (99, 0.0), (99, 1.0), (99, -1.0)])
def test_an_interval_that_ends_between_samples_is_refused(samples: int, level: float) -> None:
    with pytest.raises(UsageError, match=rf"^{samples} samples have no central interval of {level:g}[^\n]*$"):
        coverage(np.arange(samples + 1), samples, level)


def test_a_histogram_has_a_bin_for_every_rank() -> None:
    assert histogram(np.array([[0, 3], [3, 1]]), 4).tolist() == [1, 1, 0, 2, 0]
    assert histogram(np.array([], int), 2).tolist() == [0, 0, 0]
    with pytest.raises(UsageError, match="ranks from 0 to 5 are not those among 4 samples"):
        histogram(np.array([0, 5]), 4)


def test_a_segment_is_unmoved_if_truth_and_all_samples_leave_it() -> None:
    start = np.zeros((1, 1, 4, 2))
    samples, true = np.zeros((3, 1, 4, 2)), np.zeros((2, 1, 4, 2))
    samples[1, 0, 1] = 0.01  # a sample moves segment 1
    true[1, 0, 2] = 0.01  # one truth moves segment 2
    true[:, 0, 3] = STILL / 2
    (x, mask), (y, _), (begin, _) = padded(samples), padded(true), padded(start)
    assert unmoved(begin[0], x, y, mask)[:, 0].tolist() == [[True, False, True, True], [True, False, False, True]]


def test_ranks_are_uniform_on_both_sides_of_what_is_unmoved() -> None:
    """Segments move or stay by even chance in truth and in every sample; picked by the truth alone, ranks are not."""
    rng = np.random.default_rng(0)

    def outcome(*sizes: int) -> Array:
        shapes: Array = draw(rng, *sizes, n=1) * (rng.random((*sizes, 1, 1)) < 0.5)
        return shapes

    samples, true = outcome(3, 8000), outcome(1, 8000)
    (x, mask), (y, _) = padded(samples), padded(true)
    apart = unmoved(np.zeros((8000, 32, 2), np.float32), x, y, mask)
    rank = found(samples, true)
    assert 0.04 < apart.mean() < 0.09  # 1 in 16
    assert chance(histogram(rank[apart], 3)) > UNLIKELY
    assert chance(histogram(rank[~apart], 3)) > UNLIKELY
    assert chance(histogram(rank[np.abs(true).max(axis=-1) > STILL], 3)) < UNLIKELY


def plain(samples: Array, true: Array, order: Order) -> tuple[int, int]:
    """Returns the least and the greatest rank that a true shape (n, 2) may have among samples (S, n, 2)."""
    pool = np.concatenate([true[None], samples]).reshape(len(samples) + 1, -1)
    rank = rankdata(pool, axis=0)
    if order == "depth":
        rank = (len(pool) - rank) * (rank - 1)
    mean = rank.mean(axis=1)
    first = int((mean < mean[0] - 1e-9).sum())
    return first, first + int((np.abs(mean[1:] - mean[0]) < 1e-9).sum())


@ORDERS
def test_shapes_are_ranked_as_a_plain_implementation_does(order: Order) -> None:
    """With and without ties, over more than a piece of queries, against two truths."""
    rng = np.random.default_rng(0)
    samples, true = draw(rng, 6, PIECE + 3), draw(rng, 2, PIECE + 3)
    samples[:, ::2], true[:, ::2] = samples[:, ::2].round(), true[:, ::2].round()
    rank = of_shapes(samples, true, order)
    for m, b in np.ndindex(rank.shape):
        least, greatest = plain(samples[:, b], true[m, b], order)
        assert least <= rank[m, b] <= greatest
    assert np.unique(rank).tolist() == list(range(7))


@ORDERS
def test_shapes_drawn_alike_have_uniform_ranks(order: Order) -> None:
    rng = np.random.default_rng(1)
    assert chance(histogram(of_shapes(draw(rng, 19, 4000), draw(rng, 1, 4000), order), 19)) > UNLIKELY


def test_a_wrong_spread_or_place_shows_in_the_ranks_of_shapes() -> None:
    rng = np.random.default_rng(2)
    true = draw(rng, 1, 2000)

    def thirds(order: Order, spread: float, shift: float) -> Array:
        rank = of_shapes(draw(rng, 19, 2000, spread=spread) + shift, true, order)
        shares: Array = np.histogram(rank, [0, 5, 15, 20])[0] / rank.size  # of ¼, ½, ¼ if all is right
        return shares

    narrow, wide, shifted = (thirds("average", *each) for each in ((0.3, 0), (3, 0), (1, 1)))
    assert narrow[0] > 0.3 and narrow[2] > 0.3
    assert wide[1] > 0.6
    assert shifted[0] > 0.5 and shifted[2] < 0.1
    narrow, wide, shifted = (thirds("depth", *each) for each in ((0.5, 0), (2, 0), (1, 1)))
    assert narrow[0] > 0.5 and wide[2] > 0.5 and shifted[0] > 0.4


def test_only_depth_sees_what_errs_to_both_sides() -> None:
    """Half of the coordinates too high and half too low: their mean rank is in the middle."""
    rng = np.random.default_rng(3)
    samples, true = rng.normal(size=(19, 2000, 4, 2)), rng.normal(size=(1, 2000, 4, 2))
    true += np.where(np.arange(8) % 2, 2, -2).reshape(4, 2)
    assert histogram(of_shapes(samples, true, "depth"), 19)[0] > 1000
    assert histogram(of_shapes(samples, true, "average"), 19)[[0, 19]].sum() < 300


def test_values_that_are_no_numbers_are_refused_but_in_padding() -> None:
    samples = np.zeros((3, 2, 3, 2))
    samples[1, 1, 1, 1] = np.nan
    for rank in (found, lambda x, y: of_shapes(x, y, "average")):
        with pytest.raises(UsageError, match=r"^[^\n]*not finite[^\n]*$"):
            rank(samples, np.zeros((1, 2, 3, 2)))


def test_what_cannot_be_ranked_is_refused() -> None:
    x, mask = padded(np.zeros((3, 2, 3, 2)))
    with pytest.raises(UsageError, match=r"^samples of \(0, 2, 32, 2\) cannot be scored[^\n]*$"):
        ranks(x[:0], x, mask, np.random.default_rng(0))
    with pytest.raises(UsageError, match="order = mean is unknown: average and depth are there"):
        shape_ranks(x, x, mask, np.random.default_rng(0), "mean")  # type: ignore[arg-type]
