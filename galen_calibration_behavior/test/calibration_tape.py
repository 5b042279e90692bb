# SPDX-License-Identifier: Apache-2.0
"""Recordings made in memory for the tests: still poses, moves and hands, by exact physics."""

from pathlib import Path

import numpy as np
from galen_bags.arrays.arm_recording import ArmRecording
from galen_model.arm.galen import ENCODER_QUANTUM, GALEN, SENSOR
from galen_model.load.model import ADAPTER, TOOLS, Load, gravity_wrench

START_NS = 1_700_000_000_000_000_000
NS = 1_000_000_000
NO_TOOL = Load(0.0)


def grid(rolls=(-1.2, -0.4, 0.4, 1.2), tilts=(-0.9, 0.0, 0.8)):
    """Poses (roll, tilt) in a serpentine, rad."""
    rows = []
    for k, roll in enumerate(rolls):
        rows += [(roll, tilt) for tilt in (tilts if k % 2 == 0 else tilts[::-1])]
    return rows


class Tape:
    """Writes samples of both topics as the arm goes; `recording()` is what a bag would hold.

    What the tests let go wrong is set through the attributes between two calls.
    """

    def __init__(self, seed=1, rate_hz=100.0, tool=NO_TOOL, adapter=ADAPTER):
        self.random = np.random.default_rng(seed)
        self.rate_hz = rate_hz
        self.tool, self.adapter = tool, adapter
        self.bias = np.zeros(6)
        self.touch = lambda time_s: np.zeros(6)  # of the time since the call, per sample
        self.velocities_known = True
        self.frame_ids = ("ft_sensor",)
        self.problems = ()
        self.now_ns = START_NS
        self.pose = np.zeros(2)
        self._stamps, self._log, self._joints, self._velocities, self._wrenches = (
            [] for _ in "12345"
        )
        self._log_offset_ns = 0

    @property
    def time_s(self):
        """Since the first sample."""
        return (self.now_ns - START_NS) / NS

    def stay(self, duration_s):
        """Stand still."""
        self._write(np.tile(self.pose, (round(duration_s * self.rate_hz), 1)))
        return self

    def move(self, pose, duration_s=0.5):
        """Go there on a quintic, from rest to rest."""
        x = np.arange(1, round(duration_s * self.rate_hz) + 1)[:, None] / (
            duration_s * self.rate_hz
        )
        path = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        self._write(self.pose + path * (np.asarray(pose, float) - self.pose))
        self.pose = np.array(pose, float)
        return self

    def zero(self):
        """What zero_ft_sensor does, without noise."""
        self.bias = self._true(self.pose[None])[0]
        return self

    def jump(self, step_s):
        """Let the stamps jump; the log times go on."""
        self.now_ns += round(step_s * NS)
        self._log_offset_ns -= round(step_s * NS)
        return self

    def sweep(self, poses, still_s=1.0):
        """Visit them all."""
        for pose in poses:
            self.move(pose).stay(still_s)
        return self

    def calibration(self, tool, poses=None, still_s=1.0):
        """What a recorder sees of a live calibration of both sweeps."""
        poses = grid() if poses is None else poses
        self.stay(1.5).zero().stay(1.5).sweep(poses, still_s)
        self.move((0.0, 0.0)).stay(1.5)
        self.tool = tool
        return self.stay(1.5).sweep(poses, still_s).move((0.0, 0.0)).stay(1.0)

    def recording(self, path="tape", stop=None):
        """The recording, up to sample `stop`."""
        stamps = np.concatenate(self._stamps)[:stop]
        log = np.concatenate(self._log)[:stop]
        angles = np.concatenate(self._joints)[:stop]
        joints = np.column_stack([np.tile(GALEN.home[:3], (len(angles), 1)), angles])
        velocities = np.column_stack(
            [np.zeros((len(angles), 3)), np.concatenate(self._velocities)[:stop]]
        )
        wrenches = np.concatenate(self._wrenches)[:stop]
        return ArmRecording(
            Path(path),
            stamps,
            log,
            np.round(joints / ENCODER_QUANTUM) * ENCODER_QUANTUM,
            velocities if self.velocities_known else np.full_like(velocities, np.nan),
            stamps.copy(),
            log.copy(),
            np.round(wrenches / SENSOR.quantum) * SENSOR.quantum,
            self.frame_ids,
            self.problems,
        )

    def _true(self, angles):
        gravity = GALEN.gravity_in_sensor(angles)
        return gravity_wrench(gravity, self.tool) + gravity_wrench(gravity, self.adapter)

    def _write(self, angles):
        period_ns = round(NS / self.rate_hz)
        count = len(angles)
        stamps = self.now_ns + period_ns * np.arange(count)
        self.now_ns += period_ns * count
        time = np.arange(count) / self.rate_hz
        noise = SENSOR.noise_std * self.random.standard_normal((count, 6))
        touch = np.array([self.touch(t) for t in time])
        before = np.concatenate([[self.pose], angles[:-1]])
        self._stamps.append(stamps)
        self._log.append(stamps + self._log_offset_ns)
        self._joints.append(angles)
        self._velocities.append((angles - before) * self.rate_hz)
        self._wrenches.append(self._true(angles) - self.bias + touch + noise)


POINTER, RETRACTOR = TOOLS["pointer"].load, TOOLS["retractor"].load
