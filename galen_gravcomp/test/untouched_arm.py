# SPDX-License-Identifier: Apache-2.0
"""A made-up arm for tests of what is watched live: poses, pushes, another load, drift."""

import calibration_files
import numpy as np
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.load.model import Load, gravity_wrench

POINTER = Load(0.06, np.array([0.055, 0.002, 0.045]))
RETRACTOR = Load(0.2, np.array([0.07, -0.01, 0.055]))
NO_TOOL = Load(0.0, np.zeros(3))
LEVER = np.array([0.15, 0.0, 0.05])
START_NS = 1_700_000_000_000_000_000


def tool_file(load=RETRACTOR, name="retractor"):
    rmse = np.array([0.004, 0.004, 0.005, 1e-4, 1e-4, 1e-4])
    covariance = np.diag([2e-4, 1e-4, 1e-4, 1e-4]) ** 2
    made = calibration_files.tool_file(load.mass_kg, load.com_m, name, rmse=rmse)
    made.load.covariance[:] = made.adapter.covariance[:] = covariance
    return made


def push(force):
    """A push (6,) at the tip by a force (3,) in the sensor's axes."""
    return np.concatenate([force, np.cross(LEVER, force)])


class UntouchedArm:
    """Gives `take(stamp_ns, angles, wrench)` what is left when the file's weight is off."""

    def __init__(self, take, file=None, *, rate_hz=50.0, seed=0, noise=1.0):
        self.take = take
        self.file = file or tool_file()
        self.on = self.file.load.load
        self.rng = np.random.default_rng(seed)
        self.period_s = 1.0 / rate_hz
        self.noise = noise
        self.pose = np.zeros(2)
        self.time_s = 0.0
        self.sag_m = 0.0
        self.offset = np.zeros(6)
        self.drift_per_h = np.zeros(6)

    def left(self, pose):
        """What is left (6,) at a pose, without drift and noise."""
        gravity = GALEN.gravity_in_sensor(np.stack(pose, axis=-1))
        unit = gravity / np.linalg.norm(gravity)
        centre = self.on.com_m + self.sag_m * unit * [1.0, 1.0, 0.0]
        true = gravity_wrench(gravity, Load(self.on.mass_kg, centre))
        return true - gravity_wrench(gravity, self.file.load.load) + self.offset

    def hold(self, duration_s, extra=None, tremor=0.0):
        """Stand; `extra` (t from 0 on, s) -> (6,), or (6,); it trembles by a share of itself."""
        count = round(duration_s / self.period_s)
        t = np.arange(count) * self.period_s
        pushed = np.zeros((count, 6))
        if extra is not None:
            waves = np.sin(2 * np.pi * 9.0 * t) + np.sin(2 * np.pi * 0.8 * t)
            pushed += np.array([extra(now) for now in t]) if callable(extra) else extra
            pushed *= (1.0 + tremor * waves)[:, None]
        self._go(np.broadcast_to(self.pose, (count, 2)), self.left(self.pose) + pushed)

    def move(self, pose, duration_s=0.6, extra=0.0):
        start, goal = self.pose, np.asarray(pose, dtype=float)
        count = round(duration_s / self.period_s)
        s = (np.arange(1, count + 1) / count)[:, None]
        poses = start + (3.0 * s**2 - 2.0 * s**3) * (goal - start)
        self._go(poses, np.array([self.left(pose) for pose in poses]) + extra)
        self.pose = goal

    def _go(self, poses, left):
        count = len(poses)
        time_s = self.time_s + self.period_s * np.arange(1, count + 1)
        noise = self.noise * self.rng.normal(size=(count, 6)) * SENSOR.noise_std
        wrenches = left + noise + time_s[:, None] / 3600.0 * self.drift_per_h
        wrenches = np.round(wrenches / SENSOR.quantum) * SENSOR.quantum
        for k in range(count):
            self.time_s = float(time_s[k])
            stamp_ns = START_NS + round(self.time_s * 1e9)
            self.take(stamp_ns, tuple(poses[k].tolist()), wrenches[k])

    def visit(self, count, hold_s=2.0):
        for _ in range(count):
            self.hold(hold_s)
            self.move(self.rng.uniform([-1.3, -0.9], [1.3, 0.9]))
