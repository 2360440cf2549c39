"""Checks how a straight rod and a body slide to rest: the stopping distance v²/2μg.

A step of length h first sets the velocity and then moves by it, so that velocities stand half a step before positions.
A thing that shall have the speed v when it is at its start is therefore launched with v + μ g h / 2. If its velocity is
set to v it stops v h / 2 short, however right the friction is; that plain figure is given too. A third kind of row
needs no such convention: a load of twice the friction drives the thing from rest for a whole number of steps, so that
it gains and loses speed alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import GRAVITY, Domain, RigidBody
from dlobench.validation.check import Effort, Row, relative, worst
from dlobench.validation.rig import Edit, Rig
from dlobench.world import scene
from dlobench.world.starts import Start

Array = NDArray[np.float64]

G = GRAVITY
FINE = 0.001  # s
FASTEST = 0.3  # m/s
KINDS = ("rod sideways", "rod lengthways", "body")
SPEEDS: dict[Effort, tuple[float, ...]] = {
    "quick": (0.1, FASTEST),
    "normal": (0.1, 0.2, FASTEST),
    "full": (0.1, 0.15, 0.2, 0.25, FASTEST),
}
FRICTIONS: dict[Effort, tuple[float, ...]] = {
    "quick": (0.2, 0.8),
    "normal": (0.2, 0.5, 0.8),
    "full": (0.2, 0.35, 0.5, 0.65, 0.8),
}


def rig_of(
    kind: str, friction: float, *, timestep: float = scene.TIMESTEP, sleep: bool = True, edit: Edit | None = None
) -> tuple[Rig, str, Array]:
    """Returns a settled rig, the thing that is to slide and the (2,) direction to slide in."""
    bodies = (RigidBody("L3", (3000.0,) * 3, friction),) if kind == "body" else ()
    domain = Domain(friction, 0.16, 1000.0, "flexible", 1.5e-4, None, "none", bodies)
    places = np.array([[-0.05, 0.03, 0.0]])[: len(bodies)]
    begin = Start(np.array([-0.12, -0.08, 0.0]), np.zeros(domain.segments), places, np.array([0.1, 0.1]))
    rig = Rig(domain, begin, timestep=timestep, sleep=sleep, edit=edit)
    along = np.array([0.0, 1.0] if kind == "rod sideways" else [1.0, 0.0])
    return rig, "body0" if bodies else "dlo", along


def launched(
    kind: str,
    friction: float,
    speed: float,
    *,
    plain: bool = False,
    timestep: float = scene.TIMESTEP,
    edit: Edit | None = None,
) -> float:
    """Returns how far a thing goes, m, that has `speed` m/s at its start; `plain` sets just that as its velocity."""
    rig, thing, along = rig_of(kind, friction, timestep=timestep, edit=edit)
    before = rig.centre(thing)
    rig.launch(thing, (speed if plain else speed + friction * G * timestep / 2) * along)
    rig.run(1.5 * speed / (friction * G) + 0.1)
    return float((rig.centre(thing) - before) @ along)


def driven(
    kind: str, friction: float, speed: float, *, timestep: float = scene.TIMESTEP, edit: Edit | None = None
) -> tuple[float, float]:
    """Returns how far a thing goes, m, that is driven from rest to about `speed` m/s and let go; and the closed form.

    The load is twice the friction for T s, so that it goes μ g T²: half of it driven, half by itself.
    """
    rig, thing, along = rig_of(kind, friction, timestep=timestep, edit=edit)
    before = rig.centre(thing)
    duration = max(1, round(speed / (friction * G) / timestep)) * timestep
    rig.load(thing, 2 * friction * rig.mass(thing) * G * along)
    rig.run(duration)
    rig.load(thing, np.zeros(2))
    rig.run(1.5 * duration + 0.1)
    return float((rig.centre(thing) - before) @ along), friction * G * duration**2


def check_sliding(effort: Effort, edit: Edit | None = None) -> Iterator[Row]:
    """Yields stopping distances of a rod, sideways and lengthways, and of a body."""
    for kind in KINDS:
        for timestep, plain in product((FINE, scene.TIMESTEP), (False, True)):
            bound = 2.0 if timestep == FINE and not plain else None
            yield _launched(kind, effort, timestep=timestep, plain=plain, bound=bound, edit=edit)
        for timestep, speed in product((FINE, scene.TIMESTEP), SPEEDS[effort]):
            bound = 2.0 if timestep == FINE or speed == FASTEST else None
            yield _driven(kind, effort, speed, timestep=timestep, bound=bound, edit=edit)


def _launched(
    kind: str, effort: Effort, *, timestep: float, plain: bool, bound: float | None, edit: Edit | None
) -> Row:
    rows = []
    for friction, speed in product(FRICTIONS[effort], SPEEDS[effort]):
        far = launched(kind, friction, speed, plain=plain, timestep=timestep, edit=edit)
        note = f"{100 * friction * G * timestep / speed:.1f} % of it is v h/2" if plain else ""
        rows.append(relative(f"μ {friction:g}, {speed:g} m/s", far, speed**2 / (2 * friction * G), bound, "m", note))
    start = "its velocity set to v" if plain else "launched"
    return worst(f"stopping distance, {kind}, {start}, {step_name(timestep)}", rows)


def _driven(kind: str, effort: Effort, speed: float, *, timestep: float, bound: float | None, edit: Edit | None) -> Row:
    rows = []
    for friction in FRICTIONS[effort]:
        far, exact = driven(kind, friction, speed, timestep=timestep, edit=edit)
        rows.append(relative(f"μ {friction:g}", far, exact, bound, "m"))
    return worst(f"distance, {kind}, driven from rest to {speed:g} m/s and let go, {step_name(timestep)}", rows)


def step_name(timestep: float) -> str:
    """Names a time step, s."""
    return "shipped step" if timestep == scene.TIMESTEP else f"{1e3 * timestep:g} ms step"
