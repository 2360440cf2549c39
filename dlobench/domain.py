"""Describes one world: the physical parameters of the paper's section 2.2, and how they are sampled.

A `Domain` is what a model never sees. Everything here is SI: metres, kilograms, newtons, radians.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np

from dlobench import ranges
from dlobench.errors import UsageError

Material = Literal["soft", "flexible", "elastoplastic"]
Attachment = Literal["none", "movable", "fixed"]

MATERIALS: tuple[Material, ...] = get_args(Material)
ATTACHMENTS: tuple[Attachment, ...] = get_args(Attachment)

SEGMENT_LENGTH = 0.005  # m
MAX_SEGMENTS = 32
MAX_BODIES = 3
MAX_BOXES = 5  # boxes of the largest rigid shape
BOX_SIZE = 0.015  # m, the edge of every box
DLO_RADIUS = 0.0024  # m
PUSHER_RADIUS = 0.0075  # m
WORKSPACE = 0.25  # m, the edge of the square between the walls
GRAVITY = 9.81  # m/s²

LENGTHS = tuple(c / 100 for c in range(10, 17))  # m, whole centimetres
SURFACE_FRICTION = (0.2, 0.8)
BODY_FRICTION = (0.2, 0.8)
DLO_DENSITY = (700.0, 1400.0)  # kg/m³
BOX_DENSITY = (1200.0, 8000.0)  # kg/m³

# Bending stiffness EI in N m² and yield curvature in 1/m; docs/adr/0003 says why these.
STIFFNESS: dict[Material, tuple[float, float]] = {
    "soft": (3e-7, 3e-6),
    "flexible": (3e-5, 2e-4),
    "elastoplastic": (5e-5, 2e-4),
}
YIELD_CURVATURE = (0.5, 2.0)

# Cells of the box grid that each shape occupies (paper, Fig. 5): three bars, six L and T composites.
SHAPES: dict[str, tuple[tuple[int, int], ...]] = {
    "bar2": ((0, 0), (1, 0)),
    "bar3": ((0, 0), (1, 0), (2, 0)),
    "bar4": ((0, 0), (1, 0), (2, 0), (3, 0)),
    "L3": ((0, 0), (1, 0), (0, 1)),
    "L4": ((0, 0), (1, 0), (2, 0), (0, 1)),
    "J4": ((0, 0), (1, 0), (2, 0), (2, 1)),
    "L5": ((0, 0), (1, 0), (2, 0), (0, 1), (0, 2)),
    "T4": ((0, 0), (1, 0), (2, 0), (1, 1)),
    "T5": ((0, 0), (1, 0), (2, 0), (1, 1), (1, 2)),
}


def _whole_centimetres(length: object) -> float:
    """Returns the length of `LENGTHS` that is meant, m."""
    for whole in LENGTHS:
        if isinstance(length, float | np.floating) and math.isclose(length, whole, abs_tol=1e-9):
            return whole
    raise UsageError(f"length = {ranges.shown(length)} m is not a whole centimetre from 0.10 to 0.16 m")


def _set(frozen: object, **values: object) -> None:
    """Writes checked values into a frozen dataclass that is being made, each in the type that its field promises."""
    for name, value in values.items():
        object.__setattr__(frozen, name, value)


@dataclass(frozen=True)
class RigidBody:
    """Describes one composite body of boxes (paper, section 2.2 and Fig. 5).

    Raises `UsageError` for an unknown shape, a wrong number of densities or a value outside its range.
    """

    shape: str  # a key of SHAPES
    densities: tuple[float, ...]  # kg/m³, one a box, in the order of SHAPES[shape]
    friction: float

    def __post_init__(self) -> None:
        ranges.choice("shape", self.shape, tuple(SHAPES))
        boxes = len(SHAPES[self.shape])
        if not isinstance(self.densities, tuple | list):
            given = ranges.shown(self.densities)
            raise UsageError(f"densities = {given} is not one number a box, {boxes} for {self.shape!r}")
        if len(self.densities) != boxes:
            raise UsageError(f"densities holds {len(self.densities)} values, shape {self.shape!r} has {boxes} boxes")
        densities = tuple(ranges.number("box density", density, *BOX_DENSITY, "kg/m³") for density in self.densities)
        friction = ranges.number("body friction", self.friction, *BODY_FRICTION)
        _set(self, densities=densities, friction=friction)

    def boxes(self) -> np.ndarray:
        """Returns the boxes about the centroid of the shape: (boxes, 5) x m, y m, yaw rad, half sizes m."""
        cells = np.asarray(SHAPES[self.shape], dtype=float)
        out = np.zeros((len(cells), 5))
        out[:, :2] = (cells - cells.mean(axis=0)) * BOX_SIZE
        out[:, 3:] = BOX_SIZE / 2
        return out


@dataclass(frozen=True)
class Domain:
    """Describes the physical parameters of one world (paper, section 2.2).

    Raises `UsageError`, naming field, value and range, for anything outside the documented ranges.

    Examples:
        >>> rope = typical(material="soft", attachment="none", length=0.10, rigid_objects=0)
        >>> rope.segments, rope.surface_friction, rope.yield_curvature
        (20, 0.5, None)
        >>> Domain.from_json({**rope.to_json(), "density": 100.0})
        Traceback (most recent call last):
        dlobench.errors.UsageError: density = 100.0 is outside 700–1400 kg/m³

    """

    surface_friction: float
    length: float  # m, whole centimetres
    density: float  # kg/m³
    material: Material
    bending_stiffness: float  # EI, N m²
    yield_curvature: float | None  # 1/m; None never yields
    attachment: Attachment
    bodies: tuple[RigidBody, ...] = ()

    def __post_init__(self) -> None:
        ranges.choice("material", self.material, MATERIALS)
        ranges.choice("attachment", self.attachment, ATTACHMENTS)
        if (self.yield_curvature is not None) != (self.material == "elastoplastic"):
            given = ranges.shown(self.yield_curvature)
            raise UsageError(f"yield_curvature = {given} does not go with material {self.material!r}")
        if not isinstance(self.bodies, tuple | list) or not all(isinstance(body, RigidBody) for body in self.bodies):
            given = ranges.shown(self.bodies)
            raise UsageError(f"bodies = {given} is not a tuple of rigid bodies, at most {MAX_BODIES}")
        if len(self.bodies) > MAX_BODIES:
            raise UsageError(f"bodies holds {len(self.bodies)} rigid bodies, at most {MAX_BODIES} are possible")
        bending = f"bending_stiffness of {self.material}"
        _set(
            self,
            surface_friction=ranges.number("surface_friction", self.surface_friction, *SURFACE_FRICTION),
            length=_whole_centimetres(self.length),
            density=ranges.number("density", self.density, *DLO_DENSITY, "kg/m³"),
            bending_stiffness=ranges.number(bending, self.bending_stiffness, *STIFFNESS[self.material], "N m²"),
            bodies=tuple(self.bodies),
        )
        if self.yield_curvature is not None:
            _set(self, yield_curvature=ranges.number("yield_curvature", self.yield_curvature, *YIELD_CURVATURE, "1/m"))

    @property
    def segments(self) -> int:
        """Returns the number of 5 mm segments, 20 to 32."""
        return round(self.length / SEGMENT_LENGTH)

    def to_json(self) -> dict[str, Any]:
        """Returns the fields as JSON values; `from_json` reads them back exactly."""
        bodies = [{**asdict(body), "densities": list(body.densities)} for body in self.bodies]
        return {**asdict(self), "bodies": bodies}

    @staticmethod
    def from_json(given: object) -> Domain:
        """Builds a domain from what `to_json` wrote; raises `UsageError` on a missing, unknown or bad field."""
        values = ranges.members("domain", Domain, given)
        bodies = values["bodies"]
        if isinstance(bodies, list):
            bodies = [RigidBody(**ranges.members("rigid body", RigidBody, body)) for body in bodies]
        return Domain(**{**values, "bodies": bodies})


TYPICAL_SHAPES = ("bar3", "L4", "T4")  # of the bodies of a typical domain, in this order


def typical(*, material: Material, attachment: Attachment, length: float, rigid_objects: int) -> Domain:
    """Returns the domain in the middle of what `sample` draws from: the geometric middle of stiffness and yield.

    `length` is in m. Raises `UsageError` for a cell outside the documented ranges.
    """
    ranges.choice("material", material, MATERIALS)
    count = ranges.whole("rigid_objects", rigid_objects, 0, MAX_BODIES)

    def middle(low: float, high: float) -> float:
        return (low + high) / 2

    def geometric(low: float, high: float) -> float:
        return math.sqrt(low * high)

    return Domain(
        surface_friction=middle(*SURFACE_FRICTION),
        length=length,
        density=middle(*DLO_DENSITY),
        material=material,
        bending_stiffness=geometric(*STIFFNESS[material]),
        yield_curvature=geometric(*YIELD_CURVATURE) if material == "elastoplastic" else None,
        attachment=attachment,
        bodies=tuple(
            RigidBody(shape, (middle(*BOX_DENSITY),) * len(SHAPES[shape]), middle(*BODY_FRICTION))
            for shape in TYPICAL_SHAPES[:count]
        ),
    )


def sample_body(rng: np.random.Generator) -> RigidBody:
    """Samples a shape, one density a box and a friction coefficient, each uniformly."""
    shape = str(rng.choice(list(SHAPES)))
    densities = rng.uniform(*BOX_DENSITY, size=len(SHAPES[shape]))
    return RigidBody(shape, tuple(float(d) for d in densities), float(rng.uniform(*BODY_FRICTION)))


def sample(
    rng: np.random.Generator, *, material: Material, attachment: Attachment, length: float, rigid_objects: int
) -> Domain:
    """Samples the parameters that a cell leaves open: uniformly, stiffness and yield curvature log-uniformly.

    `length` is in m. Raises `UsageError` for a cell outside the documented ranges.

    Examples:
        >>> cell = {"material": "flexible", "attachment": "fixed", "length": 0.16, "rigid_objects": 2}
        >>> one, other = (sample(np.random.default_rng(seed), **cell) for seed in (0, 1))
        >>> one.attachment == other.attachment, one.density == other.density, len(one.bodies)
        (True, False, 2)

    """
    ranges.choice("material", material, MATERIALS)
    ranges.choice("attachment", attachment, ATTACHMENTS)
    length = _whole_centimetres(length)
    rigid_objects = ranges.whole("rigid_objects", rigid_objects, 0, MAX_BODIES)

    def log_uniform(low: float, high: float) -> float:
        # math, not numpy: a definition must be the same to the last bit whatever vector instructions a CPU has
        return min(max(math.exp(rng.uniform(math.log(low), math.log(high))), low), high)

    surface_friction = float(rng.uniform(*SURFACE_FRICTION))
    density = float(rng.uniform(*DLO_DENSITY))
    stiffness = log_uniform(*STIFFNESS[material])
    yield_curvature = log_uniform(*YIELD_CURVATURE)  # drawn for every material, so that the stream stays aligned
    return Domain(
        surface_friction=surface_friction,
        length=length,
        density=density,
        material=material,
        bending_stiffness=stiffness,
        yield_curvature=yield_curvature if material == "elastoplastic" else None,
        attachment=attachment,
        bodies=tuple(sample_body(rng) for _ in range(rigid_objects)),
    )
