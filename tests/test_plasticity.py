"""Tests the law of plastic bending against a model of springs and sliders, and that its check finds a wrong scene."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from altered import Edit, alter, stiffen, verdicts, weaken

from dlobench.validation.plasticity import Law, check_plasticity


def history(law: Law, curvatures: Any) -> list[float]:
    """Returns the moments along a path: a spring that yields beside one that does not."""
    slider, moments = 0.0, []
    for curvature in curvatures:
        stretch = np.clip(curvature - slider, -law.yield_curvature, law.yield_curvature)
        slider = curvature - stretch
        moments.append(law.stiffness * ((1 - law.hardening) * stretch + law.hardening * curvature))
    return moments


LAWS = [Law(2e-4, 0.5), Law(5e-5, 2.0, hardening=0.1)]


@pytest.mark.parametrize("law", LAWS)
def test_a_dlo_is_bent_and_springs_back_as_springs_and_sliders_do(law: Law) -> None:
    for share in (0.5, 1.0, 1.5, 4.0):
        curvature = share * law.yield_curvature
        there = history(law, np.linspace(0, curvature, 10_001))
        assert law.moment(curvature) == pytest.approx(there[-1], rel=1e-9)
        path = [*np.linspace(0, curvature, 10_001), law.left(curvature)]
        assert history(law, path)[-1] == pytest.approx(0, abs=1e-12)  # without a moment it stays there
    assert law.left(0.9 * law.yield_curvature) == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("law", LAWS)
def test_a_loop_takes_the_area_it_encloses(law: Law) -> None:
    largest = 3 * law.yield_curvature
    path = largest * np.sin(np.linspace(0, 4.5 * math.pi, 90_001))
    moments = np.array(history(law, path))
    second = slice(50_000, 90_001)  # from one side to the other and back
    work = np.sum((moments[second][1:] + moments[second][:-1]) / 2 * np.diff(path[second]))
    assert law.loop(largest) == pytest.approx(work, rel=1e-4)
    assert law.loop(law.yield_curvature) == 0


def test_the_shipped_scene_yields_springs_back_and_dissipates() -> None:
    found = verdicts(check_plasticity("quick"))
    assert len(found) == 4 and all(found.values()), found


@pytest.mark.parametrize("edit", [stiffen(1.03), weaken(0.97), weaken(0.5, only="bend0")])
def test_a_wrong_scene_fails(monkeypatch: pytest.MonkeyPatch, edit: Edit) -> None:
    alter(monkeypatch, edit)
    assert not all(verdicts(check_plasticity("quick")).values())
