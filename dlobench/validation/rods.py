"""Builds the peer whose DLO is MuJoCo's own rod: a 1D flex, discrete elastic rods with a twist angle an edge.

The flex is what `flexcomp` would write: a point mass at every joint of our chain, inextensible edges (`equality`), a
hinge an edge for its twist. Bending stiffness is Young's modulus times π r⁴/4; Rayleigh damping is a time, the
stiffness it scales is the rod's, so that it equals joint damping over joint stiffness. The rest shape is the compiled
one, so that each start is a model of its own.

Further settings come from trials over domains of three objects (pushes/s of one core, beside other work). MuJoCo's
default edges (time constant 20 ms, impedance 0.9) stretched by 98 % and made 14, its default contacts let the pusher
sink in by 6 mm and made 28. So all has a time constant of two steps here, solids an impedance of 0.99–0.999 and edges
one of 0.999–0.9999: 27. Damped twist hinges keep it from rolling; rolling friction (condim 6) does so as well, and made
25. Pyramids were as fast, but a squeezed rod rose from the table by 36 mm; no sleep 23; no islands 23; conjugate
gradients 6; dense matrices 7. Without twist hinges nothing rolls, but flexible rods rose and MuJoCo warned of singular
inertias.

Known of MuJoCo 4.0: while a joint passes through straight, bending is hardly damped, unless it does so in one step. A
free rod without friction swung back a fifth too far at 0.5 ms, as it should at 2 ms.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from dlobench.domain import DLO_RADIUS, SEGMENT_LENGTH, Domain
from dlobench.validation.peers import DLO_MEETS, TIMESTEP, Array, Peer, Read, resist_rolling, surroundings
from dlobench.world import contact
from dlobench.world.chain import CYLINDER_RADIUS, DAMPING_TIME
from dlobench.world.starts import Start, chain

_STUB = SEGMENT_LENGTH / 1000  # m, the clamped edge: so short that its vertex has half a segment to bend over
_TWIST_DAMPING = 1e-3  # N m s: friction on the table makes an edge roll by micrometres a second
_SOLID_SOLIMP, _EDGE_SOLIMP = (0.99, 0.999, 0.001), (0.999, 0.9999, 0.001)


def make(
    domain: Domain, start: Start, timestep: float = TIMESTEP, sleep: bool = True, rolling_friction: bool = False
) -> Peer:
    """Makes the peer at a start, settled."""
    return Peer(domain, start, spec(domain, start, timestep, sleep, rolling_friction), _reader(domain))


def spec(
    domain: Domain, start: Start, timestep: float = TIMESTEP, sleep: bool = True, rolling_friction: bool = False
) -> mujoco.MjSpec:
    """Returns the scene at a start as an editable specification.

    Friction acts a radius below the rod's axis, and its moment shifts weight along the rod where it changes direction.
    `rolling_friction` takes up that moment, as a planar world does; it takes a tenth more time.
    """
    out = surroundings(domain, start, timestep, sleep)
    if rolling_friction:
        resist_rolling(out)
    out.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    flex = _add_flex(out, domain, start)
    edges = out.add_equality(name="edges", type=mujoco.mjtEq.mjEQ_FLEX, objtype=mujoco.mjtObj.mjOBJ_FLEX, name1="dlo")
    for part in (flex, edges, *out.geoms, *out.pairs):
        part.solref[:2] = 2 * timestep, 1
    for solid in (flex, *(geom for geom in out.geoms if geom.name != "table")):
        solid.solimp[:3] = _SOLID_SOLIMP
    edges.solimp[:3] = _EDGE_SOLIMP
    return out


def _add_flex(out: mujoco.MjSpec, domain: Domain, start: Start) -> mujoco.MjsFlex:
    """Adds the vertices, the flex over them and the hinges of its twist.

    An attached rod begins with two vertices on the cylinder, which clamp it.
    """
    places = np.pad(chain(domain, start), ((0, 0), (0, 1)), constant_values=DLO_RADIUS)
    mass = domain.density * math.pi * DLO_RADIUS**2 * SEGMENT_LENGTH
    clamped = domain.attachment != "none"
    names, local = [f"vertex{i}" for i in range(len(places))], np.zeros_like(places)
    for i, (name, place) in enumerate(zip(names, places, strict=True)):
        if clamped and i == 0:
            continue
        body = out.worldbody.add_body(name=name, pos=place)
        _weigh(body, mass / 2 if i in {0, domain.segments} else mass, DLO_RADIUS)
        for axis in np.eye(3):
            body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    if clamped:
        root = np.array([CYLINDER_RADIUS, 0, DLO_RADIUS])
        names = ["cylinder", "cylinder", *names[1:]]
        local = np.concatenate([[root - [_STUB, 0, 0], root], local[1:]])
    edges = len(names) - 1
    flex = out.add_flex(
        name="dlo",
        dim=1,
        radius=DLO_RADIUS,
        young=domain.bending_stiffness / (math.pi / 4 * DLO_RADIUS**4),
        damping=DAMPING_TIME[domain.material],
        contype=contact.DLO,
        conaffinity=DLO_MEETS,
        condim=3,
        friction=[contact.friction_table(domain)["dlo-dlo"], 0, 0],
        selfcollide=mujoco.mjtFlexSelf.mjFLEXSELF_AUTO,
    )
    flex.vertbody, flex.vert = names, local.ravel()
    flex.elem = np.stack([np.arange(edges), np.arange(edges) + 1], axis=1).ravel()
    for i in range(1 if clamped else 0, edges):  # MuJoCo finds them by these names
        name = "dlo_twist" if i == edges - 1 else f"dlo_twist_{i}"
        body = out.worldbody.add_body(name=name)
        _weigh(body, 1e-9, math.sqrt(mass * DLO_RADIUS**2 / 2 / 1e-9))
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[1, 0, 0], damping=_TWIST_DAMPING)
    return flex


def _weigh(body: mujoco.MjsBody, mass: float, gyration: float) -> None:
    """Gives a body without geometry its mass (kg) and radius of gyration (m)."""
    body.explicitinertial = True
    body.mass, body.inertia = mass, [mass * gyration**2] * 3


def _reader(domain: Domain) -> Read:
    def dlo(data: mujoco.MjData) -> Array:
        """Returns the midpoint and direction of every edge: (segments, 3) x m, y m, yaw rad."""
        places = data.flexvert_xpos[-domain.segments - 1 :, :2]
        steps = np.diff(places, axis=0)
        yaws = np.arctan2(steps[:, 1], steps[:, 0])
        return np.concatenate([(places[1:] + places[:-1]) / 2, yaws[:, None]], axis=1)

    return dlo
