# SPDX-License-Identifier: Apache-2.0
"""The arm that `blind_check` records: rigid bodies, springs, gaps and cables in MuJoCo.

Every joint is driven through a spring: a servo whose stiffness is the joint's pulls the link after
the reference that `joint_states` reports. A delta's platform hangs free on six elastic rods from
three carriages, so that its stiffness follows from the rods and is written down nowhere. Drives
compensate the weight of all links, as nominal has no deflection without a push.

A robot description has no stiffnesses: its joints are rigid, here 1e7 N.m/rad. The tip of an arm of
0.8 m then gives 1 um under 10 N, a thirtieth of the tracker's noise. A spring that is stiff for the
time step gets a rotor of STEP_S^2 stiffness (10 kg.m^2 there, as of a geared motor), whose own
acceleration the drive feeds forward.

    reading = force and torque between sensor and adapter - (1 - share) inertial forces

Nominal knows no inertial forces: the sensor subtracts those of the rigid load by its own
accelerometer, all but the `share` that the effect `inertial_load` leaves in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError
from scipy.spatial.transform import Rotation

STEP_S = 1e-3
_SETTLE_S = 0.5
_CHUNK = 20_000
_LINK_KG, _CARRIAGE_KG, _PLATFORM_KG = 0.15, 3.0, 5.0
_ROTOR_KG_M2 = 0.004
_TURN_DAMPING = 3.0
"""Of the platform, which no motion turns: against the sway of the whole arm, N.m.s/rad.

Over its stiffness of 5e3 N.m/rad it delays the deflection by 0.6 ms, less than a tolerance.
"""
RIGID = 1e7
"""Stiffness of a joint that is called rigid, N.m/rad or N/m."""
_BEARING = 1e5
DECAY = 20.0
"""Damping over moved mass, 1/s: vibrations fall to 1/e in 0.1 s, as of a metal structure.

MuJoCo's sensors show the acceleration before the implicit step, which is larger than the true one
by 1 + STEP_S DECAY: 2 % of the inertial forces.
"""
_HARD = [2.0 * STEP_S, 1.0]
_GEAR_KG_M2 = 0.3
_HARD_IMPEDANCE = [0.9999, 0.9999, 1e-5, 0.5, 2.0]
_STOP_IMPEDANCE = [0.99, 0.99, 1e-5, 0.5, 2.0]
"""Of an inner mass, which gives 6 um under its weight: harder stops chatter without any play."""


@dataclass(frozen=True)
class Body:
    """A rigid body: mass (kg), centre (3,) in ft_sensor (m), inertia (3, 3) about it (kg.m^2)."""

    mass_kg: float
    com_m: Array
    inertia_kg_m2: Array


@dataclass(frozen=True)
class Gap:
    """Play of a joint behind its spring: rad; soft N.m/rad; friction N.m where it crosses."""

    joint: str
    range_rad: float
    soft: float = 0.0
    friction: float = 0.0


@dataclass(frozen=True)
class InnerMass:
    """A part of the tool's mass that moves in it: free within range_m (3,), on springs (N/m).

    mass_kg of the tool's own; damping N.s/m.
    """

    mass_kg: float
    range_m: tuple[float, float, float]
    stiffness: float = 0.0
    damping: float = 0.05


@dataclass(frozen=True)
class Cable:
    """A cable from an anchor in base_link to the tool: two elastic spans and a mass between them.

    anchor_m (3,) in base_link, attachment_m (3,) in ft_sensor; stiffness N/m, length_m of both
    spans without load, friction N at the guide.
    """

    anchor_m: tuple[float, float, float]
    attachment_m: tuple[float, float, float]
    stiffness: float
    length_m: float
    mass_kg: float
    friction: float


@dataclass(frozen=True)
class Pull:
    """A force on the tool at at_m (3,) in ft_sensor, by where that point is.

    force: N (n, 3) of its places (n, 3), m, both in base_link.
    """

    at_m: Array
    force: Callable[[Array], Array]


@dataclass(frozen=True)
class Slider:
    """A spring in series with dry friction, beside a joint's own: N.m/rad and N.m."""

    joint: str
    stiffness: float
    friction: float


