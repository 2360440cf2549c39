"""Measures the world beside its peers: pushes per second, all sides in one run on the same pushes.

Run with `make bench-world`. Courses are whole trajectories of the shipped simulator, one domain a material and
attachment, three rigid objects in each. Every side begins at their starts and executes their pushes on one thread.
Building, placing and settling are not timed, but where a side says so. MuJoCo's rod and the ball joints know no
plasticity, so that their elastoplastic domains are elastic. Nothing is asserted about time: machines differ. Where
benchmarks are disabled, all sides run once on two pushes.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rates import Rate, Rates

from dlobench.domain import ATTACHMENTS, MATERIALS, Domain, sample
from dlobench.validation import balls, rods
from dlobench.validation.peers import Peer
from dlobench.world import actions, env, starts
from dlobench.world.simulate import PUSHES, Simulator, Streams, simulate

Array = NDArray[np.float64]
Push = Callable[[int], Any]  # executes the push of that number in all trajectories of a course

TRAJECTORIES = 2  # a domain
CROWD = 16  # trajectories a domain, to share between threads
CROWD_PUSHES = 10
SHIPPED = "shipped simulator"


@dataclass(frozen=True)
class Course:
    """Holds K trajectories of one domain to be repeated, to the last bit."""

    domain: Domain
    seeds: list[list[int]]  # as `simulate` takes them
    starts: list[starts.Start]
    commanded: Array  # (K, T, 2) m
    executed: Array  # (K, T, 2) m
    end: Array  # (K, 32, 3)  x m, y m, yaw rad of the segments after the last push

    @property
    def pushes(self) -> int:
        return len(self.executed) * len(self.executed[0])


def trajectory(domain: Domain, seed: list[int], pushes: int) -> tuple[starts.Start, Array, Array, Array] | None:
    """Simulates the first attempt at a trajectory: start, commanded, executed and end; None when it fails."""
    streams = Streams.of([*seed, 0])
    start = starts.sample(domain, streams.start)
    simulator = Simulator(domain, 1)
    state = simulator.reset([start])
    fixed = simulator.fixed_cylinders()
    commanded, executed = np.zeros((2, pushes, 2))
    for push in range(pushes):
        dlo = state.dlo[0, : domain.segments, :2]
        place = None if fixed is None else fixed[0]
        commanded[push] = actions.draw(streams.action, state.pusher[0], dlo, place)[0]
        executed[push] = commanded[push] + actions.noise(streams.noise)
        state = simulator.push(executed[None, push])
        if simulator.failed[0]:
            return None
    return start, commanded, executed, state.dlo[0]


def course(domain: Domain, trajectories: int, pushes: int) -> Course:
    """Simulates the first trajectories that do not fail."""
    candidates = ([number, 0] for number in itertools.count())
    possible = ((seed, *found) for seed in candidates if (found := trajectory(domain, seed, pushes)) is not None)
    seeds, begin, commanded, executed, end = zip(*itertools.islice(possible, trajectories), strict=True)
    return Course(domain, list(seeds), list(begin), np.stack(commanded), np.stack(executed), np.stack(end))


def domains(tiny: bool) -> list[Domain]:
    cells = [(material, attachment) for material in MATERIALS for attachment in ATTACHMENTS]
    return [
        sample(np.random.default_rng([2021, i]), material=material, attachment=attachment, length=0.16, rigid_objects=3)
        for i, (material, attachment) in enumerate(cells[-1:] if tiny else cells)
    ]


@pytest.fixture(scope="module")
def tiny(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("benchmark_disable")) and not request.config.getoption("benchmark_enable")


@pytest.fixture(scope="module")
def courses(tiny: bool) -> list[Course]:
    return [course(domain, 1 if tiny else TRAJECTORIES, 2 if tiny else PUSHES) for domain in domains(tiny)]


def shipped(course: Course, threads: int = 1) -> Push:
    simulator = Simulator(course.domain, len(course.starts), threads)
    simulator.reset(course.starts)
    return lambda push: simulator.push(course.executed[:, push])


def environment(course: Course) -> Push:
    """The commands, to which an environment adds the same noise again."""
    worlds = [env.make(course.domain, seed[:-1]) for seed in course.seeds]
    for world in worlds:
        world.reset()
    return lambda push: [world.step(course.commanded[i, push]) for i, world in enumerate(worlds)]


def peer(course: Course, make: Callable[[Domain, starts.Start], Peer]) -> Push:
    peers = [make(course.domain, start) for start in course.starts]
    return lambda push: [each.push(course.executed[i, push]) for i, each in enumerate(peers)]


@dataclass(frozen=True)
class Measured:
    """Holds what each course's last push gave, and the processor seconds of every round."""

    ends: list[Any]
    seconds: list[float]


