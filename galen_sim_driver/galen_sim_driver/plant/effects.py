"""The effects of `effects/` in the plant, one sample at a time.

They are the same objects that `replay` drives along a recording, called with n = 1; only hooks that
an effect has are called. The plant does without all of this where no effect is on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from galen_model.arm.galen import GRAVITY_M_S2, ArmParameters
from galen_model.arm.sensor_motion import MotionOfSensor, SensorMotion
from galen_model.arrays import Array
from galen_model.load.model import Load, gravity_wrench
from galen_model.load.nominal_tools import ToolGeometry
from galen_model.rotation import matrix_to_quaternion

from galen_sim_driver.effects.effect import (
    Effect,
    Instants,
    Loading,
    Posture,
    in_order,
    total_turns,
)
from galen_sim_driver.effects.joints import sensor_pose
from galen_sim_driver.plant.geometry import (
    ArmGeometry,
    Matrix,
    Quaternion,
    rotate_back,
    sensor_matrix,
    sensor_quaternion,
)
from galen_sim_driver.plant.sensors import MarkerPose

_ORIGIN = (0.0, 0.0, 0.0)


class ArmNow(NamedTuple):
    """Where the true arm is and what gravity makes of its loads."""

    joints: list[float]
    matrix: Matrix
    gravity: Sequence[float]
    """In ft_sensor, m/s^2."""
    mass: float
    moment: Sequence[float]
    """Of tool and adapter, kg and kg.m."""


class PlantEffects:
    """What the effects do to one plant; `at` first, then the rest, once a sample."""

    def __init__(
        self, effects: Sequence[Effect], arm: ArmParameters, adapter: Load, home: Sequence[float]
    ) -> None:
        """Start as at the start of a bag; home (5,): reported joints where the zero was taken."""
        self._effects = [effect.fresh() for effect in in_order(effects)]
        gravity = GRAVITY_M_S2
        for effect in self._effects:
            arm, gravity = effect.arm(arm), effect.gravity(gravity)
        self.arm = arm
        self._gravity: list[float] = gravity.tolist()
        self._direction = gravity / np.linalg.norm(gravity)
        self._geometry = ArmGeometry(arm)
        self._motion = MotionOfSensor(arm)
        self._adapter = adapter
        self._turns = total_turns(self._effects)
        self._turned = bool(np.any(self._turns))
        self.wrench_delay_ns = _ns(sum(effect.wrench_delay_s for effect in self._effects))
        self.tracker_delay_ns = _ns(sum(effect.tracker_delay_s for effect in self._effects))
        self.needs_motion = any(effect.needs_motion for effect in self._effects)
        self._joints = self._with("true_joints")
        self._loads = self._with("tool_load")
        self._wrenches = self._with("wrench")
        readers = self._with("read")
        self._early = [effect for effect in readers if not effect.after_noise]
        self._late = [effect for effect in readers if effect.after_noise]
        self._benders = self._with("deflect")
        self._seers = self._with("seen")
        self._shifters = self._with("base_marker")
        self._tool: ToolGeometry | None = None
        self._true_tool = Load(0.0, np.zeros(3))
        self._tip_m = np.zeros(3)
        self.at(0.0)
        self._zero = np.zeros(6)
        self._zero = self._zero_at(home)

    @property
    def zero(self) -> list[float]:
        """What the sensor held of the adapter (6,) when it was zeroed at home."""
        return [float(value) for value in self._zero]

    def attach(self, tool: ToolGeometry | None) -> None:
        """Another tool is on, or none."""
        self._tool = tool
        self._tip_m = np.zeros(3) if tool is None else np.asarray(tool.tip_m, dtype=float)
        self._true_tool = Load(*self._tool_load(np.zeros(3)))

    def at(self, since_start_s: float) -> None:
        """Go on to this time."""
        now = np.array([since_start_s])
        self._when = Instants("", now, now)

    def arm_now(self, reported: Sequence[float]) -> ArmNow:
        """The true arm at reported joints (5,)."""
        joints = self._true(self._joints, reported)
        matrix = self._matrix(joints)
        gravity = rotate_back(matrix, self._gravity)
        mass, com = self._true_tool.mass_kg, self._true_tool.com_m
        if self._loads and self._tool is not None:
            mass, com = self._tool_load(np.array(rotate_back(matrix, self._direction)))
        moment = mass * com + self._adapter.mass_kg * np.asarray(self._adapter.com_m)
        return ArmNow(joints, matrix, gravity, mass + self._adapter.mass_kg, moment.tolist())

    def more_wrench(
        self, arm: ArmNow, velocities: Sequence[float], accelerations: Sequence[float]
    ) -> list[float] | None:
        """What else acts on the sensor (6,) while a tool is on; rates (5,) of the joints."""
        if not self._wrenches or self._tool is None:
            return None
        motion = None
        if self.needs_motion:
            roll, tilt = arm.joints[3:]
            own = self._motion.at(roll, tilt, tuple(velocities), tuple(accelerations))
            motion = SensorMotion(*(np.array([part]) for part in own))
        posture = Posture(
            joints=np.array([arm.joints]),
            rotation=np.reshape(arm.matrix, (1, 3, 3)),
            origin=np.array([self.position(arm, _ORIGIN)]),
            gravity=np.array([arm.gravity]),
            motion=motion,
            tool=self._true_tool,
            adapter=self._adapter,
            tip_m=self._tip_m,
        )
        total = np.zeros(6)
        for effect in self._wrenches:
            more = effect.wrench(self._when, posture)
            if more is not None:
                total = total + more[0]
        return [float(value) for value in total]

    def before_noise(self, wrench: list[float]) -> list[float]:
        """What the element makes of a true wrench (6,), the zero's part included."""
        return self._read(self._early, wrench)

    def after_noise(self, wrench: list[float]) -> list[float]:
        """What comes out of it in the end."""
        return self._read(self._late, wrench)

    def position(self, arm: ArmNow, point: Sequence[float]) -> tuple[float, float, float]:
        """A point that is told in ft_sensor, in base_link, m."""
        if not self._turned:
            return self._geometry.tip_position(arm.joints, arm.matrix, point)
        rotation, origin = sensor_pose(np.array([arm.joints]), self._turns, self.arm)
        x, y, z = origin[0] + rotation[0] @ np.asarray(point)
        return (float(x), float(y), float(z))

    def quaternion(self, arm: ArmNow) -> Quaternion:
        """How the sensor is turned in base_link."""
        if not self._turned:
            return sensor_quaternion(arm.joints[3], arm.joints[4])
        x, y, z, w = matrix_to_quaternion(np.reshape(arm.matrix, (3, 3)))
        return (float(x), float(y), float(z), float(w))

    def more_deflection(
        self, arm: ArmNow, at_tip: Sequence[float], elastic: Sequence[float]
    ) -> list[float] | None:
        """Displacement of the tip beside the elastic one (6,), under the wrench there (6,).

        All in base_link; None where no effect bends anything.
        """
        if not self._benders:
            return None
        loading = Loading(
            np.array([arm.joints]), np.array([at_tip]), np.array([elastic]), self._tip_m, self.arm
        )
        total = np.zeros(6)
        for effect in self._benders:
            more = effect.deflect(self._when, loading)
            if more is not None:
                total = total + more[0]
        return [float(value) for value in total]

    def seen(self, pose: MarkerPose) -> MarkerPose:
        """A marker as the tracker tells it, but for noise."""
        if not self._seers:
            return pose
        position = np.array([pose.position_m])
        for effect in self._seers:
            position = effect.seen(self._when, position)
        x, y, z = position[0].tolist()
        return MarkerPose((x, y, z), pose.quaternion)

    def base_shift(self) -> list[float] | None:
        """How far the base's marker has moved in base_link (6,); None where it can't."""
        total = None
        for effect in self._shifters:
            more = effect.base_marker(self._when)
            if more is not None:
                total = more[0] if total is None else total + more[0]
        return None if total is None else total.tolist()

    # --- inside -----------------------------------------------------------------------------

    def _with(self, hook: str) -> list[Effect]:
        """The effects that have this hook."""
        nothing: Any = getattr(Effect, hook)
        return [effect for effect in self._effects if getattr(type(effect), hook) is not nothing]

    def _true(self, effects: Sequence[Effect], reported: Sequence[float]) -> list[float]:
        joints = np.array([reported])
        for effect in effects:
            joints = effect.true_joints(self._when, joints)
        return [float(value) for value in joints[0]]

    def _matrix(self, joints: Sequence[float]) -> Matrix:
        if not self._turned:
            return sensor_matrix(joints[3], joints[4])
        rotation, _ = sensor_pose(np.array([joints]), self._turns, self.arm)
        (a, b, c), (d, e, f), (g, h, i) = rotation[0].tolist()
        return (a, b, c, d, e, f, g, h, i)

    def _tool_load(self, direction: Array) -> tuple[float, Array]:
        """The tool's true mass and centre (3,), with gravity's direction (3,) in ft_sensor."""
        if self._tool is None:
            return 0.0, np.zeros(3)
        mass, com = self._tool.load.mass_kg, np.reshape(self._tool.load.com_m, (1, 3))
        for effect in self._loads:
            mass, com = effect.tool_load(mass, com, direction[None])
        return mass, com[0]

    def _zero_at(self, home: Sequence[float]) -> Array:
        # Those that remember must not: the zero was taken some other time.
        joints = self._true([effect.fresh() for effect in self._joints], home)
        gravity = rotate_back(self._matrix(joints), self._gravity)
        return gravity_wrench(np.array(gravity), self._adapter)

    def _read(self, effects: Sequence[Effect], wrench: list[float]) -> list[float]:
        if not effects:
            return wrench
        reading = np.array([wrench]) - self._zero
        for effect in effects:
            reading = effect.read(self._when, reading)
        return [float(value) for value in reading[0] + self._zero]


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