@dataclass(frozen=True)
class Stribeck:
    """Friction of a joint that falls with its speed from static to Coulomb's, N.m; fall rad/s."""

    joint: str
    static: float
    coulomb: float
    fall: float


@dataclass(frozen=True)
class Wobble:
    """An axis that tilts twice a turn: by size_rad sin(2 q + phase) about one across it."""

    joint: str
    size_rad: float
    phase: float


@dataclass(frozen=True)
class Plant:
    """One arm as it is; the defaults are nominal.

    rods_m (6,): by how much each rod of a delta is longer; rod_friction_n (6,) along each. zero,
    gain (n,): true joints are (1 + gain) reported + zero. friction: N.m by joint. weight: share of
    the links' weight that no drive compensates. inertial: share of the inertial forces that stays
    in the reading.
    """

    tool: Body
    adapter: Body
    tip_m: Array
    arm: Arm
    rods_m: Array = field(default_factory=lambda: np.zeros(6))
    zero: Array = field(default_factory=lambda: np.zeros(len(GALEN.joints)))
    gain: Array = field(default_factory=lambda: np.zeros(len(GALEN.joints)))
    rod_friction_n: Array = field(default_factory=lambda: np.zeros(6))
    gap: Gap | None = None
    friction: Mapping[str, float] = field(default_factory=dict)
    stribeck: Stribeck | None = None
    sliders: tuple[Slider, ...] = ()
    wobble: Wobble | None = None
    pull: Pull | None = None
    inner: InnerMass | None = None
    cable: Cable | None = None
    weight: float = 0.0
    inertial: float = 0.0


class Trace(NamedTuple):
    """What an arm did: times (n,) s; wrench (n, 6) on the sensor, N and N.m in ft_sensor.

    rotation (n, 3, 3) R_base_tip and position (n, 3) of the tip, m; tension (n,) of a cable, or
    size of a pull, N.
    """

    at_s: Array
    wrench: Array
    rotation: Array
    position: Array
    tension: Array


def require_mujoco() -> Any:
    """Import MuJoCo; raises GalenError where it is not installed."""
    try:
        import mujoco
        import mujoco.rollout
    except ImportError as error:
        raise GalenError(
            "the blind arm needs MuJoCo: pip install -r requirements/dev.txt"
        ) from error
    # Its own handler writes a file into the working directory; `_rollout` reports instability.
    mujoco.set_mju_user_warning(lambda text: None)
    return mujoco


