"""Tests the simulator: the same bits however it is run, failures that are redrawn, and a world that behaves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_domain import UNEQUAL, make

from dlobench.domain import BOX_SIZE, DLO_RADIUS, PUSHER_RADIUS, SEGMENT_LENGTH, WORKSPACE, Domain, RigidBody
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Trajectories
from dlobench.validation.shapes import check_materials
from dlobench.world import actions, env, overlaps, simulate, starts
from dlobench.world.chain import CYLINDER_RADIUS
from dlobench.world.physics import Physics
from dlobench.world.scene import REACH
from dlobench.world.simulate import PENETRATION, Account, Simulator, Streams
from dlobench.world.state import LASTING, State

Array = NDArray[np.float64]

BODIES = (UNEQUAL, RigidBody("bar3", (8000.0, 1200.0, 1200.0), 0.3), RigidBody("T4", (2000.0,) * 4, 0.5))
DOMAINS: dict[str, Domain] = {
    "none": make(material="flexible", surface_friction=0.3),
    "none-bodies": make(material="soft", bodies=BODIES),
    "movable": make(material="soft", attachment="movable"),
    "movable-bodies": make(material="elastoplastic", attachment="movable", bodies=BODIES),
    "fixed": make(material="elastoplastic", attachment="fixed"),
    "fixed-bodies": make(material="flexible", attachment="fixed", bodies=BODIES[:2], length=0.12),
}
SEEDS = [[5, trajectory] for trajectory in range(8)]
PUSHES = 20


@dataclass(frozen=True)
class Sample:
    """Holds what one thread simulated in one batch: the reference of the other runs."""

    domain: Domain
    made: Trajectories
    account: Account


@pytest.fixture(scope="module")
def samples() -> dict[str, Sample]:
    return {
        name: Sample(domain, *simulate.simulate(domain, SEEDS, threads=1, pushes=PUSHES))
        for name, domain in DOMAINS.items()
    }


def same(one: Trajectories, two: Trajectories) -> None:
    """Compares bits."""
    for field in fields(Trajectories):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name), err_msg=field.name)


def first(made: Trajectories, pushes: int, rows: Sequence[int]) -> Trajectories:
    """Returns the first pushes of some trajectories."""
    taken = made.take(np.array(rows))
    cut = {name: getattr(taken, name)[:, : pushes + 1] for name in ("dlo", "pusher", "bodies", "cylinder")}
    return replace(taken, commanded=taken.commanded[:, :pushes], executed=taken.executed[:, :pushes], **cut)


@pytest.mark.parametrize("name", DOMAINS)
def test_bits_depend_on_domain_and_seed_alone(name: str, samples: dict[str, Sample]) -> None:
    domain, made = samples[name].domain, samples[name].made
    two_threads, _ = simulate.simulate(domain, SEEDS[:3], threads=2, pushes=5)
    same(two_threads, first(made, 5, [0, 1, 2]))
    other_company, _ = simulate.simulate(domain, [SEEDS[3], [99], SEEDS[0]], threads=2, pushes=5)
    same(other_company.take(np.array([0, 2])), first(made, 5, [3, 0]))
    alone, _ = simulate.simulate(domain, [SEEDS[4]], pushes=5)
    same(alone, first(made, 5, [4]))


@pytest.mark.parametrize("name", DOMAINS)
def test_the_environment_gives_the_bits_of_the_batch(name: str, samples: dict[str, Sample]) -> None:
    domain, made = samples[name].domain, samples[name].made
    row = 1
    world = env.make(domain, seed=5)
    world.reset()
    stream = Streams.of([*SEEDS[row], 0]).action
    seen, commands = [world.reset().observation], []  # its second episode
    for _ in range(8):
        now = seen[-1]
        dlo, fixed = now["dlo"][: domain.segments, :2], world.physics.fixed_cylinder()
        command, _ = actions.draw(stream, now["pusher"], dlo, fixed)
        commands.append(command)
        seen.append(world.step(command).observation)
    expected = first(made, 8, [row])
    for field in ("dlo", "pusher", "bodies"):
        ours = np.stack([observation[field] for observation in seen]).astype(np.float32)
        np.testing.assert_array_equal(ours, getattr(expected, field)[0])
    np.testing.assert_array_equal(np.array(commands, np.float32), expected.commanded[0])
    executed = np.stack([observation["executed"] for observation in seen[1:]])
    np.testing.assert_array_equal(executed.astype(np.float32), expected.executed[0])


def test_seeds_differ(samples: dict[str, Sample]) -> None:
    for sample in samples.values():
        for field in ("dlo", "pusher", "commanded", "executed"):
            rows = getattr(sample.made, field)
            assert len({row.tobytes() for row in rows}) == len(SEEDS)


def test_what_is_recorded_has_its_shape(samples: dict[str, Sample]) -> None:
    K, T = len(SEEDS), PUSHES
    for sample in samples.values():
        domain, made, account = sample.domain, sample.made, sample.account
        shapes = {"dlo": (K, T + 1, 32, 3), "pusher": (K, T + 1, 2), "bodies": (K, T + 1, 3, 3)}
        shapes |= {"cylinder": (K, T + 1, 3), "commanded": (K, T, 2), "executed": (K, T, 2)}
        for name, shape in shapes.items():
            rows = getattr(made, name)
            assert rows.shape == shape and rows.dtype == np.float32 and np.isfinite(rows).all()
        assert made.dlo_mask.sum() == domain.segments and made.body_mask.sum() == len(domain.bodies)
        assert not made.dlo[:, :, ~made.dlo_mask].any() and not made.bodies[:, :, ~made.body_mask].any()
        links = np.linalg.norm(np.diff(made.dlo[:, :, made.dlo_mask, :2], axis=2), axis=-1)
        assert links.max() < 0.005 + 1e-6  # the chain does not stretch, nor fold into itself
        assert account.commands >= K * T and account.commands_redrawn > 0
        assert account.commands == K * T or account.trajectories_redrawn
        assert made.cylinder is not None and made.cylinder.any() == (domain.attachment != "none")


def poison(monkeypatch: pytest.MonkeyPatch, calls: set[int]) -> None:
    """Makes some of the sampled starts impossible to simulate."""
    sample, count = starts.sample, iter(range(10**6))

    def broken(domain: Domain, rng: np.random.Generator) -> starts.Start:
        start = sample(domain, rng)
        return replace(start, pusher=np.full(2, 1e12)) if next(count) in calls else start

    monkeypatch.setattr(starts, "sample", broken)


def fail(monkeypatch: pytest.MonkeyPatch, at: int, row: int) -> None:
    """Makes a simulation warn in a push, counted from 0 with the settling."""
    push, count = Simulator.push, iter(range(10**6))

    def warns(self: Simulator, displacement: Array) -> State:
        state = push(self, displacement)
        if next(count) == at:
            self.failed[row] = True
        return state

    monkeypatch.setattr(Simulator, "push", warns)


def test_a_failed_simulation_is_redrawn_and_counted(
    samples: dict[str, Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    domain, made = samples["movable-bodies"].domain, samples["movable-bodies"].made
    with monkeypatch.context() as patch:
        poison(patch, {1})  # the engine itself warns of it
        one, account = simulate.simulate(domain, SEEDS[:3], pushes=4)
    assert account.trajectories_redrawn == 1
    with monkeypatch.context() as patch:
        fail(patch, at=3, row=1)
        two, account = simulate.simulate(domain, SEEDS[:3], threads=2, pushes=4)
    assert account.trajectories_redrawn == 1
    same(one, two)  # what comes instead depends on the seed alone, not on how the first one failed
    same(one.take(np.array([0, 2])), first(made, 4, [0, 2]))
    assert not np.array_equal(one.dlo[1], made.dlo[1, :5]) and np.isfinite(one.dlo).all()
    again = Simulator(domain, 1).reset([starts.sample(domain, Streams.of([*SEEDS[1], 1]).start)])
    np.testing.assert_array_equal(again.dlo[0].astype(np.float32), one.dlo[1, 0])  # the second attempt


def test_failures_in_several_attempts_are_all_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    poison(monkeypatch, {0, 1, 2, 4})  # all three, then the second of three again
    made, account = simulate.simulate(DOMAINS["none"], SEEDS[:3], pushes=2)
    assert account.trajectories_redrawn == 4
    assert np.isfinite(made.dlo).all() and np.isfinite(made.pusher).all()


def test_what_always_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulate, "RETRIES", 3)
    poison(monkeypatch, set(range(1, 100)))
    with pytest.raises(RunError, match=r"^3 simulations in a row failed from seed \[5, 1\] in Domain\(.*flexible.*\)$"):
        simulate.simulate(DOMAINS["none"], SEEDS[:3], pushes=1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": []}, "number of seeds = 0 is outside 1, 2, 3, …"),
        ({"seeds": [[1, -2]]}, "seed = -2 is outside 0, 1, 2, …"),
        ({"seeds": [[1.5]]}, "seed = 1.5 is not a whole number within 0, 1, 2, …"),
        ({"seeds": ["7"]}, "seed = '7' is not a whole number within 0, 1, 2, …"),
        ({"pushes": 0}, "pushes = 0 is outside 1, 2, 3, …"),
        ({"pushes": 2.0}, "pushes = 2.0 is not a whole number within 1, 2, 3, …"),
        ({"threads": 0}, "threads = 0 is outside 1–1024"),
        ({"threads": None}, "threads = None is not a whole number within 1–1024"),
        ({"threads": 10**12}, "threads = 1000000000000 is outside 1–1024"),
        ({"seeds": 5}, "seeds = 5 is not a list of seeds"),
    ],
)
def test_what_cannot_be_simulated_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as caught:
        simulate.simulate(DOMAINS["none"], **{"seeds": [[1]], "pushes": 1, **changes})
    assert str(caught.value) == message


def test_sizes_that_do_not_fit_the_batch_are_refused() -> None:
    with pytest.raises(UsageError, match=r"^simulations = 0 is outside 1, 2, 3, …$"):
        Simulator(DOMAINS["none"], 0)
    rng = np.random.default_rng(0)
    simulator = Simulator(DOMAINS["none"], 2)
    begin = [starts.sample(DOMAINS["none"], rng) for _ in range(2)]
    with pytest.raises(UsageError, match=r"^1 starts do not fit a batch of 2 simulations$"):
        simulator.reset(begin[:1])
    shorter, crowded = (starts.sample(make(**change), rng) for change in ({"length": 0.1}, {"bodies": BODIES[:1]}))
    with pytest.raises(UsageError, match=r"^bends of a start has shape \(20,\), a domain of 32 segments .* \(32,\)$"):
        simulator.reset([begin[0], shorter])
    with pytest.raises(UsageError, match=r"^bodies of a start has shape \(1, 3\), a domain of .* 0 rigid bodies .*$"):
        simulator.reset([crowded, begin[0]])
    state = simulator.reset(begin)
    for wrong in (np.zeros(2), np.zeros((3, 2)), np.zeros((2, 3)), [[0.0, 0.0], [np.nan, 0.0]], [[0.0, 0.0]]):
        with pytest.raises(UsageError, match=r"^displacement .*, the batch needs .*: \(2, 2\)$"):
            simulator.push(np.asarray(wrong))
    np.testing.assert_allclose(simulator.push(np.zeros((2, 2))).dlo, state.dlo, atol=1e-4)  # nothing was disturbed


def test_executed_is_commanded_and_noise(samples: dict[str, Sample]) -> None:
    for sample in samples.values():
        difference = sample.made.executed.astype(float) - sample.made.commanded
        for row, seed in zip(difference, SEEDS, strict=True):
            streams = [Streams.of([*seed, attempt]).noise for attempt in range(1 + sample.account.trajectories_redrawn)]
            drawn = [[actions.noise(stream) for _ in range(PUSHES)] for stream in streams]
            assert any(np.allclose(row, noise, rtol=0, atol=5e-9) for noise in drawn)
        lengths = np.linalg.norm(sample.made.commanded, axis=-1)
        assert lengths.min() >= 0.012 - 1e-8 and lengths.max() <= 0.024 + 1e-8


def test_a_free_pusher_reaches_its_target() -> None:
    domain = make(length=0.10)
    S = 12
    begin = starts.Start(
        root=np.array([-0.05, -0.11, 0.0]), bends=np.zeros(20), bodies=np.zeros((0, 3)), pusher=np.array([0.0, 0.03])
    )
    simulator = Simulator(domain, S)
    state = simulator.reset([begin] * S)
    np.testing.assert_allclose(state.pusher, [begin.pusher] * S, atol=1e-9)
    angles = np.linspace(0, 2 * np.pi, S, endpoint=False)[:, None]
    displacement = np.linspace(0.012, 0.0255, S)[:, None] * np.hstack([np.cos(angles), np.sin(angles)])
    there = simulator.push(displacement)
    assert np.linalg.norm(there.pusher - begin.pusher - displacement, axis=1).max() < 2e-4
    back = simulator.push(-displacement)
    assert np.linalg.norm(back.pusher - begin.pusher, axis=1).max() < 2e-4
    still = simulator.push(np.zeros((S, 2)))
    assert np.linalg.norm(still.pusher - back.pusher, axis=1).max() < 2e-4
    np.testing.assert_allclose(back.dlo, state.dlo, atol=1e-6)  # nothing else moved
    assert not simulator.failed.any()


def test_a_push_moves_the_dlo_that_is_in_the_way() -> None:
    domain = make(length=0.10, material="flexible")
    begin = starts.Start(
        root=np.array([-0.05, 0.0, 0.0]), bends=np.zeros(20), bodies=np.zeros((0, 3)), pusher=np.array([0.0, -0.015])
    )
    simulator = Simulator(domain, 1)
    before = simulator.reset([begin]).dlo[0, 9, :2]
    after = simulator.push(np.array([[0.0, 0.02]]))
    # The pusher ends at y = 5 mm, so its rim and the DLO's radius put the middle of the DLO at 14.9 mm or beyond.
    assert after.dlo[0, 9, 1] > 0.0147 and abs(before[1]) < 1e-6
    assert after.dlo[0, 9, 1] < 0.0147 + 0.004


def poses(sample: Sample) -> Iterator[overlaps.Poses]:
    """Yields what was recorded, a trajectory at a time and without padding."""
    made = sample.made
    assert made.cylinder is not None
    for k in range(len(made)):
        yield overlaps.Poses(
            dlo=made.dlo[k][:, made.dlo_mask].astype(float),
            pusher=made.pusher[k].astype(float),
            bodies=made.bodies[k][:, made.body_mask].astype(float),
            cylinder=None if sample.domain.attachment == "none" else made.cylinder[k].astype(float),
        )


def test_nothing_recorded_is_pressed_into_anything(samples: dict[str, Sample]) -> None:
    for name, sample in samples.items():
        for recorded in poses(sample):
            deepest = {pair: depth.max() for pair, depth in overlaps.depths(sample.domain, recorded).items()}
            assert max(deepest.values()) < PENETRATION + 1e-6, (name, deepest)
            assert not overlaps.crossings(sample.domain, recorded).any(), name
        assert np.abs(sample.made.pusher).max() < REACH + 2e-4, name


def lying(**changes: Any) -> State:
    """Returns a state of `PLACED` in which all is apart: the DLO along x from its cylinder, a body above it."""
    dlo, bodies = np.zeros((1, 32, 3)), np.zeros((1, 3, 3))
    dlo[0, :20, 0] = -0.05 + SEGMENT_LENGTH * (np.arange(20) + 0.5)
    bodies[0, 0] = [0.0, 0.07, 0.0]
    cylinder = np.array([[-0.05 - CYLINDER_RADIUS, 0.0, 0.0]])
    return State(**{"dlo": dlo, "pusher": np.array([[0.0, -0.08]]), "bodies": bodies, "cylinder": cylinder, **changes})


PLACED = make(length=0.10, attachment="movable", bodies=(RigidBody("bar2", (2000.0,) * 2, 0.5),))


@pytest.mark.parametrize(("depth", "expected"), [(-0.001, False), (0.0009, False), (0.0011, True), (np.nan, True)])
def test_a_state_is_impossible_from_a_millimetre_on(depth: float, expected: bool) -> None:
    edge = WORKSPACE / 2 + depth - CYLINDER_RADIUS
    for change in (
        {"pusher": np.array([[0.0, depth - DLO_RADIUS - PUSHER_RADIUS]])},  # pressed into the DLO
        {"bodies": np.array([[[0.0, WORKSPACE / 2 + depth - BOX_SIZE / 2, 0.0], [0.0] * 3, [0.0] * 3]])},  # a wall
        {"cylinder": np.array([[edge, 0.1, 0.0]])},
    ):
        assert simulate.impossible(PLACED, lying(**change)).tolist() == [expected]


@pytest.mark.parametrize(("bent", "pressed"), [([0.4] * 15, True), ([2.6] * 2, False)])
def test_a_dlo_that_crosses_itself_is_impossible(bent: list[float], pressed: bool) -> None:
    """That goes for neighbours too, which the engine never tests for contact and which no depth tells of."""
    angles = np.cumsum([*[0.0] * (20 - len(bent)), *bent])
    steps = SEGMENT_LENGTH * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    crossing = lying()
    assert not simulate.impossible(PLACED, crossing).any()
    crossing.dlo[0, :20] = np.column_stack([np.cumsum(steps, axis=0) - steps / 2 - [0.05, 0.0], angles])
    recorded = overlaps.Poses(crossing.dlo[:, :20], crossing.pusher, crossing.bodies[:, :1], crossing.cylinder)
    assert (overlaps.depths(PLACED, recorded)["dlo-dlo"] > PENETRATION) == pressed
    assert simulate.impossible(PLACED, crossing).all()


def test_what_was_impossible_once_has_failed_until_the_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    begin = starts.sample(PLACED, np.random.default_rng(0))
    crossing = replace(
        begin, root=np.zeros(3), bends=np.array([0.0] * 4 + [0.45] * 16), bodies=np.array([[0.0, 0.1, 0.0]])
    )
    simulator = Simulator(PLACED, 2)
    simulator.reset([begin, crossing])
    assert simulator.failed.tolist() == [False, True]
    with monkeypatch.context() as patch:
        patch.setattr(simulate, "impossible", lambda domain, state: np.zeros(2, dtype=bool))
        simulator.push(np.zeros((2, 2)))
        assert simulator.failed.tolist() == [False, True]
    simulator.reset([begin, begin])
    assert not simulator.failed.any()


@pytest.mark.parametrize("name", ["none-bodies", "movable-bodies", "fixed-bodies"])
def test_what_lasts_is_the_whole_state(name: str) -> None:
    """A world with the same positions and plastic bends, and nothing else in common, goes the same way."""
    domain = DOMAINS[name]
    rng = np.random.default_rng(3)
    one, two = Physics(domain), Physics(domain)
    with one.reset_context():
        one.start(starts.sample(domain, rng))
    for _ in range(6):
        state = one.state()
        command, _ = actions.draw(rng, state.pusher[0], state.dlo[0, : domain.segments, :2], one.fixed_cylinder())
        two.data.qvel[:], two.data.act[:], two.data.qacc_warmstart[:] = 0.3, 0.1, 5.0  # of another past
        for field in LASTING:
            getattr(two.data, field)[:] = getattr(one.data, field)
        for physics in (one, two):
            physics.step(physics.plan(command))
        np.testing.assert_array_equal(one.data.qpos, two.data.qpos)
        np.testing.assert_array_equal(one.data.plastic, two.data.plastic)


def test_pushes_move_the_dlo_and_the_bodies(samples: dict[str, Sample]) -> None:
    moved = []
    for sample in samples.values():
        steps = np.diff(sample.made.dlo[:, :, sample.made.dlo_mask, :2], axis=1)
        moved.append(np.linalg.norm(steps, axis=-1).mean(axis=-1).ravel() > 1e-3)
    assert np.mean(np.concatenate(moved)) > 1 / 3
    bodies = [np.abs(np.diff(s.made.bodies[:, :, s.made.body_mask], axis=1)).max(axis=-1) for s in samples.values()]
    assert max(b.max(initial=0) for b in bodies) > 5e-3


def test_a_fixed_cylinder_holds_its_end_and_a_movable_one_follows(samples: dict[str, Sample]) -> None:
    for name, sample in samples.items():
        if sample.domain.attachment == "none" or sample.made.cylinder is None:
            continue
        first, cylinder = sample.made.dlo[:, :, 0].astype(float), sample.made.cylinder.astype(float)
        end = first[..., :2] - SEGMENT_LENGTH / 2 * towards(first)
        np.testing.assert_allclose(end, cylinder[..., :2] + CYLINDER_RADIUS * towards(cylinder), atol=1e-6)
        drift = np.linalg.norm(end - end[:, :1], axis=-1).max()
        assert drift < 1e-6 if name.startswith("fixed") else drift > 5e-3, name


def towards(pose: Array) -> Array:
    """Returns the directions (…, 2) that poses (…, 3) look in."""
    return np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], axis=-1)


def test_materials_end_in_different_shapes() -> None:
    rows = list(check_materials("quick"))
    assert rows and all(row.passed for row in rows), [row for row in rows if not row.passed]
