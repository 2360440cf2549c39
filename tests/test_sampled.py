"""Tests the scores of samples: by hand, against closed forms and scoringrules, for propriety, fairness and symmetries.

Monte Carlo checks have fixed seeds and allow four standard errors, which they estimate from their own queries.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scoringrules
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dlobench.bench.metrics import Score, euclidean, shape_error, where_moving
from dlobench.bench.sampled import BANDWIDTHS, crps, energy, floor, mmd2, segment_energy, variogram
from dlobench.errors import UsageError
from dlobench.trajectories import Mask

Array = NDArray[np.float64]
Points = list[list[tuple[float, float]]]  # by sample, then by segment

SCORES = [energy, segment_energy, variogram, crps, mmd2]
EVERY = pytest.mark.parametrize("score", SCORES, ids=lambda each: each.__name__)
POINTWISE = pytest.mark.parametrize("score", SCORES[:-1], ids=lambda each: each.__name__)


def padded(shapes: Array) -> tuple[Any, Mask]:
    """Returns shapes (S, B, n, 2) among padding that is no number, and their mask."""
    n = shapes.shape[2]
    out = np.full((*shapes.shape[:2], 32, 2), np.nan)
    out[:, :, :n] = shapes
    return out, np.arange(32) < n


def of(score: Score, samples: Any, true: Any) -> float:
    """Returns the score of samples (S, B, n, 2) against true ones (M, B, n, 2)."""
    x, mask = padded(np.asarray(samples, float))
    return score(x, padded(np.asarray(true, float))[0], mask)


def by_hand(score: Score, samples: Points, true: Points) -> float:
    """Returns the score of one query."""
    return of(score, np.array(samples)[:, None], np.array(true)[:, None])


STAY: list[tuple[float, float]] = [(0, 0), (0, 0)]
FIRST: list[tuple[float, float]] = [(3, 4), (0, 0)]  # the first of two segments moved by 5 m
LAST: list[tuple[float, float]] = [(0, 0), (3, 4)]


def test_the_energy_score_of_whole_shapes() -> None:
    """Shapes lie √(25 / 2) or, where both segments differ, 5 m apart; half the distance of the samples is their due."""
    assert by_hand(energy, [STAY, FIRST], [STAY]) == pytest.approx(0, abs=1e-12)
    assert by_hand(energy, [STAY, FIRST], [LAST]) == pytest.approx((np.sqrt(12.5) + 5) / 2 - np.sqrt(12.5) / 2)
    assert by_hand(energy, [STAY, FIRST], [STAY, LAST]) == pytest.approx(2.5 / 2)


def test_the_energy_score_of_segments() -> None:
    assert by_hand(segment_energy, [STAY, FIRST], [LAST]) == pytest.approx((2.5 - 2.5 + 5 - 0) / 2)
    assert by_hand(segment_energy, [STAY, STAY, FIRST], [STAY]) == pytest.approx((5 / 3 - 10 / 6) / 2)


def test_the_variogram_score() -> None:
    """√3 and 2 are the roots of the differences; their mean over two samples is off by half, its variance a quarter."""
    assert by_hand(variogram, [FIRST], [STAY]) == pytest.approx((3 + 4) / 2)
    assert by_hand(variogram, [FIRST], [LAST]) == pytest.approx(0)
    assert by_hand(variogram, [STAY, FIRST], [STAY]) == pytest.approx(((3 + 4) / 4 - (3 + 4) / 4) / 2)
    assert by_hand(variogram, [FIRST, FIRST], [STAY]) == pytest.approx((3 + 4) / 2)


def test_the_ranked_probability_score() -> None:
    """Of samples 0 and 3 against 1: the mean error 1.5 less half of 3."""
    assert by_hand(crps, [[(0, 0)], [(3, 0)]], [[(1, 0)]]) == pytest.approx(0)
    assert by_hand(crps, [[(0, 0)], [(3, 0)]], [[(5, 0)]]) == pytest.approx((3.5 - 1.5) / 2)
    assert by_hand(crps, [[(0, 0)], [(3, 0)]], [[(1, 0)], [(5, 0)]]) == pytest.approx((0 + 1) / 2)


def test_the_mean_discrepancy() -> None:
    """Equal pairs, a distance d apart: 2 − 2 k(d); a pair that is d apart against another like it: k(d) − 1."""
    d = 0.002

    def k(distance: float) -> float:
        return float(np.mean([np.exp(-(distance**2) / 2 / h**2) for h in BANDWIDTHS]))

    here, there = [(0.0, 0.0)], [(0.0, d)]
    assert by_hand(mmd2, [here, here], [there, there]) == pytest.approx(2 - 2 * k(d))
    assert by_hand(mmd2, [here, there], [here, there]) == pytest.approx(2 * k(d) - (1 + k(d)))


def draw(rng: np.random.Generator, *sizes: int, n: int = 4, spread: float = 0.001, together: float = 0.8) -> Array:
    """Draws Gaussian shapes (…, n, 2) whose segments correlate by `together`, m."""
    shared, own = rng.normal(size=(*sizes, 1, 2)), rng.normal(size=(*sizes, n, 2))
    shapes: Array = spread * (np.sqrt(together) * shared + np.sqrt(1 - together) * own)
    return shapes


@pytest.mark.parametrize("truths", [1, 3])
def test_one_sample_is_scored_as_a_point(truths: int) -> None:
    rng = np.random.default_rng(0)
    x, mask = padded(draw(rng, 1, 6))
    y, _ = padded(draw(rng, truths, 6))
    for score, error in ((energy, shape_error), (segment_energy, euclidean)):
        assert score(x, y, mask) == pytest.approx(np.mean([error(x[0], each, mask) for each in y]), rel=1e-12)
    assert crps(x, y, mask) == pytest.approx(np.nanmean(np.abs(x - y)))
    pairs = np.sqrt(np.abs(x[..., mask, None, :] - x[..., None, mask, :]))
    true_pairs = np.sqrt(np.abs(y[..., mask, None, :] - y[..., None, mask, :]))
    assert variogram(x, y, mask) == pytest.approx(((pairs - true_pairs) ** 2).sum(axis=(-3, -2)).mean() / 12)


def test_equal_samples_are_scored_as_one() -> None:
    rng = np.random.default_rng(0)
    x, y = draw(rng, 1, 6), draw(rng, 2, 6)
    for score in SCORES[:-1]:
        assert of(score, np.repeat(x, 5, axis=0), y) == pytest.approx(of(score, x, y))


@pytest.mark.parametrize("S", [2, 3, 20])
def test_scoringrules_agrees(S: int) -> None:
    """With its estimator "fair", which is not its default."""
    rng = np.random.default_rng(S)
    x, y = draw(rng, S, 5), draw(rng, 1, 5)
    n = x.shape[2]
    forecast, observed = x.reshape(S, 5, -1), y.reshape(5, -1)
    of_shapes = scoringrules.es_ensemble(observed, forecast, m_axis=0, estimator="fair", backend="numpy")
    assert of(energy, x, y) == pytest.approx(of_shapes.mean() / np.sqrt(n))
    of_segments = scoringrules.es_ensemble(y[0], x, m_axis=0, estimator="fair", backend="numpy")
    assert of(segment_energy, x, y) == pytest.approx(of_segments.mean())
    weights = np.broadcast_to(np.tile(np.eye(2), (n, n)) / (2 * n * (n - 1)), (5, 2 * n, 2 * n))
    of_pairs = scoringrules.vs_ensemble(observed, forecast, weights, m_axis=0, estimator="fair", backend="numpy")
    assert of(variogram, x, y) == pytest.approx(of_pairs.mean())
    of_coordinates = scoringrules.crps_ensemble(observed, forecast, m_axis=0, estimator="fair", backend="numpy")
    assert of(crps, x, y) == pytest.approx(of_coordinates.mean())
    plain = scoringrules.es_ensemble(observed, forecast, m_axis=0, backend="numpy").mean() / np.sqrt(n)
    assert of(energy, x, y) < plain


@POINTWISE
def test_many_truths_score_the_mean_of_each(score: Score) -> None:
    rng = np.random.default_rng(0)
    x, y = draw(rng, 5, 3), draw(rng, 4, 3)
    assert of(score, x, y) == pytest.approx(np.mean([of(score, x, each[None]) for each in y]))


@EVERY
def test_queries_score_the_mean_of_each(score: Score) -> None:
    assert each_query(score, *(draw(np.random.default_rng(s), 5, 3) for s in (0, 1))).mean() == pytest.approx(
        of(score, *(draw(np.random.default_rng(s), 5, 3) for s in (0, 1)))
    )


seeds = st.integers(0, 2**32 - 1)


@EVERY
@settings(max_examples=25)
@given(seed=seeds, S=st.integers(2, 6), M=st.integers(2, 4), x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_the_origin_and_all_orders_do_not_matter(score: Score, seed: int, S: int, M: int, x: float, y: float) -> None:
    rng = np.random.default_rng(seed)
    samples, true = padded(draw(rng, S, 3))[0], padded(draw(rng, M, 3))[0]
    order, queries = rng.permutation(32), rng.permutation(3)

    def moved(shapes: Any) -> Any:
        return (shapes + np.array([x, y]))[rng.permutation(len(shapes))][:, queries][:, :, order]

    mask = np.arange(32) < 4
    expected = score(samples, true, mask)
    assert score(moved(samples), moved(true), mask[order]) == pytest.approx(expected, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("score", [energy, segment_energy, mmd2], ids=lambda each: each.__name__)
@settings(max_examples=25)
@given(seed=seeds, turn=st.floats(-np.pi, np.pi), mirrored=st.booleans())
def test_the_direction_of_the_frame_does_not_matter(score: Score, seed: int, turn: float, mirrored: bool) -> None:
    rng = np.random.default_rng(seed)
    x, y = draw(rng, 5, 2), draw(rng, 3, 2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    rotation[:, 0] *= -1 if mirrored else 1
    assert of(score, x @ rotation, y @ rotation) == pytest.approx(of(score, x, y), rel=1e-9, abs=1e-12)


@POINTWISE
@settings(max_examples=25)
@given(seed=seeds, factor=st.floats(1e-3, 1e3))
def test_scores_have_a_unit(score: Score, seed: int, factor: float) -> None:
    rng = np.random.default_rng(seed)
    x, y = draw(rng, 5, 2), draw(rng, 3, 2)
    assert of(score, factor * x, factor * y) == pytest.approx(factor * of(score, x, y), rel=1e-9, abs=1e-12)


@EVERY
def test_inputs_may_be_float32_and_stay_as_they_were(score: Score) -> None:
    rng = np.random.default_rng(0)
    (x, mask), (y, _) = padded(draw(rng, 3, 2)), padded(draw(rng, 2, 2))
    samples, true = x.astype(np.float32), y.astype(np.float32)
    kept = samples.copy(), true.copy()
    assert score(samples, true, mask) == pytest.approx(score(x, y, mask), rel=1e-4)
    assert np.array_equal(samples, kept[0], equal_nan=True) and np.array_equal(true, kept[1], equal_nan=True)


def each_query(score: Score, x: Array, y: Array) -> Array:
    """Returns the score of every query."""
    return np.array([of(score, x[:, b : b + 1], y[:, b : b + 1]) for b in range(x.shape[1])])


def errors(values: Array) -> float:
    """Returns how many standard errors the mean of values is above 0."""
    return float(values.mean() / (values.std(ddof=1) / np.sqrt(len(values))))


QUERIES = 500
WRONG: dict[str, Callable[[np.random.Generator], Array]] = {
    "shifted": lambda rng: draw(rng, 20, QUERIES) + 0.0005,
    "too narrow": lambda rng: draw(rng, 20, QUERIES, spread=0.0005),
    "too wide": lambda rng: draw(rng, 20, QUERIES, spread=0.002),
    "a point": lambda rng: draw(rng, 1, QUERIES, spread=0).repeat(20, axis=0),
}


@pytest.mark.parametrize(
    ("score", "wrong"),
    [(score, wrong) for score in SCORES for wrong in WRONG if (score, wrong) != (variogram, "shifted")],
    ids=lambda each: each if isinstance(each, str) else each.__name__,
)
def test_the_true_distribution_scores_best(score: Score, wrong: str) -> None:
    """But for the variogram score of what moves a whole shape, to which it is blind."""
    rng = np.random.default_rng(1)
    true = draw(rng, 2, QUERIES)
    right = each_query(score, draw(rng, 20, QUERIES), true)
    assert errors(each_query(score, WRONG[wrong](rng), true) - right) > 4


@pytest.mark.parametrize("score", [energy, variogram, mmd2], ids=lambda each: each.__name__)
def test_scores_of_shapes_see_how_segments_move_together(score: Score) -> None:
    rng = np.random.default_rng(2)
    true = draw(rng, 2, 3 * QUERIES)
    right = each_query(score, draw(rng, 20, 3 * QUERIES), true)
    assert errors(each_query(score, draw(rng, 20, 3 * QUERIES, together=0.0), true) - right) > 4


def test_few_narrow_samples_gain_nothing() -> None:
    """The plain energy score of two samples is better for too narrow ones than for true ones; the fair one is not."""
    rng = np.random.default_rng(2)
    true, right, narrow = draw(rng, 1, 3000), draw(rng, 2, 3000), draw(rng, 2, 3000, spread=0.0007)

    def plain(x: Array) -> Array:
        scores: Array = scoringrules.es_ensemble(
            true[0].reshape(3000, -1), x.reshape(2, 3000, -1), m_axis=0, estimator="nrg", backend="numpy"
        )
        return scores

    assert errors(plain(narrow) - plain(right)) < -4
    assert errors(each_query(energy, narrow, true) - each_query(energy, right, true)) > 2


def test_the_score_of_segments_does_not() -> None:
    rng = np.random.default_rng(2)
    true = draw(rng, 2, QUERIES)
    right = each_query(segment_energy, draw(rng, 20, QUERIES), true)
    assert abs(errors(each_query(segment_energy, draw(rng, 20, QUERIES, together=0.0), true) - right)) < 4


@POINTWISE
def test_the_number_of_samples_does_not_matter_in_expectation(score: Score) -> None:
    rng = np.random.default_rng(3)
    true = draw(rng, 1, 3000)
    few = each_query(score, draw(rng, 2, 3000, spread=0.002), true)
    many = each_query(score, draw(rng, 30, 3000, spread=0.002), true)
    assert abs(errors(few - many)) < 4


def test_expectations_are_those_of_closed_forms() -> None:
    """Of standard normals: E|X − X'| is 2 / √π for a coordinate and √π for a point of the plane; a half is left."""
    rng = np.random.default_rng(4)
    x, y = draw(rng, 3, 4000, n=1, spread=1), draw(rng, 1, 4000, n=1, spread=1)
    assert abs(errors(each_query(crps, x, y) - 1 / np.sqrt(np.pi))) < 4
    assert abs(errors(each_query(energy, x, y) - np.sqrt(np.pi) / 2)) < 4
    assert abs(errors(each_query(segment_energy, x, y) - np.sqrt(np.pi) / 2)) < 4


