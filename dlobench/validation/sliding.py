"""Checks how things slide: stopping distances, the load at which they slip, and creep below it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dlobench.domain import Domain, RigidBody
from dlobench.validation.rig import Edit, Rig
from dlobench.world import scene
from dlobench.world.starts import Start
from dlobench.world.state import PUSH_TIME

Array = NDArray[np.float64]

G = scene.GRAVITY
KINDS = ("rod sideways", "rod lengthways", "body")


def domain_of(kind: str, friction: float) -> Domain:
    """Returns the domain of a straight rod, or of a body beside it, with one coefficient on the table."""
    bodies = (RigidBody("L3", (3000.0,) * 3, friction),) if kind == "body" else ()
    return Domain(friction, 0.16, 1000.0, "flexible", 1.5e-4, None, "none", bodies)


def start_of(kind: str, yaw: float = 0.0) -> Start:
    """Lays the rod along x and, turned by yaw, a body apart from it; the pusher is out of the way."""
    bodies = np.array([[-0.05, 0.03, yaw]]) if kind == "body" else np.zeros((0, 3))
    return Start(np.array([-0.12, -0.08, 0.0]), np.zeros(32), bodies, np.array([0.1, 0.1]))


def rig_of(
    kind: str, friction: float, *, timestep: float = scene.TIMESTEP, sleep: bool = True, edit: Edit | None = None
) -> tuple[Rig, str, Array]:
    """Returns a settled rig, the thing that is to slide and the (2,) direction to slide in."""
    rig = Rig(domain_of(kind, friction), start_of(kind), timestep=timestep, sleep=sleep, edit=edit)
    thing = "body0" if kind == "body" else "dlo"
    return rig, thing, np.array([0.0, 1.0] if kind == "rod sideways" else [1.0, 0.0])


def stopping(
    kind: str, friction: float, speed: float, *, timestep: float = scene.TIMESTEP, edit: Edit | None = None
) -> float:
    """Returns how far a thing goes, m, whose velocity is set to `speed` m/s."""
    rig, thing, along = rig_of(kind, friction, timestep=timestep, edit=edit)
    before = rig.centre(thing)
    rig.launch(thing, speed * along)
    rig.run(1.5 * speed / (friction * G) + 0.1)
    return float((rig.centre(thing) - before) @ along)


def shoved(
    kind: str, friction: float, speed: float, *, timestep: float = scene.TIMESTEP, edit: Edit | None = None
) -> tuple[float, float]:
    """Returns how far a thing goes, m, that twice its friction drove from rest to about `speed` m/s, and the reference.

    It gains speed as fast as it then loses it, over a whole number of steps.
    """
    rig, thing, along = rig_of(kind, friction, timestep=timestep, edit=edit)
    before = rig.centre(thing)
    steps = max(1, round(speed / (friction * G) / timestep))
    duration = steps * timestep
    rig.load(thing, 2 * friction * rig.mass(thing) * G * along)
    rig.run(duration)
    rig.load(thing, np.zeros(2))
    rig.run(1.5 * duration + 0.1)
    return float((rig.centre(thing) - before) @ along), friction * G * duration**2


SLIPPED = 0.002  # m; creep is far slower
PATIENCE = 1.0  # s; 1.002 times the threshold takes friction 0.2 so far


def slips(rig: Rig, thing: str, force: Array) -> bool:
    """Tells whether a steady load makes the thing slip: how far it goes tells that apart from creep."""
    before = rig.centre(thing)
    rig.load(thing, force)
    for _ in range(10):
        rig.run(PATIENCE / 10)
        if np.linalg.norm(rig.centre(thing) - before) > SLIPPED:
            return True
    return False


def threshold(
    kind: str,
    friction: float,
    *,
    timestep: float = scene.TIMESTEP,
    sleep: bool = True,
    edit: Edit | None = None,
    rounds: int = 7,
) -> float:
    """Returns the least steady load, as a share of the thing's weight, that makes it slip: by halving 0.8 to 1.2 μ."""
    low, high = 0.8 * friction, 1.2 * friction
    for _ in range(rounds):
        middle = (low + high) / 2
        rig, thing, along = rig_of(kind, friction, timestep=timestep, sleep=sleep, edit=edit)
        if slips(rig, thing, middle * rig.mass(thing) * G * along):
            high = middle
        else:
            low = middle
    return (low + high) / 2


def creep(
    kind: str,
    friction: float,
    *,
    timestep: float = scene.TIMESTEP,
    sleep: bool = True,
    edit: Edit | None = None,
    share: float = 0.8,
) -> float:
    """Returns how far a part of a thing at most moves, m, in the time of a push under a share of the slipping load."""
    rig, thing, along = rig_of(kind, friction, timestep=timestep, sleep=sleep, edit=edit)
    before = rig.parts(thing)[2].copy()
    rig.load(thing, share * friction * rig.mass(thing) * G * along)
    rig.run(PUSH_TIME)
    return float(np.linalg.norm(rig.parts(thing)[2] - before, axis=-1).max())


def print_all(timestep: float = scene.TIMESTEP, edit: Edit | None = None) -> None:
    """Prints everything that is measured here."""
    for kind in KINDS:
        for friction in (0.2, 0.5, 0.8):
            for speed in (0.1, 0.2, 0.3):
                exact = speed**2 / (2 * friction * G)
                far = stopping(kind, friction, speed, timestep=timestep, edit=edit)
                shove, wanted = shoved(kind, friction, speed, timestep=timestep, edit=edit)
                print(
                    f"{kind} μ {friction} v {speed}: launched {100 * (far / exact - 1):+.2f} %, with v h/2 "
                    f"{100 * ((far + speed * timestep / 2) / exact - 1):+.2f} %, shoved {100 * (shove / wanted - 1):+.2f} %"
                )
            load = threshold(kind, friction, timestep=timestep, edit=edit)
            crept = [1e3 * creep(kind, friction, timestep=timestep, edit=edit, sleep=sleep) for sleep in (True, False)]
            print(f"{kind} μ {friction}: threshold {100 * (load / friction - 1):+.2f} %, creep {crept} mm")
