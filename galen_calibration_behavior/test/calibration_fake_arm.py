# SPDX-License-Identifier: Apache-2.0
"""A small arm, sensor and hand for the tests: no ROS, no limits, exact physics plus noise."""

import numpy as np
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.load.model import Load, gravity_wrench

ADAPTER = Load(0.100, np.array([0.0, 0.0, 0.020]))
POINTER = Load(0.060, np.array([0.055, 0.002, 0.045]))
NO_TOOL = Load(0.0)
STEP_S = 0.01
STEP_NS = 10_000_000


class FakeArm:
    """Steps by 10 ms. What the tests let go wrong is set through the public attributes."""

    def __init__(self, seed=1, start=GALEN.home, arm=GALEN):
        self.arm = arm
        self.random = np.random.default_rng(seed)
        self.stamp_ns = 1_000_000_000
        self.joints = np.array(start, float)
        self.velocities = np.zeros(len(arm.joints))
        self.tool = POINTER
        self.bias = np.zeros(6)
        self.ignored_joints = ()  # these don't follow commands
        self.creep = np.zeros(len(arm.joints))  # rad/s or m/s at any time
        self.report_velocity = True
        self.noise = SENSOR.noise_std.copy()
        self.touch = lambda arm: np.zeros(6)
        self.skip_ns = 0  # added once to the next stamp
        self._from = self._to = self.joints.copy()
        self._progress, self._duration = 1.0, 1.0
        self._known = (None, None)

    def move_to(self, joints, duration_s):
        """Begin a quintic from rest to rest."""
        self._from, self._to = self.joints.copy(), np.array(joints, float)
        for k in self.ignored_joints:
            self._to[k] = self._from[k]
        self._progress, self._duration = 0.0, duration_s

    def stop(self):
        """Stay here."""
        self._from = self._to = self.joints.copy()
        self._progress = 1.0

    @property
    def moving(self):
        return self._progress < 1.0

    def true_reading(self):
        """Reading before bias, touch and noise; worked out anew only when something has changed."""
        key = (*self.arm.angles(self.joints), id(self.tool))
        if self._known[0] != key:
            gravity = self.arm.gravity_in_sensor(key[:-1])
            loads = gravity_wrench(gravity, self.tool) + gravity_wrench(gravity, ADAPTER)
            self._known = (key, loads)
        return self._known[1]

    def zero(self):
        """What zero_ft_sensor does."""
        self.bias = self.true_reading() + self.touch(self)

    def step(self):
        """Go on by 10 ms; return stamp (ns), positions, velocities or None, wrench."""
        self.stamp_ns += STEP_NS + self.skip_ns
        self.skip_ns = 0
        before = self.joints.copy()
        self._progress = min(1.0, self._progress + STEP_S / self._duration)
        x = self._progress
        path = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        self._from = self._from + self.creep * STEP_S
        self._to = self._to + self.creep * STEP_S
        self.joints = self._from + path * (self._to - self._from)
        self.velocities = (self.joints - before) / STEP_S
        noise = self.noise * self.random.standard_normal(6)
        wrench = self.true_reading() - self.bias + self.touch(self) + noise
        return (
            self.stamp_ns,
            self.joints.copy(),
            self.velocities.copy() if self.report_velocity else None,
            wrench,
        )
