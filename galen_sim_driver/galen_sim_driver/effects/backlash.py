"""Play in a joint: after each reversal its true value lags by half the gap (contract, section 6).

In motion: with x the reported joint and h = gap / 2 the true one is the play operator's

    w_k = min(max(w_(k-1), x_k - h), x_k + h),    w_0 = x_0 + `start` h

(e.g. Brokate and Sprekels, Hysteresis and Phase Transitions, 1996, section 2.2): x - h while it
goes up, x + h while it goes down, and between the two it stays. Where it is in its gap before the
first motion of a bag nobody knows who hasn't seen what was before: `start`, 0 for the middle, is -1
after going up and 1 after going down.

In a push: a moment M about the axis takes the joint to the side of the gap that it points to, and
there it stays until a moment points the other way. It takes M_s (`seat` times 0.05 N.m, or 0.5 N of
a sliding joint) to move it at all, so that what a sensor's noise makes of no load does nothing, and
3 M_s to take it all the way. With u = M / M_s, and clip to -1 ... 1,

    s_k = min(max(s_(k-1), clip(u - 2)), clip(u + 2)),

and the tip moves by s h less where it rested. Rest is where the last motion left the joint: on the
side it came from, s = -1 after going up; `start` before any motion. So the first push moves it by h
from the middle, and by the whole gap or not at all after a motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from galen_model.arm.galen import JOINT_NAMES
from galen_model.arrays import Array
from galen_model.rotation import rot_x
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants, Loading
from galen_sim_driver.errors import ConfigError

_TILT = JOINT_NAMES.index("tilt")
_ROLL = JOINT_NAMES.index("roll")
_SEAT = (0.5, 0.5, 0.5, 0.05, 0.05)
_STILL = (5e-5, 5e-5, 5e-5, 5e-4, 5e-4)
"""Joints that move by less, m or rad, stand: some ten quanta of the encoders."""


class _Memory:
    """What a joint in its gap knows of before."""

    def __init__(self, start: float) -> None:
        self.true: float | None = None
        self.at: float | None = None
        self.rest = self.side = start


@dataclass(frozen=True)
class Backlash(Effect):
    """`joint` has a gap of `gap_rad`; of a sliding joint, in m."""

    name: ClassVar[str] = "backlash"
    fitted: ClassVar[tuple[Fitted, ...]] = (
        Fitted("gap_rad", "rad", 0.002, 0.0, 0.2),
        Fitted("start", "", 1.0, -1.0, 1.0),
        Fitted("seat", "", 2.0, 0.1, 30.0),
    )
    beyond_contract: ClassVar[tuple[str, ...]] = ("start", "seat")

    joint: str = param("tilt", "the joint with the gap: delta_x delta_y delta_z roll tilt")
    gap_rad: float = param(0.0, "the gap, rad; of a sliding joint in m", 0.0, 0.2)
    start: float = param(
        0.0, "where in its gap it starts, -1 to 1, as after going up or down", -1.0, 1.0
    )
    seat: float = param(
        1.0, "moment that moves it through its gap, over 0.05 Nm, or force over 0.5 N", 0.1, 30.0
    )

    _memory: ClassVar[_Memory | None] = None

    @property
    def changes_nothing(self) -> bool:
        """There is no gap."""
        return self.gap_rad == 0.0

    def validate(self) -> None:
        """The joint is one of the arm's."""
        if self.joint not in JOINT_NAMES:
            known = ", ".join(JOINT_NAMES)
            raise ConfigError(f"{self.name}: joint is {self.joint!r}, not one of {known}")

    def fresh(self) -> Self:
        """The same, where it starts in its gap."""
        new = replace(self)
        # A dataclass's own way into its frozen fields; the memory is none of its numbers.
        object.__setattr__(new, "_memory", _Memory(self.start))
        return new

    @property
    def _index(self) -> int:
        return JOINT_NAMES.index(self.joint)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """The play operator on the one joint."""
        if not len(joints) or self.gap_rad == 0.0:
            return joints
        memory = self._memory or _Memory(self.start)
        half, reported = 0.5 * self.gap_rad, joints[:, self._index].tolist()
        now = reported[0] + self.start * half if memory.true is None else memory.true
        path = []
        for value in reported:
            now = min(max(now, value - half), value + half)
            path.append(now)
        memory.true = now
        true = joints.copy()
        true[:, self._index] = path
        return true

    def deflect(self, when: Instants, loading: Loading) -> Array | None:
        """How far the tip moves where the load takes the joint through its gap."""
        if not len(when) or self.gap_rad == 0.0:
            return None
        memory = self._memory or _Memory(self.start)
        column = self._column(loading)
        index = self._index
        loads = np.einsum("ni,ni->n", column, loading.wrench) / (self.seat * _SEAT[index])
        at = memory.at
        moved = []
        for place, load in zip(loading.joints[:, index].tolist(), loads.tolist(), strict=True):
            if at is None:
                at = place
            elif abs(place - at) > _STILL[index]:
                memory.rest = memory.side = -1.0 if place > at else 1.0
                at = place
            low, high = (min(max(load + way, -1.0), 1.0) for way in (-2.0, 2.0))
            memory.side = min(max(memory.side, low), high)
            moved.append(memory.side - memory.rest)
        memory.at = at
        return 0.5 * self.gap_rad * np.array(moved)[:, None] * column

    def _column(self, loading: Loading) -> Array:
        """Twist of the tip (n, 6) in base_link over the joint's rate.

        The tip lies from the tilt axis by Ry(tilt) (tilt to sensor + Ry(pi/2) tip) in the axes of
        the roll link, and from the roll axis by that and roll to tilt.
        """
        column = np.zeros((len(loading.joints), 6))
        index = self._index
        if index < _ROLL:
            column[:, index] = 1.0
            return column
        tilt, arm = loading.joints[:, _TILT], loading.arm
        z, y, x = -loading.tip_m[0], loading.tip_m[1], loading.tip_m[2]
        x, y, z = np.array([x, y, z]) + arm.tilt_to_sensor_m
        lever = np.stack(
            [
                np.cos(tilt) * x + np.sin(tilt) * z,
                0.0 * tilt + y,
                np.cos(tilt) * z - np.sin(tilt) * x,
            ],
            axis=1,
        )
        axis = np.array([0.0, 1.0, 0.0])
        if index == _ROLL:
            lever, axis = lever + arm.roll_to_tilt_m, np.array([1.0, 0.0, 0.0])
        roll = rot_x(loading.joints[:, _ROLL])
        column[:, :3] = np.einsum("nij,nj->ni", roll, np.cross(axis, lever))
        column[:, 3:] = roll @ axis
        return column