class MujocoArm:
    """A plant in MuJoCo."""

    def __init__(self, plant: Plant, nominal: Arm) -> None:
        """Build the model; nominal: the arm that the drives' kinematics believe in."""
        self.plant = plant
        self._nominal = nominal
        self._mj = require_mujoco()
        self._spec = self._mj.MjSpec()
        self._carried = 1.0 - plant.weight
        self._stiffness: list[float] = []
        self._build()
        self._model = self._spec.compile()
        self._damping = self._damp()

    # The model

    def _build(self) -> None:
        mj, spec, plant = self._mj, self._spec, self.plant
        spec.compiler.degree = False
        spec.option.timestep = STEP_S
        spec.option.integrator = mj.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.gravity = np.asarray(plant.arm.gravity_m_s2)
        spec.option.disableflags |= mj.mjtDisableBit.mjDSBL_CONTACT
        link = spec.worldbody
        first = 0
        if plant.arm.delta is not None:
            link, first = self._platform(), 3
        for joint in plant.arm.joints[first:]:
            link = self._link(link, joint)
        if plant.wobble is not None:
            self._drive("wobble", _BEARING)
        for number, slider in enumerate(plant.sliders):
            self._slider(f"slider{number}", slider)
        self._load(link)

    def _body(self, parent: Any, name: str, kg: float, size_m: float, **place: Any) -> Any:
        inertia = kg * size_m**2 * np.ones(3)
        return parent.add_body(
            name=name, mass=kg, ipos=np.zeros(3), inertia=inertia, explicitinertial=True,
            gravcomp=1.0 - self.plant.weight, **place,
        )  # fmt: skip

    def _platform(self) -> Any:
        """Three driven carriages, and the platform that six rods hold on them."""
        mj, delta = self._mj, self.plant.arm.delta
        assert delta is not None
        platform = self._body(self._spec.worldbody, "platform", _PLATFORM_KG, 0.1)
        for axis in np.eye(3):
            platform.add_joint(type=mj.mjtJoint.mjJNT_SLIDE, axis=axis)
        platform.add_joint(type=mj.mjtJoint.mjJNT_BALL, damping=[_TURN_DAMPING, 0.0, 0.0])
        for leg, foot in enumerate(delta.feet_m):
            name = f"carriage{leg}"
            carriage = self._body(self._spec.worldbody, name, _CARRIAGE_KG, 0.05, pos=[*foot, 0.0])
            carriage.add_joint(
                name=name, type=mj.mjtJoint.mjJNT_SLIDE, axis=[0.0, 0.0, 1.0],
                frictionloss=self.plant.friction.get("carriage", 0.0),
                solref_friction=_HARD, solimp_friction=_HARD_IMPEDANCE,
            )  # fmt: skip
            self._drive(name, delta.carriage_stiffness)
            for rod in (2 * leg, 2 * leg + 1):
                ball = delta.ball_joints_m[rod]
                carriage.add_site(name=f"foot{rod}", pos=ball)
                platform.add_site(name=f"ball{rod}", pos=ball)
                length = delta.rod_length_m + self.plant.rods_m[rod]
                damping = DECAY * _PLATFORM_KG
                self._span(
                    (f"foot{rod}", f"ball{rod}"), delta.rod_stiffness, length, damping,
                    friction=float(self.plant.rod_friction_n[rod]),
                )  # fmt: skip
        return platform

    def _link(self, parent: Any, joint: Any) -> Any:
        mj, plant = self._mj, self.plant
        place: dict[str, Any] = {"pos": joint.origin_m}
        if joint.rotation is not None:
            place["quat"] = _quaternion(joint.rotation)
        link = self._body(parent, joint.name, _LINK_KG, 0.06, **place)
        turns = joint.kind == "revolute"
        kind = mj.mjtJoint.mjJNT_HINGE if turns else mj.mjtJoint.mjJNT_SLIDE
        if plant.wobble is not None and plant.wobble.joint == joint.name:
            across = np.cross(joint.axis, np.eye(3)[np.argmin(np.abs(joint.axis))])
            link.add_joint(name="wobble", type=kind, axis=across, armature=STEP_S**2 * _BEARING)
        stiffness = min(joint.stiffness, RIGID)
        friction = plant.friction.get(joint.name, 0.0)
        if plant.stribeck is not None and plant.stribeck.joint == joint.name:
            friction = plant.stribeck.coulomb
        link.add_joint(
            name=joint.name, type=kind, axis=joint.axis,
            armature=max(_ROTOR_KG_M2 if turns else _LINK_KG, STEP_S**2 * stiffness),
            frictionloss=friction, solref_friction=_HARD, solimp_friction=_HARD_IMPEDANCE,
        )  # fmt: skip
        self._drive(joint.name, stiffness)
        gap = plant.gap
        if gap is not None and gap.joint == joint.name:
            half = 0.5 * gap.range_rad
            link.add_joint(
                name="gap", type=kind, axis=joint.axis, limited=1, range=[-half, half],
                stiffness=[gap.soft, 0.0, 0.0], damping=[0.2, 0.0, 0.0],
                # Its stops are as stiff as 1 / _HARD^2 of what turns; a gap that is nearly none has
                # a spring that is too stiff for the step.
                armature=max(_GEAR_KG_M2, STEP_S**2 * gap.soft),
                frictionloss=gap.friction, solref_limit=_HARD, solimp_limit=_HARD_IMPEDANCE,
                solref_friction=_HARD, solimp_friction=_HARD_IMPEDANCE,
            )  # fmt: skip
        return link

    def _drive(self, name: str, stiffness: float) -> None:
        """Servo with the spring's stiffness."""
        mj = self._mj
        drive = self._spec.add_actuator(
            name=name, target=name, trntype=mj.mjtTrn.mjTRN_JOINT,
            gaintype=mj.mjtGain.mjGAIN_FIXED, biastype=mj.mjtBias.mjBIAS_AFFINE,
        )  # fmt: skip
        drive.gainprm[0], drive.biasprm[1] = stiffness, -stiffness
        self._stiffness.append(stiffness)

    def _slider(self, name: str, slider: Slider) -> None:
        """Hang a mass with friction on a joint by a spring; it stands where the joint begins."""
        mj = self._mj
        mass = self._body(self._spec.worldbody, name, 1e-3, 0.01)
        mass.add_joint(
            name=name, type=mj.mjtJoint.mjJNT_HINGE, axis=[0.0, 0.0, 1.0],
            armature=4.0 * STEP_S**2 * slider.stiffness, frictionloss=slider.friction,
            solref_friction=_HARD, solimp_friction=_HARD_IMPEDANCE,
        )  # fmt: skip
        spring = self._spec.add_tendon(name=f"{name}_spring")
        spring.wrap_joint(slider.joint, 1.0)
        spring.wrap_joint(name, -1.0)
        spring.stiffness[0], spring.springlength = slider.stiffness, [0.0, 0.0]

    def _damp(self) -> Array:
        """Damp each servo by the mass that it moves at home; returns N.s/m, N.m.s/rad (drives,)."""
        model, data = self._model, self._mj.MjData(self._model)
        self._start(data, self._nominal.home, self._controls(self._nominal.home[None], None)[0])
        self._mj.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        self._mj.mj_fullM(model, data, mass)
        moved = np.diag(mass)[model.jnt_dofadr[model.actuator_trnid[:, 0]]]
        damping = DECAY * moved
        model.actuator_biasprm[:, 2] = -damping
        return np.asarray(damping)

    def _span(
        self, sites: tuple[str, str], stiffness: float, length: float, damping: float,
        slack: bool = False, friction: float = 0.0,
    ) -> None:  # fmt: skip
        span = self._spec.add_tendon(name="-".join(sites))
        for site in sites:
            span.wrap_site(site)
        span.stiffness[0], span.damping[0], span.frictionloss = stiffness, damping, friction
        span.springlength = [0.0 if slack else length, length]
        span.solref_friction, span.solimp_friction = _HARD, _HARD_IMPEDANCE

    def _load(self, link: Any) -> None:
        """Sensor, adapter, tool and tip; sensors at the end of the chain."""
        mj, plant = self._mj, self.plant
        adapter = self._rigid(
            link, "adapter", plant.adapter, pos=plant.arm.sensor_origin_m,
            quat=_quaternion(plant.arm.sensor_rotation),
        )  # fmt: skip
        adapter.add_site(name="sensor")
        tool = plant.tool
        if plant.inner is not None:
            tool = Body(tool.mass_kg - plant.inner.mass_kg, tool.com_m, tool.inertia_kg_m2)
        body = self._rigid(adapter, "tool", tool)
        # Its own weight moves the inner mass; the drives carry it where it hangs.
        body.gravcomp = self._carried * plant.tool.mass_kg / tool.mass_kg
        body.add_site(name="tip", pos=plant.tip_m)
        if plant.inner is not None:
            self._inner(body, plant.inner, tool.com_m)
        if plant.cable is not None:
            self._cable(body, plant.cable)
        for kind in ("FORCE", "TORQUE", "ACCELEROMETER", "GYRO", "FRAMEANGACC"):
            self._sense(kind, "sensor")
        self._sense("FRAMEQUAT", "sensor")
        self._sense("FRAMEPOS", "tip")
        self._sense("FRAMEQUAT", "tip")
        if plant.cable is not None:
            self._spec.add_sensor(
                type=mj.mjtSensor.mjSENS_TENDONPOS, objtype=mj.mjtObj.mjOBJ_TENDON,
                objname="lump-attachment",
            )  # fmt: skip
            self._sense("FRAMEPOS", "lump")
            self._sense("FRAMEPOS", "attachment")

    def _sense(self, kind: str, site: str) -> None:
        mj = self._mj
        self._spec.add_sensor(
            type=getattr(mj.mjtSensor, f"mjSENS_{kind}"), objtype=mj.mjtObj.mjOBJ_SITE,
            objname=site,
        )  # fmt: skip

    def _rigid(self, parent: Any, name: str, body: Body, **place: Any) -> Any:
        moments, axes = np.linalg.eigh(body.inertia_kg_m2)
        axes[:, 2] *= np.linalg.det(axes)
        return parent.add_body(
            name=name, mass=body.mass_kg, ipos=body.com_m, iquat=_quaternion(axes),
            inertia=moments, explicitinertial=True, gravcomp=self._carried, **place,
        )  # fmt: skip

    def _inner(self, tool: Any, inner: InnerMass, com_m: Array) -> None:
        """Slides along ft_sensor's axes, on springs between hard ends."""
        mass = self._body(tool, "inner", inner.mass_kg, 0.005, pos=com_m)
        mass.gravcomp = 0.0
        for axis, reach in zip(np.eye(3), inner.range_m, strict=True):
            if reach:
                mass.add_joint(
                    type=self._mj.mjtJoint.mjJNT_SLIDE, axis=axis, limited=1,
                    range=[-reach, reach], stiffness=[inner.stiffness, 0.0, 0.0],
                    damping=[inner.damping, 0.0, 0.0], armature=STEP_S**2 * inner.stiffness,
                    solref_limit=[8.0 * STEP_S, 1.0], solimp_limit=_STOP_IMPEDANCE,
                )  # fmt: skip

    def _cable(self, tool: Any, cable: Cable) -> None:
        self._spec.worldbody.add_site(name="anchor", pos=cable.anchor_m)
        tool.add_site(name="attachment", pos=cable.attachment_m)
        lump = self._spec.worldbody.add_body(
            name="lump", mass=cable.mass_kg, inertia=1e-6 * np.ones(3), explicitinertial=True
        )
        lump.add_site(name="lump")
        for axis in np.eye(3):
            lump.add_joint(
                type=self._mj.mjtJoint.mjJNT_SLIDE,
                axis=axis,
                damping=[4.0 * cable.mass_kg, 0.0, 0.0],
            )
        for sites, friction in (
            (("anchor", "lump"), cable.friction),
            (("lump", "attachment"), 0.0),
        ):
            damping = 0.2 * np.sqrt(cable.stiffness * cable.mass_kg)
            self._span(sites, 2.0 * cable.stiffness, 0.5 * cable.length_m, damping, True, friction)

    # Running it

    def run(self, at_s: Array, reported: Array, push: Array | None = None) -> Trace:
        """Drive along reported joints, from rest at the first ones.

        Args:
            at_s: Times, STEP_S apart, (n,), s.
            reported: Joints as the encoders report them, (n, k), rad or m.
            push: Wrench on the tool in ft_sensor about its origin, (n, 6), N and N.m; None for no
                contact.

        Returns:
            The trace at the same times.

        Raises:
            GalenError: The simulation became unstable.

        """
        true = reported * (1.0 + self.plant.gain) + self.plant.zero
        settle = round(_SETTLE_S / STEP_S)
        lead = [(settle, 0), (0, 0)]
        control = np.pad(self._controls(true, self._damping), lead, mode="edge")
        joint_forces = np.pad(self._seated(true) + self._rubbing(true), lead)
        control = np.concatenate([control, joint_forces], axis=1)
        applied = np.zeros((len(control), 0))
        spec = self._mj.mjtState.mjSTATE_CTRL | self._mj.mjtState.mjSTATE_QFRC_APPLIED
        size = np.zeros(len(true))
        if push is not None or self.plant.pull is not None:
            pulled = self._pulled(true)
            size = np.linalg.norm(pulled[:, :3], axis=1)
            if push is not None:
                pulled += self._in_base(true, push)
            applied = np.pad(pulled, lead, mode="edge")
            spec |= self._mj.mjtState.mjSTATE_XFRC_APPLIED
        rows = self._rollout(true[0], control, applied, spec)[settle:]
        trace = self._trace(at_s, rows)
        return trace if self.plant.cable is not None else trace._replace(tension=size)

    def _controls(self, true: Array, damping: Array | None) -> Array:
        """Servos' set points (n, drives): positions, velocities for the damping, accelerations."""
        wanted, plant = true, self.plant
        delta = self._nominal.delta
        if delta is not None:
            flat = true[:, None, :2] - delta.feet_m
            height = np.sqrt(delta.rod_length_m**2 - np.sum(flat**2, axis=-1))
            wanted = np.concatenate([true[:, 2:3] - height, true[:, 3:]], axis=1)
        if plant.wobble is not None:
            own = true[:, plant.arm.joint_names.index(plant.wobble.joint)]
            tilt = plant.wobble.size_rad * np.sin(2.0 * own + plant.wobble.phase)
            wanted = np.concatenate([wanted, tilt[:, None]], axis=1)
        if damping is None:
            return np.asarray(wanted)
        velocity = np.gradient(wanted, STEP_S, axis=0)
        stiffness = np.array(self._stiffness)
        rotor = np.maximum(STEP_S**2 - _ROTOR_KG_M2 / stiffness, 0.0)
        ahead = damping / stiffness * velocity + rotor * np.gradient(velocity, STEP_S, axis=0)
        return np.asarray(wanted + ahead)

    def _rubbing(self, true: Array) -> Array:
        """Generalized forces (n, nv): friction beyond Coulomb's, at the speed of the reference."""
        forces = np.zeros((len(true), self._model.nv))
        stribeck = self.plant.stribeck
        if stribeck is not None:
            number = self.plant.arm.joint_names.index(stribeck.joint)
            speed = np.gradient(true[:, number], STEP_S) / stribeck.fall
            beyond = (stribeck.static - stribeck.coulomb) * np.exp(-(speed**2))
            dof = self._model.jnt_dofadr[self._model.joint(stribeck.joint).id]
            forces[:, dof] = -beyond * np.tanh(20.0 * speed)
        return forces

    def _pulled(self, true: Array) -> Array:
        """Wrench (n, 6) of the pull in base_link's axes about the tool's centre of mass."""
        pull = self.plant.pull
        if pull is None:
            return np.zeros((len(true), 6))
        rotation, origin = self.plant.arm.sensor_pose(true)
        force = pull.force(origin + rotation @ pull.at_m)
        lever = rotation @ (pull.at_m - self.plant.tool.com_m)
        return np.concatenate([force, np.cross(lever, force)], axis=1)

    def _seated(self, true: Array) -> Array:
        """Generalized forces (n, nv): the load's weight on a gap, which drives carry elsewhere."""
        forces = np.zeros((len(true), self._model.nv))
        plant = self.plant
        if plant.gap is None:
            return forces
        arm = plant.arm
        origins, axes = arm.joint_axes(true)
        number = arm.joint_names.index(plant.gap.joint)
        rotation, place = arm.sensor_pose(true)
        dof = self._model.jnt_dofadr[self._model.joint("gap").id]
        for body in (plant.tool, plant.adapter):
            lever = place + rotation @ body.com_m - origins[:, number]
            moment = np.cross(lever, body.mass_kg * np.asarray(arm.gravity_m_s2))
            forces[:, dof] += np.sum(axes[:, number] * moment, axis=1)
        return forces

    def _in_base(self, true: Array, push: Array) -> Array:
        """Pushes (n, 6) in base_link's axes about the tool's centre of mass."""
        pushed = np.any(push != 0.0, axis=1)
        world = np.zeros_like(push)
        rotation, _ = self.plant.arm.sensor_pose(true[pushed])
        force, torque = push[pushed, :3], push[pushed, 3:]
        torque = torque - np.cross(self.plant.tool.com_m, force)
        world[pushed, :3] = np.einsum("nij,nj->ni", rotation, force)
        world[pushed, 3:] = np.einsum("nij,nj->ni", rotation, torque)
        return world

    def _rollout(self, joints: Array, control: Array, applied: Array, spec: int) -> Array:
        mj, model = self._mj, self._model
        data = mj.MjData(model)
        self._start(data, joints, control[0])
        state = np.zeros(mj.mj_stateSize(model, mj.mjtState.mjSTATE_FULLPHYSICS))
        mj.mj_getState(model, data, state, mj.mjtState.mjSTATE_FULLPHYSICS)
        tool = model.body("tool").id
        parts = []
        for begin in range(0, len(control), _CHUNK):
            here = control[begin : begin + _CHUNK]
            if applied.shape[1]:
                forces = np.zeros((len(here), model.nbody, 6))
                forces[:, tool] = applied[begin : begin + _CHUNK]
                here = np.concatenate([here, forces.reshape(len(here), -1)], axis=1)
            states, sensed = mj.rollout.rollout(
                model, data, state, here[None], control_spec=int(spec)
            )
            state = states[0, -1]
            parts.append(sensed[0])
        rows = np.concatenate(parts)
        if not np.all(np.isfinite(rows)) or data.warning.number.any():
            raise GalenError(
                f"the simulated {self.plant.arm.name} became unstable with {self._changes()}: a"
                f" spring is too stiff for the step of {STEP_S:g} s, or a mass too small"
            )
        return rows

    def _changes(self) -> str:
        names = "gap", "friction", "stribeck", "sliders", "wobble", "inner", "cable"
        found = [str(value) for name in names if (value := getattr(self.plant, name))]
        return ", ".join(found) or "nothing but its springs"

    def _start(self, data: Any, joints: Array, control: Array) -> None:
        model, plant = self._model, self.plant
        qpos = np.array(model.qpos0)
        if plant.arm.delta is not None:
            qpos[:3] = joints[:3]
        driven = len(self._stiffness)
        for k in range(driven):
            joint = model.actuator_trnid[k, 0]
            qpos[model.jnt_qposadr[joint]] = control[k]
        for number, slider in enumerate(plant.sliders):
            own, beside = (model.joint(name).qposadr for name in (slider.joint, f"slider{number}"))
            qpos[beside] = qpos[own]
        if plant.cable is not None:
            _, origin = plant.arm.sensor_pose(joints)
            at = 0.5 * (np.asarray(plant.cable.anchor_m) + origin)
            place = model.jnt_qposadr[model.body("lump").jntadr[0]]
            qpos[place : place + 3] = at - [0.0, 0.0, 0.05]
        data.qpos[:] = qpos

    def _trace(self, at_s: Array, rows: Array) -> Trace:
        force, torque, proper, omega, alpha = np.split(rows[:, :15], 5, axis=1)
        turn, rotation = _matrices(rows[:, 15:19]), _matrices(rows[:, 22:26])
        gravity = np.einsum("nji,j->ni", turn, np.asarray(self.plant.arm.gravity_m_s2))
        alpha = np.einsum("nji,nj->ni", turn, alpha)
        inertial = np.zeros((len(rows), 6))
        for body in (self.plant.tool, self.plant.adapter):
            inertial += _inertial(body, proper + gravity, omega, alpha)
        wrench = -np.concatenate([force, torque], axis=1) - (1.0 - self.plant.inertial) * inertial
        tension = np.zeros(len(rows))
        cable = self.plant.cable
        if cable is not None:
            stretch = rows[:, 26] - 0.5 * cable.length_m
            tension = 2.0 * cable.stiffness * np.maximum(stretch, 0.0)
            line = rows[:, 27:30] - rows[:, 30:33]
            line = line / np.linalg.norm(line, axis=1, keepdims=True)
            pull = np.einsum("nji,nj->ni", turn, tension[:, None] * line)
            lever = np.asarray(cable.attachment_m)
            wrench = wrench + np.concatenate([pull, np.cross(lever, pull)], axis=1)
        return Trace(at_s, wrench, rotation, rows[:, 19:22], tension)


def _inertial(body: Body, acceleration: Array, omega: Array, alpha: Array) -> Array:
    """Newton's and Euler's wrench (n, 6) of a rigid body about the sensor's origin."""
    com = body.com_m
    at_com = acceleration + np.cross(alpha, com) + np.cross(omega, np.cross(omega, com))
    force = -body.mass_kg * at_com
    spin = alpha @ body.inertia_kg_m2 + np.cross(omega, omega @ body.inertia_kg_m2)
    return np.concatenate([force, np.cross(com, force) - spin], axis=1)


def _quaternion(rotation: Array) -> Array:
    """MuJoCo's order: w, x, y, z."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(scalar_first=True))


def _matrices(quaternions: Array) -> Array:
    return np.asarray(Rotation.from_quat(quaternions, scalar_first=True).as_matrix())
