"""Tests the validation: what a row says, how the command ends, and that every check fails when the world is wrong."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from test_cli import Call, call, check_failed
from test_domain import UNEQUAL, make

from dlobench.domain import GRAVITY, MATERIALS, Domain
from dlobench.validation import energy, sameness, shapes, suite, survey
from dlobench.validation.check import EFFORTS, Effort, Row, at_most, relative
from dlobench.validation.probe import Edit, Probe, Trace, walk
from dlobench.validation.pushes import rest_rows, sanity_rows, step_rows
from dlobench.validation.survey import Compared, Found, Piece
from dlobench.world import scene, starts
from dlobench.world.simulate import simulate
from dlobench.world.state import State

Array = NDArray[np.float64]
__all__ = ["call"]


def verdicts(rows: Iterator[Row]) -> dict[str, bool | None]:
    return {row.name: row.passed for row in rows}


@pytest.mark.parametrize(("error", "passed"), [(0.9, True), (1.0, True), (1.1, False), (math.nan, False)])
def test_a_row_passes_within_its_bound(error: float, passed: bool) -> None:
    assert at_most("x", error, 1.0).passed is passed
    assert at_most("x", error, None).passed is None


def test_what_is_no_number_never_passes() -> None:
    assert Row("x", math.nan, 1.0, 0.0, 1.0).passed is False
    assert Row("x", math.inf, 1.0, 0.0, 1.0).passed is False
    assert Row("x", 1.0, 1.0, math.inf, math.inf).passed is False


def test_a_relative_row_counts_in_percent_of_the_reference() -> None:
    row = relative("x", -1.9, -2.0, 5.1)
    assert row.error == pytest.approx(5.0) and row.error_unit == "%" and row.passed
    assert not relative("x", 2.0, -2.0, 5.1).passed


def good(effort: Effort) -> Iterator[Row]:
    yield at_most(f"good, {effort}", 0.5, 1.0, "mm", "a note")
    yield at_most("only to be read", 7.0, None)


def bad(effort: Effort) -> Iterator[Row]:
    yield relative("bad", math.nan, 2.0, 1.0)
    yield at_most("worse", 3.0, 1.0)


def broken(effort: Effort) -> Iterator[Row]:
    yield at_most("before", 0.0, 1.0)
    raise ValueError("no such thing")


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "CHECKS", {"good": good, "bad": bad, "broken": broken})


@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize(
    ("flags", "effort"), [((), "normal"), (("--quick",), "quick"), (("--full",), "full")], ids=EFFORTS
)
def test_a_world_that_keeps_its_bounds_ends_with_0(call: Call, flags: tuple[str, ...], effort: str) -> None:
    done = call("validate", "--only", "good", *flags)
    assert done.code == 0
    header, first, second = (line.split() for line in done.out.splitlines())
    assert header == ["name", "measured", "reference", "error", "bound", "pass", "note"]
    assert first == ["good,", effort, "0.5", "mm", "0", "mm", "0.5", "mm", "1", "mm", "yes", "a", "note"]
    assert "yes" not in second and "NO" not in second
    assert "good: 1 of 1 bounds kept" in done.err


@pytest.mark.usefixtures("toys")
def test_a_world_that_breaks_a_bound_ends_with_1_and_names_it(call: Call) -> None:
    done = call("validate")
    check_failed(done, 1, "3 of 5 bounds are not kept: bad; worse; broken ends")
    assert "ValueError: no such thing" in done.out and "before" in done.out
    assert done.out.count(" NO ") == 3


@pytest.mark.usefixtures("toys")
def test_json_holds_every_field_of_every_row(call: Call) -> None:
    done = call("validate", "--json", "--only", "bad", "--only", "good")
    rows = {row["name"]: row for row in json.loads(done.out)}
    assert done.code == 1 and list(rows) == ["good, normal", "only to be read", "bad", "worse"]
    assert rows["good, normal"] == {
        "check": "good", "name": "good, normal", "measured": 0.5, "reference": 0.0, "error": 0.5, "bound": 1.0,
        "unit": "mm", "error_unit": "mm", "note": "a note", "pass": True,
    }  # fmt: skip
    assert rows["only to be read"]["pass"] is None and rows["only to be read"]["bound"] is None
    assert rows["bad"]["measured"] is None and rows["bad"]["error"] is None and rows["bad"]["pass"] is False


@pytest.mark.usefixtures("toys")
def test_bad_usage_of_validate_is_one_sentence(call: Call) -> None:
    check_failed(call("validate", "--only", "nothing"), 2, "'nothing'", "good, bad, broken")
    check_failed(call("validate", "--quick", "--full"), 2, "--quick and --full")


# What follows breaks the world, or what was found of it, and sees the check fail.


def found(**changes: object) -> Found:
    """Returns what a faultless world would leave behind."""
    still, moved = np.zeros(200), np.full(100, 0.008)
    perfect = Found(
        domain=make(),
        depth={"dlo-dlo": still, "dlo-wall": still},
        crossings=still,
        outside=np.zeros(200, dtype=bool),
        speed={"DLO": still, "bodies and cylinder": still, "pusher": still},
        recorded=np.ones(200, dtype=bool),
        warned=np.zeros(10, dtype=bool),
        failed=np.zeros(10, dtype=bool),
        commands=200,
        redrawn=50,
        compared=Compared(motion=moved, step=moved / 100, restart=moved / 100),
    )
    return replace(perfect, **changes)  # type: ignore[arg-type]


def one(value: float, rest: float = 0.0) -> Array:
    return np.array([value, *[rest] * 199])


def test_a_faultless_world_passes() -> None:
    for rows in (step_rows, sanity_rows, rest_rows):
        assert False not in verdicts(rows([found()])).values()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("states that are no number", {"depth": {"dlo-dlo": one(math.nan)}}),
        ("trajectories with an engine warning", {"warned": np.arange(10) == 3}),
        ("states with something beyond a wall", {"outside": np.arange(200) == 3}),
        ("states in which the DLO crosses itself", {"crossings": one(2.0)}),
        ("penetration, 99.9 % of states", {"depth": {"dlo-dlo": one(0.0), "dlo-wall": one(0.006)}}),
    ],
)
def test_one_impossible_state_fails(name: str, change: dict[str, object]) -> None:
    rows = verdicts(sanity_rows([found(**change)]))
    assert rows[name] is False


def test_states_of_redrawn_trajectories_are_printed_and_not_judged() -> None:
    deep = found(depth={"dlo-dlo": one(0.006)}, outside=np.arange(200) == 0, recorded=np.arange(200) > 0)
    rows = verdicts(sanity_rows([deep]))
    assert rows["penetration, 99.9 % of states"] is True and rows["states with something beyond a wall"] is True
    assert rows["penetration, redrawn trajectories included"] is None


@pytest.mark.parametrize("part", ["DLO", "bodies and cylinder", "pusher"])
@pytest.mark.parametrize("speed", [0.0011, math.nan])
def test_a_push_that_ends_in_motion_fails(part: str, speed: float) -> None:
    speeds = {**found().speed, part: one(speed)}
    assert verdicts(rest_rows([found(speed=speeds)]))["pushes that end faster than 1 mm/s, all"] is False


def test_a_coarse_step_fails_and_so_does_a_frozen_world() -> None:
    moved = np.full(100, 0.008)
    coarse = found(compared=Compared(motion=moved, step=np.full(100, 0.00031), restart=moved))
    assert set(verdicts(step_rows([coarse])).values()) == {False}
    frozen = found(compared=Compared(*np.zeros((3, 0))))
    assert set(verdicts(step_rows([frozen])).values()) == {False}
    elsewhere = replace(coarse, domain=make(material="soft", attachment="fixed"))
    rows = verdicts(step_rows([found(), found(), found(), elsewhere]))
    assert rows["step-size error a push, soft"] is False and rows["step-size error a push, flexible"] is True


DOMAIN = make(attachment="fixed", length=0.12, bodies=(UNEQUAL,))


def straight(domain: Domain) -> starts.Start:
    """Places a straight DLO, a body and the pusher apart."""
    begin = starts.Start(
        root=np.array([-0.05, -0.05, 0.0]),
        bends=np.zeros(domain.segments),
        bodies=np.array([[0.05, 0.06, 0.3]])[: len(domain.bodies)],
        pusher=np.array([-0.08, 0.08]),
    )
    assert starts.possible(domain, begin)
    return begin


def test_the_survey_walks_the_shipped_trajectories() -> None:
    probe, seeds = Probe(DOMAIN, 2), [[5], [6]]
    pushes = list(walk(probe, [[*seed, 0] for seed in seeds], 4))
    made, account = simulate(DOMAIN, seeds, pushes=4)
    assert account.trajectories_redrawn == 0
    dlo = np.stack([push.poses.dlo for push in pushes], axis=1)
    np.testing.assert_array_equal(dlo.astype(np.float32), made.dlo[:, :, : DOMAIN.segments])
    assert sum(push.commands for push in pushes) == account.commands
    assert sum(push.redrawn for push in pushes) == account.commands_redrawn


def test_the_survey_sees_smaller_errors_at_smaller_steps() -> None:
    over = [make(), make(material="soft", attachment="movable")]
    coarse, fine = (
        survey.gather(over, 6, 4, timestep=step, workers=1) for step in (2 * scene.TIMESTEP, scene.TIMESTEP / 2)
    )
    errors = [np.concatenate([f.compared.step for f in part]).mean() for part in (coarse, fine)]
    assert errors[0] > 1.5 * errors[1] > 0
    assert all((f.compared.motion > survey.MOVED).all() and len(f.speed["DLO"]) == 24 for f in coarse)


def test_settings_can_be_tried() -> None:
    def slippery(model: mujoco.MjModel) -> None:
        model.geom_friction[:, 0] = 0

    shipped, tried = (survey.gather([make()], 2, 3, edit=edit, workers=1) for edit in (None, slippery))
    assert tried[0].speed["DLO"].max() > 2 * shipped[0].speed["DLO"].max()


def test_speeds_are_those_of_the_fastest_points() -> None:
    probe = Probe(DOMAIN, 2)
    probe.reset([straight(DOMAIN)] * 2)
    qvel = probe._batch.bind("qvel")
    qvel[:] = 0
    qvel[1, probe.layout.joint_qpos[0]] = 0.5  # rad/s, the whole DLO about its clamped end
    qvel[1, probe.layout.body_qpos[0, 2]] = 2.0
    qvel[1, probe.layout.pusher_qpos] = [0.3, 0.4]
    speeds = probe.speeds()
    pivot = probe.layout.body_pivot[0]  # a body turns about its centre of mass
    corner = np.linalg.norm(np.abs(UNEQUAL.boxes()[:, :2] - pivot) + UNEQUAL.boxes()[:, 3:], axis=1).max()
    assert speeds["DLO"] == pytest.approx([0, 0.5 * 0.12], rel=1e-4)
    assert speeds["bodies and cylinder"] == pytest.approx([0, 2 * corner], rel=1e-4)
    assert speeds["pusher"] == pytest.approx([0, 0.5])


def tilt(model: mujoco.MjModel) -> None:
    """Tilts the table so far that everything just slides."""
    model.opt.gravity[1] = 1.05 * 0.5 * GRAVITY


@pytest.mark.parametrize("edit", [None, tilt], ids=["level", "tilted"])
def test_energy_that_comes_from_nowhere_is_seen(edit: Edit | None) -> None:
    probe = Probe(make(bodies=(UNEQUAL,)), 1, edit=edit)
    probe.reset([straight(probe.domain)])
    still = np.zeros((1, 2))
    gained = energy.growth(probe, Trace.joined(probe.trace(still), probe.trace(still)), 0)
    rows = verdicts(energy.energy_rows(np.array([gained])))
    assert rows["pushes that gain energy once the pusher rests"] is (edit is None)


def test_energy_is_not_judged_where_no_pusher_rests() -> None:
    rows = verdicts(energy.energy_rows(np.array([[math.nan, 0.0], [0.0, 0.0], [math.nan, 0.0]])))
    assert rows["pushes that gain energy once the pusher rests"] is False


def test_energy_is_that_of_springs_and_masses() -> None:
    domain = make(attachment="fixed")
    probe = Probe(domain, 1)
    probe.reset([straight(domain)])
    trace = probe.trace(np.zeros((1, 2)))
    hinges = probe.layout.joint_qpos
    trace.qpos[0, -1, hinges[1:]] = 0.01
    bent = energy.energies(probe, trace, 0, len(trace.qpos[0]) - 1)[0]
    assert bent == pytest.approx((domain.segments - 1) * domain.bending_stiffness / 0.005 * 0.01**2 / 2, rel=1e-3)
    trace.qpos[0, -1, hinges] = 0
    trace.qvel[0, -1, hinges[0]] = 0.5
    swinging = energy.energies(probe, trace, 0, len(trace.qpos[0]) - 1)[0]
    mass = 1000.0 * math.pi * 0.0024**2 * 0.16
    assert swinging == pytest.approx(mass * 0.16**2 / 3 * 0.5**2 / 2, rel=0.01)


def test_a_jacobian_that_matters_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    piece = Piece(0, make(material="soft"), 2, 3)
    assert sameness.denseness(piece)[1].max() < sameness.JACOBIAN_BOUND

    def other(model: mujoco.MjModel) -> None:
        model.opt.impratio = 1.0

    monkeypatch.setattr(sameness, "dense", other)
    assert sameness.denseness(piece)[1].max() > sameness.JACOBIAN_BOUND


def test_the_other_jacobian_is_tried() -> None:
    model = scene.build(make())
    shipped = model.opt.jacobian
    sameness.dense(model)
    kinds = mujoco.mjtJacobian
    assert {shipped, model.opt.jacobian} == {int(kinds.mjJAC_DENSE), int(kinds.mjJAC_SPARSE)}


def test_a_single_bit_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sameness, "domains", lambda **_: [make(length=0.10)])
    run = sameness.run

    def other(domain: Domain, seeds: range | list[int], pushes: int, threads: int = 1) -> list[State]:
        states = run(domain, seeds, pushes, threads)
        if threads == 2:
            states[-1].dlo[0, 0, 0] = np.nextafter(states[-1].dlo[0, 0, 0], 1)
        return states

    monkeypatch.setattr(sameness, "run", other)
    rows = {row.name: row for row in sameness.check_same_bits("quick")}
    assert rows["other bits, one thread or two"].measured == 1 and not rows["other bits, one thread or two"].passed
    assert rows["other bits, whatever the company"].passed and rows["other bits, environment or batch"].passed


def test_shapes_that_cannot_be_told_apart_fail() -> None:
    frozen = np.zeros((1 + shapes.PUSHES + shapes.RETREATS, 32, 3))
    rows = verdicts(shapes.shape_rows(dict.fromkeys(MATERIALS, frozen)))
    assert all(passed is False for name, passed in rows.items() if "flexible" not in name or "kept" not in name)


def test_a_flexible_rod_that_stays_bent_fails_and_a_soft_one_that_straightens() -> None:
    states = 1 + shapes.PUSHES + shapes.RETREATS
    stays, straightens = np.zeros((2, states, 32, 3))
    stays[shapes.PUSHES :, :, 2] = straightens[shapes.PUSHES, :, 2] = np.linspace(0, 2, 32)
    assert shapes.bend(stays)[-1] == pytest.approx(2.0)
    rows = verdicts(shapes.shape_rows({"soft": straightens, "flexible": stays, "elastoplastic": stays}))
    assert rows["bend kept after the retreat, soft"] is rows["bend kept after the retreat, flexible"] is False
    assert rows["bend kept after the retreat, elastoplastic"] is True


# What the world does not keep, and says so: docs/adr/0002 and the README.
SHORT = {"pushes that end faster than 1 mm/s, all", "pushes that gain energy once the pusher rests"}


def test_the_world_keeps_all_bounds_but_those_that_are_said_to_be_open() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from dlobench.cli import main; main()", "validate", "--quick", "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    rows = json.loads(done.stdout)
    assert len(rows) > 100
    # Means over random pushes shift with the last bits of a CPU: there half as much again is allowed.
    noise = {row["name"] for row in rows if row["check"] == "step-size" and row["error"] <= 1.5 * (row["bound"] or 0)}
    noise |= {row["name"] for row in rows if row["name"].startswith("shapes apart") and row["error"] <= 0.5}  # % L
    assert {row["name"] for row in rows if row["pass"] is False} <= SHORT | noise
