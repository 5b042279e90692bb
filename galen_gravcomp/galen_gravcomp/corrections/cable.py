# SPDX-License-Identifier: Apache-2.0
"""The pull of a tool's cable, fast for one pose at a time and for arrays of poses. No ROS."""

import math

import numpy as np
from galen_common.stream.monitor import joined
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.load.cable import SEEN, UNSEEN, LearnedPull

# Poses at once: the kernel of so many with those of a sweep stays in the processor's cache.
_ROWS = 2048


class CablePull:
    """`CablePosterior.readings`, for single poses some twenty times as fast; and the last pose.

    Both kernels' exponents are linear in the pose but for one square each:

        -|q - p|^2 / 2 = p.q - |p|^2 / 2 - |q|^2 / 2   (in units of the lengths)

    so one product with a matrix gives all of them.
    """

    def __init__(self, drag: LearnedPull, arm: Arm) -> None:
        self._arm = arm
        self.drag = drag
        self._posterior = posterior = drag.posterior
        self._count = len(drag.joints)
        # From the middle of the poses, so that no digits are lost in the differences.
        poses = drag.joints - posterior.middle
        squares = np.array([posterior.lengths, posterior.support_lengths]) ** -2.0
        linear = np.concatenate([poses * squares[0], poses * squares[1]])
        quadratic = -0.5 * np.repeat(squares, self._count, axis=0)
        # (2 n, 10): times (q, q^2), the pull's exponents and those of the support, but for _fixed.
        self._table: Array = np.concatenate([linear, quadratic], axis=1)
        self._fixed: Array = -0.5 * np.concatenate([poses**2 @ squares[0], poses**2 @ squares[1]])
        self._free = drag.form == "free"
        self._attachment: list[float] = drag.attachment_m.tolist()
        self._at: tuple[float, ...] = ()
        self._reading: Array = np.zeros(6)
        self.weight = math.nan
        """The part of the pull subtracted at the last pose, 0 to 1; NaN before the first."""

    @property
    def std(self) -> Array:
        """Standard deviations (6,) of what is left of the pull at the last pose, N and N.m.

        NaN before the first.
        """
        if not self._at:
            return np.full(6, math.nan)
        return np.asarray(np.sqrt(np.diag(self._posterior.covariance(self._at))))

    @property
    def where(self) -> str:
        """Where the last pose lies: `inside` of the poses seen, at their `edge`, or `outside`."""
        if not self._at:
            return "no pose yet"
        if self.weight == 0.0:
            return "outside"
        return "inside" if self.weight == 1.0 else "edge"

    def values(self) -> dict[str, object]:
        """Return values for /diagnostics; units are in the names."""
        std = self.std
        return {
            "cable": self.where,
            "cable_weight": self.weight,
            "cable_std_force_n": joined(std[:3]),
            "cable_std_torque_nm": joined(std[3:]),
            "cable_learned_at": self.drag.learned_at,
        }

    def forget(self) -> None:
        """Forget the last pose."""
        self._at, self.weight = (), math.nan

    def reading(self, joints: tuple[float, ...]) -> Array:
        """Return the pull to subtract at one pose.

        Args:
            joints: (n,), m and rad.

        Returns:
            (6,), N and N.m along ft_sensor.

        """
        if joints != self._at:
            self._at = joints
            self._reading = self._compute(joints)
        return self._reading

    def readings(self, joints: Array) -> Array:
        """Return the pulls to subtract at many poses.

        Args:
            joints: (k, n), m and rad.

        Returns:
            (k, 6), N and N.m along ft_sensor.

        """
        if not len(joints):
            return np.zeros((0, 6))
        self.reading(tuple(joints[-1].tolist()))
        parts = [
            self._posterior.readings(joints[first : first + _ROWS])
            for first in range(0, len(joints), _ROWS)
        ]
        return np.concatenate(parts)

    def _compute(self, joints: tuple[float, ...]) -> Array:
        posterior, count = self._posterior, self._count
        middle = posterior.middle
        q = self._arm.nearest(joints, middle) - middle
        exponents = self._table @ np.concatenate((q, q * q))
        exponents += self._fixed
        kernels = np.exp(exponents)
        near = kernels[count:]
        self.weight = weight = _step(1.0 - float(near @ (posterior.support @ near)))
        if weight == 0.0:
            return np.zeros(6)
        smooth = (posterior.by_pose @ kernels[:count] + posterior.constant) * weight
        if self._free:
            return np.asarray(smooth)
        values = smooth.tolist()
        angles = self._arm.angles_of(joints)
        cosines, sines = list(map(math.cos, angles)), list(map(math.sin, angles))
        along_sensor = self._arm.components_in_sensor
        fx, fy, fz = along_sensor((values[0], values[1], values[2]), cosines, sines)
        rx, ry, rz = self._attachment
        tx, ty, tz = ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx
        if len(values) == 6:
            mx, my, mz = along_sensor((values[3], values[4], values[5]), cosines, sines)
            tx, ty, tz = tx + mx, ty + my, tz + mz
        return np.array((fx, fy, fz, tx, ty, tz))


def _step(missing: float) -> float:
    """`galen_model.load.cable.support_step` of one number."""
    x = min(max((missing - SEEN) / (UNSEEN - SEEN), 0.0), 1.0)
    return 1.0 - x * x * (3.0 - 2.0 * x)
