"""Checks how composite bodies slide and spin to rest against quadrature over their contact patch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import GRAVITY, Domain, RigidBody, sample_body
from dlobench.validation.check import Effort, Row, worst
from dlobench.validation.patch import Patch
from dlobench.validation.rig import Edit, Rig, box_masses
from dlobench.validation.sliding import step_name
from dlobench.world import scene
from dlobench.world.starts import Start

Array = NDArray[np.float64]

G = GRAVITY
FINE = 0.0005  # s
YAW = 0.5  # rad, at the start
SHOVE, TWIST = 1.8, 0.6  # times friction; a twist also times the radius of gyration
SHOVE_SPEED = 0.3  # m/s, about what a shove leads to


@dataclass(frozen=True)
class Case:
    """Describes a body and how it starts: speed m/s, heading rad, spin rad/s."""

    body: RigidBody  # its friction is the table's too, and so that of the two
    speed: float
    heading: float
    spin: float

    def __str__(self) -> str:
        """Names what tells one case from another."""
        loads = "/".join(f"{density:.0f}" for density in self.body.densities)
        return (
            f"{self.body.shape} {loads} kg/m³, μ {self.body.friction:.2g}, {self.speed:.2g} m/s, {self.spin:.2g} rad/s"
        )

    def patch(self) -> Patch:
        """Returns the body's contact patch."""
        return Patch.of(self.body.boxes(), box_masses(self.body), self.body.friction, G)

    def velocity(self) -> Array:
        """Returns (vx m/s, vy m/s, spin rad/s) at the start."""
        return np.array([self.speed * math.cos(self.heading), self.speed * math.sin(self.heading), self.spin])


CASES = (
    Case(RigidBody("L5", (1200.0, 8000.0, 8000.0, 1200.0, 1200.0), 0.2), 0.3, 0.0, 10.0),
    Case(RigidBody("bar4", (5000.0, 3000.0, 1500.0, 1200.0), 0.8), 0.3, 2.0, -12.0),
    Case(RigidBody("T5", (3000.0, 2000.0, 6000.0, 1500.0, 4000.0), 0.5), 0.2, 1.0, 20.0),
    Case(RigidBody("bar2", (2000.0, 2000.0), 0.2), 0.2, 1.0, 20.0),
    Case(RigidBody("L3", (3000.0, 7000.0, 1200.0), 0.8), 0.3, 2.0, -12.0),
    Case(RigidBody("bar2", (8000.0, 1200.0), 0.5), 0.3, 0.0, 10.0),
    Case(RigidBody("J4", (1500.0, 2500.0, 4000.0, 7000.0), 0.5), 0.25, -1.0, -20.0),
    Case(RigidBody("bar4", (8000.0, 1200.0, 1200.0, 1200.0), 0.2), 0.2, 1.0, 15.0),
)


def cases(effort: Effort) -> Sequence[Case]:
    """Returns three cases, eight, or eight and forty that are drawn at random."""
    if effort != "full":
        return CASES[:3] if effort == "quick" else CASES
    rng = np.random.default_rng(0)
    drawn = [
        Case(
            sample_body(rng),
            rng.uniform(0.1, 0.3),
            rng.uniform(-np.pi, np.pi),
            rng.choice([-1, 1]) * rng.uniform(8, 20),
        )
        for _ in range(40)
    ]
    return (*CASES, *drawn)


def rig_of(case: Case, *, timestep: float = scene.TIMESTEP, edit: Edit | None = None) -> Rig:
    """Returns the case's body at rest in the middle of the table, clear of everything."""
    domain = Domain(case.body.friction, 0.16, 1000.0, "flexible", 1.5e-4, None, "none", (case.body,))
    begin = Start(
        np.array([-0.08, -0.11, 0.0]), np.zeros(domain.segments), np.array([[0.0, 0.01, YAW]]), np.array([0.11, 0.11])
    )
    return Rig(domain, begin, timestep=timestep, edit=edit)


def launched(
    case: Case, *, plain: bool = False, timestep: float = scene.TIMESTEP, edit: Edit | None = None
) -> tuple[Array, float]:
    """Returns how far the centre of mass goes, (2,) m, and how far the body turns, rad.

    Velocities stand half a step before positions (see `sliding`); `plain` sets the velocity at the start as it is.
    """
    velocity = case.velocity()
    if not plain:
        velocity = velocity - timestep / 2 * case.patch().acceleration(YAW, velocity, np.zeros(3))
    rig = rig_of(case, timestep=timestep, edit=edit)
    before, yaw = rig.centre("body0"), rig.yaw("body0")
    rig.launch("body0", velocity[:2], float(velocity[2]))
    rig.run(0.5)
    return rig.centre("body0") - before, rig.yaw("body0") - yaw


def driven(
    case: Case, *, timestep: float = scene.TIMESTEP, edit: Edit | None = None
) -> tuple[tuple[Array, float], tuple[Array, float]]:
    """Returns the same for a body shoved and twisted from rest for a whole number of steps; and the quadrature."""
    patch = case.patch()
    friction = case.body.friction * patch.mass * G
    twist = math.copysign(TWIST * math.sqrt(patch.inertia / patch.mass), case.spin)
    shove = friction * np.array([SHOVE * math.cos(case.heading), SHOVE * math.sin(case.heading), twist])
    duration = max(1, round(SHOVE_SPEED / (case.body.friction * G) / timestep)) * timestep
    rig = rig_of(case, timestep=timestep, edit=edit)
    before, yaw = rig.centre("body0"), rig.yaw("body0")
    rig.run(duration, lambda: rig.load("body0", shove[:2], float(shove[2])))
    rig.load("body0", np.zeros(2))
    rig.run(0.5)
    return (rig.centre("body0") - before, rig.yaw("body0") - yaw), patch.slide(YAW, np.zeros(3), shove, duration)


def check_spinning(effort: Effort, edit: Edit | None = None) -> Iterator[Row]:
    """Yields for launched and for driven bodies how far they slide and turn until they rest."""
    chosen = cases(effort)
    exact = [case.patch().slide(YAW, case.velocity()) for case in chosen]
    for timestep in (FINE, scene.TIMESTEP):
        for plain in (False, True):
            found = [launched(case, plain=plain, timestep=timestep, edit=edit) for case in chosen]
            how = f"{'their velocity set as it is' if plain else 'launched'}, {step_name(timestep)}"
            yield from _rows(how, chosen, found, exact, 3.0 if timestep == FINE and not plain else None)
        both = [driven(case, timestep=timestep, edit=edit) for case in chosen]
        yield from _rows(f"driven, {step_name(timestep)}", chosen, [b[0] for b in both], [b[1] for b in both], 3.0)


def _rows(
    how: str,
    chosen: Sequence[Case],
    found: Sequence[tuple[Array, float]],
    exact: Sequence[tuple[Array, float]],
    bound: float | None,
) -> Iterator[Row]:
    """Yields the worst slide and the worst turn."""
    slides, turns = [], []
    for case, (slide, turn), (slide_exact, turn_exact) in zip(chosen, found, exact, strict=True):
        far, wanted = float(np.linalg.norm(slide)), float(np.linalg.norm(slide_exact))
        error = 100 * float(np.linalg.norm(slide - slide_exact)) / wanted
        slides.append(Row(str(case), far, wanted, error, bound, "m", "%", "error of the vector"))
        turns.append(Row(str(case), turn, turn_exact, 100 * abs(turn / turn_exact - 1), bound, "rad", "%"))
    yield worst(f"bodies that slide and spin, distance, {how}", slides)
    yield worst(f"bodies that slide and spin, turn, {how}", turns)
