"""The expected reading of a tool, fast for one pose at a time and for arrays of poses."""

import math

import numpy as np
from galen_model.arrays import Array
from galen_model.tool_file import ToolFile


class Prediction:
    """`ToolFile.predict`, for single poses some ten times as fast.

    Every term of the model is linear in gravity's direction in the sensor's frame or constant:

        reading = A u + c,   u = (cos roll cos tilt, -sin roll, cos roll sin tilt)

    (u is `galen_model.kinematics.gravity_in_sensor` over g). A (6, 3) and c (6,) are read off
    `predict` itself at the poses where u is +x, -x, y and z, so the physics stays in one place.
    """

    def __init__(self, tool: ToolFile) -> None:
        half_pi = math.pi / 2
        plus_x, minus_x, y, z = tool.predict(
            np.array([0.0, math.pi, -half_pi, 0.0]), np.array([0.0, 0.0, 0.0, half_pi])
        )
        self._constant: Array = (plus_x + minus_x) / 2
        self._by_direction: Array = np.stack([plus_x, y, z], axis=1) - self._constant[:, None]

    def reading(self, roll_rad: float, tilt_rad: float) -> Array:
        """Reading (6,) expected without touch, N and N.m in the sensor's frame."""
        cos_roll = math.cos(roll_rad)
        direction = np.array(
            (
                cos_roll * math.cos(tilt_rad),
                -math.sin(roll_rad),
                cos_roll * math.sin(tilt_rad),
            )
        )
        reading: Array = self._by_direction @ direction + self._constant
        return reading

    def readings(self, roll_rad: Array, tilt_rad: Array) -> Array:
        """Readings (n, 6) as `reading` gives them, for angles (n,)."""
        cos_roll = np.cos(roll_rad)
        directions = np.stack(
            (cos_roll * np.cos(tilt_rad), -np.sin(roll_rad), cos_roll * np.sin(tilt_rad)), axis=1
        )
        readings: Array = directions @ self._by_direction.T + self._constant
        return readings

    def wrench(self, difference: Array) -> Array:
        """Wrench (6,) in ft_sensor, N and N.m, of a raw reading less the expected one (6,)."""
        return difference

    def wrenches(self, differences: Array) -> Array:
        """Wrenches (n, 6) as `wrench` gives them."""
        return differences
