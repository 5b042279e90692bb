# SPDX-License-Identifier: Apache-2.0
"""The arm with the effects of `effects/`, one sample at a time.

They are the same objects that `replay` drives along a recording, called with n = 1; only hooks that
an effect has are called.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.sensor_motion import MotionOfSensor, SensorMotion
from galen_model.arrays import Array
from galen_model.load.model import Load, ToolGeometry, gravity_wrench

from galen_sim_driver.effects.effect import (
    Effect,
    Instants,
    Loading,
    Posture,
    added,
    in_order,
)
from galen_sim_driver.plant.geometry import Matrix, rotate_back, sensor_matrix
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
    """What the effects do to one plant: call `at` first, then the rest, once a sample."""

    def __init__(
        self, effects: Sequence[Effect], arm: Arm, adapter: Load, home: Sequence[float]
    ) -> None:
        """Start as at the start of a bag; home (n,): reported joints where the zero was taken."""
        self._effects = [effect.fresh() for effect in in_order(effects)]
        self._nominal = arm
        gravity = arm.gravity_m_s2
        for effect in self._effects:
            arm, gravity = effect.arm(arm), effect.gravity(gravity)
        self.arm = arm
        self._gravity: list[float] = gravity.tolist()
        self._direction: list[float] = (gravity / np.linalg.norm(gravity)).tolist()
        self._adapter = adapter
        self._misaligned = arm
        for effect in self._effects:
            self._misaligned = effect.misaligned(self._misaligned)
        self.wrench_delay_ns = _ns(sum(effect.wrench_delay_s for effect in self._effects))
        self.tracker_delay_ns = _ns(sum(effect.tracker_delay_s for effect in self._effects))
        self.needs_motion = any(effect.needs_motion for effect in self._effects)
        self._motion = MotionOfSensor(self.arm) if self.needs_motion else None
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
        self.at(0.0)
        self.attach(None)
        self._zero = np.zeros(6)
        self._zero = self._zero_at(home)

    @property
    def zero(self) -> list[float]:
        """Part of the adapter's weight (6,) that was subtracted by zeroing at home."""
        return [float(value) for value in self._zero]

    def attach(self, tool: ToolGeometry | None) -> None:
        """Put another tool on.

        Args:
            tool: its nominal load and tip; None for none.

        """
        self._tool = tool
        self._tip_m = np.zeros(3) if tool is None else np.asarray(tool.tip_m, dtype=float)
        self._true_tool = Load(*self._tool_load(np.zeros(3)))
        self._load = self._with_adapter(self._true_tool.mass_kg, self._true_tool.com_m)

    def at(self, since_start_s: float) -> None:
        """Go on to a time.

        Args:
            since_start_s: since the plant's start, s.

        """
        now = np.array([since_start_s])
        self._when = Instants("", now, now)

    def arm_now(self, reported: Sequence[float]) -> ArmNow:
        """Return the true arm, and what gravity makes of its loads.

        Args:
            reported: joints (n,), m and rad.

        Returns:
            The arm at this sample; effects with memory go on by it.

        """
        joints = self._true(self._joints, reported)
        matrix = sensor_matrix(self._misaligned, joints)
        gravity = rotate_back(matrix, self._gravity)
        load = self._load
        if self._loads and self._tool is not None:
            direction = np.array(rotate_back(matrix, self._direction))
            load = self._with_adapter(*self._tool_load(direction))
        return ArmNow(joints, matrix, gravity, *load)

    def more_wrench(
        self, arm: ArmNow, velocities: Sequence[float], accelerations: Sequence[float]
    ) -> list[float] | None:
        """Return what else acts on the sensor while a tool is on.

        Args:
            arm: of `arm_now`.
            velocities: of the reported joints (n,), m/s and rad/s.
            accelerations: of the reported joints (n,), m/s^2 and rad/s^2.

        Returns:
            Wrench (6,) about the sensor's origin in ft_sensor, N and N.m; None for nothing.

        """
        if not self._wrenches or self._tool is None:
            return None
        motion = None
        if self._motion is not None:
            own = self._motion.at(arm.joints, velocities, accelerations)
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
            arm=self._nominal,
        )
        return _first(added(effect.wrench(self._when, posture) for effect in self._wrenches))

    def before_noise(self, wrench: list[float]) -> list[float]:
        """Apply the sensing element's errors that come before its noise.

        Args:
            wrench: true one (6,) in ft_sensor, N and N.m, before zeroing.

        Returns:
            Wrench (6,), before zeroing.

        """
        return self._read(self._early, wrench)

    def after_noise(self, wrench: list[float]) -> list[float]:
        """Apply the sensing element's errors that follow its noise.

        Args:
            wrench: noisy one (6,) in ft_sensor, N and N.m, before zeroing.

        Returns:
            Wrench (6,), before zeroing.

        """
        return self._read(self._late, wrench)

    def position(self, arm: ArmNow, point: Sequence[float]) -> tuple[float, float, float]:
        """Return where a point of the sensor is.

        Args:
            arm: of `arm_now`.
            point: (3,) in ft_sensor, m.

        Returns:
            (3,) in base_link, m, without deflection.

        """
        _, at = self._misaligned.tip_pose(arm.joints, point)
        return (float(at[0]), float(at[1]), float(at[2]))

    def more_deflection(
        self, arm: ArmNow, at_tip: Sequence[float], elastic: Sequence[float]
    ) -> list[float] | None:
        """Return the tip's displacement beside the elastic one.

        Args:
            arm: of `arm_now`.
            at_tip: wrench (6,) about the tip in base_link, N and N.m.
            elastic: the springs' displacement (6,) of the tip in base_link, m and rad.

        Returns:
            Translation and rotation vector (6,) in base_link, m and rad; None where no effect bends
            anything.

        """
        if not self._benders:
            return None
        loading = Loading(
            np.array([arm.joints]), np.array([at_tip]), np.array([elastic]), self._tip_m, self.arm
        )
        return _first(added(effect.deflect(self._when, loading) for effect in self._benders))

    def seen(self, pose: MarkerPose) -> MarkerPose:
        """Return a marker as the tracker measures it, but for noise.

        Args:
            pose: true one in `tracker`.

        Returns:
            The reading; the rotation stays.

        """
        if not self._seers:
            return pose
        position, turn = np.array([pose[0]]), pose[1]
        for effect in self._seers:
            position = effect.seen(self._when, position)
        x, y, z = position[0].tolist()
        return (x, y, z), turn

    def base_shift(self) -> list[float] | None:
        """Return the base marker's displacement in base_link (6,); None without an effect on it."""
        return _first(added(effect.base_marker(self._when) for effect in self._shifters))

    # --- inside -----------------------------------------------------------------------------

    def _with(self, hook: str) -> list[Effect]:
        nothing: Any = getattr(Effect, hook)
        return [effect for effect in self._effects if getattr(type(effect), hook) is not nothing]

    def _with_adapter(self, mass_kg: float, com_m: Array) -> tuple[float, list[float]]:
        """Mass and first moment of tool and adapter, kg and kg.m."""
        moment = mass_kg * com_m + self._adapter.mass_kg * np.asarray(self._adapter.com_m)
        return mass_kg + self._adapter.mass_kg, moment.tolist()

    def _true(self, effects: Sequence[Effect], reported: Sequence[float]) -> list[float]:
        if not effects:
            return list(reported)
        joints = np.array([reported])
        for effect in effects:
            joints = effect.true_joints(self._when, joints)
        return [float(value) for value in joints[0]]

    def _tool_load(self, direction: Array) -> tuple[float, Array]:
        if self._tool is None:
            return 0.0, np.zeros(3)
        mass, com = self._tool.load.mass_kg, np.reshape(self._tool.load.com_m, (1, 3))
        for effect in self._loads:
            mass, com = effect.tool_load(mass, com, direction[None])
        return mass, com[0]

    def _zero_at(self, home: Sequence[float]) -> Array:
        # Those that remember must not: the zero was taken some other time.
        joints = self._true([effect.fresh() for effect in self._joints], home)
        gravity = rotate_back(sensor_matrix(self._misaligned, joints), self._gravity)
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


def _first(rows: Array | None) -> list[float] | None:
    return None if rows is None else [float(value) for value in rows[0]]
