"""Tests the intervals where the truth is known: crossed effects of domains and seeds, and what has no interval."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dlobench.bench.statistics import FEW, Interval, counts, generator, interval, intervals, resampled, spread
from dlobench.errors import UsageError


def names(kind: str, count: int) -> tuple[str, ...]:
    return tuple(f"{kind}{i}" for i in range(count))


def crossed(rng: np.random.Generator, S: int, D: int, *, seed: float, domain: float, rest: float) -> np.ndarray:
    """Draws scores about 1 with effects of seeds and of domains of these standard deviations."""
    return 1 + seed * rng.normal(size=(S, 1)) + domain * rng.normal(size=(1, D)) + rest * rng.normal(size=(S, D))


@pytest.mark.parametrize(
    ("S", "D", "seed", "domain"), [(3, 18, 0.1, 0.3), (3, 18, 0.3, 0.1), (6, 18, 0.2, 0.3), (8, 40, 0.1, 0.4)]
)
def test_intervals_hold_the_truth_as_often_as_they_say(S: int, D: int, seed: float, domain: float) -> None:
    rng, trials = np.random.default_rng(S * 100 + D), 300
    held = 0
    for _ in range(trials):
        values = crossed(rng, S, D, seed=seed, domain=domain, rest=0.1)
        found = interval(values, np.ones_like(values), names("s", S), names("d", D))
        assert found.low is not None and found.high is not None
        held += found.low <= 1 <= found.high
    assert 0.91 <= held / trials <= 0.99  # three standard errors of 95 %, about


def test_few_domains_and_many_seeds_are_not_taken_for_many_domains() -> None:
    """Seeds add nothing about other domains: the interval stays as wide as the domains make it."""
    rng = np.random.default_rng(0)
    values = crossed(rng, 1, 6, seed=0, domain=0.5, rest=0)
    many = np.repeat(values, 40, axis=0)
    one = interval(values, np.ones_like(values), names("s", 1), names("d", 6))
    all_ = interval(many, np.ones_like(many), names("s", 40), names("d", 6))
    assert one.low is not None and one.high is not None and all_.low is not None and all_.high is not None
    assert all_.high - all_.low > 0.7 * (one.high - one.low)


def test_one_seed_is_a_students_interval_over_domains() -> None:
    values = np.array([[1.0, 2.0, 3.0, 6.0]])
    error, freedom = spread(values, np.ones_like(values))
    assert error == pytest.approx(values.std(ddof=1) / 2)
    assert freedom == 3
    found = interval(values, np.ones_like(values), ("0",), names("d", 4))
    assert found.estimate == 3
    assert found.high == pytest.approx(3 + 3.182446 * error, rel=1e-5)  # Student's quantile at 3 degrees of freedom
    assert (found.domains, found.seeds) == (4, 1)


def test_the_squared_error_is_the_variance_of_a_crossed_mean() -> None:
    rng = np.random.default_rng(3)
    draws = [crossed(rng, 4, 10, seed=0.5, domain=1, rest=1) for _ in range(3000)]
    found = np.mean([spread(values, np.ones_like(values))[0] ** 2 for values in draws])
    assert found == pytest.approx(0.5**2 / 4 + 1 / 10 + 1 / 40, rel=0.05)


def test_skill_with_hard_domains_is_held_somewhat_less_often() -> None:
    rng, held = np.random.default_rng(5), 0
    for _ in range(300):
        still = np.broadcast_to(np.exp(rng.normal(size=48)), (5, 48))
        values = still * crossed(rng, 5, 48, seed=0.05, domain=0.1, rest=0.05)
        found = interval(values, still, names("s", 5), names("d", 48))
        assert found.low is not None and found.high is not None
        held += found.low <= 1 <= found.high
    assert 0.89 <= held / 300 <= 0.985


def test_one_domain_has_no_interval() -> None:
    found = interval(np.ones((3, 1)), np.ones((3, 1)), names("s", 3), ("d",))
    assert (found.estimate, found.low, found.high, found.tie) == (1, None, None, None)


def test_a_ratio_is_of_sums() -> None:
    values, weights = np.array([[1.0, 9.0]]), np.array([[2.0, 10.0]])
    assert interval(values, weights, ("0",), ("a", "b")).estimate == pytest.approx(10 / 12)
    assert resampled(values, weights, ("0",), ("a", "b")).min() == pytest.approx(0.5)


@pytest.mark.parametrize("S", [2, FEW, 9])
def test_no_spread_is_no_width(S: int) -> None:
    found = interval(np.full((S, 5), 2.0), np.ones((S, 5)), names("s", S), names("d", 5))
    assert (found.low, found.high) == (2, 2)


@given(
    S=st.integers(1, 7), D=st.integers(2, 12), seed=st.integers(0, 99), shift=st.floats(-5, 5), scale=st.floats(0.1, 10)
)
@settings(max_examples=30, deadline=None)
def test_intervals_move_and_stretch_with_the_scores(S: int, D: int, seed: int, shift: float, scale: float) -> None:
    values = crossed(np.random.default_rng(seed), S, D, seed=0.2, domain=0.3, rest=0.1)
    ones = np.ones_like(values)
    one, other = (interval(v, ones, names("s", S), names("d", D)) for v in (values, shift + scale * values))
    assert one.low is not None and one.high is not None and other.low is not None and other.high is not None
    assert one.low <= one.estimate <= one.high
    for before, after in ((one.low, other.low), (one.estimate, other.estimate), (one.high, other.high)):
        assert after == pytest.approx(shift + scale * before, abs=1e-9)


def test_draws_depend_on_names_alone_and_cannot_be_spoiled() -> None:
    assert generator("a", 1).random() == generator("a", 1).random() != generator("a", 2).random()
    drawn = counts("domains", names("d", 7))
    assert (drawn.sum(axis=1) == 7).all()
    with pytest.raises(ValueError, match="read-only"):
        drawn[0, 0] = 3


def test_ties_are_intervals_that_hold_zero() -> None:
    assert Interval(0.1, -0.1, 0.3, 5, 1).tie is True
    assert Interval(0.2, 0.1, 0.3, 5, 1).tie is False


@pytest.mark.parametrize(
    ("values", "weights"),
    [
        (np.ones((2, 2)), np.ones((2, 3))),
        (np.full((2, 3), np.nan), np.ones((2, 3))),
        (np.ones((2, 3)), np.zeros((2, 3))),
    ],
)
def test_what_has_no_interval_is_refused(values: np.ndarray, weights: np.ndarray) -> None:
    with pytest.raises(UsageError):
        interval(values, weights, ("0", "1"), ("a", "b", "c"))


@given(S=st.integers(1, 7), D=st.integers(1, 9), seed=st.integers(0, 99), alike=st.booleans())
@settings(max_examples=25, deadline=None)
def test_many_at_once_are_each_alone(S: int, D: int, seed: int, alike: bool) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(4, S, D))
    weights = np.broadcast_to(rng.uniform(1, 2, size=D), values.shape) if alike else rng.uniform(1, 2, size=(4, S, D))
    values[1] = 2 * weights[1]  # no spread
    together = intervals(values, weights, names("s", S), names("d", D))
    for one, each, weight in zip(together, values, weights, strict=True):
        alone = interval(each, weight, names("s", S), names("d", D))
        for field in ("estimate", "low", "high"):
            assert getattr(one, field) == pytest.approx(getattr(alone, field), abs=1e-12)
        assert (one.domains, one.seeds) == (D, S)
        drawn = [(each * w).sum() / (weight * w).sum() for w in outer_counts(S, D)]
        assert resampled(each, weight, names("s", S), names("d", D))[: len(drawn)] == pytest.approx(drawn)


def outer_counts(S: int, D: int) -> list[np.ndarray]:
    """Returns how often each pair of a seed and a domain is drawn, of the first resamplings."""
    of_seeds, of_domains = counts("seeds", names("s", S)), counts("domains", names("d", D))
    return [np.outer(of_seeds[r], of_domains[r]) for r in range(5)]
