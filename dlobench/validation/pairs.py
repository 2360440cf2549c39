"""Checks the friction of every pair of things that can touch: presses one on the other and draws it along.

All but what is drawn stands in tough honey, and that itself in thinner, so that it soon goes steadily. Friction is held
against what presses as the contacts have it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import (
    BOX_SIZE,
    DLO_RADIUS,
    GRAVITY,
    PUSHER_RADIUS,
    SEGMENT_LENGTH,
    WORKSPACE,
    Attachment,
    Domain,
    RigidBody,
)
from dlobench.validation.check import Effort, Row, relative
from dlobench.validation.forces import touch
from dlobench.validation.rig import Edit, Rig
from dlobench.world.chain import CYLINDER_RADIUS
from dlobench.world.contact import friction_table
from dlobench.world.starts import Start

Array = NDArray[np.float64]

PRESS = 0.1  # N
SLOW = 0.005  # m/s, how fast it is drawn along
GAP = 1e-4  # m, at the start
HONEY, HONEY_TURN = 1e3, 1.0  # N s/m and N m s
SETTLE, MEASURE = 0.1, 0.2  # s
SURFACE, BODIES = 0.6, (RigidBody("bar4", (2000.0,) * 4, 0.25), RigidBody("bar2", (2000.0,) * 2, 0.7))
# What slides, along y; what holds it, on its right.
PRESSED = (
    ("dlo", "wall"), ("dlo", "pusher"), ("dlo", "body0"), ("dlo", "body1"),
    ("cylinder", "wall"), ("cylinder", "pusher"), ("cylinder", "body0"), ("cylinder", "body1"),
    ("body0", "wall"), ("body0", "pusher"), ("body0", "body1"), ("body1", "pusher"),("body1", "wall"),
)  # fmt: skip
CURLED = (("dlo", "dlo"), ("dlo", "cylinder"))


def documented(domain: Domain, a: str, b: str) -> float:
    """Returns the coefficient that the friction table has for a pair of things."""
    table = friction_table(domain)
    either = {a, b}
    for thing in ("pusher", "wall"):
        if thing in either:
            return table[f"{thing}-any"]
    if all(name.startswith("body") for name in either):
        return max(table[f"dlo-{name}"] for name in either)
    for key in (f"{a}-{b}", f"{b}-{a}"):
        if key in table:
            return table[key]
    return table["cylinder-any"]


def rig_of(a: str, b: str, *, edit: Edit | None = None) -> Rig:
    """Returns a rig in which `a` nearly touches `b` on its right, `b` is held, and `a` may shift but not turn."""
    attachment: Attachment = "movable" if "cylinder" in (a, b) else "none"
    domain = Domain(SURFACE, 0.10, 1000.0, "soft", 1e-6, None, attachment, BODIES)
    reach = {"dlo": DLO_RADIUS, "cylinder": CYLINDER_RADIUS, "pusher": PUSHER_RADIUS, "wall": 0.0}
    right = WORKSPACE / 2 if b == "wall" else 0.0  # where b's left side stands
    left = right - GAP - reach.get(a, BOX_SIZE / 2)
    # Bars and the rod lie along y; a cylinder's rod points away to the left.
    places = {
        "body0": [-0.08, 0.08, 0.0],
        "body1": [-0.08, -0.08, 0.0],
        "pusher": [-0.1, 0.02],
        "dlo": [-0.11, -0.11, 0.0],
    }
    upright = math.pi / 2
    for thing, x in ((a, left), (b, right + reach.get(b, BOX_SIZE / 2))):
        if thing.startswith("body"):
            places[thing] = [x, 0.0, upright]
        elif thing == "pusher":
            places[thing] = [x, 0.0]
        elif thing == "dlo":
            places["dlo"] = [x, -0.0525, upright]  # boxes end in the middle of a segment, where no joint can catch
        elif thing == "cylinder":
            places["dlo"] = [x, 0.0, math.pi]
    bodies = np.array([places["body0"], places["body1"]])
    begin = Start(np.array(places["dlo"], dtype=float), np.zeros(domain.segments), bodies, np.array(places["pusher"]))
    rig = Rig(domain, begin, sleep=False, edit=edit)
    free = rig.dofs("dlo" if a == "cylinder" else a)[:2]
    hold(rig, free, PRESS / SLOW / 2)
    return rig


def hold(rig: Rig, free: NDArray[np.intp], damping: float | Array) -> None:
    """Sets everything in tough honey but some degrees of freedom, which get a damping of their own."""
    bodies = [f"body{i}" for i in range(len(rig.domain.bodies))]
    for name in ("dlo", "hinges", "pusher", *bodies):
        dofs = rig.dofs(name)
        slides = rig.model.jnt_type[rig.model.dof_jntid[dofs]] == mujoco.mjtJoint.mjJNT_SLIDE
        rig.model.dof_damping[dofs] = np.where(slides, HONEY, HONEY_TURN)
    rig.model.dof_damping[free] = damping


def curled(b: str, *, edit: Edit | None = None) -> Rig:
    """Returns a rig in which the DLO's tip comes round and nearly stands upright on its first part, or on its cylinder.

    One hinge is left free to press the tip down, and one to draw it along.
    """
    attachment: Attachment = "movable" if b == "cylinder" else "none"
    domain = Domain(SURFACE, 0.10, 1000.0, "soft", 1e-6, None, attachment)
    out, back = (6, 6) if b == "cylinder" else (8, 4)  # segments that lead away, and back
    top = (CYLINDER_RADIUS if b == "cylinder" else DLO_RADIUS) + DLO_RADIUS + GAP
    over = np.deg2rad([30, 60, 90, 120, 150, 210, 240, 270])
    lean = math.asin((SEGMENT_LENGTH * np.sin(over).sum() - top) / (SEGMENT_LENGTH * back))
    yaws = np.concatenate([np.zeros(out), over[:5], np.full(back, math.pi + lean), over[5:]])
    begin = Start(np.zeros(3), np.diff(yaws, prepend=0.0), np.zeros((0, 3)), np.array([-0.1, 0.1]))
    rig = Rig(domain, begin, sleep=False, edit=edit)
    first = 0 if b == "cylinder" else 1  # without a cylinder the first segment has no hinge
    levers = SEGMENT_LENGTH * np.array([back + 1.5, 2.0])  # m, from the free hinges to the tip
    free = rig.dofs("hinges")[[out + 5 - first, domain.segments - 2 - first]]
    hold(rig, free, PRESS / SLOW / 2 * levers**2)
    return rig


def coefficient(a: str, b: str, *, edit: Edit | None = None) -> tuple[float, float, float]:
    """Returns the friction coefficient of a pair, the mean force between the two, N, and the documented coefficient."""
    around = (a, b) in CURLED
    rig = curled(b, edit=edit) if around else rig_of(a, b, edit=edit)
    wanted = documented(rig.domain, a, b)
    if around:
        drawn = (2 * wanted + 0.5) * PRESS
        rig.data.xfrc_applied[rig.layout.segments[-1], :2] = [drawn, -PRESS]
    else:
        thing = "dlo" if a == "cylinder" else a
        mu = friction_table(rig.domain)[f"{thing}-table"]
        drawn = (2 * wanted + 0.5) * PRESS + mu * rig.mass(thing) * GRAVITY
        rig.load(thing, np.array([PRESS, drawn]))
    rig.run(SETTLE)
    ratios, presses = [], []
    for _ in range(round(MEASURE / rig.timestep)):
        rig.run(rig.timestep)
        found = touch(rig, a, b)
        presses.append(found.presses.sum())
        if presses[-1] > 0:
            ratios.append(np.linalg.norm(found.rubs.sum(axis=0)) / presses[-1])
    # What slides hops a little, and for a moment after landing it may stick: the median is of sliding.
    return float(np.median(ratios)) if ratios else math.nan, float(np.mean(presses)), wanted


def check_pairs(effort: Effort, edit: Edit | None = None) -> Iterator[Row]:  # noqa: ARG001  # always the same
    """Yields the friction coefficient of every pair of things that can touch; with the table, see `directions`."""
    for a, b in (*PRESSED, *CURLED):
        found, force, wanted = coefficient(a, b, edit=edit)
        yield relative(f"friction {a}–{b}", found, wanted, 1.0, "", f"pressed together with {force:.2f} N")
