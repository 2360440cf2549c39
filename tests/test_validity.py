"""Tests whether shapes could be a DLO: spacing by hand, overlap beside that of the world's own poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_domain import make

from dlobench.bench.validity import APART, PIECE, overlapping, self_overlap, spacing_error
from dlobench.domain import DLO_RADIUS, SEGMENT_LENGTH
from dlobench.errors import UsageError
from dlobench.trajectories import Floats, Mask
from dlobench.world import chain, overlaps
from dlobench.world.simulate import PENETRATION

Array = NDArray[np.float64]


def straight(segments: int = 20) -> tuple[Floats, Mask]:
    """Returns a straight DLO along x, (1, 32, 2) m, with padding that is no number."""
    mask = np.arange(32) < segments
    dlo = np.full((1, 32, 2), np.nan, np.float32)
    dlo[0, mask, 0] = SEGMENT_LENGTH * np.arange(segments)
    dlo[0, mask, 1] = 0
    return dlo, mask


def test_a_straight_dlo_is_valid() -> None:
    dlo, mask = straight()
    assert spacing_error(dlo, mask) == pytest.approx(0, abs=1e-6)
    assert self_overlap(dlo, mask) == 0


@pytest.mark.parametrize("factor", [0.0, 0.9, 1.1, 3.0])
def test_the_spacing_error_is_relative(factor: float) -> None:
    dlo, mask = straight()
    assert spacing_error(factor * dlo, mask) == pytest.approx(abs(factor - 1), abs=1e-6)


def test_the_spacing_error_is_a_mean_over_neighbours_and_windows() -> None:
    dlo, mask = straight(3)
    dlo = np.concatenate([dlo, dlo])
    dlo[0, 2] = dlo[0, 1] + (0, 2 * SEGMENT_LENGTH)
    dlo[1, 0] = dlo[1, 1]
    assert spacing_error(dlo, mask) == pytest.approx((0 + 1 + 1 + 0) / 4, abs=1e-6)


def test_neighbours_are_those_of_the_world() -> None:
    assert APART == chain.APART


@pytest.mark.parametrize(("gap", "overlaps_"), [(2 * DLO_RADIUS - 1e-4, True), (2 * DLO_RADIUS + 1e-4, False)])
def test_segments_nearer_than_a_diameter_overlap(gap: float, overlaps_: bool) -> None:
    """The last segments run back over the first, far above; but one of them lies a gap from the third."""
    dlo, mask = straight()
    dlo[0, 14:20, 0] = SEGMENT_LENGTH * np.arange(4, -2, -1)
    dlo[0, 14:20, 1] = 0.02
    dlo[0, 16, 1] = gap
    assert overlapping(dlo, mask).tolist() == [overlaps_]


@pytest.mark.parametrize(("apart", "overlaps_"), [(APART, False), (APART + 1, True)])
def test_neighbours_never_overlap(apart: int, overlaps_: bool) -> None:
    dlo, mask = straight(20)
    dlo[0, :20] *= 10  # all far from each other
    dlo[0, 10 + apart] = dlo[0, 10] + (0, DLO_RADIUS)
    assert overlapping(dlo, mask).tolist() == [overlaps_]


def test_lines_that_cross_overlap_though_all_centres_are_apart() -> None:
    dlo, mask = straight(20)
    dlo[0, 10:20, 0] = SEGMENT_LENGTH * 4.5
    dlo[0, 10:20, 1] = SEGMENT_LENGTH * (np.arange(10) - 4.5)
    nearest = np.linalg.norm(dlo[0, :10, None] - dlo[0, None, 10:20], axis=-1).min()
    assert nearest > SEGMENT_LENGTH / 2
    assert overlapping(dlo, mask).all()


def test_segments_in_one_place_overlap_without_a_warning() -> None:
    assert self_overlap(np.zeros((2, 32, 2), np.float32), np.arange(32) < 20) == 1


def chains(rng: np.random.Generator, count: int) -> Array:
    """Draws chains of 32 segments that bend smoothly, some into themselves: (count, 32, 3) x m, y m, yaw rad."""
    bend = rng.normal(0, 0.25, (count, 1)) + rng.normal(0, 0.12, (count, 32))
    yaw = np.cumsum(bend, axis=1)
    along = SEGMENT_LENGTH * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    return np.concatenate([np.cumsum(along, axis=1) - along / 2, yaw[..., None]], axis=-1)


def test_overlap_is_that_of_the_world_without_its_yaw() -> None:
    dlo = chains(np.random.default_rng(0), 3 * PIECE)
    count = len(dlo)
    far, none = np.full((count, 2), 9.0), np.zeros((count, 0, 3))
    poses = overlaps.Poses(dlo, pusher=far, bodies=none, cylinder=None)
    depth = overlaps.depths(make(length=0.16, attachment="none", bodies=()), poses)["dlo-dlo"]
    found = overlapping(dlo[..., :2].astype(np.float32), np.ones(32, bool))
    assert 0.2 < found.mean() < 0.8
    assert found[depth > 5e-4].all()  # m, what the direction of segments may be wrong by
    assert (found == (depth > 0)).mean() > 0.99


def test_what_the_world_allows_is_no_overlap_by_a_millimetre() -> None:
    dlo, every = chains(np.random.default_rng(0), 2000), np.ones(32, bool)
    none, far = np.zeros((2000, 0, 3)), np.full((2000, 2), 9.0)
    poses = overlaps.Poses(dlo, pusher=far, bodies=none, cylinder=None)
    touching = overlaps.depths(make(length=0.16, attachment="none", bodies=()), poses)["dlo-dlo"] < PENETRATION / 2
    centres = dlo[..., :2].astype(np.float32)
    assert not overlapping(centres[touching], every, PENETRATION).any()
    shares = [self_overlap(centres, every, depth) for depth in (0, PENETRATION, 2 * PENETRATION, 2 * DLO_RADIUS)]
    assert sorted(set(shares), reverse=True) == shares and shares[-1] == 0


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), turn=st.floats(-np.pi, np.pi), x=st.floats(-0.1, 0.1))
def test_frame_and_order_do_not_matter(seed: int, turn: float, x: float) -> None:
    dlo = chains(np.random.default_rng(seed), 4)[..., :2]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    mask = np.ones(32, bool)
    moved = (dlo @ rotation.T + (x, -x))[::-1, ::-1]
    assert spacing_error(moved, mask) == pytest.approx(spacing_error(dlo, mask), rel=1e-9)  # type: ignore[arg-type]
    assert overlapping(moved, mask).tolist() == overlapping(dlo, mask)[::-1].tolist()  # type: ignore[arg-type]


@pytest.mark.parametrize("score", [spacing_error, self_overlap])
@pytest.mark.parametrize(
    ("shape", "segments"), [((0, 32, 2), 20), ((2, 32, 3), 20), ((32, 2), 20), ((2, 32, 2), 1), ((2, 32, 2), 0)]
)
def test_what_is_no_shape_is_refused_in_a_sentence(score: object, shape: tuple[int, ...], segments: int) -> None:
    assert callable(score)
    with pytest.raises(UsageError, match=r"^[^\n]+$"):
        score(np.zeros(shape, np.float32), np.arange(32) < segments)
