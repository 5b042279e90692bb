# SPDX-License-Identifier: Apache-2.0
"""Inertial forces of tool and adapter, from the joints or from an IMU beside them. No ROS.

A polynomial is fitted by least squares to the samples in a window around a moment T, from
T + delay - window to T + delay, and evaluated at T (Savitzky, Golay, *Anal. Chem.* 36, 1964, here
for stamps as they come, and not only in the window's middle). It needs samples up to T + delay and
gives its answer that much later: the delay is known, and no phase is lost.

With independent errors sigma of n samples evenly in a window W, a cubic has in its middle

    std(x') = sqrt(75) sigma / (W sqrt(n)),    std(x'') = sqrt(720) sigma / (W^2 sqrt(n)),
    bias(x'') = W^2 x'''' / 56,

so noise falls with W^2.5 at a given rate, while the bias grows with W^2. Away from the middle both
grow; a cubic's x'' then has a bias of x'''' too, a parabola's already one of x'''.

The forces are reading = inertial wrench(-a, w, al; mass, first moment, inertia of tool and adapter)
with the sensor's motion a, w, al at the wrench's stamp. Tool and adapter move as one, so that the
sum of their loads counts. Without an estimated inertia in the calibration file it is that of two
points at their centres, which lacks their own inertia about these centres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from galen_common.stream.samples import Rejection
from galen_model.arm.arm import Arm
from galen_model.arm.sensor_motion import MotionOfSensor
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.inertia import ImuMount, LoadInMotion, point_mass_inertia
from galen_model.rotation import rotvec_to_matrix

from galen_gravcomp.parameters import GravcompParameters

DEGREE = 3
# Fewer leave nearly no freedom to average noise.
FEWEST_SAMPLES = 2 * (DEGREE + 1)
# Of the window: samples further apart leave the polynomial to guess.
_LARGEST_GAP = 0.25
# Samples kept: more than a window's, and than come while a wrench waits.
_CAPACITY = 4096
_US = 1000
# From one sample to the next no joint goes further than this and 7 times its fastest: m, m/s; rad,
# rad/s. A wrong sample, differentiated twice, would be a blow at the tool for a whole window.
_LARGEST_STEP = {"m": (0.005, 1.5), "rad": (0.03, 10.0)}
# As with joint_states: a longer step of the stamps is no gap, and this far apart are two clocks.
_RESTART_NS = 1_000_000_000
_OTHER_CLOCK_NS = 5_000_000_000
_UNKNOWN = "inertial forces are not known:"


class LocalPolynomial:
    """Differentiates samples of k values in windows; remembers the weights of the last window."""

    def __init__(self, window_s: float, delay_s: float) -> None:
        """Evaluate `delay_s` before the end of a window of `window_s`."""
        if not 0.0 <= delay_s < window_s:
            raise ValueError(f"need 0 <= delay < window: {delay_s = }, {window_s = }")
        self._half_s = half_s = window_s / 2.0
        self._powers = np.arange(DEGREE + 1)
        self._scales = np.array([[1.0], [1.0 / half_s], [2.0 / half_s**2]])
        self._key = b""
        self._weights = np.zeros((3, 0))

    def derivatives(
        self, stamp_ns: np.ndarray, values: Array, at_ns: int
    ) -> tuple[Array, Array, Array]:
        """Return value and derivatives at a moment.

        Args:
            stamp_ns: (n,) distinct, n more than the polynomial's degree.
            values: (n, k) at these stamps.
            at_ns: the moment.

        Returns:
            Value, first (1/s) and second derivative (1/s^2), (k,) each.

        """
        # Less the first sample, so that the level costs no digits.
        value, first, second = self.weights(stamp_ns - at_ns) @ (values - values[0])
        return value + values[0], first, second

    def weights(self, after_ns: np.ndarray) -> Array:
        """Return W with value and derivatives = W samples.

        Stamps are rounded to the microsecond, in which the arm moves less than an encoder's step.

        Args:
            after_ns: (n,) how long after the moment each sample is, ns.

        Returns:
            (3, n), of value, first (1/s) and second derivative (1/s^2).

        """
        after_us = (after_ns + _US // 2) // _US
        key = after_us.tobytes()
        if key != self._key:
            design = (after_us * (1e-6 / self._half_s))[:, None] ** self._powers
            rows = np.linalg.solve(design.T @ design, design.T)[:3]
            self._weights, self._key = rows * self._scales, key
        return self._weights


class MotionWindow:
    """Keeps one stream's samples and differentiates them at a stamp."""

    def __init__(self, parameters: GravcompParameters, topic: str) -> None:
        """`topic`: as it is called in sentences."""
        p = parameters
        self._topic = topic
        self._polynomial = LocalPolynomial(p.motion_window_s, p.motion_delay_s)
        self._window_ms = p.motion_window_s * 1e3
        self._delay_ns = round(p.motion_delay_s * 1e9)
        self._lag_ns = round(p.motion_lag_s * 1e9)
        self._window_ns = round(p.motion_window_s * 1e9)
        self._gap_ns = round(_LARGEST_GAP * p.motion_window_s * 1e9)
        # The newest samples in arrays, so that a window of them is a view.
        self._stamps = np.zeros(2 * _CAPACITY, dtype=np.int64)
        self._values = np.zeros((0, 0))
        self._count = 0
        self.newest_ns: int | None = None

    @property
    def known_until_ns(self) -> int | None:
        """The newest stamp of a wrench whose samples have come; None before the first one."""
        return None if self.newest_ns is None else self.newest_ns - self._delay_ns + self._lag_ns

    def push(self, stamp_ns: int, values: tuple[float, ...]) -> None:
        """Take a sample; one that is not newer than the newest is dropped.

        One with a value that is not finite is kept as such: nothing is known around it.

        Args:
            stamp_ns: its stamp.
            values: (k,), always as many.

        """
        if self.newest_ns is not None and stamp_ns <= self.newest_ns:
            return
        if not math.isfinite(sum(values)):
            values = (math.nan,) * len(values)
        if not len(self._values):
            self._values = np.zeros((2 * _CAPACITY, len(values)))
        if self._count == 2 * _CAPACITY:
            self._stamps[:_CAPACITY] = self._stamps[_CAPACITY:]
            self._values[:_CAPACITY] = self._values[_CAPACITY:]
            self._count = _CAPACITY
        self._stamps[self._count] = self.newest_ns = stamp_ns
        self._values[self._count] = values
        self._count += 1

    def clear(self) -> None:
        """Forget every sample."""
        self._count, self.newest_ns = 0, None

    def at(self, stamp_ns: int) -> tuple[Array, Array, Array] | str:
        """Return value and derivatives at a wrench's stamp.

        Args:
            stamp_ns: the wrench's, later by motion_lag_s than the samples' for the same moment.

        Returns:
            Value, first (1/s) and second derivative (1/s^2), (k,) each; or why they are not known,
            in words.

        """
        at_ns = stamp_ns - self._lag_ns
        end_ns = at_ns + self._delay_ns
        start_ns = end_ns - self._window_ns
        stamps = self._stamps[: self._count]
        rows = slice(
            int(stamps.searchsorted(start_ns)), int(stamps.searchsorted(end_ns, side="right"))
        )
        stamps, values = stamps[rows], self._values[rows]
        lacking = self._lacking(stamps, start_ns, end_ns)
        if not lacking:
            found = self._polynomial.derivatives(stamps, values, at_ns)
            if np.isfinite(found[2].sum()):
                return found
            lacking = f"holds a value of {self._topic} that is not finite, or jumps"
        return f"{_UNKNOWN} the window of {self._window_ms:.0f} ms {lacking}"

    def _lacking(self, stamps: np.ndarray, start_ns: int, end_ns: int) -> str:
        """Why stamps (n,) are too few or too far apart to differentiate; empty if not."""
        if len(stamps) < FEWEST_SAMPLES:
            return (
                f"holds {len(stamps)} samples of {self._topic}; {FEWEST_SAMPLES} are"
                " needed (a longer motion_window_s, or more samples a second)"
            )
        before_ns, after_ns = int(stamps[0]) - start_ns, end_ns - int(stamps[-1])
        gap_ns = int((stamps[1:] - stamps[:-1]).max())
        if gap_ns > self._gap_ns:
            return f"has a gap of {gap_ns * 1e-6:.0f} ms in {self._topic}"
        if before_ns > self._gap_ns:
            return f"has no sample of {self._topic} in its first {before_ns * 1e-6:.0f} ms"
        # At the end, where it is evaluated, the polynomial must not hang over by more than the
        # sample that is always still to come there.
        period_ns = int(stamps[-1] - stamps[0]) // (len(stamps) - 1)
        if after_ns > max(self._delay_ns // 2, period_ns):
            return f"has no sample of {self._topic} in its last {after_ns * 1e-6:.0f} ms"
        return ""


def inertia_source(tool: CalibrationFile | None) -> str:
    """Return where the inertia of an active tool comes from.

    Args:
        tool: its calibration; None: no tool.

    Returns:
        In words.

    """
    if tool is None:
        return "no tool"
    return "of two points at the centres" if tool.inertia is None else "the tool's file"


class InertialForces:
    """Inertial forces of the active tool at a wrench's stamp; a subclass knows the motion."""

    needs_positions = False
    needs_imu = False
    source = ""
    topic = ""

    def __init__(self, parameters: GravcompParameters, arm: Arm) -> None:
        self._arm = arm
        self._parameters = parameters
        self._window = MotionWindow(parameters, self.topic)
        self.set_tool(None)

    @property
    def known_until_ns(self) -> int | None:
        """The newest stamp of a wrench whose motion is known."""
        return self._window.known_until_ns

    def late(self, newest_wrench_ns: int) -> tuple[Rejection, str] | None:
        """Return why wrenches must not wait any longer; joints that are late the pairing rejects.

        Args:
            newest_wrench_ns: the newest wrench's stamp.

        Returns:
            Reason and sentence; None: they may wait.

        """
        return None

    def set_tool(self, tool: CalibrationFile | None) -> None:
        """Take another tool's loads; the samples stay.

        Args:
            tool: its calibration; None: no tool.

        """
        self._inertia = inertia_source(tool)
        self._load: LoadInMotion | None = None
        self._gravity: Callable[[Sequence[float]], Array] = self._arm.gravity_in_sensor
        if tool is None:
            return
        loads = (tool.load.load, tool.adapter.load)
        inertia = (
            point_mass_inertia(*loads) if tool.inertia is None else tool.inertia.about_sensor_kg_m2
        )
        self._load = LoadInMotion(loads[0].moments + loads[1].moments, inertia)
        self._gravity = tool.gravity_in_sensor

    def clear(self) -> None:
        """Forget every sample."""
        self._window.clear()

    def push_joints(self, stamp_ns: int, joints: tuple[float, ...]) -> None:
        """Take joints.

        Args:
            stamp_ns: their stamp.
            joints: (n,) in the arm's order, m and rad, NaN where unknown.

        """

    def push_imu(
        self, stamp_ns: int, angular_rad_s: Sequence[float], linear_m_s2: Sequence[float]
    ) -> None:
        """Take an IMU's reading.

        Args:
            stamp_ns: its stamp.
            angular_rad_s: (3,) angular velocity in the IMU's axes.
            linear_m_s2: (3,) specific force in the IMU's axes.

        """

    def reading(self, stamp_ns: int, angles: tuple[float, ...]) -> Array | str:
        """Return the inertial forces at a wrench's stamp.

        Args:
            stamp_ns: the wrench's.
            angles: (k,) at that stamp, rad.

        Returns:
            (6,), N and N.m in ft_sensor; or why they are not known, in words.

        Raises:
            NotImplementedError: a subclass must define it.

        """
        raise NotImplementedError

    def values(self) -> dict[str, object]:
        """For /diagnostics."""
        return {
            "motion": self.source,
            "motion_window_s": self._parameters.motion_window_s,
            "motion_delay_s": self._parameters.motion_delay_s,
            "motion_lag_s": self._parameters.motion_lag_s,
            "motion_inertia": self._inertia,
        }


class JointMotion(InertialForces):
    """From the joints, differentiated twice.

    A wrench whose stamp is late by a lag is that of earlier joints, its weight too: with s = g - a
    at stamp - lag and g at the stamp, whose weight the compensator subtracts, -a becomes s - g.
    """

    needs_positions = True
    source = "joints"
    topic = "joint_states"

    def __init__(self, parameters: GravcompParameters, arm: Arm) -> None:
        self._largest = tuple(_LARGEST_STEP[unit] for unit in arm.units)
        self._sensor = MotionOfSensor(arm)
        self._zero = (0.0,) * len(arm.turning)
        self._last: tuple[int, tuple[float, ...]] | None = None
        super().__init__(parameters, arm)

    def set_tool(self, tool: CalibrationFile | None) -> None:
        """Take another tool's loads and zeros of joints.

        Args:
            tool: its calibration; None: no tool.

        """
        super().set_tool(tool)
        mounting = None if tool is None else tool.mounting
        zero = [0.0] * len(self._zero) if mounting is None else mounting.joint_zero_rad.tolist()
        self._zero = tuple(zero)

    def clear(self) -> None:
        """Forget every sample."""
        super().clear()
        self._last = None

    def push_joints(self, stamp_ns: int, joints: tuple[float, ...]) -> None:
        """Take joints; with a NaN, and after a jump, the motion is unknown.

        Args:
            stamp_ns: their stamp.
            joints: (n,) in the arm's order, m and rad.

        """
        last = self._last
        if last is not None and self._arm.endless.any():
            joints = tuple(self._arm.nearest(joints, last[1]).tolist())
        self._last = stamp_ns, joints
        if last is not None and self._jumps(stamp_ns - last[0], last[1], joints):
            joints = (math.nan,) * len(joints)
        self._window.push(stamp_ns, joints)

    def _jumps(self, step_ns: int, before: tuple[float, ...], joints: tuple[float, ...]) -> bool:
        step_s = abs(step_ns) * 1e-9
        return any(
            abs(now - then) > size + speed * step_s
            for now, then, (size, speed) in zip(joints, before, self._largest, strict=True)
        )

    def reading(self, stamp_ns: int, angles: tuple[float, ...]) -> Array | str:
        """Return the inertial forces at a wrench's stamp.

        Args:
            stamp_ns: the wrench's.
            angles: (k,) at that stamp, rad.

        Returns:
            (6,), N and N.m in ft_sensor; or why they are not known, in words.

        """
        assert self._load is not None
        found = self._window.at(stamp_ns)
        if isinstance(found, str):
            last = () if self._last is None else self._last[1]
            others = {
                joint.name: at
                for joint, at in zip(self._arm.joints, last, strict=False)
                if joint.kind == "prismatic"
            }
            if others and all(map(math.isnan, others.values())):
                return f"{_UNKNOWN} joint_states lacks {', '.join(others)}"
            return found
        value, first, second = found
        then, change = angles, (0.0, 0.0, 0.0)
        if self._parameters.motion_lag_s:
            then = self._arm.angles_of(tuple(value.tolist()))
            x, y, z = (self._gravity(then) - self._gravity(angles)).tolist()
            change = (x, y, z)
        for place, angle, zero in zip(self._arm.turning, then, self._zero, strict=True):
            value[place] = angle + zero
        w, al, (ax, ay, az) = self._sensor.at(value, first, second)
        specific = (change[0] - ax, change[1] - ay, change[2] - az)
        return np.array(self._load.wrench(specific, w, al))


class ImuMotion(InertialForces):
    """From an IMU at r in ft_sensor, turned by R into it.

    It reads specific force u = s R^T (a_imu - g) + b and angular velocity, with g gravity and s a
    scale. The sensor's origin accelerates with

        a = R (u - b) / s + g - al x r - w x (w x r),

    al from the gyroscope by a local polynomial, g from the angles. Unlike joints it feels what
    the arm does between its encoders and the tool, and at once; but where R or b are wrong by e, it
    adds m e also at rest. `galen_model.load.inertia` finds R, s and b from still poses.
    """

    needs_imu = True
    source = "imu"
    topic = "the IMU"

    def __init__(self, parameters: GravcompParameters, arm: Arm) -> None:
        p = parameters
        self._mount = ImuMount(
            np.array(p.imu_rotvec_rad),
            np.array(p.imu_lever_m),
            np.array(p.imu_bias_m_s2),
            p.imu_scale,
        )
        self._rotation = rotvec_to_matrix(self._mount.rotvec_rad)
        # A wrench that is behind by no more than this has nothing to wait for too long.
        self._usual_ns = round((p.motion_delay_s - p.motion_lag_s) * 1e9)
        self._max_age_ns = round(p.max_joint_age_s * 1e9)
        self._first_wrench_ns: int | None = None
        self._received = 0
        super().__init__(parameters, arm)

    def late(self, newest_wrench_ns: int) -> tuple[Rejection, str] | None:
        """Return why wrenches must not wait: the IMU lags, or never sent.

        Args:
            newest_wrench_ns: the newest wrench's stamp.

        Returns:
            Reason and sentence; None: they may wait.

        """
        until = self.known_until_ns
        if until is None:
            if self._first_wrench_ns is None:
                self._first_wrench_ns = newest_wrench_ns
            until = self._first_wrench_ns - self._usual_ns
        behind_ns = newest_wrench_ns - until - self._usual_ns
        if behind_ns <= self._max_age_ns:
            return None
        what = f"is {behind_ns * 1e-6:.0f} ms behind the wrench"
        if behind_ns > _OTHER_CLOCK_NS:
            what += ", does it get its stamps from another clock?"
        if self.known_until_ns is None:
            what = "has sent nothing"
        return Rejection.NO_MOTION, f"{_UNKNOWN} the IMU {what} (topic imu)"

    def clear(self) -> None:
        """Forget every sample."""
        super().clear()
        self._first_wrench_ns = None

    def push_imu(
        self, stamp_ns: int, angular_rad_s: Sequence[float], linear_m_s2: Sequence[float]
    ) -> None:
        """Take a reading.

        Where its stamps jump, what came before is forgotten: one wrong stamp from the future must
        not make all that follows it too old.

        Args:
            stamp_ns: its stamp.
            angular_rad_s: (3,) angular velocity in the IMU's axes.
            linear_m_s2: (3,) specific force in the IMU's axes.

        """
        self._received += 1
        newest = self._window.newest_ns
        if newest is not None and not -self._max_age_ns <= stamp_ns - newest <= _RESTART_NS:
            self.clear()
        self._window.push(stamp_ns, (*angular_rad_s, *linear_m_s2))

    def reading(self, stamp_ns: int, angles: tuple[float, ...]) -> Array | str:
        """Return the inertial forces at a wrench's stamp.

        Args:
            stamp_ns: the wrench's.
            angles: (k,) at that stamp, rad.

        Returns:
            (6,), N and N.m in ft_sensor; or why they are not known, in words.

        """
        assert self._load is not None
        found = self._window.at(stamp_ns)
        if isinstance(found, str):
            return found
        value, first, _ = found
        mount, turn = self._mount, self._rotation
        w, al = turn @ value[:3], turn @ first[:3]
        felt = turn @ ((value[3:] - mount.bias_m_s2) / mount.scale)
        gravity = self._gravity(angles)
        # -a of the sensor's origin
        arm = np.cross(al, mount.lever_m) + np.cross(w, np.cross(w, mount.lever_m))
        specific = arm - felt - gravity
        x, y, z = specific.tolist()
        wx, wy, wz = w.tolist()
        ax, ay, az = al.tolist()
        return np.array(self._load.wrench((x, y, z), (wx, wy, wz), (ax, ay, az)))

    def values(self) -> dict[str, object]:
        """For /diagnostics."""
        return {**super().values(), "imu_received": self._received}
