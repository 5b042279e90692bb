"""Inertial forces of tool and adapter from an IMU beside them. No ROS.

An IMU at r in ft_sensor, turned by R into it, reads specific force u = R^T (a_imu - g) + b and
angular velocity, with g gravity. The sensor's origin accelerates with

    a = R (u - b) + g - al x r - w x (w x r),

al from the gyroscope by a local polynomial, g from roll and tilt. Unlike joints it feels what the
arm does between its encoders and the tool, and at once; but where R or b are wrong by e, it adds
m e also at rest. `galen_model.load.inertia.imu_mount` finds R, scale and b from still poses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.inertia.imu_mount import ImuMount
from galen_model.load.inertia.inertial import LoadInMotion
from galen_model.rotation import rotvec_to_matrix
from galen_ros.stream.results import Rejection

from galen_gravcomp.corrections.joint_motion import inertia_source, load_in_motion
from galen_gravcomp.corrections.motion_window import MotionWindow, NoMotion
from galen_gravcomp.parameters import GravcompParameters

# As with joint_states: a longer step of the stamps is no gap, and this far apart are two clocks.
_RESTART_NS = 1_000_000_000
_OTHER_CLOCK_NS = 5_000_000_000


class ImuMotion:
    """Motion stage of a `Compensator`."""

    needs_positions = False
    needs_imu = True

    def __init__(self, parameters: GravcompParameters | None = None) -> None:
        self._parameters = p = parameters or GravcompParameters()
        self.mount = ImuMount(
            np.array(p.imu_rotvec_rad),
            np.array(p.imu_lever_m),
            np.array(p.imu_bias_m_s2),
            p.imu_scale,
        )
        self._rotation = rotvec_to_matrix(self.mount.rotvec_rad)
        self._window = MotionWindow(p, "the IMU")
        # A wrench that is behind by no more than this has nothing to wait for too long.
        self._usual_ns = round((p.motion_delay_s - p.motion_lag_s) * 1e9)
        self._max_age_ns = round(p.max_joint_age_s * 1e9)
        self._load: LoadInMotion | None = None
        self._gravity: Callable[[float, float], Array] = gravity_in_sensor
        self._source = inertia_source(None)
        self._first_wrench_ns: int | None = None
        self._received = 0

    @property
    def known_until_ns(self) -> int | None:
        """The newest stamp of a wrench whose motion is known."""
        return self._window.known_until_ns

    def late(self, newest_wrench_ns: int) -> NoMotion | None:
        """Whether the IMU lags, or never came."""
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
        return NoMotion(
            Rejection.NO_MOTION, f"inertial forces are not known: the IMU {what} (topic imu)"
        )

    def set_tool(self, tool: CalibrationFile | None) -> None:
        """Take another tool's loads; the samples stay."""
        self._load = None if tool is None else load_in_motion(tool)
        self._source = inertia_source(tool)
        self._gravity = gravity_in_sensor if tool is None else tool.gravity_in_sensor

    def clear(self) -> None:
        """Forget every sample."""
        self._window.clear()
        self._first_wrench_ns = None

    def push_joints(
        self, stamp_ns: int, roll_rad: float, tilt_rad: float, position_m: tuple[float, ...] | None
    ) -> None:
        """The joints tell this stage nothing but the angles at the stamp."""

    def push_imu(
        self, stamp_ns: int, angular_rad_s: Sequence[float], linear_m_s2: Sequence[float]
    ) -> None:
        """Take a reading: angular velocity (3,), specific force (3,), in the IMU's axes.

        Where its stamps jump, what came before is forgotten: one wrong stamp from the future must
        not make all that follow it too old.
        """
        self._received += 1
        newest = self._window.newest_ns
        if newest is not None and not -self._max_age_ns <= stamp_ns - newest <= _RESTART_NS:
            self.clear()
        self._window.push(stamp_ns, (*angular_rad_s, *linear_m_s2))

    def reading(self, stamp_ns: int, roll_rad: float, tilt_rad: float) -> Array | NoMotion:
        """Inertial forces (6,) at a stamp, N and N.m in ft_sensor."""
        assert self._load is not None
        found = self._window.at(stamp_ns)
        if isinstance(found, NoMotion):
            return found
        mount, turn = self.mount, self._rotation
        w, al = turn @ found.value[:3], turn @ found.first[:3]
        felt = turn @ ((found.value[3:] - mount.bias_m_s2) / mount.scale)
        gravity = self._gravity(roll_rad, tilt_rad)
        # -a of the sensor's origin
        arm = np.cross(al, mount.lever_m) + np.cross(w, np.cross(w, mount.lever_m))
        specific = arm - felt - gravity
        x, y, z = specific.tolist()
        wx, wy, wz = w.tolist()
        ax, ay, az = al.tolist()
        return np.array(self._load.wrench((x, y, z), (wx, wy, wz), (ax, ay, az)))

    def values(self) -> dict[str, object]:
        """For /diagnostics."""
        return {
            "motion": "imu",
            "motion_window_s": self._parameters.motion_window_s,
            "motion_delay_s": self._parameters.motion_delay_s,
            "motion_lag_s": self._parameters.motion_lag_s,
            "motion_inertia": self._source,
            "imu_received": self._received,
        }
