"""Inertial forces of tool and adapter from the joints, differentiated twice. No ROS.

    reading = inertial wrench(-a, w, al; mass, first moment, inertia of tool and adapter)

with the sensor's motion from the joints' derivatives at the wrench's stamp (`sensor_motion`,
`inertial`), these from a local polynomial. Tool and adapter move as one, so that the sum of their
loads counts. Without an estimated inertia in the tool's file it is that of two points at their
centres, which lacks their own inertia about these centres.

A wrench whose stamp is late by a lag is that of earlier joints, its weight too: with s = g - a at
stamp - lag and g at the stamp, whose weight the compensator subtracts, -a above becomes s - g.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arm.sensor_motion import MotionOfSensor
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.inertia.inertial import LoadInMotion, point_mass_inertia

from galen_gravcomp.corrections.motion_window import MotionWindow, NoMotion
from galen_gravcomp.parameters import GravcompParameters


def load_in_motion(tool: CalibrationFile) -> LoadInMotion:
    """All that hangs on the sensor, tool and adapter, as a tool's file knows it."""
    loads = (tool.load.load, tool.adapter.load)
    inertia = (
        point_mass_inertia(*loads) if tool.inertia is None else tool.inertia.about_sensor_kg_m2
    )
    return LoadInMotion(loads[0].moments + loads[1].moments, inertia)


def inertia_source(tool: CalibrationFile | None) -> str:
    """Where the inertia of an active tool comes from, in words."""
    if tool is None:
        return "no tool"
    return "of two points at the centres" if tool.inertia is None else "the tool's file"


# From one sample to the next no joint goes further than this and 7 times its fastest: m, m/s; rad,
# rad/s. A wrong sample, differentiated twice, would be a blow at the tool for a whole window.
_JUMPS = ((0.005, 1.5),) * 3 + ((0.03, 10.0),) * 2


_NO_PLATFORM = "inertial forces are not known: joint_states lacks the platform's position"


class JointMotion:
    """Motion stage of a `Compensator`: the platform's position and both angles, differentiated."""

    needs_positions = True
    needs_imu = False

    def __init__(self, parameters: GravcompParameters | None = None) -> None:
        self._parameters = parameters or GravcompParameters()
        self._window = MotionWindow(self._parameters, "joint_states")
        self._sensor = MotionOfSensor()
        self._load: LoadInMotion | None = None
        self._source = inertia_source(None)
        self._zero = (0.0, 0.0)
        self._last: tuple[int, tuple[float, ...]] | None = None
        self._gravity: Callable[[float, float], Array] = gravity_in_sensor

    @property
    def known_until_ns(self) -> int | None:
        """The newest stamp whose motion is known."""
        return self._window.known_until_ns

    def late(self, newest_wrench_ns: int) -> NoMotion | None:
        """Joints that come late are the pairing's to reject."""
        return None

    def set_tool(self, tool: CalibrationFile | None) -> None:
        """Take another tool's loads; the samples stay."""
        self._load = None if tool is None else load_in_motion(tool)
        self._source = inertia_source(tool)
        mounting = None if tool is None else tool.mounting
        zero = (0.0, 0.0) if mounting is None else mounting.joint_zero_rad
        self._zero = (float(zero[0]), float(zero[1]))
        self._gravity = gravity_in_sensor if tool is None else tool.gravity_in_sensor

    def clear(self) -> None:
        """Forget every sample."""
        self._window.clear()
        self._last = None

    def push_joints(
        self, stamp_ns: int, roll_rad: float, tilt_rad: float, position_m: tuple[float, ...] | None
    ) -> None:
        """Take a joint sample; without a position, and after a jump, it tells no motion."""
        platform = (math.nan,) * 3 if position_m is None else position_m
        joints = (*platform, roll_rad, tilt_rad)
        last, self._last = self._last, (stamp_ns, joints)
        if last is not None and _jumps(stamp_ns - last[0], last[1], joints):
            joints = (math.nan,) * 5
        self._window.push(stamp_ns, joints)

    def push_imu(
        self, stamp_ns: int, angular_rad_s: Sequence[float], linear_m_s2: Sequence[float]
    ) -> None:
        """An IMU is not asked for."""

    def reading(self, stamp_ns: int, roll_rad: float, tilt_rad: float) -> Array | NoMotion:
        """Inertial forces (6,) at a stamp, N and N.m in ft_sensor."""
        assert self._load is not None
        found = self._window.at(stamp_ns)
        if isinstance(found, NoMotion):
            lacking = self._last is not None and all(map(math.isnan, self._last[1][:3]))
            return NoMotion(found.reason, _NO_PLATFORM) if lacking else found
        then, change = (roll_rad, tilt_rad), (0.0, 0.0, 0.0)
        if self._parameters.motion_lag_s:
            then = (float(found.value[3]), float(found.value[4]))
            x, y, z = (self._gravity(*then) - self._gravity(roll_rad, tilt_rad)).tolist()
            change = (x, y, z)
        w, al, (ax, ay, az) = self._sensor.at(
            then[0] + self._zero[0],
            then[1] + self._zero[1],
            tuple(found.first.tolist()),
            tuple(found.second.tolist()),
        )
        specific = (change[0] - ax, change[1] - ay, change[2] - az)
        return np.array(self._load.wrench(specific, w, al))

    def values(self) -> dict[str, object]:
        """For /diagnostics."""
        return {
            "motion": "joints",
            "motion_window_s": self._parameters.motion_window_s,
            "motion_delay_s": self._parameters.motion_delay_s,
            "motion_lag_s": self._parameters.motion_lag_s,
            "motion_inertia": self._source,
        }


def _jumps(step_ns: int, before: tuple[float, ...], joints: tuple[float, ...]) -> bool:
    step_s = abs(step_ns) * 1e-9
    return any(
        abs(now - then) > size + speed * step_s
        for now, then, (size, speed) in zip(joints, before, _JUMPS, strict=True)
    )
