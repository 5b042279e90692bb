"""How the arm moves: joints, velocities and accelerations at any time, in closed form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from scipy.interpolate import CubicSpline


class Going(NamedTuple):
    """Joints (n, 5), velocities and accelerations, m, rad, s."""

    joints: Array
    velocity: Array
    acceleration: Array


class Stops:
    """From pose to pose, standing at each, with moves of the fifth degree between.

    q = a + (b - a) (10 s^3 - 15 s^4 + 6 s^5): velocity and acceleration vanish at both ends.
    """

    def __init__(self, poses: Array, arrive_s: Array, leave_s: Array) -> None:
        """Stand at poses (k, 5), at each from arrive_s to leave_s, both (k,)."""
        self.poses = poses
        self.arrive_s = arrive_s
        self.leave_s = leave_s

    def at(self, at_s: Array) -> Going:
        """Where the arm is at times (n,)."""
        last = len(self.poses) - 1
        number = np.clip(np.searchsorted(self.arrive_s, at_s, side="right") - 1, 0, last)
        after = np.minimum(number + 1, last)
        takes = np.where(after > number, self.arrive_s[after] - self.leave_s[number], 1.0)
        s = np.clip((at_s - self.leave_s[number]) / takes, 0.0, 1.0)
        s = np.where(after > number, s, 0.0)
        way = self.poses[after] - self.poses[number]
        place = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        rate = 30.0 * s**2 * (1.0 - s) ** 2 / takes
        change = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / takes**2
        return Going(
            self.poses[number] + place[:, None] * way, rate[:, None] * way, change[:, None] * way
        )


class Spline:
    """Through knots with continuous acceleration, at rest at both ends."""

    def __init__(self, knot_s: Array, joints: Array) -> None:
        """Go through joints (k, 5) at knot_s (k,)."""
        self._place = CubicSpline(knot_s, joints, bc_type="clamped")
        self._rate = self._place.derivative(1)
        self._change = self._place.derivative(2)
        self._ends = (float(knot_s[0]), float(knot_s[-1]))

    def at(self, at_s: Array) -> Going:
        """Where the arm is at times (n,)."""
        inside = np.clip(at_s, *self._ends)
        return Going(self._place(inside), self._rate(inside), self._change(inside))


class Multisine:
    """Sines about a middle, faded in from rest and out again over `fade_s` by sin^4."""

    def __init__(
        self,
        middle: Array,
        amplitude: Array,
        frequency_hz: Array,
        phase_rad: Array,
        duration_s: float,
        fade_s: float,
    ) -> None:
        """Go about `middle` (5,); amplitude, frequency_hz, phase_rad (k, 5)."""
        self._middle = middle
        self._amplitude = amplitude
        self._omega = 2.0 * np.pi * frequency_hz
        self._phase = phase_rad
        self._duration_s = duration_s
        self._fade_s = fade_s

    def at(self, at_s: Array) -> Going:
        """Where the arm is at times (n,)."""
        angle = self._omega * at_s[:, None, None] + self._phase
        sine, cosine = np.sin(angle), np.cos(angle)
        place = np.sum(self._amplitude * sine, axis=1)
        rate = np.sum(self._amplitude * self._omega * cosine, axis=1)
        change = -np.sum(self._amplitude * self._omega**2 * sine, axis=1)
        e, e1, e2 = (part[:, None] for part in self._envelope(at_s))
        return Going(
            self._middle + e * place,
            e1 * place + e * rate,
            e2 * place + 2.0 * e1 * rate + e * change,
        )

    def _envelope(self, at_s: Array) -> tuple[Array, Array, Array]:
        left = np.minimum(at_s, self._duration_s - at_s)
        sign = np.where(at_s < 0.5 * self._duration_s, 1.0, -1.0)
        # sin^4, so that acceleration starts from zero.
        x = 0.5 * np.pi * np.clip(left / self._fade_s, 0.0, 1.0)
        by = 0.5 * np.pi / self._fade_s
        inside = (left > 0.0) & (left < self._fade_s)
        sine, cosine = np.sin(x), np.cos(x)
        first = np.where(inside, 4.0 * sine**3 * cosine * by, 0.0)
        second = np.where(inside, (12.0 * sine**2 * cosine**2 - 4.0 * sine**4) * by**2, 0.0)
        return sine**4, sign * first, second


Course = Stops | Spline | Multisine
