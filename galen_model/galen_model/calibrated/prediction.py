# SPDX-License-Identifier: Apache-2.0
"""The expected reading of a tool, fast for one pose at a time and for arrays of poses."""

from collections.abc import Sequence
from math import cos, sin

import numpy as np

from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.mounting import Mounting

_BLOCK = 4096
"""Samples; with all that is worked out of them some 0.7 MB."""


class Prediction:
    """`CalibrationFile.predict`, for single poses some ten times as fast.

    Every term of the model is linear in gravity's direction in the sensor's frame or constant,

        reading = A u + c,   u = R_base_sensor^T d,

    with gravity's direction d in the base's frame, the arm's for a level base, and angles that
    hold the joints' zeros (`galen_model.load.mounting`). A (6, 3) and c (6,) are read off
    the file's own `predict_under`, so that the physics, and a turned sensor's gains, stay in one
    place.
    """

    def __init__(self, tool: CalibrationFile, arm: Arm) -> None:
        self._arm, self._into_sensor = arm, arm.into_sensor
        gravity = float(np.linalg.norm(tool.gravity_m_s2))
        self._constant: Array = tool.predict_under(np.zeros(3))
        self._by_direction: Array = (
            tool.predict_under(gravity * np.eye(3)) - self._constant[None, :]
        ).T
        self._by_direction_and_one: Array = np.vstack([self._by_direction.T, self._constant])
        mounting = Mounting.of(arm) if tool.mounting is None else tool.mounting
        x, y, z = mounting.gravity_direction(arm).tolist()
        self._down = (x, y, z)
        self._zero: list[float] = mounting.joint_zero_rad.tolist()
        self._turns = tuple(zip(arm.turns, self._zero, strict=True))
        self._to_wrench = None if tool.mounting is None else mounting.wrench_from_reading

    def reading(self, angles: Sequence[float]) -> Array:
        """Predict the reading of one pose without contact.

        Args:
            angles: reported, k of the turning joints, rad.

        Returns:
            (6,), N and N.m, in the sensor's own axes.

        """
        parts = self._down
        for k, (turn, zero) in enumerate(self._turns):
            angle = angles[k] + zero
            parts = turn(parts, cos(angle), sin(angle))
        reading: Array = self._by_direction @ np.array(self._into_sensor(parts)) + self._constant
        return reading

    def readings(self, angles: Array) -> Array:
        """Predict the readings of many poses as `reading` does.

        Args:
            angles: reported (n, k), rad.

        Returns:
            (n, 6), N and N.m, in the sensor's own axes.

        """
        directions: Array = np.ones((len(angles), 4))
        self._write_directions(directions, angles)
        readings: Array = directions @ self._by_direction_and_one
        return readings

    def compensate(self, readings: Array, angles: Array) -> Array:
        """Compute the wrenches that readings hold beside the expected ones.

        Block by block: what a block needs in between stays in the processor's cache, so that only
        readings, angles and wrenches go through memory. Sines and cosines take most of the time.

        Args:
            readings: raw (n, 6), N and N.m.
            angles: reported (n, k), rad.

        Returns:
            Wrenches (n, 6) in ft_sensor, N and N.m.

        """
        out = np.empty_like(readings)
        directions = np.ones((min(_BLOCK, len(readings)), 4))
        for first in range(0, len(readings), _BLOCK):
            rows = slice(first, first + _BLOCK)
            block = out[rows]
            u = directions[: len(block)]
            self._write_directions(u, angles[rows])
            np.matmul(u, self._by_direction_and_one, out=block)
            np.subtract(readings[rows], block, out=block)
            if self._to_wrench is not None:
                block[...] = self.wrenches(block)
        return out

    def _write_directions(self, out: Array, angles: Array) -> None:
        """Write gravity's directions u for angles (n, k) into the first columns of out (n, 4)."""
        true = [column + zero for column, zero in zip(angles.T, self._zero, strict=True)]
        parts = self._arm.components_in_sensor(self._down, map(np.cos, true), map(np.sin, true))
        for k in range(3):
            out[:, k] = parts[k]

    def wrench(self, difference: Array) -> Array:
        """Turn a difference of readings into a wrench, gains undone.

        Args:
            difference: raw reading less the expected one (6,), N and N.m.

        Returns:
            Wrench (6,) in ft_sensor, N and N.m.

        """
        return difference if self._to_wrench is None else self._to_wrench @ difference

    def wrenches(self, differences: Array) -> Array:
        """Turn differences of readings into wrenches as `wrench` does.

        Args:
            differences: (n, 6), N and N.m.

        Returns:
            Wrenches (n, 6) in ft_sensor, N and N.m.

        """
        return differences if self._to_wrench is None else differences @ self._to_wrench.T
