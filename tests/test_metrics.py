"""Tests the metrics against cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dlobench.bench.metrics import euclidean, mse, skill
from dlobench.trajectories import Floats, Mask


def case() -> tuple[Floats, Floats, Mask]:
    """Returns two queries of two valid segments: errors (3, 4), (0, 0) and (0, 1), (2, 0) m; the rest is padding."""
    mask = np.arange(32) < 2
    true = np.full((2, 32, 2), 7, np.float32)
    predicted = true.copy()
    predicted[0, 0] += (3, 4)
    predicted[1, 0] += (0, 1)
    predicted[1, 1] += (2, 0)
    return predicted, true, mask


def test_mse_is_the_mean_square_per_coordinate() -> None:
    assert mse(*case()) == (9 + 16 + 1 + 4) / 8


def test_euclidean_is_the_mean_distance_per_segment() -> None:
    assert euclidean(*case()) == (5 + 0 + 1 + 2) / 4


def test_predictions_and_truth_may_change_places() -> None:
    predicted, true, mask = case()
    assert mse(true, predicted, mask) == mse(predicted, true, mask)
    assert euclidean(true, predicted, mask) == euclidean(predicted, true, mask)


@pytest.mark.parametrize("padding", [1e6, -1e30, np.nan, np.inf])
def test_padding_never_counts(padding: float) -> None:
    predicted, true, mask = case()
    predicted[:, 2:] = padding
    assert mse(predicted, true, mask) == mse(*case())
    assert euclidean(predicted, true, mask) == euclidean(*case())


def test_errors_are_summed_in_double_precision() -> None:
    mask = np.ones(32, bool)
    predicted = np.full((1, 32, 2), 1e-30, np.float32)  # its square is 0 in float32
    assert mse(predicted, np.zeros_like(predicted), mask) == pytest.approx(1e-60, rel=1e-6)


def test_inputs_are_left_as_they_were() -> None:
    given_, expected = case(), case()
    mse(*given_)
    euclidean(*given_)
    assert all(np.array_equal(a, b) for a, b in zip(given_, expected, strict=True))


def test_skill_is_a_ratio_of_sums() -> None:
    assert skill([1.0, 1.0], [10.0, 2.0]) == pytest.approx(1 - 2 / 12)


def test_skill_is_not_blown_up_by_a_domain_where_nothing_moves() -> None:
    assert skill([1.0, 1.0], [10.0, 0.0]) == pytest.approx(0.8)


errors = st.lists(st.floats(1e-12, 1e3), min_size=1, max_size=20)


@given(still=errors)
def test_skill_of_persistence_is_0_and_of_a_perfect_model_1(still: list[float]) -> None:
    assert skill(still, still) == 0
    assert skill([0.0] * len(still), still) == 1


@given(still=errors, factor=st.floats(1.01, 100))
def test_skill_is_negative_for_what_is_worse_than_standing_still(still: list[float], factor: float) -> None:
    assert skill([factor * each for each in still], still) == pytest.approx(1 - factor)


def test_where_nothing_moves_there_is_no_skill() -> None:
    with pytest.raises(ValueError, match="nothing moves"):
        skill([0.0], [0.0])
