"""Integrates a flat body that slides and spins on its contact patch: quadrature of an affine pressure, no engine.

Under a rigid body on an even, slightly soft table the pressure is affine, p = a + b x + c y, where it presses at all.
Weight and both moments fix a, b and c. Coulomb friction acts at every spot of the patch against that spot's velocity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AT_REST = 1e-3  # of the greatest speed: what is left to go is a millionth of the way
STEPS = 100  # Heun steps in the time that friction needs to stop the present speed


@dataclass(frozen=True)
class Patch:
    """Holds the spots of a flat body about its centre of mass, in its own frame, and the friction at each."""

    spots: Array  # (n, 2)  m
    rubs: Array  # (n,)  N, friction coefficient times what the spot carries
    mass: float  # kg
    inertia: float  # kg m², about the vertical through the centre of mass

    @staticmethod
    def of(boxes: Array, masses: Array, friction: float, gravity: float, order: int = 12) -> Patch:
        """Lays order × order Gauss points on each of (n, 5) unturned boxes (x, y, yaw, half sizes, m) of (n,) kg."""
        centre = masses @ boxes[:, :2] / masses.sum()
        nodes, weights = np.polynomial.legendre.leggauss(order)
        grid = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
        spots = (boxes[:, None, :2] - centre + grid * boxes[:, None, 3:]).reshape(-1, 2)
        areas = np.outer(boxes[:, 3:].prod(axis=1), np.outer(weights, weights)).ravel()
        own = masses * (boxes[:, 3:] ** 2).sum(axis=1) / 3
        inertia = float((own + masses * ((boxes[:, :2] - centre) ** 2).sum(axis=1)).sum())
        weight = float(masses.sum() * gravity)
        return Patch(spots, friction * weight * shares(spots, areas), float(masses.sum()), inertia)

    def acceleration(self, yaw: float, motion: Array, load: Array) -> Array:
        """Returns (ax m/s², ay m/s², change of spin rad/s²) under friction and a load (fx N, fy N, moment N m).

        motion (vx m/s, vy m/s, spin rad/s).
        """
        c, s = math.cos(yaw), math.sin(yaw)
        x, y = (self.spots @ np.array([[c, s], [-s, c]])).T
        vx, vy = motion[0] - motion[2] * y, motion[1] + motion[2] * x
        per_speed = -self.rubs / np.maximum(np.hypot(vx, vy), 1e-300)
        fx, fy = per_speed * vx, per_speed * vy
        total = np.array([fx.sum(), fy.sum(), (x * fy - y * fx).sum()]) + load
        change: Array = total / np.array([self.mass, self.mass, self.inertia])
        return change

    def slide(
        self, yaw: float, motion: Array, shove: Array | None = None, duration: float = 0.0
    ) -> tuple[Array, float]:
        """Returns how far the centre of mass goes, (2,) m, and how far the body turns, rad, until it rests.

        It starts with `motion` (vx m/s, vy m/s, spin rad/s). A shove (fx N, fy N, moment N m) strong enough to move it
        may act for a `duration` in s first. Heun's method, with steps that shrink with the speed.
        """
        place, turned, fastest = np.zeros(2), 0.0, 0.0
        motion = np.array(motion, dtype=float)
        arm = math.sqrt(self.inertia / self.mass)
        braking = self.rubs.sum() / self.mass
        pushes = 0 if shove is None else 2 * STEPS
        while True:
            speed = math.hypot(motion[0], motion[1], arm * motion[2])
            fastest = max(fastest, speed)
            if pushes <= 0 and speed <= AT_REST * fastest:
                return place, turned
            load, step = np.zeros(3), max(speed, 0.02 * fastest) / braking / STEPS
            if shove is not None and pushes > 0:
                load, step = shove, duration / (2 * STEPS)
            # Before it moves, friction acts against the way in which it will.
            ahead = motion if speed > 0 else load / [1, 1, arm**2]
            first = self.acceleration(yaw + turned, ahead, load)
            second = self.acceleration(yaw + turned + step * motion[2], motion + step * first, load)
            after = motion + step * (first + second) / 2
            mean = (motion + after) / 2
            place, turned, motion, pushes = place + step * mean[:2], turned + step * mean[2], after, pushes - 1


def shares(spots: Array, areas: Array) -> Array:
    """Returns which share of the weight each (n, 2) m spot carries, (n,), so that no moment is left about the origin.

    The table cannot pull: where the affine pressure would, it is 0, and the rest presses the harder.
    """
    plane = np.column_stack([np.ones(len(spots)), spots])
    pressed = np.ones(len(spots), dtype=bool)
    for _ in range(len(spots)):
        area = np.where(pressed, areas, 0.0)
        pressure = plane @ np.linalg.solve(plane.T @ (area[:, None] * plane), [1.0, 0.0, 0.0])
        if ((pressure > 0) == pressed).all():
            break
        pressed = pressure > 0
    return np.asarray(area * pressure)