def test_the_discrepancy_of_the_truth_is_0_in_expectation() -> None:
    rng = np.random.default_rng(5)
    found = each_query(mmd2, draw(rng, 3, 3000), draw(rng, 4, 3000))
    assert abs(errors(found)) < 4 and (found < 0).any()


def test_the_floor_is_what_the_truth_scores() -> None:
    rng = np.random.default_rng(6)
    true = draw(rng, 8, 1500, n=1, spread=1)
    found = np.array([floored(crps, true[:, b : b + 1]) for b in range(1500)])
    assert abs(errors(found - 1 / np.sqrt(np.pi))) < 4
    assert abs(errors(np.array([floored(mmd2, true[:, b : b + 1]) for b in range(1500)]))) < 4


def floored(score: Score, true: Array) -> float:
    """Returns the floor of true samples (R, B, n, 2)."""
    return floor(score, *padded(true))


def test_the_floor_scores_each_half_against_the_other() -> None:
    true, mask = padded(np.arange(6.0)[:, None, None, None] * np.ones((6, 2, 3, 2)))
    met: list[tuple[list[float], list[float]]] = []

    def score(samples: Any, truths: Any, _: Mask) -> float:
        met.append((samples[:, 0, 0, 0].tolist(), truths[:, 0, 0, 0].tolist()))
        return float(len(met))

    assert floor(score, true, mask) == 1.5
    assert met == [([0, 1, 2], [3, 4, 5]), ([3, 4, 5], [0, 1, 2])]


