# SPDX-License-Identifier: Apache-2.0
"""A small arm, sensor, tracker and hand for the tests of the collection: no ROS, exact physics."""

from dataclasses import dataclass

import numpy as np
from galen_deflection.collection.plan import CollectionParameters
from galen_deflection.models.springs import Springs
from galen_model.arm.galen import GALEN
from galen_model.registration import Transform
from push_bag import BASE_IN_TRACKER, BASE_MARKER

STEP_S = 0.01
STEP_NS = 10_000_000
TIP = np.array([0.18, 0.01, 0.05])
BASE_POSE = BASE_IN_TRACKER @ BASE_MARKER
TRACKER_EVERY = 3
SPRINGS = Springs(TIP, arm=GALEN)


@dataclass(frozen=True)
class Impatient(CollectionParameters):
    overload_share = 1.5
    release_timeout_s = 1.0
    push_edge_s = 0.2
    max_left_out_in_a_row = 3


class FakeArm:
    """Steps by 10 ms. What the tests let go wrong is set through the public attributes."""

    def __init__(self, seed=1):
        self.random = np.random.default_rng(seed)
        self.stamp_ns = 1_000_000_000
        self.joints = np.array(GALEN.home, float)
        self.load = np.zeros(6)  # at the tip in base_link
        self.drift = np.zeros(5)  # of the joints, m and rad per s, at any time
        self.ignored_joints = ()
        self.offset = np.array([0.05, -0.03, 0.02, 0.002, 0.0, -0.001])  # the wrench's own zero
        self.noise_n = 0.02
        self.marker_hidden = False
        self.base_shift = np.zeros(6)
        self.skip_ns = 0  # added once to the next stamp
        self._from = self._to = self.joints.copy()
        self._progress, self._duration = 1.0, 1.0
        self._known = None
        self._steps = 0

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

    def step(self):
        """Go on by 10 ms; return stamp (ns), positions, velocities, wrench, two poses or None."""
        self.stamp_ns += STEP_NS + self.skip_ns
        self.skip_ns = 0
        before = self.joints.copy()
        self._progress = min(1.0, self._progress + STEP_S / self._duration)
        x = self._progress
        path = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        self._from = self._from + self.drift * STEP_S
        self._to = self._to + self.drift * STEP_S
        self.joints = self._from + path * (self._to - self._from)
        self._steps += 1
        wrench = np.linalg.solve(self._here().to_tip, self.load) + self.offset
        wrench[:3] += self.noise_n * self.random.standard_normal(3)
        wrench[3:] += 0.02 * self.noise_n * self.random.standard_normal(3)
        looks = self._steps % TRACKER_EVERY == 0
        return (
            self.stamp_ns,
            self.joints.copy(),
            (self.joints - before) / STEP_S,
            wrench,
            self._tool_pose() if looks and not self.marker_hidden else None,
            self._seen(BASE_POSE.displaced(self.base_shift)) if looks else None,
        )

    def _here(self):
        """Worked out anew only when the arm has moved."""
        if self._known is None or not np.array_equal(self._known.joints, self.joints):
            self._known = Here(
                self.joints.copy(),
                SPRINGS.geometry(self.joints[None]).to_tip[0],
                Transform(*GALEN.tip_pose(self.joints, TIP)),
                None if self.moving else GALEN.tip_compliance(self.joints, TIP),
            )
        return self._known

    def _tool_pose(self):
        here = self._here()
        tip = here.tip
        if here.compliance is not None and np.any(self.load):
            tip = tip.displaced(here.compliance @ self.load)
        return self._seen(BASE_IN_TRACKER @ tip)

    def _seen(self, pose):
        noise = 3e-5 * self.random.standard_normal(3)
        return Transform(pose.rotation, pose.translation + noise)


@dataclass(frozen=True)
class Here:
    """What hangs on the joints alone; no compliance on the way."""

    joints: np.ndarray
    to_tip: np.ndarray
    tip: Transform
    compliance: np.ndarray | None


class Hand:
    """Pushes as the procedure asks, a share of it at a time: what a willing person does."""

    def __init__(self):
        self.share = 1.0  # of the level
        self.aside = np.zeros(6)  # beside what is asked
        self.lets_go = True
        self.delay_s = 0.2
        self._target = np.zeros(6)

    def hear(self, feedback):
        """Do as the feedback says."""
        asked = feedback.state.name in ("PUSH", "HOLD")
        if asked:
            self._target = self.share * np.nan_to_num(feedback.wanted) + self.aside
        elif self.lets_go:
            self._target = np.zeros(6)

    def step(self, load):
        """The load one step later: nearer to what it wants."""
        return load + (self._target - load) * min(1.0, STEP_S / self.delay_s * 3.0)
