"""Takes the shipped scene's DLO off the table, to be held against beam theory.

What is changed in the scene: no gravity, no contact, no sleep, and which of the engine's solvers is named (see `Rod`).
What is added: forces on the DLO's end, and a testing machine that bends the whole DLO.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import DLO_RADIUS, SEGMENT_LENGTH, Attachment, Domain, Material
from dlobench.errors import RunError
from dlobench.world import scene

Array = NDArray[np.float64]

GRIP = 1.0  # N m/rad, the testing machine; a whole DLO has 2e-6 to 2e-3
PATIENCE = 200  # looks at whether a rod has settled
FREE_SPACE = "gravity, contact and sleep off"  # in the note of every row


def specimen(
    material: Material, stiffness: float, length: float, attachment: Attachment, yield_curvature: float | None = None
) -> Domain:
    """Returns a domain of ordinary density without bodies; stiffness EI in N m², length in m, curvature in 1/m."""
    return Domain(
        surface_friction=0.5,
        length=length,
        density=1000.0,
        material=material,
        bending_stiffness=stiffness,
        yield_curvature=yield_curvature,
        attachment=attachment,
    )


class Rod:
    """Holds a domain's DLO in free space, with the shipped options and time step unless told otherwise.

    MuJoCo 4.0.0's Newton and CG take generalised forces below 3e-8 N m for none as long as nothing touches: 1 % of what
    bends the softest DLO. `heedful` names PGS instead, which heeds them; without contacts no solver has anything else
    to do. PGS leaves servos out of the implicit step, so the testing machine wants the shipped solver.
    """

    def __init__(self, domain: Domain, timestep: float = scene.TIMESTEP, *, heedful: bool = False) -> None:
        mujoco.set_mju_user_warning(scene.quiet)
        self.length = domain.length  # m
        self.stiffness = domain.bending_stiffness  # EI, N m²
        self.mass = domain.density * math.pi * DLO_RADIUS**2  # kg/m
        hinges = np.arange(0 if domain.attachment != "none" else 1, domain.segments)
        # (hinges,) m: how much of the DLO each hinge bends for, and how far it is from the first end
        self.span: Array = SEGMENT_LENGTH * np.where(hinges == 0, 0.5, 1.0)
        self.arc: Array = SEGMENT_LENGTH * hinges.astype(np.float64)
        spec = scene.spec(domain, timestep)
        spec.option.gravity = [0, 0, 0]
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        if heedful:
            spec.option.solver = mujoco.mjtSolver.mjSOL_PGS
        names = [f"bend{i}" for i in hinges]
        _add_loads(spec, f"segment{domain.segments - 1}")
        _add_machine(spec, names)
        self.model = scene.compile(spec)
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name).id for name in names]
        self._qpos, self._dof = self.model.jnt_qposadr[joints], self.model.jnt_dofadr[joints]
        self._hinge_stiffness = self.model.jnt_stiffness[joints].copy()
        self._loads = [self.model.actuator_ctrladr[self.model.actuator(f"load_{axis}").id] for axis in "xy"]
        self._machine = self.model.actuator("machine").id
        self._set_point = self.model.actuator_ctrladr[self._machine]
        mujoco.mj_kinematics(self.model, self.data)
        self._end = self.data.site("end").xpos[:2].copy()

    @property
    def timestep(self) -> float:
        """Returns the length of a step, s."""
        return float(self.model.opt.timestep)

    @property
    def angles(self) -> Array:
        """Returns the (hinges,) joint angles, rad."""
        return np.array(self.data.qpos[self._qpos])

    @property
    def end(self) -> Array:
        """Returns how far the end is from where the straight DLO's was: (2,) m."""
        mujoco.mj_kinematics(self.model, self.data)
        return np.array(self.data.site("end").xpos[:2] - self._end)

    @property
    def bend(self) -> float:
        """Returns by how much the DLO's ends are turned against each other, rad."""
        return float(self.angles.sum())

    @property
    def moment(self) -> float:
        """Returns the bending moment that the testing machine applies, N m.

        It is read off the machine's spring: the engine reports a servo's force as it was at the beginning of the step.
        """
        spring = float(self.model.actuator_gainprm[self._machine, 0])
        return spring * (float(self.data.ctrl[self._set_point]) - self.bend)

    def place(self, angles: Array) -> None:
        """Bends the DLO to (hinges,) rad, at rest; its relaxed shape stays what it was."""
        self.data.qpos[self._qpos] = angles
        self.data.qvel[:] = 0

    def damp(self, seconds: float) -> None:
        """Sets the hinges' damping to their stiffness times a time, s; statics do not depend on it."""
        self.model.dof_damping[self._dof] = self._hinge_stiffness * seconds

    def load(self, x: float, y: float) -> None:
        """Applies a force to the end, N, along the world's axes whichever way the DLO turns."""
        self.data.ctrl[self._loads] = x, y

    def grip(self, share: float, angle: float) -> None:
        """Lets the machine turn the DLO's ends against each other by `angle`, rad, holding on with a share of its grip.

        It applies the same moment to every hinge and cares for the sum of their angles alone, as two end couples do.
        """
        self.model.actuator_gainprm[self._machine, 0] = share * GRIP
        self.model.actuator_biasprm[self._machine, 1] = -share * GRIP
        self.data.ctrl[self._set_point] = angle

    def step(self, steps: int = 1) -> None:
        """Advances by whole steps."""
        mujoco.mj_step(self.model, self.data, steps)

    def run(self, seconds: float) -> None:
        """Advances by about `seconds`, at least one step."""
        self.step(max(1, round(seconds / self.timestep)))

    def settle(self, seconds: float, still: float) -> None:
        """Runs until no hinge moves by more than `still`, rad, in so many seconds.

        Raises `RunError` if that never comes.
        """
        before = self.angles
        for _ in range(PATIENCE):
            self.run(seconds)
            now = self.angles
            if float(np.abs(now - before).max()) <= still:
                return
            before = now
        raise RunError(f"a DLO of EI = {self.stiffness:g} N m² did not come to rest within {PATIENCE * seconds:g} s")


def _add_loads(spec: mujoco.MjSpec, last: str) -> None:
    """Adds a force along x and one along y on the free end of the last segment."""
    spec.body(last).add_site(name="end", pos=[SEGMENT_LENGTH / 2, 0, 0])
    spec.worldbody.add_site(name="axes")
    for axis, gear in (("x", [1, 0, 0, 0, 0, 0]), ("y", [0, 1, 0, 0, 0, 0])):
        motor = spec.add_actuator(
            name=f"load_{axis}", target="end", refsite="axes", trntype=mujoco.mjtTrn.mjTRN_SITE, gear=gear
        )
        motor.set_to_motor()


def _add_machine(spec: mujoco.MjSpec, hinges: list[str]) -> None:
    """Adds a servo on the sum of the hinges' angles, its grip open."""
    total = spec.add_tendon(name="total_bend")
    for hinge in hinges:
        total.wrap_joint(hinge, 1.0)
    servo = spec.add_actuator(name="machine", target="total_bend", trntype=mujoco.mjtTrn.mjTRN_TENDON)
    servo.set_to_position(kp=GRIP)
    servo.gainprm[0] = servo.biasprm[1] = 0.0