def measure(benchmark: Any, prepare: Callable[[Course], Push], courses: Sequence[Course], rounds: int) -> Measured:
    """Times a side on all courses. Processor time is what other work on the machine changes least."""
    seconds: list[float] = []

    def setup() -> tuple[tuple[list[Push]], dict[str, Any]]:
        return ([prepare(course) for course in courses],), {}

    def play(pushing: list[Push]) -> list[Any]:
        numbers, before = range(len(courses[0].executed[0])), time.process_time()
        ends = [[push(number) for number in numbers][-1] for push in pushing]
        seconds.append(time.process_time() - before)
        return ends

    return Measured(benchmark.pedantic(play, setup=setup, rounds=rounds), seconds)


def report(benchmark: Any, rates: Rates, side: str, pushes: int, seconds: float, *, same: bool = True) -> None:
    """Adds what a reader asks for to the benchmark's record and to the table; `same`: on the pushes of all sides."""
    if benchmark.stats is None:  # benchmarks are disabled
        return
    rate = pushes / seconds
    times = rates[SHIPPED].pushes / rate if same and SHIPPED in rates else None
    rates[side] = Rate(rate, times)
    benchmark.extra_info |= {"pushes": pushes, "pushes_per_second": rate, "shipped_over_this": times}


def total(courses: Sequence[Course]) -> int:
    return sum(course.pushes for course in courses)


def test_shipped(benchmark: Any, rates: Rates, courses: list[Course]) -> None:
    measured = measure(benchmark, shipped, courses, rounds=3)
    report(benchmark, rates, SHIPPED, total(courses), statistics.median(measured.seconds))
    for course, end in zip(courses, measured.ends, strict=True):
        np.testing.assert_array_equal(end.dlo, course.end)


def test_environment(benchmark: Any, rates: Rates, courses: list[Course]) -> None:
    measured = measure(benchmark, environment, courses, rounds=2)
    report(benchmark, rates, "shipped scene, Environment.step", total(courses), statistics.median(measured.seconds))
    for course, end in zip(courses, measured.ends, strict=True):
        np.testing.assert_array_equal([step.observation["dlo"] for step in end], course.end)


PEERS: dict[str, Callable[[Domain, starts.Start], Peer]] = {
    "MuJoCo's flex rod, 2 ms": rods.make,
    "ball joints, 2 ms": balls.make,
    "ball joints, a sphere a segment, 2 ms": partial(balls.make, spheres=True),
}


@pytest.mark.parametrize("side", PEERS)
def test_peer(benchmark: Any, rates: Rates, courses: list[Course], side: str) -> None:
    measured = measure(benchmark, partial(peer, make=PEERS[side]), courses, rounds=1)
    report(benchmark, rates, side, total(courses), measured.seconds[0])
    assert all(np.isfinite(state.dlo).all() for end in measured.ends for state in end)


def test_generation(benchmark: Any, rates: Rates, courses: list[Course]) -> None:
    """Starts, settling, actions and noise included: the same trajectories again, and the same bits."""
    pushes, before = len(courses[0].executed[0]), time.process_time()
    made = benchmark.pedantic(lambda: [simulate(c.domain, c.seeds, pushes=pushes)[0] for c in courses], rounds=1)
    report(benchmark, rates, "simulate, all included", total(courses), time.process_time() - before)
    for course, again in zip(courses, made, strict=True):
        np.testing.assert_array_equal(again.dlo[:, -1], course.end.astype(np.float32))


@pytest.fixture(scope="module")
def crowds(tiny: bool) -> list[Course]:
    chosen = domains(tiny)[::4]  # the diagonal: every material and every attachment once
    return [course(domain, 2 if tiny else CROWD, 2 if tiny else CROWD_PUSHES) for domain in chosen]


@pytest.mark.parametrize("threads", [1, 2])
def test_threads(benchmark: Any, rates: Rates, crowds: list[Course], threads: int) -> None:
    """One thread against two, by the clock, on batches that are large enough to be shared."""
    measured = measure(benchmark, partial(shipped, threads=threads), crowds, rounds=3)
    for course, end in zip(crowds, measured.ends, strict=True):
        np.testing.assert_array_equal(end.dlo, course.end)
    if benchmark.stats is not None:
        clock, side = benchmark.stats.stats.median, f"shipped, batches of {CROWD}, threads by the clock: {threads}"
        report(benchmark, rates, side, total(crowds), clock, same=False)