@EVERY
def test_without_noise_the_floor_is_0(score: Score) -> None:
    true = draw(np.random.default_rng(0), 1, 3).repeat(4, axis=0)
    assert floored(score, true) == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("R", [0, 1, 2, 3, 5])
def test_what_has_no_halves_has_no_floor(R: int) -> None:
    with pytest.raises(UsageError, match=rf"^{R} true samples cannot be cut"):
        floor(energy, np.zeros((R, 2, 32, 2), np.float32), np.ones(32, bool))


def test_samples_are_scored_over_the_windows_that_move() -> None:
    rng = np.random.default_rng(0)
    (x, mask), (y, _) = padded(draw(rng, 3, 4)), padded(draw(rng, 2, 4, spread=1e-5))
    start = y.mean(axis=0)
    start[1:3] += 1
    assert where_moving(energy, x, y, start, mask) == pytest.approx(energy(x[:, 1:3], y[:, 1:3], mask))
    assert where_moving(energy, x, np.stack([start] * 2), start, mask) is None


@EVERY
@pytest.mark.parametrize(
    ("samples", "true", "mask"),
    [
        ((0, 2, 32, 2), (2, 2, 32, 2), 32),
        ((2, 2, 32, 2), (0, 2, 32, 2), 32),
        ((2, 0, 32, 2), (2, 0, 32, 2), 32),
        ((2, 2, 32, 2), (2, 3, 32, 2), 32),
        ((2, 2, 32, 3), (2, 2, 32, 3), 32),
        ((2, 2, 32, 2), (2, 32, 2), 32),
        ((2, 2, 32, 2), (2, 2, 32, 2), 0),
    ],
    ids=str,
)
def test_what_cannot_be_scored_is_refused_in_a_sentence(
    score: Score, samples: tuple[int, ...], true: tuple[int, ...], mask: int
) -> None:
    with pytest.raises(UsageError, match=r"^[^\n]+$"):
        score(np.zeros(samples, np.float32), np.zeros(true, np.float32), np.arange(32) < mask)


def test_a_point_has_no_discrepancy_and_a_segment_no_variogram() -> None:
    one = np.zeros((1, 2, 32, 2), np.float32)
    with pytest.raises(UsageError, match="MMD² of 1 samples and 2 true ones"):
        mmd2(one, one.repeat(2, axis=0), np.ones(32, bool))
    with pytest.raises(UsageError, match="single valid segment"):
        variogram(one, one, np.arange(32) < 1)
