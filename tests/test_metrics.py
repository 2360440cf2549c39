"""Tests the metrics against cases worked out by hand."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dlobench.bench.metrics import (
    PIECE,
    Score,
    displacement,
    euclidean,
    moving,
    mse,
    pose_error,
    shape_error,
    skill,
    where_moving,
)
from dlobench.errors import UsageError
from dlobench.trajectories import Floats, Mask

POINTS = pytest.mark.parametrize("score", [mse, euclidean, shape_error])


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


def test_the_error_of_a_shape_is_a_root_mean_square_over_its_segments() -> None:
    assert shape_error(*case()) == pytest.approx((np.sqrt(25 / 2) + np.sqrt((1 + 4) / 2)) / 2)


@POINTS
def test_many_queries_are_scored_as_few(score: Score) -> None:
    """In pieces, of which the last is not full, and with valid segments that do not come first."""
    rng = np.random.default_rng(0)
    mask = rng.random(32) < 0.7
    predicted, true = rng.normal(size=(2, 2 * PIECE + 3, 32, 2)).astype(np.float32)
    distance = np.linalg.norm(predicted[:, mask].astype(float) - true[:, mask], axis=-1)
    expected = {
        "mse": (distance**2).mean() / 2,
        "euclidean": distance.mean(),
        "shape_error": np.sqrt((distance**2).mean(axis=1)).mean(),
    }
    assert score(predicted, true, mask) == pytest.approx(expected[score.__name__], rel=1e-12)


@POINTS
def test_no_copy_of_the_whole_is_made(score: Score) -> None:
    true = np.zeros((50_000, 32, 2), np.float32)
    tracemalloc.start()
    try:
        score(true, true, np.arange(32) < 20)
        assert tracemalloc.get_traced_memory()[1] < true.nbytes / 4
    finally:
        tracemalloc.stop()


turns = st.floats(-np.pi, np.pi)
places = st.floats(-1, 1)


@POINTS
@given(turn=turns, x=places, y=places, seed=st.integers(0, 99))
def test_errors_do_not_depend_on_the_frame_nor_on_any_order(
    score: Score, turn: float, x: float, y: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    predicted, true = rng.normal(size=(2, 5, 32, 2))
    mask = rng.random(32) < 0.5
    mask[0] = True
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    queries, segments = rng.permutation(5), rng.permutation(32)

    def moved(dlo: Floats) -> Floats:
        there: Floats = (dlo @ rotation.T + (x, y))[queries][:, segments]
        return there

    expected = score(predicted, true, mask)
    assert score(moved(predicted), moved(true), mask[segments]) == pytest.approx(expected)
    assert euclidean(predicted, true, mask) <= shape_error(predicted, true, mask) * (1 + 1e-12)


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
    assert shape_error(predicted, true, mask) == shape_error(*case())


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


def windows() -> tuple[Floats, Floats, Mask]:
    """Returns starts and truths of three windows whose two segments move by (0, 0), (0, 2) and (0, 2.1) mm."""
    mask = np.arange(32) < 2
    start = np.full((3, 32, 2), np.nan, np.float32)
    start[:, mask] = 0
    true = start.copy()
    true[1, 1] = (0, np.nextafter(np.float32(0.002), np.float32(0)))  # the float32 next to 0.002 is larger
    true[2, 1] = (0.0021, 0)
    return start, true, mask


def test_a_window_moves_if_its_mean_displacement_is_more_than_a_millimetre() -> None:
    start, true, mask = windows()
    assert displacement(start, true, mask) == pytest.approx([0, 0.001, 0.00105])
    assert moving(start, true, mask).tolist() == [False, False, True]


def test_of_true_samples_the_mean_displacement_decides() -> None:
    start, true, mask = windows()
    assert moving(start, np.stack([true, true]), mask).tolist() == moving(start, true, mask).tolist()
    far = start + np.float32(1)
    assert moving(start, np.stack([start, far, start]), mask).all()
    near = start + np.float32(0.0014)  # by 2 mm
    assert not moving(start, np.stack([start, near, start]), mask).any()
    assert moving(start, np.stack([near, near, start]), mask).all()


def test_errors_where_windows_move_are_those_of_these_windows() -> None:
    start, true, mask = windows()
    predicted = true.copy()
    predicted[0] += 7  # in a window that does not move
    predicted[2] += 1
    assert where_moving(mse, predicted, true, start, mask) == pytest.approx(1, rel=1e-6)
    still = where_moving(euclidean, start, true, start, mask)
    assert still == pytest.approx(np.mean(displacement(start, true, mask)[moving(start, true, mask)]))


def test_where_no_window_moves_there_is_no_such_error() -> None:
    start, _, mask = windows()
    assert where_moving(mse, start + np.float32(1), start, start, mask) is None


def poses() -> tuple[Floats, Floats, Mask]:
    """Returns predicted and true poses of one query: one body is off by (3, 4) m and a tenth of a turn, one is not."""
    true = np.zeros((1, 3, 3), np.float32)
    true[0, 2] = np.nan
    predicted = true.copy()
    predicted[0, 0] = (3, 4, np.pi / 5)
    return predicted, true, np.array([True, True, False])


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 5])
def test_poses_have_an_error_of_position_and_one_of_angle(turns: int) -> None:
    predicted, true, mask = poses()
    predicted[..., 2] += np.float32(2 * np.pi * turns)
    assert pose_error(predicted, true, mask) == pytest.approx((2.5, np.pi / 10), abs=1e-5)


@given(a=st.floats(-20, 20), b=st.floats(-20, 20))
def test_angles_go_the_shorter_way_round(a: float, b: float) -> None:
    one, other = np.zeros((2, 1, 3, 3))
    one[..., 2], other[..., 2] = a, b
    error = pose_error(one, other, np.ones(3, bool))  # type: ignore[arg-type]
    assert error is not None and error.position == 0 and 0 <= error.angle <= np.pi
    assert np.cos(error.angle) == pytest.approx(np.cos(a - b))
    assert error == pytest.approx(pose_error(other, one, np.ones(3, bool)))  # type: ignore[arg-type]


def test_where_no_body_exists_there_is_no_pose_error() -> None:
    assert pose_error(*poses()[:2], np.zeros(3, bool)) is None


@POINTS
@pytest.mark.parametrize(
    ("predicted", "true", "mask"),
    [
        ((2, 32, 2), (3, 32, 2), np.ones(32, bool)),
        ((2, 32, 3), (2, 32, 3), np.ones(32, bool)),
        ((2, 31, 2), (2, 31, 2), np.ones(32, bool)),
        ((0, 32, 2), (0, 32, 2), np.ones(32, bool)),
        ((1, 2, 32, 2), (1, 2, 32, 2), np.ones(32, bool)),
        ((2, 32, 2), (2, 32, 2), np.zeros(32, bool)),
        ((2, 32, 2), (2, 32, 2), np.ones(31, bool)),
        ((2, 32, 2), (2, 32, 2), np.ones(32, int)),
    ],
    ids=str,
)
def test_what_cannot_be_scored_is_refused_in_a_sentence(
    score: Score, predicted: tuple[int, ...], true: tuple[int, ...], mask: Mask
) -> None:
    with pytest.raises(UsageError, match=r"^[^\n]*\(\d[^\n]*32[^\n]*$"):
        score(np.zeros(predicted, np.float32), np.zeros(true, np.float32), mask)


@pytest.mark.parametrize("shape", [(0, 3, 3), (1, 2, 3), (3, 3)])
def test_poses_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(UsageError, match=r"poses of \("):
        pose_error(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.ones(3, bool))
