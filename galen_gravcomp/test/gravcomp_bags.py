# SPDX-License-Identifier: Apache-2.0
"""Recordings for tests: a sweep over still poses, computed from the model, written as a bag."""

import numpy as np
from calibration_files import tool_file  # noqa: F401 - for those who use recordings
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_model.arm.galen import GALEN, SENSOR

START_NS = 1_700_000_000_000_000_000
DELAY_NS = 400_000


class Recording:
    """A sweep: `hold_s` at each pose, `move_s` between two; untouched, with the sensor's noise."""

    def __init__(self, tool, *, poses=16, hold_s=1.5, move_s=0.5, rate_hz=100.0, seed=0, noise=1.0):
        rng = np.random.default_rng(seed)
        period_ns = round(1e9 / rate_hz)
        goals = np.column_stack([rng.uniform(-1.3, 1.3, poses), rng.uniform(-0.9, 0.9, poses)])
        hold, move = round(hold_s * rate_hz), round(move_s * rate_hz)
        s = np.arange(1, move + 1) / move
        ramp = (10 * s**3 - 15 * s**4 + 6 * s**5)[:, None]
        parts = []
        for k, goal in enumerate(goals):
            if k:
                parts.append(goals[k - 1] + ramp * (goal - goals[k - 1]))
            parts.append(np.repeat(goal[None], hold, axis=0))
        angles = np.concatenate(parts)
        self.goals = goals
        self.angles = np.round(angles / 5e-5) * 5e-5
        self.stamp_ns = START_NS + period_ns * np.arange(len(angles), dtype=np.int64)
        self.wrench = tool.predict(angles)
        self.wrench = self.wrench + noise * rng.normal(size=(len(angles), 6)) * SENSOR.noise_std
        self.log_ns = self.stamp_ns + DELAY_NS
        self.kept = np.ones(len(angles), dtype=bool)
        self.pose_slices = [
            slice(k * (hold + move), k * (hold + move) + hold) for k in range(poses)
        ]

    @property
    def time_s(self):
        return (self.stamp_ns - self.stamp_ns[0]) * 1e-9

    def write(self, path, *, joint_names=GALEN.joint_names, frame_id="ft_sensor", namespace=""):
        """Quantise and write; samples not `kept` are left out. Joints come before wrenches."""
        quantised = np.round(self.wrench / SENSOR.quantum) * SENSOR.quantum
        states, forces = joint_state_bytes(joint_names), wrench_bytes(frame_id)
        with BagWriter(path) as bag:
            joints = bag.add_topic(f"{namespace}joint_states", "sensor_msgs/msg/JointState")
            wrenches = bag.add_topic(f"{namespace}wrench_raw", "geometry_msgs/msg/WrenchStamped")
            for k in np.flatnonzero(self.kept).tolist():
                positions = [0.0, 0.0, 0.408, *self.angles[k].tolist()]
                stamp, log = int(self.stamp_ns[k]), int(self.log_ns[k])
                bag.write(joints, log, states.fill(stamp, positions, [0.0] * 5))
                bag.write(wrenches, log + 1000, forces.fill(stamp, quantised[k].tolist()))
        return path
