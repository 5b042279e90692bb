# SPDX-License-Identifier: Apache-2.0
"""Recordings of pushes for tests: made from the contract's formulas, with known truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from deflection_synthetic import NOISE, POSITIONS
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import joint_state_bytes, pose_bytes, wrench_bytes
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.calibrated.prediction import Prediction
from galen_model.files.calibration_file import CalibrationFile, read_calibration
from galen_model.registration import IDENTITY, Transform, move_wrench
from galen_model.rotation import matrix_to_quaternion, rotvec_to_matrix

ROOT = Path(__file__).resolve().parents[2]
TOOL = read_calibration(ROOT / "bags" / "tools" / "retractor.json", arm=GALEN)
NS = 1_000_000_000
START_NS = 1_700_000_000 * NS
JOINTS, WRENCH = "/joint_states", "/wrench_raw"
TOOL_POSE, BASE_POSE = "/tracker/tool_pose", "/tracker/base_pose"
BASE_IN_TRACKER = Transform(rotvec_to_matrix([0.1, 2.9, 0.3]), np.array([0.15, -0.35, 1.8]))
BASE_MARKER = Transform(rotvec_to_matrix([0.05, -0.1, 0.7]), np.array([0.32, 0.21, 0.05]))


@dataclass
class Topic:
    """Messages of a topic: stamp_ns, log_ns (n,) and values (n, k), to be tampered with."""

    stamp_ns: np.ndarray
    log_ns: np.ndarray
    values: np.ndarray

    def keep(self, mask: np.ndarray) -> None:
        self.stamp_ns, self.log_ns = self.stamp_ns[mask], self.log_ns[mask]
        self.values = self.values[mask]

    def seconds(self) -> np.ndarray:
        """When each was logged, from the start."""
        return (self.log_ns - START_NS) * 1e-9


@dataclass
class Scene:
    """What is recorded; times in s. `rest_s` untouched, then pushes of `push_s` each."""

    positions: np.ndarray = field(default_factory=lambda: POSITIONS)
    rest_s: float = 1.5
    push_s: float = 0.8
    pause_s: float = 0.3
    gap_s: float = 1.0
    pushes: tuple[tuple[float, ...], ...] = ((8.0, 0.0, 0.0), (0.0, -8.0, 0.0), (0.0, 0.0, 8.0))
    joint_rate_hz: float = 100.0
    wrench_rate_hz: float = 120.0
    tracker_rate_hz: float = 60.0
    tool_marker: Transform = IDENTITY
    joint_zeros: np.ndarray = field(default_factory=lambda: np.zeros(5))
    seed: int = 0
    arm: Arm = GALEN
    tool: CalibrationFile = TOOL

    @property
    def stay_s(self) -> float:
        return self.rest_s + len(self.pushes) * (self.push_s + self.pause_s)

    @property
    def length_s(self) -> float:
        return len(self.positions) * (self.stay_s + self.gap_s)

    def wrench_at(self, time_s: np.ndarray) -> np.ndarray:
        """Applied wrench (n, 6) in ft_sensor, from forces at the tip."""
        in_stay = time_s % (self.stay_s + self.gap_s) - self.rest_s
        number = np.floor(in_stay / (self.push_s + self.pause_s)).astype(int)
        part = in_stay - number * (self.push_s + self.pause_s)
        pushed = (number >= 0) & (number < len(self.pushes)) & (part < self.push_s)
        strength = np.where(pushed, np.sin(np.pi * part / self.push_s) ** 2, 0.0)
        force = np.array(self.pushes)[np.clip(number, 0, len(self.pushes) - 1)]
        force = strength[:, None] * force
        return np.hstack([force, np.cross(np.asarray(TOOL.tip_m), force)])

    def position_at(self, time_s: np.ndarray) -> np.ndarray:
        whole = np.floor(time_s / (self.stay_s + self.gap_s)).astype(int)
        return np.clip(whole, 0, len(self.positions) - 1)

    def joints_at(self, time_s: np.ndarray) -> np.ndarray:
        """Joints as reported (n, 5): at rest in a stay, straight to the next one after it."""
        here = self.position_at(time_s)
        after = np.minimum(here + 1, len(self.positions) - 1)
        since = time_s - here * (self.stay_s + self.gap_s)
        way = np.clip((since - self.stay_s) / self.gap_s, 0.0, 1.0)[:, None]
        return (1.0 - way) * self.positions[here] + way * self.positions[after]

    def topics(self) -> dict[str, Topic]:
        rng = np.random.default_rng(self.seed)
        made = {}
        times = self._times(self.joint_rate_hz, 0.0)
        made[JOINTS] = _topic(times, self.joints_at(times))
        times = self._times(self.wrench_rate_hz, 0.0013)
        angles = self.arm.angles(self.joints_at(times))
        reading = self.wrench_at(times) + Prediction(self.tool, self.arm).readings(angles)
        noise = rng.standard_normal((len(times), 6)) * SENSOR.noise_std
        made[WRENCH] = _topic(times, reading + noise)
        times = self._times(self.tracker_rate_hz, 0.0021)
        joints = self.joints_at(times) + self.joint_zeros
        tip = Transform(*self.arm.tip_pose(joints, self.tool.tip_m))
        tip = tip.displaced(self.deflection_at(times))
        made[TOOL_POSE] = self._seen(times, tip @ repeated(self.tool_marker, len(times)), rng)
        times = self._times(self.tracker_rate_hz, 0.0055)
        made[BASE_POSE] = self._seen(times, repeated(BASE_MARKER, len(times)), rng)
        return made

    def deflection_at(self, time_s: np.ndarray) -> np.ndarray:
        """True deflection (n, 6)."""
        found = np.zeros((len(time_s), 6))
        wrench, which = self.wrench_at(time_s), self.position_at(time_s)
        for number, joints in enumerate(self.positions + self.joint_zeros):
            here = which == number
            found[here] = nominal(joints, wrench[here], self.tool.tip_m, self.arm)
        return found

    def _times(self, rate_hz: float, first_s: float) -> np.ndarray:
        return np.arange(first_s, self.length_s - self.gap_s, 1.0 / rate_hz)

    def _seen(self, times: np.ndarray, poses: Transform, rng: np.random.Generator) -> Topic:
        seen = repeated(BASE_IN_TRACKER, len(times)) @ poses
        seen = seen.displaced(rng.standard_normal((len(times), 6)) * NOISE)
        return _topic(times, np.hstack([seen.translation, matrix_to_quaternion(seen.rotation)]))


def nominal(joints: np.ndarray, wrench: np.ndarray, tip_m=TOOL.tip_m, arm=GALEN) -> np.ndarray:
    """Nominal deflections (n, 6) of one position's wrenches (n, 6) in ft_sensor."""
    rotation, origin = arm.sensor_pose(joints)
    _, tip = arm.tip_pose(joints, tip_m)
    return move_wrench(wrench, rotation, origin - tip) @ arm.tip_compliance(joints, tip_m).T


