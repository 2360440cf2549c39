"""Tests pushes: feasible whatever the noise, biased towards the DLO, redrawn rather than clamped."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dlobench.domain import PUSHER_RADIUS
from dlobench.errors import RunError
from dlobench.world import actions
from dlobench.world.chain import CYLINDER_RADIUS
from dlobench.world.scene import REACH

Array = NDArray[np.float64]

TOUCH = PUSHER_RADIUS + CYLINDER_RADIUS
WORST = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)]) * actions.NOISE_LIMIT


def draws(count: int, pusher: Array, dlo: Array, fixed: Array | None = None) -> tuple[Array, int]:
    """Returns commands (count, 2) and how many were redrawn."""
    rng = np.random.default_rng(0)
    commands, redrawn = zip(*(actions.draw(rng, pusher, dlo, fixed) for _ in range(count)), strict=True)
    return np.array(commands), sum(redrawn)


def nearest(pusher: Array, displacement: Array, point: Array) -> float:
    """Returns the least distance of the pusher's way to a point, by trying many places on the way."""
    way = pusher + np.linspace(0, 1, 60)[:, None] * displacement
    return float(np.linalg.norm(way - point, axis=1).min())


def place(limit: float) -> st.SearchStrategy[Array]:
    return st.tuples(st.floats(-limit, limit), st.floats(-limit, limit)).map(np.array)


@settings(deadline=None)
@given(pusher=place(REACH), closest=place(0.11), fixed=st.none() | place(0.11), seed=st.integers(0, 2**32 - 1))
def test_commands_are_feasible_whatever_the_noise(
    pusher: Array, closest: Array, fixed: Array | None, seed: int
) -> None:
    dlo = closest + np.arange(5)[:, None] * np.array([0.005, 0.0])
    if fixed is not None and np.linalg.norm(fixed - pusher) < TOUCH:
        return  # the pusher cannot be inside the cylinder
    rng = np.random.default_rng(seed)
    for _ in range(3):
        command, redrawn = actions.draw(rng, pusher, dlo, fixed)
        assert 0.012 <= np.linalg.norm(command) <= 0.024
        assert redrawn >= 0
        for noise in WORST:
            assert np.abs(pusher + command + noise).max() <= REACH + 1e-12
            # A pusher that touches the cylinder may be led a tenth of a millimetre into it as it leaves sideways.
            assert fixed is None or nearest(pusher, command + noise, fixed) > TOUCH - 1.3e-4


def test_pushes_have_every_length() -> None:
    commands, redrawn = draws(4000, np.zeros(2), np.array([[0.02, 0.0]]))
    lengths = np.linalg.norm(commands, axis=1)
    np.testing.assert_allclose(np.quantile(lengths, [0.25, 0.5, 0.75]), [0.015, 0.018, 0.021], atol=5e-4)
    assert lengths.min() < 0.0121 and lengths.max() > 0.0239 and redrawn == 0


@pytest.mark.parametrize("bearing", [0.0, 1.0, np.pi, -2.0])
def test_pushes_are_biased_towards_the_closest_segment(bearing: float) -> None:
    pusher, towards = np.array([0.01, -0.02]), np.array([np.cos(bearing), np.sin(bearing)])
    far = pusher - towards * np.linspace(0.05, 0.08, 10)[:, None]  # all others lie the other way
    commands, _ = draws(3000, pusher, np.concatenate([far, [pusher + 0.03 * towards]]))
    turned = commands @ np.array([[towards[0], -towards[1]], [towards[1], towards[0]]])
    angle = np.arctan2(turned[:, 1], turned[:, 0])
    # 80 % are within three standard deviations of 0.5 rad, the others anywhere.
    assert np.mean(np.abs(angle) < 0.5) == pytest.approx(0.8 * 0.683 + 0.2 / (2 * np.pi), abs=0.04)
    assert np.mean(np.abs(angle) > 1.5) == pytest.approx(0.2 * (1 - 1.5 / np.pi), abs=0.03)
    assert abs(np.mean(np.sign(angle))) < 0.06


