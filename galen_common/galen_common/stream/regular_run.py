# SPDX-License-Identifier: Apache-2.0
"""How far samples in the order of their arrival are regular, and what becomes of them, as arrays.

Regular is what `Compensator` compensates without a rejection, a restart or a dropped sample.
Nothing is changed here: the compensator takes over what was found, and pushes the sample at which
it ended by itself. The rules are those of `SampleLimits` and `JointBuffer`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array

from galen_common.stream.samples import JointBuffer, SampleLimits, joint_jump, surely_finite

# Earlier and later than any stamp of a message, which has 32 bits for the seconds; differences of
# these don't overflow.
_BEFORE_ALL_NS = -(2**61)
_AFTER_ALL_NS = 2**61


@dataclass(frozen=True)
class Arrivals:
    """Samples of both topics; is_wrench (n,) says whose the next one is.

    Joints: stamps (j,) ns, joints (j, k) m and rad, all of the arm's or the turning ones.
    Wrenches: stamps (w,), wrenches (w, 6) N and N.m.
    `*_usable`: whether the message could be read and its frame is right.
    """

    is_wrench: np.ndarray
    joint_stamp_ns: np.ndarray
    joints: Array
    joint_usable: np.ndarray
    wrench_stamp_ns: np.ndarray
    wrenches: Array
    wrench_usable: np.ndarray

    def first(self, count: int) -> Arrivals:
        """Return only the samples that came first.

        Args:
            count: how many, of both topics together.

        Returns:
            Views of the arrays' beginnings.

        """
        w = int(np.count_nonzero(self.is_wrench[:count]))
        j = count - w
        return Arrivals(
            self.is_wrench[:count],
            self.joint_stamp_ns[:j],
            self.joints[:j],
            self.joint_usable[:j],
            self.wrench_stamp_ns[:w],
            self.wrenches[:w],
            self.wrench_usable[:w],
        )


def find_regular_run(
    arrivals: Arrivals,
    waiting_ns: np.ndarray,
    newest_wrench_ns: int | None,
    joints: JointBuffer,
    limits: SampleLimits,
    reported: tuple[int, tuple[float, ...]] | None,
    angles: Array,
) -> tuple[Arrivals, Array]:
    """Find the regular run at the start of the arrivals.

    Args:
        arrivals: samples of both topics; joints (j, all n or the k turning ones).
        waiting_ns: (k,) stamps of the wrenches that wait, ns.
        newest_wrench_ns: stamp of the newest wrench before, ns; None: there is none.
        joints: the joint samples before.
        limits: of steps, ages and the queue.
        reported: stamp, ns, and angles, rad, of the last joint sample before; None: there is none.
        angles: (j, k) of the arrivals' turning joints, rad.

    Returns:
        The regular arrivals; and joints, as many rows as wrenches come out. These are the first
        ones of the wrenches that waited, followed by those that arrived.

    """
    if np.any(np.diff(waiting_ns) <= 0):
        return arrivals.first(0), np.zeros((0, arrivals.joints.shape[1]))
    arrivals = arrivals.first(
        _in_line(
            arrivals,
            newest_wrench_ns,
            joints.newest_ns,
            limits,
            _jumps(arrivals.joint_stamp_ns, angles, reported, joints),
        )
    )
    # From here on the stamps of either topic increase, so they can be searched.
    wrench_at = np.flatnonzero(arrivals.is_wrench)
    joint_at = np.flatnonzero(~arrivals.is_wrench)
    waited = len(waiting_ns)
    wrench_ns = np.concatenate((waiting_ns, arrivals.wrench_stamp_ns))
    oldest_ns = int(wrench_ns[0]) if len(wrench_ns) else _AFTER_ALL_NS
    kept_ns, kept_joints = joints.since(oldest_ns)
    joint_ns = np.concatenate((kept_ns, arrivals.joint_stamp_ns))
    # How many samples of `joint_ns` there are when each wrench arrives.
    seen = len(kept_ns) + wrench_at - np.arange(len(wrench_at))

    # On arrival: a wrench without joints may wait, but neither for too long nor with too many.
    newest_ns = np.concatenate(([_BEFORE_ALL_NS], joint_ns))[seen]
    waits = arrivals.wrench_stamp_ns > newest_ns
    behind_ns = arrivals.wrench_stamp_ns - np.where(seen > 0, newest_ns, oldest_ns)
    queued = waited + 1 + np.arange(len(seen)) - np.searchsorted(wrench_ns, newest_ns, side="right")
    dropped = waits & ((behind_ns > limits.max_age_ns) | (queued > limits.max_waiting))

    # A wrench comes out once both it and the first joint sample not before it are there.
    after = np.searchsorted(joint_ns, wrench_ns, side="left")
    after = after[: np.searchsorted(after, len(joint_ns), side="left")]
    arrived = np.concatenate((np.full(waited, -1), wrench_at))[: len(after)]
    out_at = np.maximum(arrived, np.concatenate((np.full(len(kept_ns), -1), joint_at))[after])
    found, good, oldest = joints.interpolate(
        joint_ns,
        np.concatenate((kept_joints.reshape(-1, arrivals.joints.shape[1]), arrivals.joints)),
        wrench_ns[: len(after)],
    )
    # The newest sample then; the buffer may have dropped what lies its capacity behind it.
    seen = np.concatenate((np.zeros(waited, dtype=int), seen))[: len(after)]
    newest = np.maximum(after, seen - 1)
    rejected = ~good | (newest - oldest >= joints.capacity)

    end = min(
        _first(dropped, wrench_at, len(arrivals.is_wrench)),
        _first(rejected, out_at, len(arrivals.is_wrench)),
    )
    out = np.searchsorted(out_at, end, side="left")
    return arrivals.first(end), found[:out]


def _in_line(
    arrivals: Arrivals,
    newest_wrench_ns: int | None,
    newest_joints_ns: int | None,
    limits: SampleLimits,
    jumps: np.ndarray,
) -> int:
    fine = np.empty(len(arrivals.is_wrench), dtype=bool)
    fine[~arrivals.is_wrench] = (
        arrivals.joint_usable
        & limits.regular_steps(arrivals.joint_stamp_ns, newest_joints_ns)
        & np.isfinite(arrivals.joints).all(axis=1)
        & ~jumps
    )
    fine[arrivals.is_wrench] = (
        arrivals.wrench_usable
        & (arrivals.wrench_stamp_ns > 0)
        & limits.regular_steps(arrivals.wrench_stamp_ns, newest_wrench_ns)
        & surely_finite(arrivals.wrenches)
    )
    return _first(~fine, np.arange(len(fine)), len(fine))


def _jumps(
    stamp_ns: np.ndarray,
    angles: Array,
    reported: tuple[int, tuple[float, ...]] | None,
    joints: JointBuffer,
) -> np.ndarray:
    """Which joint samples the arm can't have turned to from the one before."""
    if not len(stamp_ns):
        return np.zeros(0, dtype=bool)
    before_ns, before = (stamp_ns[0] - 1, angles[0]) if reported is None else reported
    previous = np.vstack((before, angles[:-1]))
    step_rad = np.abs(joints.nearest(angles, previous) - previous).max(axis=1)
    return np.asarray(joint_jump(np.diff(stamp_ns, prepend=before_ns), step_rad))


def _first(marks: np.ndarray, at: np.ndarray, none: int) -> int:
    """Where the first mark is; `none` if there is none."""
    marked = np.flatnonzero(marks)
    return int(at[marked[0]]) if len(marked) else none
