"""Lets a test build a wrong scene, to see that a check finds it."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import mujoco
import pytest

from dlobench.domain import Domain
from dlobench.validation.check import Row
from dlobench.world import scene

Edit = Callable[[mujoco.MjSpec], None]


def alter(monkeypatch: pytest.MonkeyPatch, edit: Edit) -> None:
    """Edits every scene that is built from now on."""
    shipped = scene.spec

    def spec(domain: Domain, timestep: float = scene.TIMESTEP, fineness: int = 1) -> mujoco.MjSpec:
        out = shipped(domain, timestep, fineness)
        edit(out)
        return out

    monkeypatch.setattr(scene, "spec", spec)


def stiffen(factor: float, *, only: str = "bend") -> Edit:
    """Multiplies the stiffness of the hinges whose names begin so."""

    def edit(spec: mujoco.MjSpec) -> None:
        for joint in hinges(spec, only):
            joint.stiffness[0] *= factor

    return edit


def weaken(factor: float, *, only: str = "bend") -> Edit:
    """Multiplies the yield angle of the hinges whose names begin so."""

    def edit(spec: mujoco.MjSpec) -> None:
        for joint in hinges(spec, only):
            joint.springyield *= factor

    return edit


def displace(spec: mujoco.MjSpec) -> None:
    """Puts every segment's centre of mass a segment ahead of where it is."""
    for body in spec.bodies:
        if body.name.startswith("segment"):
            body.ipos = [0.005, 0, 0]


def hinges(spec: mujoco.MjSpec, only: str) -> list[mujoco.MjsJoint]:
    found = [joint for joint in spec.joints if joint.name.startswith(only)]
    assert found or "bend0" in only  # a free DLO has no clamped hinge
    return found


def verdicts(rows: Iterable[Row]) -> dict[str, bool]:
    """Returns what became of every bounded row."""
    found = {f"{row.name} ({row.note})": row.passed for row in rows}
    return {name: passed for name, passed in found.items() if passed is not None}