def write(path: Path, topics: dict[str, Topic], frame: str = "tracker", arm: Arm = GALEN) -> Path:
    """Write a bag."""
    names = arm.joint_names
    fill = {
        JOINTS: (
            "sensor_msgs/msg/JointState",
            lambda stamp, row: joint_state_bytes(names).fill(stamp, row, [0.0] * len(row)),
        ),
        WRENCH: ("geometry_msgs/msg/WrenchStamped", wrench_bytes("ft_sensor").fill),
    }
    for name in (TOOL_POSE, BASE_POSE):
        pose = pose_bytes(frame)
        fill[name] = (
            "geometry_msgs/msg/PoseStamped",
            lambda stamp, row, pose=pose: pose.fill(stamp, row[:3], row[3:]),
        )
    messages = []
    with BagWriter(path, compressed=False) as bag:
        for name, topic in topics.items():
            kind, to_bytes = fill[name]
            handle = bag.add_topic(name, kind)
            messages += [
                (log, handle, to_bytes(stamp, row))
                for log, stamp, row in zip(
                    topic.log_ns.tolist(),
                    topic.stamp_ns.tolist(),
                    topic.values.tolist(),
                    strict=True,
                )
            ]
        for log, handle, data in sorted(messages, key=lambda message: message[0]):
            bag.write(handle, log, data)
    return path


def _topic(times: np.ndarray, values: np.ndarray) -> Topic:
    stamp_ns = START_NS + np.rint(times * NS).astype(np.int64)
    return Topic(stamp_ns, stamp_ns + 200_000, values)


def repeated(one: Transform, count: int) -> Transform:
    """The same transform so many times."""
    rotation = np.broadcast_to(one.rotation, (count, 3, 3))
    return Transform(rotation, np.broadcast_to(one.translation, (count, 3)))