def test_infeasible_pushes_are_redrawn_and_never_clamped() -> None:
    pusher = np.array([REACH - 0.008, 0.0])
    commands, redrawn = draws(3000, pusher, np.array([[0.12, 0.0]]))  # the DLO lies by the wall
    assert redrawn > 3000
    lengths = np.linalg.norm(commands, axis=1)
    assert lengths.min() < 0.0121 and lengths.max() > 0.0239
    assert (np.histogram(lengths, bins=6, range=actions.DISTANCE)[0] > 0.05 * len(lengths)).all()
    slack = REACH - actions.NOISE_LIMIT - (pusher + commands)[:, 0]
    assert slack.min() >= 0 and np.mean(slack < 1e-6) < 0.01  # none is put on the border
    angle = np.abs(np.arctan2(commands[:, 1], commands[:, 0]))
    assert np.histogram(angle, bins=4, range=(np.pi / 2, np.pi))[0].min() > 0  # away from the wall: all directions


def test_kept_commands_are_the_feasible_ones_of_a_free_draw() -> None:
    pusher, dlo = np.array([REACH - 0.01, 0.0]), np.array([[0.12, 0.02]])
    kept, redrawn = draws(2000, pusher, dlo)
    free, _ = draws(2000 + redrawn, np.zeros(2), dlo - pusher)  # the same stream where nothing is in the way
    feasible = (pusher + free)[:, 0] <= REACH - actions.NOISE_LIMIT
    np.testing.assert_allclose(free[feasible], kept, atol=1e-12)


def test_a_fixed_cylinder_is_gone_round() -> None:
    pusher, fixed = np.array([-0.022, 0.0]), np.zeros(2)
    commands, redrawn = draws(1500, pusher, np.array([[0.0, 0.0]]), fixed)
    assert redrawn > 1000
    assert min(nearest(pusher, command, fixed) for command in commands) > TOUCH + actions.NOISE_LIMIT - 1e-5
    free, _ = draws(1500, pusher, np.array([[0.0, 0.0]]))
    assert np.mean([nearest(pusher, command, fixed) < TOUCH for command in free]) > 0.5


def test_a_pusher_beside_the_cylinder_can_leave() -> None:
    pusher = np.array([-TOUCH - 1e-4, 0.0])
    assert actions.feasible(pusher, np.array([-0.02, 0.0]), np.zeros(2))
    assert not actions.feasible(pusher, np.array([0.02, 0.0]), np.zeros(2))
    assert not actions.feasible(pusher, np.array([0.012, 0.012]), np.zeros(2))


def test_a_pusher_with_no_way_out_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actions, "ATTEMPTS", 40)
    with pytest.raises(RunError, match=r"no feasible push in 40 draws with the pusher at \[1\. 1\.\]"):
        actions.draw(np.random.default_rng(0), np.ones(2), np.zeros((3, 2)), None)


def test_noise_is_gaussian_and_bounded() -> None:
    rng = np.random.default_rng(0)
    drawn = np.array([actions.noise(rng) for _ in range(6000)])
    assert actions.NOISE == 5e-4 and actions.NOISE_LIMIT == 1.5e-3
    assert np.linalg.norm(drawn, axis=1).max() <= actions.NOISE_LIMIT
    # Cut at three standard deviations, a Gaussian in the plane keeps 97 % of its standard deviation.
    np.testing.assert_allclose(drawn.std(axis=0), 0.974 * actions.NOISE, rtol=0.03)
    np.testing.assert_allclose(drawn.mean(axis=0), 0, atol=4 * actions.NOISE / 6000**0.5)
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.05
    assert np.mean(np.linalg.norm(drawn, axis=1) > 2 * actions.NOISE) == pytest.approx(0.126, abs=0.02)
