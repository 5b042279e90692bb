"""A recording of joints and wrenches made into the sensor's motion, filtered alike.

Derivatives of encoders are noisy, and noise in a regressor draws what is fitted by it towards zero;
smoothing them alone leaves a bias wherever the motion is fast. So joints and wrench go through the
same zero-phase low-pass before the joints are differentiated: what it takes away, it takes away on
both sides of the equation (Swevers, Verdonck, De Schutter, *IEEE Control Systems* 27(5), 2007,
"parallel filtering"). Products of slow and fast motion are filtered not quite alike, which matters
only for motion near the cut-off.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.signal import butter, sosfiltfilt

from galen_model.arm.sensor_motion import sensor_motion
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.load.mounting.mounting import Mounting

CUTOFF_HZ = 10.0
"""The arm's own motion is below 5 Hz."""
_ORDER = 4
_SAMPLES_A_CUTOFF = 10.0
_EDGE_S = 0.3
_LARGEST_GAP_S = 0.05


@dataclass(frozen=True)
class MotionRecord:
    """The sensor's motion at each reading, all in ft_sensor: time_s (n,), the rest (n, 3), (n, 6).

    gravity, acceleration of the origin (m/s^2), angular velocity and acceleration, wrench.
    """

    time_s: Array
    gravity: Array
    acceleration_m_s2: Array
    velocity_rad_s: Array
    acceleration_rad_s2: Array
    wrench: Array

    def __len__(self) -> int:
        """Number of readings."""
        return len(self.time_s)

    def take(self, rows: np.ndarray) -> MotionRecord:
        """Some of the readings, by index or mask."""
        return MotionRecord(
            self.time_s[rows],
            self.gravity[rows],
            self.acceleration_m_s2[rows],
            self.velocity_rad_s[rows],
            self.acceleration_rad_s2[rows],
            self.wrench[rows],
        )


def motion_record(
    joint_stamp_ns: np.ndarray,
    joints: Array,
    wrench_stamp_ns: np.ndarray,
    wrenches: Array,
    mounting: Mounting | None = None,
    cutoff_hz: float = CUTOFF_HZ,
) -> MotionRecord:
    """From joints (n, 5), m and rad, and wrenches (m, 6), N and N.m, with their stamps, ns.

    Readings come at ten times the cut-off; the ends of each stretch without a gap are left out, as
    filters have nothing to hold on to there. Raises IdentificationError where nothing is left.
    """
    mounting = mounting or Mounting()
    kept = np.isfinite(joints).all(axis=1)
    joint_stamp_ns, joints = joint_stamp_ns[kept], joints[kept]
    kept = np.isfinite(wrenches).all(axis=1)
    wrench_stamp_ns, wrenches = wrench_stamp_ns[kept], wrenches[kept]
    start_ns = int(joint_stamp_ns[0]) if len(joint_stamp_ns) else 0
    joint_s = (joint_stamp_ns - start_ns) * 1e-9
    wrench_s = (wrench_stamp_ns - start_ns) * 1e-9
    parts = []
    for first_s, last_s in _stretches(joint_s, wrench_s):
        period_s = float(np.median(np.diff(joint_s)))
        if 1.0 / period_s < 4.0 * cutoff_hz:
            raise IdentificationError(
                f"joint_states come at {1.0 / period_s:.0f} Hz; {4.0 * cutoff_hz:.0f} Hz or more"
                " are needed to tell motion"
            )
        time_s = np.arange(first_s, last_s, period_s)
        sections = butter(_ORDER, cutoff_hz, fs=1.0 / period_s, output="sos")
        smooth, felt = (
            sosfiltfilt(sections, _at(time_s, own_s, values), axis=0)
            for own_s, values in ((joint_s, joints), (wrench_s, wrenches))
        )
        velocity = np.gradient(smooth, period_s, axis=0)
        acceleration = np.gradient(velocity, period_s, axis=0)
        step = max(1, round(1.0 / (_SAMPLES_A_CUTOFF * cutoff_hz * period_s)))
        edge = round(_EDGE_S / period_s)
        rows = slice(edge, len(time_s) - edge, step)
        angles = smooth[rows, 3:]
        turned = smooth[rows].copy()
        turned[:, 3:] += mounting.joint_zero_rad
        motion = sensor_motion(turned, velocity[rows], acceleration[rows])
        parts.append(
            MotionRecord(
                time_s[rows],
                mounting.gravity_in_sensor(angles[:, 0], angles[:, 1]),
                motion.acceleration_m_s2,
                motion.velocity_rad_s,
                motion.acceleration_rad_s2,
                felt[rows] @ mounting.wrench_from_reading.T,
            )
        )
    if not parts:
        raise IdentificationError(
            f"joints and wrenches never come together for {4 * _EDGE_S:.1f} s without a gap"
        )
    return MotionRecord(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in _FIELDS)
    )


_FIELDS = (
    "time_s", "gravity", "acceleration_m_s2", "velocity_rad_s", "acceleration_rad_s2", "wrench",
)  # fmt: skip


def _at(time_s: Array, own_s: Array, values: Array) -> Array:
    return np.column_stack([np.interp(time_s, own_s, column) for column in values.T])


def _stretches(joint_s: Array, wrench_s: Array) -> list[tuple[float, float]]:
    """From where to where both come without a gap, s."""
    if len(joint_s) < 2 or len(wrench_s) < 2:
        return []
    first = max(joint_s[0], wrench_s[0])
    last = min(joint_s[-1], wrench_s[-1])
    borders = [(float(first), float(first)), (float(last), float(last))]
    for own_s in (joint_s, wrench_s):
        for row in np.flatnonzero(np.diff(own_s) > _LARGEST_GAP_S):
            borders.append((float(own_s[row]), float(own_s[row + 1])))
    borders.sort()
    found = []
    for (_, begin), (end, _) in pairwise(borders):
        if end - begin > 4 * _EDGE_S and first <= begin and end <= last:
            found.append((begin, end))
    return found
