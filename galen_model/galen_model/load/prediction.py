"""The expected reading of a tool, fast for one pose at a time and for arrays of poses."""

import math

import numpy as np

from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.mounting.mounting import Mounting

_BLOCK = 4096
"""Samples; with all that is worked out of them some 0.7 MB."""


class Prediction:
    """`CalibrationFile.predict`, for single poses some ten times as fast.

    Every term of the model is linear in gravity's direction in the sensor's frame or constant,

        reading = A u + c,   u = Ry(tilt + pi/2)^T Rx(roll)^T d,

    with gravity's direction d in base_link, (0, 0, -1) for a level base, and angles that hold the
    joints' zeros (`galen_model.load.mounting.mounting`). A (6, 3) and c (6,) are read off the
    tool's own `predict_under`, so that the physics, and a turned sensor's gains, stay in one place.
    """

    def __init__(self, tool: CalibrationFile) -> None:
        gravity = abs(tool.gravity_m_s2[2])
        self._constant: Array = tool.predict_under(np.zeros(3))
        self._by_direction: Array = (
            tool.predict_under(gravity * np.eye(3)) - self._constant[None, :]
        ).T
        self._by_direction_and_one: Array = np.vstack([self._by_direction.T, self._constant])
        mounting = Mounting() if tool.mounting is None else tool.mounting
        self._down: tuple[float, ...] = tuple(mounting.gravity_direction.tolist())
        self._zero: tuple[float, ...] = tuple(mounting.joint_zero_rad.tolist())
        self._to_wrench = None if tool.mounting is None else mounting.wrench_from_reading

    def reading(self, roll_rad: float, tilt_rad: float) -> Array:
        """Reading (6,) expected without touch, N and N.m in the sensor's own axes."""
        (x, y, z), (zero_roll, zero_tilt) = self._down, self._zero
        sin_roll, cos_roll = math.sin(roll_rad + zero_roll), math.cos(roll_rad + zero_roll)
        sin_tilt, cos_tilt = math.sin(tilt_rad + zero_tilt), math.cos(tilt_rad + zero_tilt)
        across, down = y * cos_roll + z * sin_roll, y * sin_roll - z * cos_roll
        direction = np.array(
            (down * cos_tilt - x * sin_tilt, across, down * sin_tilt + x * cos_tilt)
        )
        reading: Array = self._by_direction @ direction + self._constant
        return reading

    def readings(self, roll_rad: Array, tilt_rad: Array) -> Array:
        """Readings (n, 6) as `reading` gives them, for angles (n,)."""
        directions: Array = np.ones((len(roll_rad), 4))
        self._write_directions(directions, roll_rad, tilt_rad)
        readings: Array = directions @ self._by_direction_and_one
        return readings

    def compensate(self, readings: Array, roll_rad: Array, tilt_rad: Array) -> Array:
        """Wrenches (n, 6) in ft_sensor of readings (n, 6) at angles (n,), less what is expected.

        Block by block: what a block needs in between stays in the processor's cache, so that only
        readings, angles and wrenches go through memory. Sines and cosines take most of the time.
        """
        out = np.empty_like(readings)
        directions = np.ones((min(_BLOCK, len(readings)), 4))
        for first in range(0, len(readings), _BLOCK):
            rows = slice(first, first + _BLOCK)
            block = out[rows]
            u = directions[: len(block)]
            self._write_directions(u, roll_rad[rows], tilt_rad[rows])
            np.matmul(u, self._by_direction_and_one, out=block)
            np.subtract(readings[rows], block, out=block)
            if self._to_wrench is not None:
                block[...] = self.wrenches(block)
        return out

    def _write_directions(self, out: Array, roll_rad: Array, tilt_rad: Array) -> None:
        """Write gravity's directions u for angles (n,) into the first columns of out (n, 4)."""
        (x, y, z), (zero_roll, zero_tilt) = self._down, self._zero
        roll, tilt = roll_rad + zero_roll, tilt_rad + zero_tilt
        sin_roll, cos_roll, sin_tilt, cos_tilt = (
            np.sin(roll),
            np.cos(roll),
            np.sin(tilt),
            np.cos(tilt),
        )
        across, down = y * cos_roll + z * sin_roll, y * sin_roll - z * cos_roll
        out[:, 0] = down * cos_tilt - x * sin_tilt
        out[:, 1] = across
        out[:, 2] = down * sin_tilt + x * cos_tilt

    def wrench(self, difference: Array) -> Array:
        """Wrench (6,) in ft_sensor, N and N.m, of a raw reading less the expected one (6,)."""
        return difference if self._to_wrench is None else self._to_wrench @ difference

    def wrenches(self, differences: Array) -> Array:
        """Wrenches (n, 6) as `wrench` gives them."""
        return differences if self._to_wrench is None else differences @ self._to_wrench.T
