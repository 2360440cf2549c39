"""Checks the elastoplastic DLO on a testing machine: yield moment, springback, and what a closed loop dissipates."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from dlobench.domain import STIFFNESS, YIELD_CURVATURE, Attachment
from dlobench.validation.check import Effort, Row, at_most, relative
from dlobench.validation.rod import FREE_SPACE, GRIP, Rod, specimen

LENGTH = 0.16  # m
ELASTIC, PLASTIC = 0.8, (1.5, 3.0, 6.0)  # curvatures that a DLO is bent to, over its yield curvature
LOOP = 3.0  # the loop's curvature, to either side, over the yield curvature
CHANGE, HOLD = 30.0, 0.02  # s, for every change of the machine, and between its set-points
# s, for a loop. Damping of stiffness × τ adds 2π² τ LOOP² / 4 (LOOP − 1) ROUND to its work: 0.56 % with τ = 50 ms.
ROUND = 200.0
OPENING = 1e-6  # of its grip is what the machine has left when it lets go
STILL, LOOK = 1e-4, 0.2  # of the yield angle is what may move within so many seconds when all is still
ATTACHMENTS: tuple[Attachment, ...] = ("none", "fixed")


@dataclass(frozen=True)
class Law:
    """Says what moment a curvature takes: linear up to the yield curvature, then with a fraction of the slope."""

    stiffness: float  # EI, N m²
    yield_curvature: float  # 1/m
    hardening: float = 0.0  # slope beyond yield over slope before it, kinematic; 0 is ideal plasticity

    def moment(self, curvature: float) -> float:
        """Returns the moment, N m, when a straight DLO is bent to a curvature, 1/m, for the first time."""
        beyond = max(0.0, curvature - self.yield_curvature)
        return self.stiffness * (curvature - (1 - self.hardening) * beyond)

    def left(self, curvature: float) -> float:
        """Returns the curvature, 1/m, that stays after bending to `curvature` and letting go: κ − M / EI."""
        return curvature - self.moment(curvature) / self.stiffness

    def loop(self, curvature: float) -> float:
        """Returns the work, J/m, that a closed loop between ± `curvature`, 1/m, takes: the enclosed area."""
        plastic = (1 - self.hardening) * self.stiffness * self.yield_curvature
        return 4 * plastic * max(0.0, curvature - self.yield_curvature)


def check_plasticity(effort: Effort) -> Iterator[Row]:
    """Yields moments, springback and dissipation, of a free DLO and of one whose fixed end is clamped too.

    The options and the step are the shipped ones.
    """
    cases = list(product(STIFFNESS["elastoplastic"], YIELD_CURVATURE, ATTACHMENTS))
    for EI, kappa, attachment in cases if effort != "quick" else cases[-1:]:
        law = Law(EI, kappa)
        yield from _springback(law, attachment)
        yield _dissipation(law, attachment)


def _rod(law: Law, attachment: Attachment) -> Rod:
    return Rod(specimen("elastoplastic", law.stiffness, LENGTH, attachment, law.yield_curvature))


def _say(what: str, law: Law, attachment: Attachment) -> str:
    return f"{what}, {law.stiffness:g} N m², yields at {law.yield_curvature:g}/m, attachment {attachment}"


def _springback(law: Law, attachment: Attachment) -> Iterator[Row]:
    """Bends a DLO ever further, and lets it go each time."""
    rod, plateau, left = _rod(law, attachment), [], []
    length, still = float(rod.span.sum()), STILL * law.yield_curvature * float(rod.span.min())
    for share in (ELASTIC, *PLASTIC):
        _turn(rod, share * law.yield_curvature * length, still)
        curvature, moment = rod.bend / length, 1e6 * rod.moment
        _let_go(rod, still)
        stays = rod.bend / length
        note = f"bent to {share:g} of the yield curvature"
        if share == ELASTIC:
            note = f"{note}; {FREE_SPACE}"
            whole = _say("elastic springback, what is left / yield curvature", law, attachment)
            yield at_most(whole, 100 * abs(stays) / law.yield_curvature, 1.0, "%", note)
            continue
        note = f"{note}, worst of {', '.join(f'{s:g}' for s in PLASTIC)}; {FREE_SPACE}"
        name = _say("plastic moment", law, attachment)
        plateau.append(relative(name, moment, 1e6 * law.moment(curvature), 1.0, "µN m", note))
        name = _say("springback, curvature left", law, attachment)
        left.append(relative(name, stays, law.left(curvature), 1.0, "1/m", note))
    for rows in (plateau, left):
        yield max(rows, key=lambda row: row.error)


def _dissipation(law: Law, attachment: Attachment) -> Row:
    """Bends a DLO to one side, and from there all the way to the other and back."""
    rod = _rod(law, attachment)
    length = float(rod.span.sum())
    steps = round(ROUND / rod.timestep)
    path = []
    for angle in LOOP * law.yield_curvature * length * np.sin(2 * math.pi * np.arange(steps // 4 + steps + 1) / steps):
        rod.grip(1.0, angle)
        rod.step()
        bent = rod.bend
        path.append((bent, GRIP * (angle - bent)))  # as `rod.moment`, which would look again
    bend, moment = np.array(path[steps // 4 :]).T
    work = float(np.sum((moment[1:] + moment[:-1]) / 2 * np.diff(bend))) / length
    reference = law.loop(float(bend.max() - bend.min()) / 2 / length)
    note = f"between ± {LOOP:g} of the yield curvature within {ROUND:g} s; {FREE_SPACE}"
    return relative(_say("work of a loop", law, attachment), 1e6 * work, 1e6 * reference, 1.0, "µJ/m", note)


def _turn(rod: Rod, angle: float, still: float) -> None:
    """Turns the ends against each other, starting and ending at rest, and waits until all is still."""
    begin = rod.bend
    for t in np.linspace(0, 1, round(CHANGE / HOLD)):
        rod.grip(1.0, begin + (3 * t**2 - 2 * t**3) * (angle - begin))
        rod.run(HOLD)
    rod.settle(LOOK, still)


def _let_go(rod: Rod, still: float) -> None:
    """Opens the grip by the same factor again and again, so that nothing snaps back, and waits until all is still."""
    held = rod.bend + rod.moment / GRIP
    for share in np.geomspace(1, OPENING, round(CHANGE / HOLD)):
        rod.grip(share, held)
        rod.run(HOLD)
    rod.grip(0.0, 0.0)
    rod.settle(LOOK, still)
